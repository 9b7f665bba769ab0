//! Blur by binomial weights, with zeros around the map if wanted (sizes rounded down).
//!
//! Windows of 3x3 on maps that keep their size go down strips of columns, with the sums of three rows in registers. For all others,
//! weighted sums of rows go to a band of rows in the scratch, and weighted sums of the band's columns to the output. A band is
//! written whole before it is read: a vector that is read across two that were just written would wait for both.

use crate::pool::PoolShape;
use crate::simd::{ALIGNMENT, Simd, align, get, get_first, put_first};

/// Largest height and width of a window.
pub const MAX_TAPS: usize = 7;

/// Rows of a band at most: they stay in the first-level cache.
const BAND: usize = 16;

/// The sizes of a blur.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BlurShape {
    /// The map and the windows. Use [`BlurShape::out_h`] and [`BlurShape::out_w`]: those of this field know nothing of the padding.
    pub windows: PoolShape,
    /// Rows of zeros above the map and as many below it, fewer than the window's.
    pub pad_h: usize,
    /// Columns of zeros on either side of the map, fewer than the window's.
    pub pad_w: usize,
}

impl BlurShape {
    /// The same windows on the map with its padding.
    pub(crate) fn padded(&self) -> PoolShape {
        let PoolShape { h, w, .. } = self.windows;
        PoolShape { h: h + 2 * self.pad_h, w: w + 2 * self.pad_w, ..self.windows }
    }

    /// Output height: windows that fit, 0 if the window is higher than the map with its padding.
    pub fn out_h(&self) -> usize {
        self.padded().out_h()
    }

    /// Output width: windows that fit, 0 if the window is wider than the map with its padding.
    pub fn out_w(&self) -> usize {
        self.padded().out_w()
    }

    /// Length of the scratch that the kernels need.
    pub fn scratch_len(&self) -> usize {
        let PoolShape { h, w, .. } = self.windows;
        ALIGNMENT + BAND.min(h.max(self.out_h())) * band_width(w.max(self.out_w()))
    }

    /// Checks the lengths of a batch of inputs and one of outputs.
    fn check(&self, kernel: &str, n: usize, x_len: usize, y_len: usize) {
        let PoolShape { c, h, w, kh, kw, stride_h, stride_w } = self.windows;
        assert!(stride_h > 0 && stride_w > 0, "{kernel}: {self:?} has a stride of 0");
        assert!(self.pad_h < kh && self.pad_w < kw, "{kernel}: the padding of {self:?} is not less than the window");
        assert_eq!(x_len, n * c * h * w, "{kernel}: input length for {n} of {self:?}");
        assert_eq!(y_len, n * c * self.out_h() * self.out_w(), "{kernel}: output length for {n} of {self:?}");
    }
}

/// Length of a row of a band for maps up to `widest` columns: zeros before them, and after them to the end of the last vector that is
/// read.
fn band_width(widest: usize) -> usize {
    ALIGNMENT + widest.next_multiple_of(ALIGNMENT) + ALIGNMENT
}

/// The weights of `taps` places, row `taps - 1` of Pascal's triangle over its sum: 1/4, 2/4, 1/4 for three. The rest is 0.
///
/// # Panics
/// Panics if there are more than [`MAX_TAPS`], or none.
pub fn binomial(taps: usize) -> [f32; MAX_TAPS] {
    assert!((1..=MAX_TAPS).contains(&taps), "a blur of {taps} taps");
    let mut weights = [0.0; MAX_TAPS];
    weights[0] = 1.0;
    for last in 1..taps {
        for k in (1..=last).rev() {
            weights[k] = 0.5 * (weights[k] + weights[k - 1]);
        }
        weights[0] *= 0.5;
    }
    weights
}

/// The blur of one batch from maps of `from` to maps of `to` (height, width), `pads` rows and columns of zeros around those of `from`.
#[derive(Clone, Copy, Debug)]
struct Maps {
    count: usize,
    from: [usize; 2],
    to: [usize; 2],
    taps: [usize; 2],
    strides: [usize; 2],
    pads: [usize; 2],
}

impl Maps {
    /// Overwrites `y`, the blurred maps of `x`.
    #[inline(always)]
    fn blur<S: Simd>(self, simd: S, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        let Maps { from: [h, w], taps, strides, pads, .. } = self;
        if (taps, strides, pads) == ([3, 3], [1, 1], [1, 1]) && w >= 3 {
            for (x, y) in x.chunks_exact(h * w).zip(y.chunks_exact_mut(h * w)) {
                blur_3x3(simd, w, x, y);
            }
        } else {
            self.blur_bands(simd, x, y, scratch);
        }
    }

