//! The gradient, in two passes over `x`.

use super::{ChannelMeans, ChannelStatistics, RectifyShape, Slopes};
use crate::simd::{Simd, get, get_pairs, put, put_pairs};

/// Elements that are summed in single precision before their sum is added up in double.
const STRIP: usize = 512;

/// How the slopes of a row are found: none, one for all, or a list.
const ZERO: u8 = 0;
const ONE: u8 = 1;
const EACH: u8 = 2;

/// What the gradient of one channel needs.
#[derive(Clone, Copy)]
struct Line {
    /// `z = x scale + shift`.
    scale: f32,
    shift: f32,
    mean: f32,
    /// The slope, where there is one for all.
    slope: f32,
    /// `dx = dz gain + x slope_x + offset`.
    gain: f32,
    slope_x: f32,
    offset: f32,
}

/// Sums over lanes and blocks: of `dz`, of `dz (x - mean)` and of the gradient of a single slope.
type Sums<S> = [<S as Simd>::V; 3];

/// Two rows of windows with what belongs to them; without pooling `above` is all there is.
#[derive(Clone, Copy)]
struct Rows<'a> {
    dy: &'a [f32],
    /// Slopes, if there is one for each element.
    above: &'a [f32],
    below: &'a [f32],
}

#[inline(always)]
fn larger<S: Simd>(simd: S, a: S::V, b: S::V) -> S::V {
    simd.select_greater(a, b, a, b)
}

/// `dz` of the four values of each of `LANES` windows: the first largest in row-major order gets `dy` times the slope it
/// has there. `z` are the normalised values, `slopes` theirs. Also the gradients of the slopes.
#[inline(always)]
fn window_gradient<S: Simd, const SLOPES: u8>(
    simd: S,
    z: [S::V; 4],
    slopes: [S::V; 4],
    dy: S::V,
) -> ([S::V; 4], [S::V; 4]) {
    let zero = simd.splat(0.0);
    let mut f = z;
    for i in 0..4 {
        let negative = if SLOPES == ZERO { zero } else { simd.mul_add(z[i], slopes[i], zero) };
        f[i] = simd.select_greater(z[i], zero, z[i], negative);
    }
    let most = larger(simd, larger(simd, f[0], f[1]), larger(simd, f[2], f[3]));
    let (mut dz, mut dslopes, mut left) = ([zero; 4], [zero; 4], dy);
    for i in 0..4 {
        let taken = simd.select_equal(f[i], most, left, zero);
        left = simd.select_equal(f[i], most, zero, left);
        let negative = if SLOPES == ZERO { zero } else { simd.mul_add(taken, slopes[i], zero) };
        dz[i] = simd.select_greater(z[i], zero, taken, negative);
        if SLOPES != ZERO {
            dslopes[i] = simd.select_greater(z[i], zero, zero, simd.mul_add(z[i], taken, zero));
        }
    }
    (dz, dslopes)
}

/// The slopes of `LANES` windows from window `at` on.
#[inline(always)]
fn window_slopes<S: Simd, const SLOPES: u8>(simd: S, line: &Line, rows: Rows, at: usize) -> [S::V; 4] {
    if SLOPES == EACH {
        let ([a, b], [c, d]) = (get_pairs(simd, rows.above, 2 * at), get_pairs(simd, rows.below, 2 * at));
        [a, b, c, d]
    } else {
        [simd.splat(line.slope); 4]
    }
}

/// Adds the sums of `LANES` windows from window `at` on.
#[inline(always)]
fn sum_windows<S: Simd, const SLOPES: u8>(
    simd: S,
    line: &Line,
    x: [&[f32]; 2],
    rows: Rows,
    dslopes: [&mut [f32]; 2],
    at: usize,
    sums: &mut Sums<S>,
) {
    let (scale, shift) = (simd.splat(line.scale), simd.splat(line.shift));
    let ([a, b], [c, d]) = (get_pairs(simd, x[0], 2 * at), get_pairs(simd, x[1], 2 * at));
    let x = [a, b, c, d];
    let mut z = x;
    for i in 0..4 {
        z[i] = simd.mul_add(x[i], scale, shift);
    }
    let slopes = window_slopes::<S, SLOPES>(simd, line, rows, at);
    let (dz, of_slopes) = window_gradient::<S, SLOPES>(simd, z, slopes, get(simd, rows.dy, at));
    let one = simd.splat(1.0);
    for i in 0..4 {
        sums[0] = simd.mul_add(dz[i], one, sums[0]);
        sums[1] = simd.mul_add(dz[i], simd.mul_add(x[i], one, simd.splat(-line.mean)), sums[1]);
        if SLOPES == ONE {
            sums[2] = simd.mul_add(of_slopes[i], one, sums[2]);
        }
    }
    if SLOPES == EACH {
        for (row, dslopes) in dslopes.into_iter().enumerate() {
            let mut new = get_pairs(simd, dslopes, 2 * at);
            for i in 0..2 {
                new[i] = simd.mul_add(of_slopes[2 * row + i], one, new[i]);
            }
            put_pairs(simd, dslopes, 2 * at, new);
        }
    }
}

