//! The phases of a strided axis.

/// The rows, or columns, of the input whose position leaves the same remainder when divided by the stride.
///
/// With `i + pad = q * stride + remainder`, input row `i` is touched by the taps `k = remainder + j * stride`, and meets the
/// output rows `q - j`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Phase {
    /// The remainder.
    pub remainder: usize,
    /// Number of taps that touch these rows.
    pub taps: usize,
    /// The first quotient `q`.
    pub first: usize,
    /// Number of quotients.
    pub count: usize,
}

/// The phases of one axis that have any rows and taps.
pub(super) fn phases(len: usize, kernel: usize, stride: usize, pad: usize) -> Vec<Phase> {
    let phase = |remainder: usize| {
        let first = pad.saturating_sub(remainder).div_ceil(stride);
        let end = (len + pad).saturating_sub(remainder).div_ceil(stride);
        Phase { remainder, taps: (kernel - remainder).div_ceil(stride), first, count: end.saturating_sub(first) }
    };
    (0..stride.min(kernel)).map(phase).filter(|phase| phase.count > 0).collect()
}
