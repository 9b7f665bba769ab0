//! Activation functions and their gradients.
//!
//! | function | forward | backward, dx = |
//! |---|---|---|
//! | ReLU | `max(x, 0)` | `dy` where `y > 0`, else 0 |
//! | ELU (Clevert et al. 2015) | `x` if `x > 0`, else `alpha (e^x - 1)` | `dy` where `y > 0`, else `dy (y + alpha)` |
//! | PReLU (He et al. 2015) | `x` if `x > 0`, else `slope x` | `dy` where `x > 0`, else `slope dy` |
//! | leaky ReLU (Maas et al. 2013) | as PReLU, with one fixed slope | as PReLU |
//! | tanh | `tanh x` | `dy (1 - y^2)` |
//! | softsign | `x / (1 + \|x\|)` | `dy (1 - \|y\|)^2` |
//! | swish, SiLU (Elfwing et al. 2017) | `x s(x)` with `s(x) = 1 / (1 + e^-x)` | `dy s(x) (1 + x (1 - s(x)))` |
//!
//! ReLU, ELU, tanh and softsign need only their output `y` to go backward, PReLU, leaky ReLU and swish their input `x`.

/// `e^x - 1` for `x <= 0`, relative error below 1e-6; the same operations in the same order in every lane.
///
/// `x = k ln 2 + r` with `|r| <= ln 2 / 2`, `e^x - 1 = 2^k (e^r - 1) + (2^k - 1)`, and `e^r - 1` by its Taylor
/// polynomial of degree 7, whose first neglected term is `r^7 / 40320 < 2e-8` of the value.
#[inline(always)]
fn expm1_of_negative(x: f32) -> f32 {
    /// Adding 1.5 * 2^23 leaves the nearest integer in the low bits of the sum.
    const ROUND: f32 = 12_582_912.0;
    /// The leading bits of ln 2: its product with a small integer is exact.
    const LN2_HIGH: f32 = 0.693_359_4;
    const LN2_LOW: f32 = -2.121_944_4e-4;
    // Below -50, e^x - 1 is -1 in f32, and 2^k would leave the range of the exponent.
    let x = if x > -50.0 { x } else { -50.0 };
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let k = shifted - ROUND;
    let r = (x - k * LN2_HIGH) - k * LN2_LOW;
    let power = f32::from_bits((shifted.to_bits() << 23).wrapping_add(0x3f80_0000));
    let tail = 1.0 / 24.0 + r * (1.0 / 120.0 + r * (1.0 / 720.0 + r * (1.0 / 5040.0)));
    let series = r + r * r * (0.5 + r * (1.0 / 6.0 + r * tail));
    power * series + (power - 1.0)
}

per_isa! {
    /// `y = max(x, 0)`; a NaN becomes 0. All other activations pass a NaN on.
    pub fn relu_forward<S>(_simd: S, x: &[f32], y: &mut [f32]) {
        assert_eq!(x.len(), y.len(), "relu_forward: x and y differ in length");
        for (y, &x) in y.iter_mut().zip(x) {
            *y = if x > 0.0 { x } else { 0.0 };
        }
    }
}

per_isa! {
    /// The gradient of [`relu_forward`], `y = max(x, 0)`, from its output `y`; `dx` is overwritten.
    pub fn relu_backward<S>(_simd: S, y: &[f32], dy: &[f32], dx: &mut [f32]) {
        assert!(y.len() == dy.len() && y.len() == dx.len(), "relu_backward: y, dy and dx differ in length");
        for ((dx, &dy), &y) in dx.iter_mut().zip(dy).zip(y) {
            *dx = if y > 0.0 { dy } else { 0.0 };
        }
    }
}

per_isa! {
    /// `y = x` where `x > 0`, else `alpha (e^x - 1)`.
    pub fn elu_forward<S>(_simd: S, alpha: f32, x: &[f32], y: &mut [f32]) {
        assert_eq!(x.len(), y.len(), "elu_forward: x and y differ in length");
        for (y, &x) in y.iter_mut().zip(x) {
            let negative = alpha * expm1_of_negative(if x < 0.0 { x } else { 0.0 });
            // A NaN is neither below nor above 0: it is passed on here.
            *y = if x <= 0.0 { negative } else { x };
        }
    }
}

per_isa! {
    /// The gradient of [`elu_forward`], `y = x` or `alpha (e^x - 1)`, from its output `y`; `dx` is overwritten.
    pub fn elu_backward<S>(_simd: S, alpha: f32, y: &[f32], dy: &[f32], dx: &mut [f32]) {
        assert!(y.len() == dy.len() && y.len() == dx.len(), "elu_backward: y, dy and dx differ in length");
        for ((dx, &dy), &y) in dx.iter_mut().zip(dy).zip(y) {
            *dx = if y > 0.0 { dy } else { dy * (y + alpha) };
        }
    }
}