/// The gradient of the values of `LANES` windows from window `at` on.
#[inline(always)]
fn of_windows<S: Simd, const SLOPES: u8>(simd: S, line: &Line, x: [&[f32]; 2], rows: Rows, at: usize) -> [S::V; 4] {
    let (scale, shift) = (simd.splat(line.scale), simd.splat(line.shift));
    let ([a, b], [c, d]) = (get_pairs(simd, x[0], 2 * at), get_pairs(simd, x[1], 2 * at));
    let mut values = [a, b, c, d];
    let mut z = values;
    for i in 0..4 {
        z[i] = simd.mul_add(values[i], scale, shift);
    }
    let slopes = window_slopes::<S, SLOPES>(simd, line, rows, at);
    let (dz, _) = window_gradient::<S, SLOPES>(simd, z, slopes, get(simd, rows.dy, at));
    let (gain, slope_x, offset) = (simd.splat(line.gain), simd.splat(line.slope_x), simd.splat(line.offset));
    for i in 0..4 {
        values[i] = simd.mul_add(dz[i], gain, simd.mul_add(values[i], slope_x, offset));
    }
    values
}

/// Writes the values of `LANES` windows from window `at` on.
#[inline(always)]
fn put_windows<S: Simd>(simd: S, to: [&mut [f32]; 2], at: usize, v: [S::V; 4]) {
    let [above, below] = to;
    put_pairs(simd, above, 2 * at, [v[0], v[1]]);
    put_pairs(simd, below, 2 * at, [v[2], v[3]]);
}

/// `dz` of `LANES` elements from `at` on, without pooling, and the gradient of their slopes.
#[inline(always)]
fn row_gradient<S: Simd, const SLOPES: u8>(simd: S, line: &Line, x: S::V, rows: Rows, at: usize) -> (S::V, S::V) {
    let zero = simd.splat(0.0);
    let z = simd.mul_add(x, simd.splat(line.scale), simd.splat(line.shift));
    let dy = get(simd, rows.dy, at);
    if SLOPES == ZERO {
        return (simd.select_greater(z, zero, dy, zero), zero);
    }
    let slope = if SLOPES == EACH { get(simd, rows.above, at) } else { simd.splat(line.slope) };
    let dz = simd.select_greater(z, zero, dy, simd.mul_add(slope, dy, zero));
    (dz, simd.select_greater(z, zero, zero, simd.mul_add(z, dy, zero)))
}

/// Elements of a row that a block may hang over its end by, at most.
const MOST: usize = 32;

/// The end of a row, filled up with zeros to whole vectors.
#[inline(always)]
fn filled(from: &[f32], at: usize) -> [f32; MOST] {
    let mut to = [0.0; MOST];
    if at < from.len() {
        to[..from.len() - at].copy_from_slice(&from[at..]);
    }
    to
}

