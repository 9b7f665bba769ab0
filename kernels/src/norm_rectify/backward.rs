//! The second pass of the gradient: the gradient of `x`.

use super::gradient::{Line, Rows, Windows, put_windows, row_gradient};
use super::operands::{ChannelMeans, ChannelStatistics, RectifyShape, Slopes};
use super::windows::{EACH, ONE, ZERO, get_windows, prefetch_windows};
use crate::simd::{Simd, get_first, put_first};

/// The gradient of the four values of each of the `count` windows from window `at` on.
#[inline(always)]
fn of_windows<S: Simd, const SLOPES: u8>(
    simd: S,
    line: &Line,
    x: [&[f32]; 2],
    rows: Rows,
    at: usize,
    count: usize,
) -> [S::V; 4] {
    let mut x = get_windows(simd, x, at, count);
    let windows = Windows::new::<SLOPES>(simd, line, x, rows, at, count);
    let dy = simd.to_pair_order(get_first(simd, rows.dy, at, count));
    // A window of ReLU without a gradient has no argmax.
    let dz = if SLOPES == ZERO { dy } else { windows.gradient::<SLOPES>(simd, dy).0 };
    let argmax = windows.argmax::<SLOPES>(simd);
    let (zero, one) = (simd.splat(0.0), simd.splat(1.0));
    let (slope_x, offset) = (simd.splat(line.slope_x), simd.splat(line.offset));
    let dz = simd.mul_add(dz, simd.splat(line.gain), zero);
    for i in 0..4 {
        let rest = simd.mul_add(x[i], slope_x, offset);
        x[i] = simd.select(argmax[i], simd.mul_add(dz, one, rest), rest);
    }
    x
}

per_isa! {
    /// Overwrites `x` with its gradient, `gain[c] (dz - mean_dz[c] - xhat mean_dz_xhat[c])` with `xhat = (x - mean[c]) inv_std[c]`.
    /// Forward was `y = pool(f(x scale[c] + shift[c]))`. The means are those of the batch; `gain` is `gamma inv_std`.
    ///
    /// # Shapes
    /// As for [`forward`](super::forward()), `dy` like `y`.
    ///
    /// # Panics
    /// If a slice has another length.
    pub fn backward<S>(
        simd: S,
        shape: &RectifyShape,
        n: usize,
        x: &mut [f32],
        dy: &[f32],
        statistics: ChannelStatistics,
        means: ChannelMeans,
        slopes: Slopes,
    ) {
        let ChannelStatistics { mean, inv_std, scale, shift } = statistics;
        let all = [mean, inv_std, scale, shift, means.dz, means.dz_xhat, means.gain];
        shape.check("norm_rectify backward", n, x.len(), dy.len(), &all, slopes);
        if x.is_empty() {
            return;
        }
        match slopes {
            Slopes::Zero => backward_of::<S, ZERO>(simd, shape, x, dy, statistics, means, slopes),
            Slopes::PerChannel(_) => backward_of::<S, ONE>(simd, shape, x, dy, statistics, means, slopes),
            Slopes::PerPosition(_) => backward_of::<S, EACH>(simd, shape, x, dy, statistics, means, slopes),
        }
    }
}

#[inline(always)]
fn backward_of<S: Simd, const SLOPES: u8>(
    simd: S,
    shape: &RectifyShape,
    x: &mut [f32],
    dy: &[f32],
    statistics: ChannelStatistics,
    means: ChannelMeans,
    slopes: Slopes,
) {
    let &RectifyShape { c, h, w, pooled } = shape;
    let ChannelStatistics { mean, inv_std, scale, shift } = statistics;
    // Without a single window, `dy` is empty.
    let mut dys = dy.chunks_exact(shape.y_plane().max(1));
    for (plane, x) in x.chunks_exact_mut(h * w).enumerate() {
        let channel = plane % c;
        let dy = dys.next().unwrap_or(&[]);
        let (mean, gain) = (mean[channel], means.gain[channel]);
        let slope_x = -gain * inv_std[channel] * means.dz_xhat[channel];
        let line = Line {
            scale: scale[channel],
            shift: shift[channel],
            mean,
            slope: slopes.single(channel),
            gain,
            slope_x,
            offset: -gain * means.dz[channel] - slope_x * mean,
        };
        let plane_slopes = slopes.each(if SLOPES == EACH { channel * h * w..(channel + 1) * h * w } else { 0..0 });
        if !pooled {
            line.row::<S, SLOPES>(simd, x, Rows { dy, above: plane_slopes, below: &[] });
            continue;
        }
        let mut dy = dy.chunks_exact((w / 2).max(1));
        for (row, x) in x.chunks_mut(2 * w).enumerate() {
            let Some(dy) = dy.next().filter(|_| x.len() == 2 * w) else {
                line.without_gradient(x);
                continue;
            };
            let both = if SLOPES == EACH { 2 * row * w..2 * (row + 1) * w } else { 0..0 };
            let (above, below) = plane_slopes[both.clone()].split_at(both.len() / 2);
            line.windows::<S, SLOPES>(simd, x, Rows { dy, above, below });
        }
    }
}

impl Line {
    /// The gradient of elements outside of all windows.
    #[inline(always)]
    fn without_gradient(&self, x: &mut [f32]) {
        for x in x {
            *x = *x * self.slope_x + self.offset;
        }
    }

    #[inline(always)]
    fn row<S: Simd, const SLOPES: u8>(&self, simd: S, x: &mut [f32], rows: Rows) {
        #[inline(always)]
        fn vector<S: Simd, const SLOPES: u8>(simd: S, line: &Line, x: &mut [f32], rows: Rows, at: usize, count: usize) {
            let old = get_first(simd, x, at, count);
            let (dz, _) = row_gradient::<S, SLOPES>(simd, line, old, rows, at, count);
            let rest = simd.mul_add(old, simd.splat(line.slope_x), simd.splat(line.offset));
            put_first(simd, x, at, simd.mul_add(dz, simd.splat(line.gain), rest), count);
        }
        let whole = x.len() - x.len() % S::LANES;
        for at in (0..whole).step_by(S::LANES) {
            vector::<S, SLOPES>(simd, self, x, rows, at, S::LANES);
        }
        if whole < x.len() {
            vector::<S, SLOPES>(simd, self, x, rows, whole, x.len() - whole);
        }
    }

    #[inline(always)]
    fn windows<S: Simd, const SLOPES: u8>(&self, simd: S, x: &mut [f32], rows: Rows) {
        let ahead = x.as_ptr();
        let (above, below) = x.split_at_mut(x.len() / 2);
        let whole = rows.dy.len() - rows.dy.len() % S::LANES;
        let rest = rows.dy.len() - whole;
        // The last vector of a row is read first and written last. Its masked load reaches into the beginning of the next row,
        // and a load of an address that is just being written has to wait.
        let mut last = [simd.splat(0.0); 4];
        if rest > 0 {
            last = of_windows::<S, SLOPES>(simd, self, [above, below], rows, whole, rest);
        }
        for at in (0..whole).step_by(S::LANES) {
            prefetch_windows(simd, ahead, at);
            let new = of_windows::<S, SLOPES>(simd, self, [above, below], rows, at, S::LANES);
            put_windows(simd, [&mut *above, &mut *below], at, new, S::LANES);
        }
        if rest > 0 {
            put_windows(simd, [&mut *above, &mut *below], whole, last, rest);
        }
        self.without_gradient(&mut above[2 * rows.dy.len()..]);
        self.without_gradient(&mut below[2 * rows.dy.len()..]);
    }
}