    #[inline(always)]
    fn blur_bands<S: Simd>(self, simd: S, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        let Maps { count, from: [h, w], to: [out_h, out_w], taps: [kh, kw], strides: [stride_h, stride_w], pads } =
            self;
        let [pad_h, pad_w] = pads;
        let [down, along] = [kh, kw].map(|taps| binomial(taps).map(|weight| simd.splat(weight)));
        let width = band_width(w.max(out_w));
        let rows = BAND.min(out_h);
        // The columns beside the map stay 0: only the map's are written.
        let band = &mut align(scratch)[..rows * width];
        band.fill(0.0);
        for map in 0..count {
            let (x, y) = (&x[map * h * w..][..h * w], &mut y[map * out_h * out_w..][..out_h * out_w]);
            for (index, y) in y.chunks_mut(rows * out_w).enumerate() {
                for (row, sums) in (index * rows..out_h).zip(band.chunks_exact_mut(width)) {
                    // The first row of the window, counted from the first row of padding.
                    let top = row * stride_h;
                    let sums = &mut sums[ALIGNMENT..][..w];
                    if top >= pad_h && top + kh <= h + pad_h {
                        weighted_sums(simd, &down[..kh], &x[(top - pad_h) * w..][..kh * w], w, sums);
                    } else {
                        let (first, end) = (pad_h.saturating_sub(top), kh.min(h + pad_h - top));
                        let x = &x[(top + first - pad_h) * w..][..(end - first) * w];
                        weighted_sums(simd, &down[first..end], x, w, sums);
                    }
                }
                for (y, sums) in y.chunks_exact_mut(out_w).zip(band.chunks_exact(width)) {
                    let sums = &sums[ALIGNMENT - pad_w..];
                    if stride_w == 1 {
                        weighted_sums(simd, &along[..kw], sums, 1, y);
                    } else {
                        let weights = binomial(kw);
                        for (column, y) in y.iter_mut().enumerate() {
                            let window = &sums[column * stride_w..][..kw];
                            *y = window.iter().zip(weights).map(|(sum, weight)| weight * sum).sum();
                        }
                    }
                }
            }
        }
    }
}

/// Overwrites `y`, a map of rows of `w >= 3`: the blur of `x` by windows of 3x3 with stride 1 and zeros around.
#[inline(always)]
fn blur_3x3<S: Simd>(simd: S, w: usize, x: &[f32], y: &mut [f32]) {
    for (column, neighbour) in [(0, 1), (w - 1, w - 2)] {
        let sum = |row: &[f32]| row[column] + 0.5 * row[neighbour];
        let mut below = x.chunks_exact(w).map(sum);
        let (mut above, mut here) = (0.0, below.next().unwrap_or(0.0));
        for y in y.chunks_exact_mut(w) {
            let next = below.next().unwrap_or(0.0);
            y[column] = 0.25 * (here + 0.5 * (above + next));
            (above, here) = (here, next);
        }
    }
    let end = w - 1;
    for column in (1..end).step_by(S::LANES) {
        if column + S::LANES <= end {
            strip_3x3(simd, w, column, S::LANES, x, y);
        } else if end > S::LANES {
            // A whole vector computes some columns again, at less cost than a part of one.
            strip_3x3(simd, w, end - S::LANES, S::LANES, x, y);
        } else {
            strip_3x3(simd, w, column, end - column, x, y);
        }
    }
}

/// [`blur_3x3`] of the `count` columns from `column` on, which have neighbours on both sides.
#[inline(always)]
fn strip_3x3<S: Simd>(simd: S, w: usize, column: usize, count: usize, x: &[f32], y: &mut [f32]) {
    let (zero, quarter) = (simd.splat(0.0), simd.splat(0.25));
    let (mut above, mut here) = (zero, across_3(simd, x, column, count));
    for (at, y) in y.chunks_exact_mut(w).enumerate() {
        let next = (at + 1) * w;
        let below = if next < x.len() { across_3(simd, x, next + column, count) } else { zero };
        put_first(simd, y, column, simd.mul_add(quarter, middle_of_3(simd, above, here, below), zero), count);
        (above, here) = (here, below);
    }
}

/// The `count` values from `at` on, each with half of its neighbours.
#[inline(always)]
fn across_3<S: Simd>(simd: S, x: &[f32], at: usize, count: usize) -> S::V {
    if count == S::LANES {
        middle_of_3(simd, get(simd, x, at - 1), get(simd, x, at), get(simd, x, at + 1))
    } else {
        let before = get_first(simd, x, at - 1, count);
        middle_of_3(simd, before, get_first(simd, x, at, count), get_first(simd, x, at + 1, count))
    }
}