/// The sums of `dz`, of `dz (x - mean)` and of the gradient of a single slope over a row of windows.
#[inline(always)]
fn sums_of_windows<S: Simd, const SLOPES: u8>(
    simd: S,
    line: &Line,
    x: [&[f32]; 2],
    rows: Rows,
    dslopes: [&mut [f32]; 2],
) -> [f64; 3] {
    let mut sums = [simd.splat(0.0); 3];
    let whole = rows.dy.len() - rows.dy.len() % S::LANES;
    let [above, below] = dslopes;
    for at in (0..whole).step_by(S::LANES) {
        sum_windows::<S, SLOPES>(simd, line, x, rows, [&mut *above, &mut *below], at, &mut sums);
    }
    let count = rows.dy.len() - whole;
    if count > 0 && whole > 0 {
        // A last vector that reaches back over windows that are done, whose `dy` is left out.
        let at = rows.dy.len() - S::LANES;
        let mut dy = [0.0; MOST];
        dy[S::LANES - count..S::LANES].copy_from_slice(&rows.dy[whole..]);
        let slopes = |all: &'_ [f32]| if SLOPES == EACH { 2 * at..all.len() } else { 0..0 };
        let (range_above, range_below) = (slopes(above), slopes(below));
        let rest = Rows { dy: &dy, above: &rows.above[range_above.clone()], below: &rows.below[range_below.clone()] };
        let x = [&x[0][2 * at..], &x[1][2 * at..]];
        let dslopes = [&mut above[range_above], &mut below[range_below]];
        sum_windows::<S, SLOPES>(simd, line, x, rest, dslopes, 0, &mut sums);
    } else if count > 0 {
        // Windows that do not exist have no `dy`, so they add nothing.
        let end = 2 * rows.dy.len();
        let x = [filled(&x[0][..end], 2 * whole), filled(&x[1][..end], 2 * whole)];
        let slopes = [filled(rows.above, 2 * whole), filled(rows.below, 2 * whole)];
        let dy = filled(rows.dy, whole);
        let rest = Rows { dy: &dy, above: &slopes[0], below: &slopes[1] };
        let mut of_slopes = [filled(above, 2 * whole), filled(below, 2 * whole)];
        let [a, b] = &mut of_slopes;
        sum_windows::<S, SLOPES>(simd, line, [&x[0], &x[1]], rest, [a, b], 0, &mut sums);
        if SLOPES == EACH {
            let count = end - 2 * whole;
            above[2 * whole..end].copy_from_slice(&of_slopes[0][..count]);
            below[2 * whole..end].copy_from_slice(&of_slopes[1][..count]);
        }
    }
    sums.map(|sum| f64::from(simd.sum(sum)))
}

/// The same over a row without pooling.
#[inline(always)]
fn sums_of_row<S: Simd, const SLOPES: u8>(
    simd: S,
    line: &Line,
    x: &[f32],
    rows: Rows,
    dslopes: &mut [f32],
) -> [f64; 3] {
    #[inline(always)]
    fn block<S: Simd, const SLOPES: u8>(
        simd: S,
        line: &Line,
        x: &[f32],
        rows: Rows,
        dslopes: &mut [f32],
        at: usize,
        sums: &mut Sums<S>,
    ) {
        let (x, one) = (get(simd, x, at), simd.splat(1.0));
        let (dz, of_slope) = row_gradient::<S, SLOPES>(simd, line, x, rows, at);
        sums[0] = simd.mul_add(dz, one, sums[0]);
        sums[1] = simd.mul_add(dz, simd.mul_add(x, one, simd.splat(-line.mean)), sums[1]);
        if SLOPES == ONE {
            sums[2] = simd.mul_add(of_slope, one, sums[2]);
        }
        if SLOPES == EACH {
            let old = get(simd, dslopes, at);
            put(simd, dslopes, at, simd.mul_add(of_slope, one, old));
        }
    }
    let mut totals = [0.0; 3];
    let whole = x.len() - x.len() % S::LANES;
    // So many that single precision suffices for the sums of a strip.
    for strip in (0..whole).step_by(STRIP) {
        let mut sums = [simd.splat(0.0); 3];
        for at in (strip..whole.min(strip + STRIP)).step_by(S::LANES) {
            block::<S, SLOPES>(simd, line, x, rows, dslopes, at, &mut sums);
        }
        for (total, sum) in totals.iter_mut().zip(sums) {
            *total += f64::from(simd.sum(sum));
        }
    }
    if whole < x.len() {
        let mut sums = [simd.splat(0.0); 3];
        let (dy, above, mut of_slopes) = (filled(rows.dy, whole), filled(rows.above, whole), filled(dslopes, whole));
        let rest = Rows { dy: &dy, above: &above, below: &[] };
        block::<S, SLOPES>(simd, line, &filled(x, whole), rest, &mut of_slopes, 0, &mut sums);
        if SLOPES == EACH {
            dslopes[whole..].copy_from_slice(&of_slopes[..x.len() - whole]);
        }
        for (total, sum) in totals.iter_mut().zip(sums) {
            *total += f64::from(simd.sum(sum));
        }
    }
    totals
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
        let mut totals = [0.0; 3];
        let of_plane = if SLOPES == EACH { channel * h * w..(channel + 1) * h * w } else { 0..0 };
        let plane_slopes = slopes.each(of_plane.clone());
        let plane_dslopes = &mut dslopes[of_plane];
        if pooled {
            for (row, (x, dy)) in x.chunks_exact(2 * w).zip(dy.chunks_exact(w / 2)).enumerate() {
                let both = if SLOPES == EACH { 2 * row * w..2 * (row + 1) * w } else { 0..0 };
                let (above, below) = plane_slopes[both.clone()].split_at(both.len() / 2);
                let (ds_above, ds_below) = plane_dslopes[both.clone()].split_at_mut(both.len() / 2);
                let (x_above, x_below) = x.split_at(w);
                let rows = Rows { dy, above, below };
                let row = sums_of_windows::<S, SLOPES>(simd, &line, [x_above, x_below], rows, [ds_above, ds_below]);
                for (total, sum) in totals.iter_mut().zip(row) {
                    *total += sum;
                }
            }
        } else {
            let rows = Rows { dy, above: plane_slopes, below: &[] };
            totals = sums_of_row::<S, SLOPES>(simd, &line, x, rows, plane_dslopes);
        }
        sums[channel] += totals[0];
        sums[c + channel] += totals[1] * f64::from(inv_std[channel]);
        if SLOPES == ONE {
            dslopes[channel] += totals[2] as f32;
        }
    }
}

