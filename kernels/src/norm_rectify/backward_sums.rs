//! The first pass of the gradient: its sums.

use super::gradient::{Line, Rows, Windows, put_windows, row_gradient};
use super::operands::{ChannelStatistics, RectifyShape, Slopes};
use super::windows::{EACH, ONE, ZERO, get_windows, prefetch_windows};
use crate::simd::{Simd, get_first, put_first};

/// Vectors that are summed in single precision before their sum is added to one in double precision. A strip ends with a row.
const STRIP: usize = 32;

/// Sums in each lane: of `dz`, of `dz (x - mean)` and of the gradient of a single slope.
type Sums<S> = [<S as Simd>::V; 3];

/// Adds the `count` windows from window `at` on to the sums; returns the new gradients of their slopes, if each element has a slope.
#[inline(always)]
fn sum_windows<S: Simd, const SLOPES: u8>(
    simd: S,
    line: &Line,
    x: [&[f32]; 2],
    rows: Rows,
    dslopes: [&[f32]; 2],
    at: usize,
    count: usize,
    sums: &mut Sums<S>,
) -> [S::V; 4] {
    let x = get_windows(simd, x, at, count);
    let windows = Windows::new::<SLOPES>(simd, line, x, rows, at, count);
    // The lanes of windows that do not exist have a `dy` of 0, so they add nothing.
    let dy = simd.to_pair_order(get_first(simd, rows.dy, at, count));
    let (dz, of_slope) = windows.gradient::<SLOPES>(simd, dy);
    add::<S, SLOPES>(simd, line, windows.choose(simd, x), dz, of_slope, sums);
    if SLOPES != EACH {
        return x;
    }
    let mut new = get_windows(simd, dslopes, at, count);
    let argmax = windows.argmax::<SLOPES>(simd);
    for i in 0..4 {
        new[i] = simd.select(argmax[i], simd.mul_add(of_slope, simd.splat(1.0), new[i]), new[i]);
    }
    new
}

/// Adds the terms of `x` to the sums.
#[inline(always)]
fn add<S: Simd, const SLOPES: u8>(simd: S, line: &Line, x: S::V, dz: S::V, of_slope: S::V, sums: &mut Sums<S>) {
    let one = simd.splat(1.0);
    sums[0] = simd.mul_add(dz, one, sums[0]);
    sums[1] = simd.mul_add(dz, simd.mul_add(x, one, simd.splat(-line.mean)), sums[1]);
    if SLOPES == ONE {
        sums[2] = simd.mul_add(of_slope, one, sums[2]);
    }
}

/// Adds the `count` elements from `at` on to the sums, without pooling.
#[inline(always)]
fn sum_elements<S: Simd, const SLOPES: u8>(
    simd: S,
    line: &Line,
    x: &[f32],
    rows: Rows,
    dslopes: &mut [f32],
    at: usize,
    count: usize,
    sums: &mut Sums<S>,
) {
    let x = get_first(simd, x, at, count);
    let (dz, of_slope) = row_gradient::<S, SLOPES>(simd, line, x, rows, at, count);
    add::<S, SLOPES>(simd, line, x, dz, of_slope, sums);
    if SLOPES == EACH {
        let old = get_first(simd, dslopes, at, count);
        put_first(simd, dslopes, at, simd.mul_add(of_slope, simd.splat(1.0), old), count);
    }
}

/// The sums of a plane.
struct Totals<S: Simd> {
    /// Of the current strip.
    strip: Sums<S>,
    /// Of the strips before it.
    done: [f64; 3],
}

impl<S: Simd> Totals<S> {
    #[inline(always)]
    fn new(simd: S) -> Totals<S> {
        Totals { strip: [simd.splat(0.0); 3], done: [0.0; 3] }
    }

    #[inline(always)]
    fn end_strip<const SLOPES: u8>(&mut self, simd: S) {
        for i in 0..if SLOPES == ONE { 3 } else { 2 } {
            self.done[i] += f64::from(simd.sum(self.strip[i]));
            self.strip[i] = simd.splat(0.0);
        }
    }

    /// Adds a row of windows.
    #[inline(always)]
    fn add_windows<const SLOPES: u8>(&mut self, simd: S, line: &Line, x: &[f32], rows: Rows, dslopes: [&mut [f32]; 2]) {
        let x_rows: [&[f32]; 2] = x.split_at(x.len() / 2).into();
        let [above, below] = dslopes;
        let whole = rows.dy.len() - rows.dy.len() % S::LANES;
        let rest = rows.dy.len() - whole;
        // Read first and written last: see `Line::windows` of the other pass.
        let mut last = [simd.splat(0.0); 4];
        if rest > 0 {
            last = sum_windows::<S, SLOPES>(simd, line, x_rows, rows, [above, below], whole, rest, &mut self.strip);
        }
        for at in (0..whole).step_by(S::LANES) {
            prefetch_windows(simd, x.as_ptr(), at);
            let old = [&*above, &*below];
            let new = sum_windows::<S, SLOPES>(simd, line, x_rows, rows, old, at, S::LANES, &mut self.strip);
            if SLOPES == EACH {
                put_windows(simd, [&mut *above, &mut *below], at, new, S::LANES);
            }
        }
        if SLOPES == EACH && rest > 0 {
            put_windows(simd, [above, below], whole, last, rest);
        }
    }