#[inline(always)]
fn middle_of_3<S: Simd>(simd: S, before: S::V, middle: S::V, after: S::V) -> S::V {
    simd.mul_add(simd.splat(0.5), simd.mul_add(simd.splat(1.0), before, after), middle)
}

/// Overwrites `y`: `y[i]` is the sum over k of `weights[k] x[i + k step]`.
#[inline(always)]
fn weighted_sums<S: Simd>(simd: S, weights: &[S::V], x: &[f32], step: usize, y: &mut [f32]) {
    let whole = y.len() / S::LANES * S::LANES;
    for at in (0..whole).step_by(S::LANES) {
        let mut sum = simd.splat(0.0);
        for (tap, &weight) in weights.iter().enumerate() {
            sum = simd.mul_add(weight, get(simd, x, at + tap * step), sum);
        }
        put_first(simd, y, at, sum, S::LANES);
    }
    let rest = y.len() - whole;
    if rest > 0 {
        let mut sum = simd.splat(0.0);
        for (tap, &weight) in weights.iter().enumerate() {
            sum = simd.mul_add(weight, get_first(simd, x, whole + tap * step, rest), sum);
        }
        put_first(simd, y, whole, sum, rest);
    }
}

per_isa! {
    /// `y[i][j] = Σ_{k,l} a_k b_l x[i·s + k - p][j·s + l - p]` in each channel, a and b [`binomial`], x 0 outside the map. `x`:
    /// `[n][c][h][w]`, `y`: `[n][c][out_h][out_w]`, overwritten; `scratch` as [`BlurShape::scratch_len`] says.
    pub fn blur_forward<S>(simd: S, shape: &BlurShape, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        shape.check("blur_forward", n, x.len(), y.len());
        let PoolShape { c, h, w, kh, kw, stride_h, stride_w } = shape.windows;
        if y.is_empty() {
            return;
        }
        let maps = Maps {
            count: n * c,
            from: [h, w],
            to: [shape.out_h(), shape.out_w()],
            taps: [kh, kw],
            strides: [stride_h, stride_w],
            pads: [shape.pad_h, shape.pad_w],
        };
        maps.blur(simd, x, y, scratch);
    }
}

per_isa! {
    /// The gradient of [`blur_forward`], `y[i][j] = Σ_{k,l} a_k b_l x[i·s + k - p][j·s + l - p]`: `dx[i·s + k - p][j·s + l - p] +=
    /// a_k b_l dy[i][j]` where that lies in the map. `dx` is overwritten; `scratch` as for [`blur_forward`].
    pub fn blur_backward<S>(simd: S, shape: &BlurShape, n: usize, dy: &[f32], dx: &mut [f32], scratch: &mut [f32]) {
        shape.check("blur_backward", n, dx.len(), dy.len());
        let PoolShape { c, h, w, kh, kw, stride_h, stride_w } = shape.windows;
        let (out_h, out_w) = (shape.out_h(), shape.out_w());
        if dy.is_empty() {
            dx.fill(0.0);
        } else if (stride_h, stride_w) == (1, 1) {
            // The weights are symmetric: what an output takes from its inputs, an input takes from its outputs.
            let maps = Maps {
                count: n * c,
                from: [out_h, out_w],
                to: [h, w],
                taps: [kh, kw],
                strides: [1, 1],
                pads: [kh - 1 - shape.pad_h, kw - 1 - shape.pad_w],
            };
            maps.blur(simd, dy, dx, scratch);
        } else {
            dx.fill(0.0);
            let (down, along) = (binomial(kh), binomial(kw));
            let row = &mut scratch[..w + 2 * shape.pad_w];
            for (dx, dy) in dx.chunks_exact_mut(h * w).zip(dy.chunks_exact(out_h * out_w)) {
                for (oy, dy) in dy.chunks_exact(out_w).enumerate() {
                    row.fill(0.0);
                    for (kx, &weight) in along[..kw].iter().enumerate() {
                        for (sum, &dy) in row[kx..].iter_mut().step_by(stride_w).zip(dy) {
                            *sum += weight * dy;
                        }
                    }
                    for (ky, &weight) in down[..kh].iter().enumerate() {
                        let Some(y) = (oy * stride_h + ky).checked_sub(shape.pad_h).filter(|y| *y < h) else { continue };
                        for (dx, &sum) in dx[y * w..][..w].iter_mut().zip(&row[shape.pad_w..]) {
                            *dx += weight * sum;
                        }
                    }
                }
            }
        }
    }
}
