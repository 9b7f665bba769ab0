//! Resizing of 8-bit images with the semantics of OpenCV's `INTER_LINEAR` and `INTER_AREA`.
//!
//! Both use pixel centres: output pixel x covers source positions around `(x + 0.5) * scale - 0.5`. The result is rounded
//! to 8 bits; that rounding is part of preprocessing, so training and driving see the same grey levels.

use serde::{Deserialize, Serialize};

/// How an image is resized.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Interpolation {
    /// Between the two nearest source pixels in each direction (`INTER_LINEAR`). Exact halving averages 2x2 pixels.
    #[default]
    Linear,
    /// The mean over the area an output pixel covers (`INTER_AREA`). Where it enlarges, it is a kind of linear.
    Area,
}

/// Fixed-point one of the linear weights.
const ONE: i32 = 1 << 11;

/// A planned resize of `[h][w][channels]` bytes.
#[derive(Debug, Clone)]
pub struct Resizer {
    from: [usize; 2],
    to: [usize; 2],
    channels: usize,
    method: Method,
}

/// How a planned resize goes about it.
#[derive(Debug, Clone)]
pub(crate) enum Method {
    Copy,
    Halve,
    Linear { x: Vec<LinearTap>, y: Vec<LinearTap>, rows: [Vec<i32>; 2] },
    Area { x: AreaTaps, y: AreaTaps, sum: Vec<f32> },
}

/// An output position lies between source positions `low` and `high`, with weights that sum to [`ONE`].
#[derive(Debug, Clone, Copy)]
pub(crate) struct LinearTap {
    pub low: usize,
    pub high: usize,
    pub weights: [i32; 2],
}

/// Which source positions an output position covers: `weights[starts[i]..starts[i + 1]]` from source `first[i]` on.
#[derive(Debug, Clone)]
pub(crate) struct AreaTaps {
    pub first: Vec<usize>,
    pub starts: Vec<usize>,
    pub weights: Vec<f32>,
}

impl Resizer {
    /// Plans a resize of an image of `from` = [height, width] to `to`, with `channels` interleaved channels.
    ///
    /// # Panics
    /// If a size is 0 or there are neither 1 nor 3 channels.
    pub fn new(from: [usize; 2], to: [usize; 2], channels: usize, interpolation: Interpolation) -> Self {
        assert!(from.iter().chain(&to).all(|&n| n > 0), "resize {from:?} to {to:?}");
        assert!(channels == 1 || channels == 3, "images have 1 or 3 channels, not {channels}");
        let shrinks = (0..2).all(|i| from[i] >= to[i]);
        let method = if from == to {
            Method::Copy
        } else if from == to.map(|n| 2 * n) {
            Method::Halve
        } else if interpolation == Interpolation::Area && shrinks {
            let [y, x] = [0, 1].map(|i| AreaTaps::new(from[i], to[i]));
            Method::Area { x, y, sum: vec![0.0; from[1] * channels] }
        } else {
            let [y, x] = [0, 1].map(|i| linear_taps(from[i], to[i], interpolation));
            Method::Linear { x, y, rows: [0, 1].map(|_| vec![0; to[1] * channels]) }
        };
        Self { from, to, channels, method }
    }

    /// How it goes about it.
    pub(crate) fn method(&self) -> &Method {
        &self.method
    }

    /// Height and width of the result.
    pub fn to(&self) -> [usize; 2] {
        self.to
    }

    /// Resizes `src` (`[h][w][channels]`) into `dst`.
    ///
    /// # Panics
    /// If the lengths are not those planned for.
    pub fn apply(&mut self, src: &[u8], dst: &mut [u8]) {
        let c = self.channels;
        assert_eq!(src.len(), self.from[0] * self.from[1] * c, "source of a resize from {:?}", self.from);
        assert_eq!(dst.len(), self.to[0] * self.to[1] * c, "result of a resize to {:?}", self.to);
        let [src_row, dst_row] = [self.from[1] * c, self.to[1] * c];
        match &mut self.method {
            Method::Copy => dst.copy_from_slice(src),
            Method::Halve => halve(src, dst, src_row, dst_row, c),
            Method::Linear { x, y, rows } => linear(src, dst, src_row, dst_row, c, x, y, rows),
            Method::Area { x, y, sum } => area(src, dst, src_row, dst_row, c, x, y, sum),
        }
    }
}

/// Source pixels per output pixel, rounded as OpenCV does: its `INTER_AREA` is sensitive to the last bit.
fn source_step(from: usize, to: usize) -> f64 {
    1.0 / (to as f64 / from as f64)
}

