//! The pass forward.

use super::{RectifyShape, Slopes};

per_isa! {
    /// `y = pool(f(x scale[c] + shift[c]))`; `y` is overwritten.
    ///
    /// # Shapes
    /// `x`: `[n][c][h][w]`, `y` the same or, if pooled, `[n][c][h / 2][w / 2]`.
    ///
    /// # Panics
    /// If a slice has another length.
    pub fn forward<S>(
        _simd: S,
        shape: &RectifyShape,
        n: usize,
        x: &[f32],
        scale: &[f32],
        shift: &[f32],
        slopes: Slopes,
        y: &mut [f32],
    ) {
        shape.check("norm_rectify forward", n, x.len(), y.len(), &[scale, shift], slopes);
        let &RectifyShape { c, h, w, pooled } = shape;
        if y.is_empty() {
            return;
        }
        for (plane, (x, y)) in x.chunks_exact(h * w).zip(y.chunks_exact_mut(shape.y_plane())).enumerate() {
            let channel = plane % c;
            let (scale, shift) = (scale[channel], shift[channel]);
            if !pooled {
                forward_row(x, scale, shift, slopes.of(shape, channel, 0..h), y);
                continue;
            }
            for (row, (x, y)) in x.chunks_exact(2 * w).zip(y.chunks_exact_mut(w / 2)).enumerate() {
                forward_windows(x, w, scale, shift, slopes.of(shape, channel, 2 * row..2 * row + 2), y);
            }
        }
    }
}

#[inline(always)]
fn relu(z: f32, _slope: f32) -> f32 {
    if z > 0.0 { z } else { 0.0 }
}

#[inline(always)]
fn prelu(z: f32, slope: f32) -> f32 {
    if z > 0.0 { z } else { slope * z }
}

#[inline(always)]
fn forward_row(x: &[f32], scale: f32, shift: f32, slopes: Slopes, y: &mut [f32]) {
    match slopes {
        Slopes::Zero => y.iter_mut().zip(x).for_each(|(y, x)| *y = relu(x * scale + shift, 0.0)),
        Slopes::PerChannel(slope) => {
            let slope = slope[0];
            y.iter_mut().zip(x).for_each(|(y, x)| *y = prelu(x * scale + shift, slope));
        }
        Slopes::PerPosition(slopes) => {
            y.iter_mut().zip(x).zip(slopes).for_each(|((y, x), slope)| *y = prelu(x * scale + shift, *slope));
        }
    }
}

/// One row of windows from the two rows in `x`.
#[inline(always)]
fn forward_windows(x: &[f32], w: usize, scale: f32, shift: f32, slopes: Slopes, y: &mut [f32]) {
    let (above, below) = x.split_at(w);
    let windows = above.as_chunks::<2>().0.iter().zip(below.as_chunks::<2>().0);
    // Written out: a closure might not be inlined into the function with the instruction set.
    match slopes {
        // This does not fall, so the largest can be taken first.
        Slopes::Zero => {
            for (y, (a, b)) in y.iter_mut().zip(windows) {
                let (z0, z1) = (a[0] * scale + shift, a[1] * scale + shift);
                let (z2, z3) = (b[0] * scale + shift, b[1] * scale + shift);
                *y = relu(largest(z0, z1, z2, z3), 0.0);
            }
        }
        Slopes::PerChannel(slope) => {
            let slope = slope[0];
            for (y, (a, b)) in y.iter_mut().zip(windows) {
                let (f0, f1) = (prelu(a[0] * scale + shift, slope), prelu(a[1] * scale + shift, slope));
                let (f2, f3) = (prelu(b[0] * scale + shift, slope), prelu(b[1] * scale + shift, slope));
                *y = largest(f0, f1, f2, f3);
            }
        }
        Slopes::PerPosition(slopes) => {
            let (s_above, s_below) = slopes.split_at(w);
            let slopes = s_above.as_chunks::<2>().0.iter().zip(s_below.as_chunks::<2>().0);
            for ((y, (a, b)), (s, t)) in y.iter_mut().zip(windows).zip(slopes) {
                let (f0, f1) = (prelu(a[0] * scale + shift, s[0]), prelu(a[1] * scale + shift, s[1]));
                let (f2, f3) = (prelu(b[0] * scale + shift, t[0]), prelu(b[1] * scale + shift, t[1]));
                *y = largest(f0, f1, f2, f3);
            }
        }
    }
}

/// The largest of a window.
#[inline(always)]
fn largest(a: f32, b: f32, c: f32, d: f32) -> f32 {
    let above = if a > b { a } else { b };
    let below = if c > d { c } else { d };
    if above > below { above } else { below }
}
