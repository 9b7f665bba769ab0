//! The forward pass.

use super::operands::{RectifyShape, Slopes};
use super::windows::{EACH, ONE, ZERO, get_windows, largest, prefetch_windows, rectified};
use crate::simd::{Simd, get_first, put_first};

per_isa! {
    /// `y = pool(f(x scale[c] + shift[c]))`; `y` is overwritten.
    ///
    /// # Shapes
    /// `x`: `[n][c][h][w]`, `y` the same or, if pooled, `[n][c][h / 2][w / 2]`.
    ///
    /// # Panics
    /// If a slice has another length.
    pub fn forward<S>(
        simd: S,
        shape: &RectifyShape,
        n: usize,
        x: &[f32],
        scale: &[f32],
        shift: &[f32],
        slopes: Slopes,
        y: &mut [f32],
    ) {
        shape.check("norm_rectify forward", n, x.len(), y.len(), &[scale, shift], slopes);
        if y.is_empty() {
            return;
        }
        match slopes {
            Slopes::Zero => forward_of::<S, ZERO>(simd, shape, x, scale, shift, slopes, y),
            Slopes::PerChannel(_) => forward_of::<S, ONE>(simd, shape, x, scale, shift, slopes, y),
            Slopes::PerPosition(_) => forward_of::<S, EACH>(simd, shape, x, scale, shift, slopes, y),
        }
    }
}

/// The numbers of a channel.
#[derive(Clone, Copy)]
struct Line {
    /// `z = x scale + shift`.
    scale: f32,
    shift: f32,
    /// The slope, if the channel has a single one.
    slope: f32,
}

#[inline(always)]
fn forward_of<S: Simd, const SLOPES: u8>(
    simd: S,
    shape: &RectifyShape,
    x: &[f32],
    scale: &[f32],
    shift: &[f32],
    slopes: Slopes,
    y: &mut [f32],
) {
    let &RectifyShape { c, h, w, pooled } = shape;
    for (plane, (x, y)) in x.chunks_exact(h * w).zip(y.chunks_exact_mut(shape.y_plane())).enumerate() {
        let channel = plane % c;
        let line = Line { scale: scale[channel], shift: shift[channel], slope: slopes.single(channel) };
        let slopes = slopes.each(if SLOPES == EACH { channel * h * w..(channel + 1) * h * w } else { 0..0 });
        if !pooled {
            line.row::<S, SLOPES>(simd, x, slopes, y);
            continue;
        }
        for (row, (x, y)) in x.chunks_exact(2 * w).zip(y.chunks_exact_mut(w / 2)).enumerate() {
            let slopes = if SLOPES == EACH { &slopes[2 * row * w..2 * (row + 1) * w] } else { slopes };
            line.windows::<S, SLOPES>(simd, x, slopes, y);
        }
    }
}

impl Line {
    #[inline(always)]
    fn row<S: Simd, const SLOPES: u8>(&self, simd: S, x: &[f32], slopes: &[f32], y: &mut [f32]) {
        let mut at = 0;
        while at + 4 * S::LANES <= x.len() {
            for i in 0..4 {
                self.vector::<S, SLOPES>(simd, x, slopes, y, at + i * S::LANES, S::LANES);
            }
            at += 4 * S::LANES;
        }
        while at < x.len() {
            let count = (x.len() - at).min(S::LANES);
            self.vector::<S, SLOPES>(simd, x, slopes, y, at, count);
            at += count;
        }
    }

    /// The `count` elements from `at` on, without pooling.
    #[inline(always)]
    fn vector<S: Simd, const SLOPES: u8>(
        &self,
        simd: S,
        x: &[f32],
        slopes: &[f32],
        y: &mut [f32],
        at: usize,
        count: usize,
    ) {
        let z = simd.mul_add(get_first(simd, x, at, count), simd.splat(self.scale), simd.splat(self.shift));
        let slope = if SLOPES == EACH { get_first(simd, slopes, at, count) } else { simd.splat(self.slope) };
        put_first(simd, y, at, rectified::<S, SLOPES>(simd, z, slope), count);
    }

    /// One row of windows from the two rows in `x`.
    #[inline(always)]
    fn windows<S: Simd, const SLOPES: u8>(&self, simd: S, x: &[f32], slopes: &[f32], y: &mut [f32]) {
        let (x_rows, slope_rows) = (x.split_at(x.len() / 2), slopes.split_at(slopes.len() / 2));
        let whole = y.len() - y.len() % S::LANES;
        for at in (0..whole).step_by(S::LANES) {
            prefetch_windows(simd, x.as_ptr(), at);
            self.block::<S, SLOPES>(simd, x_rows.into(), slope_rows.into(), y, at, S::LANES);
        }
        if whole < y.len() {
            prefetch_windows(simd, x.as_ptr(), whole);
            self.block::<S, SLOPES>(simd, x_rows.into(), slope_rows.into(), y, whole, y.len() - whole);
        }
    }

    /// The `count` windows from window `at` on.
    #[inline(always)]
    fn block<S: Simd, const SLOPES: u8>(
        &self,
        simd: S,
        x: [&[f32]; 2],
        slopes: [&[f32]; 2],
        y: &mut [f32],
        at: usize,
        count: usize,
    ) {
        let (scale, shift) = (simd.splat(self.scale), simd.splat(self.shift));
        let mut z = get_windows(simd, x, at, count);
        for z in &mut z {
            *z = simd.mul_add(*z, scale, shift);
        }
        let slopes = if SLOPES == EACH { get_windows(simd, slopes, at, count) } else { [simd.splat(self.slope); 4] };
        let (_, max) = largest::<S, SLOPES>(simd, z, slopes);
        put_first(simd, y, at, simd.to_memory_order(max), count);
    }
}
