//! The windows of two rows, and the slopes of their rectifier.

use crate::simd::{ALIGNMENT, Purpose, Simd, get_pairs};

/// Kind of slopes: 0 everywhere (ReLU).
pub(super) const ZERO: u8 = 0;
/// Kind of slopes: one for the whole channel.
pub(super) const ONE: u8 = 1;
/// Kind of slopes: one for each element.
pub(super) const EACH: u8 = 2;

/// Distance of a prefetch ahead of the work in `x`, in elements. The two rows of windows are two streams next to each other, which
/// hardware prefetchers do not predict well.
const AHEAD: usize = 1024;

/// Prefetches the elements of two rows of windows that are read `AHEAD` elements later. A step reads `2 * LANES` elements of each
/// row.
#[inline(always)]
pub(super) fn prefetch_windows<S: Simd>(simd: S, x: *const f32, at: usize) {
    for line in (0..4 * S::LANES).step_by(ALIGNMENT) {
        simd.prefetch(x.wrapping_add(AHEAD + 4 * at + line), Purpose::ReadSoon);
    }
}

/// The four values of each of the `count` windows from window `at` on, at most `LANES`, in row-major order. The windows are in the
/// order of [`Simd::load_pairs`].
#[inline(always)]
pub(super) fn get_windows<S: Simd>(simd: S, rows: [&[f32]; 2], at: usize, count: usize) -> [S::V; 4] {
    let [a, b] = get_pairs(simd, rows[0], 2 * at, count);
    let [c, d] = get_pairs(simd, rows[1], 2 * at, count);
    [a, b, c, d]
}

/// `f(z)`. A NaN becomes 0 with ReLU and stays NaN with slopes.
#[inline(always)]
pub(super) fn rectified<S: Simd, const SLOPES: u8>(simd: S, z: S::V, slope: S::V) -> S::V {
    let zero = simd.splat(0.0);
    if SLOPES == ZERO { simd.max(z, zero) } else { simd.select_greater(z, zero, z, simd.mul_add(z, slope, zero)) }
}

/// The rectified values of windows, and the maximum of each window. With ReLU the values stay as they are: ReLU is monotonic, so it
/// commutes with max, and where the maximum is above 0 it has the same argmax.
#[inline(always)]
pub(super) fn largest<S: Simd, const SLOPES: u8>(simd: S, z: [S::V; 4], slopes: [S::V; 4]) -> ([S::V; 4], S::V) {
    let mut f = z;
    if SLOPES != ZERO {
        for i in 0..4 {
            f[i] = rectified::<S, SLOPES>(simd, z[i], slopes[i]);
        }
    }
    let mut max = if SLOPES == ZERO { simd.splat(0.0) } else { f[0] };
    for f in f {
        // `max(a, b)` is `b` if either is NaN: a NaN is skipped, but one that comes first, with slopes, stays.
        max = simd.max(f, max);
    }
    (f, max)
}
