//! The passes of batch normalisation (Ioffe and Szegedy 2015) over `[n][c][hw]` tensors.
//!
//! The variance is a difference of two sums, and the sums of several shards of a batch are added up. So elements are summed less the
//! plane's first element, in `f32` over short strips, and the strips are added up in `f64`.

use crate::simd::{Simd, get};

/// Values that are summed side by side, so that a sum vectorises and still has a fixed order.
const WIDTH: usize = 16;

/// Adds a block of values to `WIDTH` interleaved sums.
#[inline(always)]
fn add_block(sums: &mut [f64; WIDTH], block: [f32; WIDTH]) {
    for i in 0..WIDTH {
        sums[i] += f64::from(block[i]);
    }
}

/// Vectors that are summed in single precision before their sum is added to one in double precision.
const STRIP: usize = 32;

/// The sum of a plane and the sum of its squares.
///
/// The first element is subtracted from all elements before they are summed. Then the squares are exact enough in single precision
/// even if the elements deviate little from a large mean, and a plane of equal elements has a variance of exactly 0.
#[inline(always)]
fn plane_sums<S: Simd>(simd: S, x: &[f32]) -> (f64, f64) {
    let Some(&origin) = x.first() else { return (0.0, 0.0) };
    let (zero, one, minus) = (simd.splat(0.0), simd.splat(1.0), simd.splat(-origin));
    let (mut sum, mut squares) = (0.0, 0.0);
    for strip in x.chunks(4 * STRIP * S::LANES) {
        // Side by side: an addition would wait for the one before.
        let (mut sums, mut sums_of_squares) = ([zero; 4], [zero; 4]);
        let blocks = strip.chunks_exact(4 * S::LANES);
        let vectors = blocks.remainder().chunks_exact(S::LANES);
        let rest = vectors.remainder();
        for block in blocks {
            for i in 0..4 {
                let x = simd.mul_add(get(simd, block, i * S::LANES), one, minus);
                sums[i] = simd.mul_add(x, one, sums[i]);
                sums_of_squares[i] = simd.mul_add(x, x, sums_of_squares[i]);
            }
        }
        for vector in vectors {
            let x = simd.mul_add(get(simd, vector, 0), one, minus);
            sums[0] = simd.mul_add(x, one, sums[0]);
            sums_of_squares[0] = simd.mul_add(x, x, sums_of_squares[0]);
        }
        for i in 0..4 {
            sum += f64::from(simd.sum(sums[i]));
            squares += f64::from(simd.sum(sums_of_squares[i]));
        }
        for x in rest {
            let x = f64::from(x - origin);
            sum += x;
            squares += x * x;
        }
    }
    let (origin, count) = (f64::from(origin), x.len() as f64);
    (sum + count * origin, squares + origin * (2.0 * sum + count * origin))
}

/// The sum of a plane of `dy` and the sum of its products with the normalised `x`.
#[inline(always)]
fn plane_backward_sums(x: &[f32], dy: &[f32], mean: f32, inv_std: f32) -> (f64, f64) {
    #[inline(always)]
    fn products(x: &[f32; WIDTH], dy: &[f32; WIDTH], mean: f32, inv_std: f32) -> [f32; WIDTH] {
        let mut products = [0.0; WIDTH];
        for i in 0..WIDTH {
            products[i] = dy[i] * ((x[i] - mean) * inv_std);
        }
        products
    }
    let (mut sum, mut sum_of_products) = ([0.0f64; WIDTH], [0.0f64; WIDTH]);
    let ((x_blocks, x_rest), (dy_blocks, dy_rest)) = (x.as_chunks::<WIDTH>(), dy.as_chunks::<WIDTH>());
    for (x, dy) in x_blocks.iter().zip(dy_blocks) {
        add_block(&mut sum, *dy);
        add_block(&mut sum_of_products, products(x, dy, mean, inv_std));
    }
    let (mut x, mut dy) = ([0.0; WIDTH], [0.0; WIDTH]);
    x[..x_rest.len()].copy_from_slice(x_rest);
    dy[..dy_rest.len()].copy_from_slice(dy_rest);
    add_block(&mut sum, dy);
    add_block(&mut sum_of_products, products(&x, &dy, mean, inv_std));
    (sum.iter().sum(), sum_of_products.iter().sum())
}