per_isa! {
    /// Puts the gradient of `x`, `gain[c] (dz - mean_dz[c] - xhat mean_dz_xhat[c])` with the normalised `xhat`, in the place
    /// of `x`. The means are those of the batch; `gain` is `gamma inv_std`.
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
    // Without a single window there is nothing in `dy` to go along with the planes.
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
            let (x_above, x_below) = x.split_at_mut(w);
            line.windows::<S, SLOPES>(simd, [x_above, x_below], Rows { dy, above, below });
        }
    }
}

impl Line {
    /// Where no window gives a gradient.
    #[inline(always)]
    fn without_gradient(&self, x: &mut [f32]) {
        for x in x {
            *x = *x * self.slope_x + self.offset;
        }
    }

    #[inline(always)]
    fn row<S: Simd, const SLOPES: u8>(&self, simd: S, x: &mut [f32], rows: Rows) {
        #[inline(always)]
        fn block<S: Simd, const SLOPES: u8>(simd: S, line: &Line, x: &mut [f32], rows: Rows, at: usize) {
            let old = get(simd, x, at);
            let (dz, _) = row_gradient::<S, SLOPES>(simd, line, old, rows, at);
            let rest = simd.mul_add(old, simd.splat(line.slope_x), simd.splat(line.offset));
            put(simd, x, at, simd.mul_add(dz, simd.splat(line.gain), rest));
        }
        let whole = x.len() - x.len() % S::LANES;
        for at in (0..whole).step_by(S::LANES) {
            block::<S, SLOPES>(simd, self, x, rows, at);
        }
        if whole < x.len() {
            let (dy, above, mut end) = (filled(rows.dy, whole), filled(rows.above, whole), filled(x, whole));
            block::<S, SLOPES>(simd, self, &mut end, Rows { dy: &dy, above: &above, below: &[] }, 0);
            let count = x.len() - whole;
            x[whole..].copy_from_slice(&end[..count]);
        }
    }

    #[inline(always)]
    fn windows<S: Simd, const SLOPES: u8>(&self, simd: S, x: [&mut [f32]; 2], rows: Rows) {
        let [above, below] = x;
        let (count, end) = (rows.dy.len(), 2 * rows.dy.len());
        if count < S::LANES {
            let slopes = [filled(rows.above, 0), filled(rows.below, 0)];
            let (dy, rest) = (filled(rows.dy, 0), [filled(&above[..end], 0), filled(&below[..end], 0)]);
            let rows = Rows { dy: &dy, above: &slopes[0], below: &slopes[1] };
            let values = of_windows::<S, SLOPES>(simd, self, [&rest[0], &rest[1]], rows, 0);
            let [mut a, mut b] = rest;
            put_windows(simd, [&mut a, &mut b], 0, values);
            above[..end].copy_from_slice(&a[..end]);
            below[..end].copy_from_slice(&b[..end]);
        } else {
            // The last vector reaches back over windows of the one before: it is computed before they are replaced.
            let last = of_windows::<S, SLOPES>(simd, self, [above, below], rows, count - S::LANES);
            for at in (0..count - S::LANES).step_by(S::LANES) {
                let values = of_windows::<S, SLOPES>(simd, self, [above, below], rows, at);
                put_windows(simd, [&mut *above, &mut *below], at, values);
            }
            put_windows(simd, [&mut *above, &mut *below], count - S::LANES, last);
        }
        self.without_gradient(&mut above[end..]);
        self.without_gradient(&mut below[end..]);
    }
}
