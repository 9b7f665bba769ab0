//! Blur by binomial weights over windows that lie fully inside the image (no padding, sizes rounded down).

use crate::pool::PoolShape;

/// Largest height and width of a window.
pub const MAX_TAPS: usize = 7;

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

per_isa! {
    /// `y[i][j] = Σ_{k,l} a_k b_l x[i·s + k][j·s + l]` in each channel, a and b [`binomial`]. `x`: `[n][c][h][w]`, `y`:
    /// `[n][c][out_h][out_w]`, overwritten; `row`: scratch of `w`.
    pub fn blur_forward<S>(_simd: S, shape: &PoolShape, n: usize, x: &[f32], y: &mut [f32], row: &mut [f32]) {
        shape.check("blur_forward", n, x.len(), y.len());
        let &PoolShape { c, h, w, kh, kw, stride_h, stride_w } = shape;
        let (out_h, out_w) = (shape.out_h(), shape.out_w());
        let (down, along, row) = (binomial(kh), binomial(kw), &mut row[..w]);
        if y.is_empty() {
            return;
        }
        for plane in 0..n * c {
            let x = &x[plane * h * w..][..h * w];
            for oy in 0..out_h {
                row.fill(0.0);
                for (ky, &weight) in down[..kh].iter().enumerate() {
                    for (sum, &x) in row.iter_mut().zip(&x[(oy * stride_h + ky) * w..][..w]) {
                        *sum += weight * x;
                    }
                }
                let y = &mut y[(plane * out_h + oy) * out_w..][..out_w];
                y.fill(0.0);
                for (kx, &weight) in along[..kw].iter().enumerate() {
                    for (y, &sum) in y.iter_mut().zip(row[kx..].iter().step_by(stride_w)) {
                        *y += weight * sum;
                    }
                }
            }
        }
    }
}

per_isa! {
    /// The gradient of [`blur_forward`], `y[i][j] = Σ_{k,l} a_k b_l x[i·s + k][j·s + l]`: `dx[i·s + k][j·s + l] += a_k b_l dy[i][j]`.
    /// `dx` is overwritten; `row`: scratch of `w`.
    pub fn blur_backward<S>(_simd: S, shape: &PoolShape, n: usize, dy: &[f32], dx: &mut [f32], row: &mut [f32]) {
        shape.check("blur_backward", n, dx.len(), dy.len());
        let &PoolShape { c, h, w, kh, kw, stride_h, stride_w } = shape;
        let (out_h, out_w) = (shape.out_h(), shape.out_w());
        let (down, along, row) = (binomial(kh), binomial(kw), &mut row[..w]);
        dx.fill(0.0);
        if dy.is_empty() {
            return;
        }
        for plane in 0..n * c {
            let dx = &mut dx[plane * h * w..][..h * w];
            for oy in 0..out_h {
                let dy = &dy[(plane * out_h + oy) * out_w..][..out_w];
                row.fill(0.0);
                for (kx, &weight) in along[..kw].iter().enumerate() {
                    for (sum, &dy) in row[kx..].iter_mut().step_by(stride_w).zip(dy) {
                        *sum += weight * dy;
                    }
                }
                for (ky, &weight) in down[..kh].iter().enumerate() {
                    for (dx, &sum) in dx[(oy * stride_h + ky) * w..][..w].iter_mut().zip(&*row) {
                        *dx += weight * sum;
                    }
                }
            }
        }
    }
}