per_isa! {
    /// `y = x` where `x > 0`, else `slope x`.
    pub fn leaky_relu_forward<S>(_simd: S, slope: f32, x: &[f32], y: &mut [f32]) {
        assert_eq!(x.len(), y.len(), "leaky_relu_forward: x and y differ in length");
        for (y, &x) in y.iter_mut().zip(x) {
            *y = if x > 0.0 { x } else { slope * x };
        }
    }
}

per_isa! {
    /// The gradient of [`leaky_relu_forward`], `y = x` or `slope x`, from its input `x`; `dx` is overwritten.
    pub fn leaky_relu_backward<S>(_simd: S, slope: f32, x: &[f32], dy: &[f32], dx: &mut [f32]) {
        assert!(x.len() == dy.len() && x.len() == dx.len(), "leaky_relu_backward: x, dy and dx differ in length");
        for ((dx, &dy), &x) in dx.iter_mut().zip(dy).zip(x) {
            *dx = if x > 0.0 { dy } else { slope * dy };
        }
    }
}

per_isa! {
    /// `y = tanh x`, relative error below 2e-6: with `t = e^(-2|x|) - 1`, `tanh |x| = -t / (t + 2)`.
    pub fn tanh_forward<S>(_simd: S, x: &[f32], y: &mut [f32]) {
        assert_eq!(x.len(), y.len(), "tanh_forward: x and y differ in length");
        for (y, &x) in y.iter_mut().zip(x) {
            let t = expm1_of_negative(-2.0 * x.abs());
            let value = (-t / (t + 2.0)).copysign(x);
            // The exponential clamps its argument and loses a NaN with it.
            *y = if x.is_nan() { x } else { value };
        }
    }
}

per_isa! {
    /// The gradient of [`tanh_forward`], `y = tanh x`, from its output `y`; `dx` is overwritten.
    pub fn tanh_backward<S>(_simd: S, y: &[f32], dy: &[f32], dx: &mut [f32]) {
        assert!(y.len() == dy.len() && y.len() == dx.len(), "tanh_backward: y, dy and dx differ in length");
        for ((dx, &dy), &y) in dx.iter_mut().zip(dy).zip(y) {
            *dx = dy * (1.0 - y * y);
        }
    }
}

per_isa! {
    /// `y = x / (1 + |x|)`.
    pub fn softsign_forward<S>(_simd: S, x: &[f32], y: &mut [f32]) {
        assert_eq!(x.len(), y.len(), "softsign_forward: x and y differ in length");
        for (y, &x) in y.iter_mut().zip(x) {
            *y = x / (1.0 + x.abs());
        }
    }
}

per_isa! {
    /// The gradient of [`softsign_forward`], `y = x / (1 + |x|)`, from its output `y`, as `1 - |y| = 1 / (1 + |x|)`; `dx` is
    /// overwritten.
    pub fn softsign_backward<S>(_simd: S, y: &[f32], dy: &[f32], dx: &mut [f32]) {
        assert!(y.len() == dy.len() && y.len() == dx.len(), "softsign_backward: y, dy and dx differ in length");
        for ((dx, &dy), &y) in dx.iter_mut().zip(dy).zip(y) {
            let rest = 1.0 - y.abs();
            *dx = dy * (rest * rest);
        }
    }
}

/// `s(x) = 1 / (1 + e^-x)` and `1 - s(x)` for `x >= -50`, absolute error below 1e-6: with `t = e^-|x| - 1`, the larger of them is
/// `1 / (2 + t)`, the smaller `(1 + t) / (2 + t)`.
#[inline(always)]
fn sigmoid_and_rest(x: f32) -> (f32, f32) {
    let t = expm1_of_negative(-x.abs());
    let larger = 1.0 / (t + 2.0);
    let smaller = (t + 1.0) * larger;
    if x > 0.0 { (larger, smaller) } else { (smaller, larger) }
}

per_isa! {
    /// `y = x s(x)` with `s(x) = 1 / (1 + e^-x)`, absolute error below `1e-6 max(1, |x|)`.
    pub fn swish_forward<S>(_simd: S, x: &[f32], y: &mut [f32]) {
        assert_eq!(x.len(), y.len(), "swish_forward: x and y differ in length");
        for (y, &x) in y.iter_mut().zip(x) {
            // Below -50, y is 0 in all but name; so -inf goes to 0, and NaN stays.
            let z = if x < -50.0 { -50.0 } else { x };
            let value = z * sigmoid_and_rest(z).0;
            *y = if x.is_nan() { x } else { value };
        }
    }
}