per_isa! {
    /// Adds the sum of each channel of `x` to `sums[..c]` and the sum of its squares to `sums[c..]`.
    pub fn channel_sums<S>(simd: S, n: usize, c: usize, hw: usize, x: &[f32], sums: &mut [f64]) {
        assert_eq!(x.len(), n * c * hw, "channel_sums: x is not [n][c][hw]");
        assert_eq!(sums.len(), 2 * c, "channel_sums: sums is not 2 c long");
        let (sum, squares) = sums.split_at_mut(c);
        for image in 0..n {
            for channel in 0..c {
                let plane = &x[(image * c + channel) * hw..][..hw];
                let (a, b) = plane_sums(simd, plane);
                sum[channel] += a;
                squares[channel] += b;
            }
        }
    }
}

per_isa! {
    /// `y = x * scale[c] + shift[c]`.
    pub fn normalize<S>(
        _simd: S,
        n: usize,
        c: usize,
        hw: usize,
        x: &[f32],
        scale: &[f32],
        shift: &[f32],
        y: &mut [f32],
    ) {
        assert!(x.len() == n * c * hw && y.len() == x.len(), "normalize: x or y is not [n][c][hw]");
        assert!(scale.len() == c && shift.len() == c, "normalize: scale or shift is not c long");
        for image in 0..n {
            for channel in 0..c {
                let at = (image * c + channel) * hw;
                let (scale, shift) = (scale[channel], shift[channel]);
                for (y, &x) in y[at..at + hw].iter_mut().zip(&x[at..at + hw]) {
                    *y = x * scale + shift;
                }
            }
        }
    }
}

per_isa! {
    /// Adds the sum of each channel of `dy` to `sums[..c]` and the sum of `dy * xhat` to `sums[c..]`, where
    /// `xhat = (x - mean[c]) * inv_std[c]`.
    pub fn norm_backward_sums<S>(
        _simd: S,
        n: usize,
        c: usize,
        hw: usize,
        x: &[f32],
        dy: &[f32],
        mean: &[f32],
        inv_std: &[f32],
        sums: &mut [f64],
    ) {
        assert!(x.len() == n * c * hw && dy.len() == x.len(), "norm_backward_sums: x or dy is not [n][c][hw]");
        assert!(mean.len() == c && inv_std.len() == c, "norm_backward_sums: mean or inv_std is not c long");
        assert_eq!(sums.len(), 2 * c, "norm_backward_sums: sums is not 2 c long");
        let (sum, products) = sums.split_at_mut(c);
        for image in 0..n {
            for channel in 0..c {
                let at = (image * c + channel) * hw;
                let (a, b) = plane_backward_sums(&x[at..at + hw], &dy[at..at + hw], mean[channel], inv_std[channel]);
                sum[channel] += a;
                products[channel] += b;
            }
        }
    }
}

per_isa! {
    /// `dx = g[c] * (dy - a[c] - xhat * b[c])` with `xhat = (x - mean[c]) * inv_std[c]`.
    ///
    /// This is the gradient of batch normalisation when `g` is `gamma * inv_std`, and `a` and `b` are the means of
    /// `dy` and of `dy * xhat` over the batch.
    pub fn norm_backward<S>(
        _simd: S,
        n: usize,
        c: usize,
        hw: usize,
        x: &[f32],
        dy: &[f32],
        mean: &[f32],
        inv_std: &[f32],
        a: &[f32],
        b: &[f32],
        g: &[f32],
        dx: &mut [f32],
    ) {
        assert!(x.len() == n * c * hw, "norm_backward: x is not [n][c][hw]");
        assert!(dy.len() == x.len() && dx.len() == x.len(), "norm_backward: x, dy and dx differ in length");
        assert!([mean, inv_std, a, b, g].iter().all(|s| s.len() == c), "norm_backward: a statistic is not c long");
        for image in 0..n {
            for channel in 0..c {
                let at = (image * c + channel) * hw;
                let (mean, inv_std) = (mean[channel], inv_std[channel]);
                let (a, b, g) = (a[channel], b[channel], g[channel]);
                let planes = x[at..at + hw].iter().zip(&dy[at..at + hw]);
                for (dx, (&x, &dy)) in dx[at..at + hw].iter_mut().zip(planes) {
                    *dx = g * (dy - a - (x - mean) * inv_std * b);
                }
            }
        }
    }
}
