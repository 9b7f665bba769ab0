//! The passes of batch normalisation (Ioffe and Szegedy 2015) over `[n][c][hw]` tensors.
//!
//! Sums are taken in `f64`: the variance is a difference of two sums, and several shards of a batch are added up.

/// Values that are summed side by side, so that a sum vectorises and still has a fixed order.
const WIDTH: usize = 16;

/// Adds a block of values to `WIDTH` interleaved sums.
#[inline(always)]
fn add_block(sums: &mut [f64; WIDTH], block: [f32; WIDTH]) {
    for i in 0..WIDTH {
        sums[i] += f64::from(block[i]);
    }
}

/// The sum of a plane and the sum of its squares.
#[inline(always)]
fn plane_sums(x: &[f32]) -> (f64, f64) {
    let (mut sum, mut squares) = ([0.0f64; WIDTH], [0.0f64; WIDTH]);
    let (blocks, rest) = x.as_chunks::<WIDTH>();
    let mut last = [0.0; WIDTH];
    last[..rest.len()].copy_from_slice(rest);
    for x in blocks.iter().chain([&last]) {
        add_block(&mut sum, *x);
        for i in 0..WIDTH {
            squares[i] += f64::from(x[i]) * f64::from(x[i]);
        }
    }
    (sum.iter().sum(), squares.iter().sum())
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
    pub fn channel_sums<S>(_simd: S, n: usize, c: usize, hw: usize, x: &[f32], sums: &mut [f64]) {
        assert_eq!(x.len(), n * c * hw, "channel_sums: x is not [n][c][hw]");
        assert_eq!(sums.len(), 2 * c, "channel_sums: sums is not 2 c long");
        let (sum, squares) = sums.split_at_mut(c);
        for image in 0..n {
            for channel in 0..c {
                let plane = &x[(image * c + channel) * hw..][..hw];
                let (a, b) = plane_sums(plane);
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