per_isa! {
    /// The gradient of [`swish_forward`] from its input `x`: `dx = dy (s + x s (1 - s))`; `dx` is overwritten.
    pub fn swish_backward<S>(_simd: S, x: &[f32], dy: &[f32], dx: &mut [f32]) {
        assert!(x.len() == dy.len() && x.len() == dx.len(), "swish_backward: x, dy and dx differ in length");
        for ((dx, &dy), &x) in dx.iter_mut().zip(dy).zip(x) {
            // Beyond 50 on either side the slope is that at 50: 0 or 1.
            let z = x.clamp(-50.0, 50.0);
            let (sigmoid, rest) = sigmoid_and_rest(z);
            let slope = sigmoid * (1.0 + z * rest);
            *dx = if x.is_nan() { x } else { dy * slope };
        }
    }
}

per_isa! {
    /// `y = x` where `x > 0`, else `slope x`, for `n` images.
    ///
    /// Each slope serves `repeat` consecutive elements of an image: 1 for one slope for each position, `h * w` for one slope for each
    /// channel. An image has `slopes.len() * repeat` elements.
    pub fn prelu_forward<S>(_simd: S, n: usize, slopes: &[f32], repeat: usize, x: &[f32], y: &mut [f32]) {
        let image = slopes.len() * repeat;
        assert!(x.len() == n * image && y.len() == n * image, "prelu_forward: x or y is not n images long");
        if image == 0 {
            return;
        }
        for (x, y) in x.chunks_exact(image).zip(y.chunks_exact_mut(image)) {
            if repeat == 1 {
                for ((y, &x), &slope) in y.iter_mut().zip(x).zip(slopes) {
                    *y = if x > 0.0 { x } else { slope * x };
                }
            } else {
                for ((y, x), &slope) in y.chunks_exact_mut(repeat).zip(x.chunks_exact(repeat)).zip(slopes) {
                    for (y, &x) in y.iter_mut().zip(x) {
                        *y = if x > 0.0 { x } else { slope * x };
                    }
                }
            }
        }
    }
}

per_isa! {
    /// The gradients of [`prelu_forward`], `y = x` or `slope x`: `dx` is overwritten, the gradient of the slopes is added to
    /// `dslopes`.
    pub fn prelu_backward<S>(
        _simd: S,
        n: usize,
        slopes: &[f32],
        repeat: usize,
        x: &[f32],
        dy: &[f32],
        dx: &mut [f32],
        dslopes: &mut [f32],
    ) {
        let image = slopes.len() * repeat;
        assert!(x.len() == n * image, "prelu_backward: x is not n images long");
        assert!(dy.len() == x.len() && dx.len() == x.len(), "prelu_backward: x, dy and dx differ in length");
        assert_eq!(slopes.len(), dslopes.len(), "prelu_backward: slopes and dslopes differ in length");
        if image == 0 {
            return;
        }
        for ((x, dy), dx) in x.chunks_exact(image).zip(dy.chunks_exact(image)).zip(dx.chunks_exact_mut(image)) {
            if repeat == 1 {
                for ((((dx, &dy), &x), &slope), dslope) in dx.iter_mut().zip(dy).zip(x).zip(slopes).zip(&mut *dslopes) {
                    *dx = if x > 0.0 { dy } else { slope * dy };
                    *dslope += if x > 0.0 { 0.0 } else { x * dy };
                }
            } else {
                let rows = x.chunks_exact(repeat).zip(dy.chunks_exact(repeat)).zip(dx.chunks_exact_mut(repeat));
                for (((x, dy), dx), (&slope, dslope)) in rows.zip(slopes.iter().zip(&mut *dslopes)) {
                    *dslope += prelu_channel(slope, x, dy, dx);
                }
            }
        }
    }
}