    /// Adds a plane without pooling.
    #[inline(always)]
    fn add_plane<const SLOPES: u8>(&mut self, simd: S, line: &Line, x: &[f32], rows: Rows, dslopes: &mut [f32]) {
        let whole = x.len() - x.len() % S::LANES;
        for strip in (0..whole).step_by(2 * STRIP * S::LANES) {
            let end = whole.min(strip + 2 * STRIP * S::LANES);
            // Two sums side by side: an addition would wait for the one before.
            let mut other = Totals::new(simd).strip;
            for at in (strip..end).step_by(2 * S::LANES) {
                sum_elements::<S, SLOPES>(simd, line, x, rows, dslopes, at, S::LANES, &mut self.strip);
                if at + S::LANES < end {
                    sum_elements::<S, SLOPES>(simd, line, x, rows, dslopes, at + S::LANES, S::LANES, &mut other);
                }
            }
            for (sum, other) in self.strip.iter_mut().zip(other) {
                *sum = simd.mul_add(other, simd.splat(1.0), *sum);
            }
            self.end_strip::<SLOPES>(simd);
        }
        if whole < x.len() {
            sum_elements::<S, SLOPES>(simd, line, x, rows, dslopes, whole, x.len() - whole, &mut self.strip);
            self.end_strip::<SLOPES>(simd);
        }
    }
}

per_isa! {
    /// The sums of the gradient: adds the sum of each channel of `dz` to `sums[..c]`, that of `dz` times the normalised
    /// `x` to `sums[c..]`, and the gradient of the slopes to `dslopes`, as long as the slopes.
    ///
    /// # Shapes
    /// As for [`forward`](super::forward()), `dy` like `y`.
    ///
    /// # Panics
    /// If a slice has another length.
    pub fn backward_sums<S>(
        simd: S,
        shape: &RectifyShape,
        n: usize,
        x: &[f32],
        dy: &[f32],
        statistics: ChannelStatistics,
        slopes: Slopes,
        sums: &mut [f64],
        dslopes: &mut [f32],
    ) {
        let ChannelStatistics { mean, inv_std, scale, shift } = statistics;
        shape.check("norm_rectify sums", n, x.len(), dy.len(), &[mean, inv_std, scale, shift], slopes);
        assert_eq!(sums.len(), 2 * shape.c, "norm_rectify sums: not 2 c sums");
        assert_eq!(dslopes.len(), slopes.len(), "norm_rectify sums: wrong number of slope gradients");
        if dy.is_empty() {
            return;
        }
        match slopes {
            Slopes::Zero => sums_of::<S, ZERO>(simd, shape, x, dy, statistics, slopes, sums, dslopes),
            Slopes::PerChannel(_) => sums_of::<S, ONE>(simd, shape, x, dy, statistics, slopes, sums, dslopes),
            Slopes::PerPosition(_) => sums_of::<S, EACH>(simd, shape, x, dy, statistics, slopes, sums, dslopes),
        }
    }
}

#[inline(always)]
fn sums_of<S: Simd, const SLOPES: u8>(
    simd: S,
    shape: &RectifyShape,
    x: &[f32],
    dy: &[f32],
    statistics: ChannelStatistics,
    slopes: Slopes,
    sums: &mut [f64],
    dslopes: &mut [f32],
) {
    let &RectifyShape { c, h, w, pooled } = shape;
    let ChannelStatistics { mean, inv_std, scale, shift } = statistics;
    for (plane, (x, dy)) in x.chunks_exact(h * w).zip(dy.chunks_exact(shape.y_plane())).enumerate() {
        let channel = plane % c;
        let (scale, shift, mean) = (scale[channel], shift[channel], mean[channel]);
        let slope = slopes.single(channel);
        let line = Line { scale, shift, mean, slope, gain: 0.0, slope_x: 0.0, offset: 0.0 };
        let mut totals = Totals::new(simd);
        let of_plane = if SLOPES == EACH { channel * h * w..(channel + 1) * h * w } else { 0..0 };
        let plane_slopes = slopes.each(of_plane.clone());
        let plane_dslopes = &mut dslopes[of_plane];
        if pooled {
            let mut vectors = 0;
            for (row, (x, dy)) in x.chunks_exact(2 * w).zip(dy.chunks_exact(w / 2)).enumerate() {
                let both = if SLOPES == EACH { 2 * row * w..2 * (row + 1) * w } else { 0..0 };
                let (above, below) = plane_slopes[both.clone()].split_at(both.len() / 2);
                let (ds_above, ds_below) = plane_dslopes[both.clone()].split_at_mut(both.len() / 2);
                totals.add_windows::<SLOPES>(simd, &line, x, Rows { dy, above, below }, [ds_above, ds_below]);
                vectors += dy.len().div_ceil(S::LANES);
                if vectors >= STRIP {
                    totals.end_strip::<SLOPES>(simd);
                    vectors = 0;
                }
            }
            totals.end_strip::<SLOPES>(simd);
        } else {
            let rows = Rows { dy, above: plane_slopes, below: &[] };
            totals.add_plane::<SLOPES>(simd, &line, x, rows, plane_dslopes);
        }
        let totals = totals.done;
        sums[channel] += totals[0];
        sums[c + channel] += totals[1] * f64::from(inv_std[channel]);
        if SLOPES == ONE {
            dslopes[channel] += totals[2] as f32;
        }
    }
}