fn linear_taps(from: usize, to: usize, interpolation: Interpolation) -> Vec<LinearTap> {
    let scale = source_step(from, to);
    let tap = |i: usize| {
        let (low, fraction) = match interpolation {
            Interpolation::Linear => {
                let position = ((i as f64 + 0.5) * scale - 0.5) as f32;
                (position.floor() as isize, position - position.floor())
            }
            // Where it enlarges, OpenCV's area method blends only in the output pixels that straddle a border.
            Interpolation::Area => {
                let low = (i as f64 * scale).floor();
                let fraction = ((i + 1) as f64 - (low + 1.0) / scale) as f32;
                (low as isize, if fraction <= 0.0 { 0.0 } else { fraction - fraction.floor() })
            }
        };
        let last = from as isize - 1;
        let (low, fraction) = if low < 0 {
            (0, 0.0)
        } else if low >= last {
            (last, 0.0)
        } else {
            (low, fraction)
        };
        let upper = (fraction * ONE as f32).round_ties_even() as i32;
        LinearTap { low: low as usize, high: (low + 1).min(last) as usize, weights: [ONE - upper, upper] }
    };
    (0..to).map(tap).collect()
}

impl AreaTaps {
    fn new(from: usize, to: usize) -> Self {
        let scale = source_step(from, to);
        let mut taps = Self { first: Vec::new(), starts: vec![0], weights: Vec::new() };
        for i in 0..to {
            let (begin, end) = (i as f64 * scale, ((i + 1) as f64 * scale).min(from as f64));
            let cell = end - begin;
            // Slivers below a thousandth of a pixel are rounding noise of `scale`.
            let first = if begin.ceil() - begin > 1e-3 { begin.floor() } else { begin.ceil() } as usize;
            let last = if end - end.floor() > 1e-3 { end.ceil() } else { end.floor() } as usize;
            taps.first.push(first);
            for position in first..last {
                let covered = ((position + 1) as f64).min(end) - (position as f64).max(begin);
                taps.weights.push((covered.min(1.0) / cell) as f32);
            }
            taps.starts.push(taps.weights.len());
        }
        taps
    }

    /// First source position and weights of output position `i`.
    pub fn of(&self, i: usize) -> (usize, &[f32]) {
        (self.first[i], &self.weights[self.starts[i]..self.starts[i + 1]])
    }
}

/// The mean of each 2x2 block, rounded half up.
fn halve(src: &[u8], dst: &mut [u8], src_row: usize, dst_row: usize, c: usize) {
    for (rows, out) in src.chunks_exact(2 * src_row).zip(dst.chunks_exact_mut(dst_row)) {
        let (top, bottom) = rows.split_at(src_row);
        if c == 1 { halve_row::<1>(top, bottom, out) } else { halve_row::<3>(top, bottom, out) }
    }
}

#[inline(always)]
fn halve_row<const C: usize>(top: &[u8], bottom: &[u8], out: &mut [u8]) {
    let blocks = top.chunks_exact(2 * C).zip(bottom.chunks_exact(2 * C)).zip(out.chunks_exact_mut(C));
    for ((a, b), out) in blocks {
        for i in 0..C {
            let sum = u16::from(a[i]) + u16::from(a[i + C]) + u16::from(b[i]) + u16::from(b[i + C]);
            out[i] = ((sum + 2) >> 2) as u8;
        }
    }
}

#[expect(clippy::too_many_arguments, reason = "one call site; the arguments are the fields of a plan")]
fn linear(
    src: &[u8],
    dst: &mut [u8],
    src_row: usize,
    dst_row: usize,
    c: usize,
    x: &[LinearTap],
    y: &[LinearTap],
    rows: &mut [Vec<i32>; 2],
) {
    // The two source rows last resized horizontally; output rows go down, so most are used twice.
    let mut held = [usize::MAX; 2];
    let horizontal = |row: usize, out: &mut [i32]| {
        let row = &src[row * src_row..][..src_row];
        if c == 1 { blend_row::<1>(row, x, out) } else { blend_row::<3>(row, x, out) }
    };
    for (tap, out) in y.iter().zip(dst.chunks_exact_mut(dst_row)) {
        if held[1] == tap.low {
            rows.swap(0, 1);
            held.swap(0, 1);
        }
        for (slot, source) in [tap.low, tap.high].into_iter().enumerate() {
            if held[slot] != source {
                horizontal(source, &mut rows[slot]);
                held[slot] = source;
            }
        }
        let [low, high] = tap.weights;
        for ((out, &a), &b) in out.iter_mut().zip(&rows[0]).zip(&rows[1]) {
            *out = ((((low * (a >> 4)) >> 16) + ((high * (b >> 4)) >> 16) + 2) >> 2) as u8;
        }
    }
}

/// One source row between its pixels, as [`ONE`] times the grey level.
#[inline(always)]
fn blend_row<const C: usize>(row: &[u8], x: &[LinearTap], out: &mut [i32]) {
    let pixels = row.as_chunks::<C>().0;
    for (tap, out) in x.iter().zip(out.as_chunks_mut::<C>().0) {
        let (low, high) = (&pixels[tap.low], &pixels[tap.high]);
        *out = std::array::from_fn(|i| i32::from(low[i]) * tap.weights[0] + i32::from(high[i]) * tap.weights[1]);
    }
}

