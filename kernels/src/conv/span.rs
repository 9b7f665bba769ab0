//! The output positions that each vector holds.

/// One vector of output positions of an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Span {
    /// Where the first lane's window begins in an input plane.
    pub start: usize,
    /// Index of the first lane's output in the output plane.
    pub out: usize,
    /// The lanes that hold an output. The others lie between two rows; what they compute is dropped.
    pub lanes: u32,
}

impl Span {
    /// Lanes up to the last that holds an output.
    pub fn reach(&self) -> usize {
        (32 - self.lanes.leading_zeros()) as usize
    }
}

/// Cuts an output of `out_h` rows of `out_w` into vectors of `width` lanes.
///
/// The window of output (oy, ox) begins at `oy * pitch + ox` of the input plane, so neighbouring lanes read
/// neighbouring elements even across the end of a row. A vector that straddles rows wastes only the lanes between
/// them; short rows therefore fill vectors nearly as well as long ones.
pub(crate) fn spans(out_h: usize, out_w: usize, pitch: usize, width: usize) -> Vec<Span> {
    let (mut spans, mut out) = (Vec::new(), 0);
    while out < out_h * out_w {
        let start = out / out_w * pitch + out % out_w;
        let holds = |lane: &usize| {
            let at = start + lane;
            at % pitch < out_w && at / pitch < out_h
        };
        let lanes = (0..width).filter(holds).fold(0, |lanes, lane| lanes | 1 << lane);
        spans.push(Span { start, out, lanes });
        out += lanes.count_ones() as usize;
    }
    spans
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_output_is_in_one_lane_and_in_order() {
        for (out_h, out_w, pitch, width) in
            [(3, 5, 7, 4), (1, 16, 18, 16), (4, 1, 3, 8), (6, 36, 38, 16), (2, 3, 40, 16)]
        {
            let mut seen = Vec::new();
            for span in spans(out_h, out_w, pitch, width) {
                assert_eq!(span.out, seen.len());
                let lanes = (0..width).filter(|lane| span.lanes >> lane & 1 == 1);
                seen.extend(lanes.map(|lane| span.start + lane));
            }
            let expected: Vec<usize> = (0..out_h * out_w).map(|p| p / out_w * pitch + p % out_w).collect();
            assert_eq!(seen, expected);
        }
    }
}
