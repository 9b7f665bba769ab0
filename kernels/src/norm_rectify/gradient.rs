//! The gradient of pooling and rectifier, which both passes need.

use super::windows::{EACH, ZERO, get_windows, largest};
use crate::simd::{Simd, get_first, put_pairs};

/// The numbers of a channel that its gradient needs.
#[derive(Clone, Copy)]
pub(super) struct Line {
    /// `z = x scale + shift`.
    pub scale: f32,
    pub shift: f32,
    pub mean: f32,
    /// The slope, if the channel has a single one.
    pub slope: f32,
    /// `dx = dz gain + x slope_x + offset`.
    pub gain: f32,
    pub slope_x: f32,
    pub offset: f32,
}

/// The output gradient and the slopes of two rows of windows; without pooling, `below` is empty.
#[derive(Clone, Copy)]
pub(super) struct Rows<'a> {
    pub dy: &'a [f32],
    /// The slopes of each row, if each element has its own.
    pub above: &'a [f32],
    pub below: &'a [f32],
}

/// The inputs and outputs of the rectifier for a vector of windows.
pub(super) struct Windows<S: Simd> {
    z: [S::V; 4],
    slopes: [S::V; 4],
    f: [S::V; 4],
    max: S::V,
}

impl<S: Simd> Windows<S> {
    /// The windows whose values are `x`.
    #[inline(always)]
    pub fn new<const SLOPES: u8>(
        simd: S,
        line: &Line,
        x: [S::V; 4],
        rows: Rows,
        at: usize,
        count: usize,
    ) -> Windows<S> {
        let (scale, shift) = (simd.splat(line.scale), simd.splat(line.shift));
        let mut z = x;
        for i in 0..4 {
            z[i] = simd.mul_add(x[i], scale, shift);
        }
        let slopes = if SLOPES == EACH {
            get_windows(simd, [rows.above, rows.below], at, count)
        } else {
            [simd.splat(line.slope); 4]
        };
        let (f, max) = largest::<S, SLOPES>(simd, z, slopes);
        Windows { z, slopes, f, max }
    }

    /// The windows that have a gradient at all.
    #[inline(always)]
    pub fn live<const SLOPES: u8>(&self, simd: S) -> S::M {
        // Without ReLU, all but NaN.
        if SLOPES == ZERO { simd.greater(self.max, simd.splat(0.0)) } else { simd.equal(self.max, self.max) }
    }

    /// The argmax of each live window: the first maximum in row-major order, as one mask for each of the four places.
    #[inline(always)]
    pub fn argmax<const SLOPES: u8>(&self, simd: S) -> [S::M; 4] {
        let mut left = self.live::<SLOPES>(simd);
        let mut argmax = [left; 4];
        for i in 0..3 {
            argmax[i] = simd.and(left, simd.equal(self.f[i], self.max));
            left = simd.and_not(left, argmax[i]);
        }
        argmax[3] = left;
        argmax
    }

    /// The value at the argmax of each window.
    #[inline(always)]
    pub fn choose(&self, simd: S, values: [S::V; 4]) -> S::V {
        let mut chosen = values[3];
        for i in [2, 1, 0] {
            chosen = simd.select(simd.equal(self.f[i], self.max), values[i], chosen);
        }
        chosen
    }

    /// The gradient of `z` at the argmax, and of its slope.
    #[inline(always)]
    pub fn gradient<const SLOPES: u8>(&self, simd: S, dy: S::V) -> (S::V, S::V) {
        let zero = simd.splat(0.0);
        if SLOPES == ZERO {
            return (simd.select(self.live::<SLOPES>(simd), dy, zero), zero);
        }
        let z = self.choose(simd, self.z);
        let slope = if SLOPES == EACH { self.choose(simd, self.slopes) } else { self.slopes[0] };
        gradient(simd, z, slope, dy)
    }
}

/// The gradients of `z` and of the slope, for a rectifier with slopes: forward is `f(z) = z` if `z > 0`, else `slope z`.
#[inline(always)]
fn gradient<S: Simd>(simd: S, z: S::V, slope: S::V, dy: S::V) -> (S::V, S::V) {
    let zero = simd.splat(0.0);
    let positive = simd.greater(z, zero);
    let dz = simd.select(positive, dy, simd.mul_add(slope, dy, zero));
    (dz, simd.select(positive, zero, simd.mul_add(z, dy, zero)))
}

/// Writes the four values of each of the `count` windows from window `at` on.
#[inline(always)]
pub(super) fn put_windows<S: Simd>(simd: S, rows: [&mut [f32]; 2], at: usize, v: [S::V; 4], count: usize) {
    let [above, below] = rows;
    put_pairs(simd, above, 2 * at, [v[0], v[1]], count);
    put_pairs(simd, below, 2 * at, [v[2], v[3]], count);
}

/// `dz` of the `count` elements from `at` on, without pooling, and the gradient of their slopes.
#[inline(always)]
pub(super) fn row_gradient<S: Simd, const SLOPES: u8>(
    simd: S,
    line: &Line,
    x: S::V,
    rows: Rows,
    at: usize,
    count: usize,
) -> (S::V, S::V) {
    let zero = simd.splat(0.0);
    let z = simd.mul_add(x, simd.splat(line.scale), simd.splat(line.shift));
    let dy = get_first(simd, rows.dy, at, count);
    if SLOPES == ZERO {
        return (simd.select_greater(z, zero, dy, zero), zero);
    }
    let slope = if SLOPES == EACH { get_first(simd, rows.above, at, count) } else { simd.splat(line.slope) };
    gradient(simd, z, slope, dy)
}