#[expect(clippy::too_many_arguments, reason = "one call site; the arguments are the fields of a plan")]
fn area(
    src: &[u8],
    dst: &mut [u8],
    src_row: usize,
    dst_row: usize,
    c: usize,
    x: &AreaTaps,
    y: &AreaTaps,
    sum: &mut [f32],
) {
    // Down first: that loop runs along whole rows, and each output row is then narrowed only once.
    for (i, out) in dst.chunks_exact_mut(dst_row).enumerate() {
        let (first, weights) = y.of(i);
        sum.fill(0.0);
        for (source, &weight) in src.chunks_exact(src_row).skip(first).zip(weights) {
            for (sum, &value) in sum.iter_mut().zip(source) {
                *sum += f32::from(value) * weight;
            }
        }
        if c == 1 { narrow_row::<1>(sum, x, out) } else { narrow_row::<3>(sum, x, out) }
    }
}

#[inline(always)]
fn narrow_row<const C: usize>(row: &[f32], x: &AreaTaps, out: &mut [u8]) {
    let pixels = row.as_chunks::<C>().0;
    for (i, out) in out.as_chunks_mut::<C>().0.iter_mut().enumerate() {
        let (first, weights) = x.of(i);
        let mut cell = [0.0_f32; C];
        for (pixel, &weight) in pixels[first..].iter().zip(weights) {
            for (cell, &value) in cell.iter_mut().zip(pixel) {
                *cell += value * weight;
            }
        }
        *out = cell.map(to_u8);
    }
}

/// Rounds half to even; the sum of weights is 1 up to rounding, so `x` lies in 0..256.
///
/// Adding and taking away 2^23 rounds in the addition, which costs less than a call of a rounding function.
#[inline(always)]
fn to_u8(x: f32) -> u8 {
    const SHIFT: f32 = 8_388_608.0;
    ((x + SHIFT) - SHIFT) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    fn resize(src: &[u8], from: [usize; 2], to: [usize; 2], c: usize, interpolation: Interpolation) -> Vec<u8> {
        let mut out = vec![0; to[0] * to[1] * c];
        Resizer::new(from, to, c, interpolation).apply(src, &mut out);
        out
    }

    #[test]
    fn halving_averages_blocks_and_rounds_half_up() {
        let src = [1, 2, 10, 20, 3, 4, 30, 41];
        for interpolation in [Interpolation::Linear, Interpolation::Area] {
            assert_eq!(resize(&src, [2, 4], [1, 2], 1, interpolation), [3, 25]);
        }
        let rgb = [0, 100, 200, 2, 102, 202, 4, 104, 204, 6, 106, 206];
        assert_eq!(resize(&rgb, [2, 2], [1, 1], 3, Interpolation::Linear), [3, 103, 203]);
    }

    #[test]
    fn linear_enlarges_between_pixel_centres() {
        // Centres of 4 output pixels over 2 source pixels: -0.25, 0.25, 0.75, 1.25.
        assert_eq!(resize(&[0, 100], [1, 2], [1, 4], 1, Interpolation::Linear), [0, 25, 75, 100]);
        assert_eq!(resize(&[0, 100], [2, 1], [4, 1], 1, Interpolation::Linear), [0, 25, 75, 100]);
    }

    #[test]
    fn area_weighs_by_the_part_covered() {
        // 3 -> 2: each output covers 1.5 source pixels, so (a + b/2) / 1.5.
        assert_eq!(resize(&[30, 60, 90], [1, 3], [1, 2], 1, Interpolation::Area), [40, 80]);
        assert_eq!(resize(&[10, 20, 30, 40, 50, 60], [1, 6], [1, 2], 1, Interpolation::Area), [20, 50]);
        assert_eq!(resize(&[10, 20, 30, 40, 50, 60], [6, 1], [2, 1], 1, Interpolation::Area), [20, 50]);
    }

    #[test]
    fn a_constant_image_stays_constant() {
        for interpolation in [Interpolation::Linear, Interpolation::Area] {
            for to in [[5, 7], [13, 29], [40, 3], [3, 40], [17, 23]] {
                let out = resize(&[201; 17 * 23 * 3], [17, 23], to, 3, interpolation);
                assert!(out.iter().all(|&x| x == 201), "{interpolation:?} {to:?}");
            }
        }
    }

    #[test]
    fn planned_buffers_can_be_used_again() {
        let mut resizer = Resizer::new([4, 4], [3, 3], 1, Interpolation::Linear);
        let (mut first, mut second) = ([0; 9], [0; 9]);
        let dark: Vec<u8> = (0..16).collect();
        resizer.apply(&dark, &mut first);
        resizer.apply(&[255; 16], &mut second);
        resizer.apply(&dark, &mut second);
        assert_eq!(first, second);
    }
}
