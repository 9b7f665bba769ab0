//! The gradient, in two passes over `x`.

use super::{
    ChannelMeans, ChannelStatistics, EACH, ONE, RectifyShape, Slopes, ZERO, get_windows, largest, prefetch_windows,
};
use crate::simd::{Simd, get_first, put_first, put_pairs};

/// Vectors that are summed in single precision before their sum is added up in double; a strip ends with a row.
const STRIP: usize = 32;

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

/// What goes into the rectifier, and what comes out.
struct Windows<S: Simd> {
    z: [S::V; 4],
    slopes: [S::V; 4],
    f: [S::V; 4],
    most: S::V,
}

impl<S: Simd> Windows<S> {
    /// Of the windows whose values are `x`.
    #[inline(always)]
    fn new<const SLOPES: u8>(simd: S, line: &Line, x: [S::V; 4], rows: Rows, at: usize, count: usize) -> Windows<S> {
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
        let (f, most) = largest::<S, SLOPES>(simd, z, slopes);
        Windows { z, slopes, f, most }
    }

    /// Which windows have a gradient at all.
    #[inline(always)]
    fn live<const SLOPES: u8>(&self, simd: S) -> S::M {
        // The second is false for NaN only.
        if SLOPES == ZERO { simd.greater(self.most, simd.splat(0.0)) } else { simd.equal(self.most, self.most) }
    }

    /// Where in each window the first largest is, in row-major order, if it is live.
    #[inline(always)]
    fn places<const SLOPES: u8>(&self, simd: S) -> [S::M; 4] {
        let mut left = self.live::<SLOPES>(simd);
        let mut places = [left; 4];
        for i in 0..3 {
            places[i] = simd.and(left, simd.equal(self.f[i], self.most));
            left = simd.and_not(left, places[i]);
        }
        places[3] = left;
        places
    }

    /// Of four values for each window the one that belongs to the first largest.
    #[inline(always)]
    fn choose(&self, simd: S, values: [S::V; 4]) -> S::V {
        let mut chosen = values[3];
        for i in [2, 1, 0] {
            chosen = simd.select(simd.equal(self.f[i], self.most), values[i], chosen);
        }
        chosen
    }

    /// The gradient of the first largest `z`, and that of its slope.
    #[inline(always)]
    fn gradient<const SLOPES: u8>(&self, simd: S, dy: S::V) -> (S::V, S::V) {
        let zero = simd.splat(0.0);
        if SLOPES == ZERO {
            return (simd.select(self.live::<SLOPES>(simd), dy, zero), zero);
        }
        let z = self.choose(simd, self.z);
        let slope = if SLOPES == EACH { self.choose(simd, self.slopes) } else { self.slopes[0] };
        gradient(simd, z, slope, dy)
    }
}

/// The gradient of `z` and that of the slope, of a rectifier with slopes.
#[inline(always)]
fn gradient<S: Simd>(simd: S, z: S::V, slope: S::V, dy: S::V) -> (S::V, S::V) {
    let zero = simd.splat(0.0);
    let positive = simd.greater(z, zero);
    let dz = simd.select(positive, dy, simd.mul_add(slope, dy, zero));
    (dz, simd.select(positive, zero, simd.mul_add(z, dy, zero)))
}

/// Adds the sums of the `count` windows from window `at` on; gives the new gradients of their slopes, if each has one.
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
    // Windows that do not exist have no `dy`, so they add nothing.
    let dy = simd.to_pair_order(get_first(simd, rows.dy, at, count));
    let (dz, of_slope) = windows.gradient::<SLOPES>(simd, dy);
    add::<S, SLOPES>(simd, line, windows.choose(simd, x), dz, of_slope, sums);
    if SLOPES != EACH {
        return x;
    }
    let mut new = get_windows(simd, dslopes, at, count);
    let places = windows.places::<SLOPES>(simd);
    for i in 0..4 {
        new[i] = simd.select(places[i], simd.mul_add(of_slope, simd.splat(1.0), new[i]), new[i]);
    }
    new
}

/// Adds to the sums what belongs to `x`.
#[inline(always)]
fn add<S: Simd, const SLOPES: u8>(simd: S, line: &Line, x: S::V, dz: S::V, of_slope: S::V, sums: &mut Sums<S>) {
    let one = simd.splat(1.0);
    sums[0] = simd.mul_add(dz, one, sums[0]);
    sums[1] = simd.mul_add(dz, simd.mul_add(x, one, simd.splat(-line.mean)), sums[1]);
    if SLOPES == ONE {
        sums[2] = simd.mul_add(of_slope, one, sums[2]);
    }
}

/// The gradient of the values of the `count` windows from window `at` on.
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
    // Where a window of ReLU has no gradient, none of its places is taken.
    let dz = if SLOPES == ZERO { dy } else { windows.gradient::<SLOPES>(simd, dy).0 };
    let places = windows.places::<SLOPES>(simd);
    let (zero, one) = (simd.splat(0.0), simd.splat(1.0));
    let (slope_x, offset) = (simd.splat(line.slope_x), simd.splat(line.offset));
    let dz = simd.mul_add(dz, simd.splat(line.gain), zero);
    for i in 0..4 {
        let rest = simd.mul_add(x[i], slope_x, offset);
        x[i] = simd.select(places[i], simd.mul_add(dz, one, rest), rest);
    }
    x
}

/// Writes the values of the `count` windows from window `at` on.
#[inline(always)]
fn put_windows<S: Simd>(simd: S, rows: [&mut [f32]; 2], at: usize, v: [S::V; 4], count: usize) {
    let [above, below] = rows;
    put_pairs(simd, above, 2 * at, [v[0], v[1]], count);
    put_pairs(simd, below, 2 * at, [v[2], v[3]], count);
}

/// `dz` of the `count` elements from `at` on, without pooling, and the gradient of their slopes.
#[inline(always)]
fn row_gradient<S: Simd, const SLOPES: u8>(
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

/// Adds the sums of the `count` elements from `at` on, without pooling.
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

/// Sums of a plane.
struct Totals<S: Simd> {
    /// Of the strip under way.
    strip: Sums<S>,
    /// Of those before.
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

    /// Adds the sums over a row of windows.
    #[inline(always)]
    fn add_windows<const SLOPES: u8>(&mut self, simd: S, line: &Line, x: &[f32], rows: Rows, dslopes: [&mut [f32]; 2]) {
        let x_rows: [&[f32]; 2] = x.split_at(x.len() / 2).into();
        let [above, below] = dslopes;
        let whole = rows.dy.len() - rows.dy.len() % S::LANES;
        let rest = rows.dy.len() - whole;
        // First, and written last: see `Line::windows`.
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

    /// Adds the sums over a plane without pooling.
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
            line.windows::<S, SLOPES>(simd, x, Rows { dy, above, below });
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
        // The last vector of a row is taken first and written last: what it reads over, with a mask, is the beginning of
        // the next row, and a load of what is just being written has to wait.
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