/// One channel of the PReLU gradient; the sum for the slope is taken in 16 interleaved parts so that it vectorises.
#[inline(always)]
fn prelu_channel(slope: f32, x: &[f32], dy: &[f32], dx: &mut [f32]) -> f32 {
    let mut sums = [0.0f32; 16];
    let (x_blocks, x_rest) = x.as_chunks::<16>();
    let (dy_blocks, dy_rest) = dy.as_chunks::<16>();
    let (dx_blocks, dx_rest) = dx.as_chunks_mut::<16>();
    for ((x, dy), dx) in x_blocks.iter().zip(dy_blocks).zip(dx_blocks) {
        for i in 0..16 {
            dx[i] = if x[i] > 0.0 { dy[i] } else { slope * dy[i] };
            sums[i] += if x[i] > 0.0 { 0.0 } else { x[i] * dy[i] };
        }
    }
    for (i, ((&x, &dy), dx)) in x_rest.iter().zip(dy_rest).zip(dx_rest).enumerate() {
        *dx = if x > 0.0 { dy } else { slope * dy };
        sums[i] += if x > 0.0 { 0.0 } else { x * dy };
    }
    sums.iter().sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Isa;

    #[test]
    fn expm1_is_within_1e_6_of_the_truth_also_near_zero() {
        for isa in Isa::available() {
            let x: Vec<f32> = (0..400_000).map(|i| -(1.00012f32.powi(i - 250_000)).min(120.0)).collect();
            let mut y = vec![f32::NAN; x.len()];
            elu_forward(isa, 1.0, &x, &mut y);
            for (&x, &y) in x.iter().zip(&y) {
                let truth = f64::from(x).exp_m1();
                assert!(((f64::from(y) - truth) / truth).abs() <= 1e-6, "{}: expm1({x:e}) = {y:e}", isa.name());
            }
        }
    }

    #[test]
    fn tanh_is_within_2e_6_of_the_truth_and_odd() {
        for isa in Isa::available() {
            let x: Vec<f32> = (0..400_000).map(|i| 1.00012f32.powi(i - 250_000).min(120.0)).collect();
            let (mut y, mut negative) = (vec![f32::NAN; x.len()], vec![f32::NAN; x.len()]);
            tanh_forward(isa, &x, &mut y);
            tanh_forward(isa, &x.iter().map(|x| -x).collect::<Vec<_>>(), &mut negative);
            for ((&x, &y), &negative) in x.iter().zip(&y).zip(&negative) {
                let truth = f64::from(x).tanh();
                assert!(((f64::from(y) - truth) / truth).abs() <= 2e-6, "{}: tanh({x:e}) = {y:e}", isa.name());
                assert_eq!(negative, -y);
            }
            let mut y = [1.0; 4];
            tanh_forward(isa, &[f32::NAN, 0.0, f32::NEG_INFINITY, f32::INFINITY], &mut y);
            assert!(y[0].is_nan() && y[1] == 0.0 && y[2] == -1.0 && y[3] == 1.0, "{y:?}");
        }
    }

    #[test]
    fn swish_is_within_its_bound_of_the_truth_and_goes_to_its_limits() {
        for isa in Isa::available() {
            let x: Vec<f32> = (-200_000..200_000).map(|i| i as f32 / 1000.0).collect();
            let (mut y, mut dx) = (vec![f32::NAN; x.len()], vec![f32::NAN; x.len()]);
            swish_forward(isa, &x, &mut y);
            swish_backward(isa, &x, &vec![1.0; x.len()], &mut dx);
            for ((&x, &y), &dx) in x.iter().zip(&y).zip(&dx) {
                let s = 1.0 / (1.0 + (-f64::from(x)).exp());
                let (truth, slope) = (f64::from(x) * s, s + f64::from(x) * s * (1.0 - s));
                let bound = 1e-6 * f64::from(x).abs().max(1.0);
                assert!((f64::from(y) - truth).abs() <= bound, "{}: swish({x:e}) = {y:e}", isa.name());
                assert!((f64::from(dx) - slope).abs() <= bound, "{}: slope of swish at {x:e} is {dx:e}", isa.name());
            }
            let ends = [f32::NAN, f32::NEG_INFINITY, -1e30, 0.0, f32::INFINITY];
            let (mut y, mut dx) = ([7.0; 5], [7.0; 5]);
            swish_forward(isa, &ends, &mut y);
            swish_backward(isa, &ends, &[1.0; 5], &mut dx);
            assert!(
                y[0].is_nan() && y[1].abs() < 1e-19 && y[2].abs() < 1e-19 && y[3] == 0.0 && y[4] == f32::INFINITY,
                "{y:?}"
            );
            assert!(
                dx[0].is_nan() && dx[1].abs() < 1e-19 && dx[2].abs() < 1e-19 && dx[3] == 0.5 && dx[4] == 1.0,
                "{dx:?}"
            );
        }
    }

    #[test]
    fn elu_passes_nan_on_and_keeps_zero() {
        for isa in Isa::available() {
            let mut y = [1.0; 4];
            elu_forward(isa, 1.0, &[f32::NAN, 0.0, f32::NEG_INFINITY, f32::INFINITY], &mut y);
            assert!(y[0].is_nan() && y[1] == 0.0 && y[2] == -1.0 && y[3] == f32::INFINITY, "{y:?}");
        }
    }
}
