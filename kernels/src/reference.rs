//! The naive loop for each kernel: the specification that the tests hold the kernels against.
//!
//! Names, arguments and layouts are those of the kernels, without the [`crate::Isa`]; sums are taken in `f64`.

use crate::blur::BlurShape;
use crate::conv_shape::ConvShape;
use crate::matrix::{Matrix, MatrixMut};
use crate::pool::PoolShape;
use crate::update::AdamStep;

/// See [`crate::gemm::gemm`] and [`crate::sgemm::sgemm`].
pub fn gemm(alpha: f32, a: Matrix, b: Matrix, beta: f32, c: MatrixMut) {
    let at = |matrix: Matrix, i: usize, j: usize| f64::from(matrix.values[i * matrix.strides.0 + j * matrix.strides.1]);
    for i in 0..a.rows {
        for j in 0..b.columns {
            let sum: f64 = (0..a.columns).map(|p| at(a, i, p) * at(b, p, j)).sum();
            let c = &mut c.values[i * c.strides.0 + j * c.strides.1];
            let old = if beta == 0.0 { 0.0 } else { f64::from(beta) * f64::from(*c) };
            *c = (old + f64::from(alpha) * sum) as f32;
        }
    }
}

/// Calls `visit` with the indices of x, of the weight and of y for every product of a convolution.
fn for_each_product(s: &ConvShape, n: usize, mut visit: impl FnMut(usize, usize, usize)) {
    let (out_h, out_w) = (s.out_h(), s.out_w());
    for image in 0..n {
        for oc in 0..s.oc {
            for oy in 0..out_h {
                for ox in 0..out_w {
                    for c in 0..s.c {
                        for ky in 0..s.kh {
                            for kx in 0..s.kw {
                                let (iy, ix) = (oy * s.stride_h + ky, ox * s.stride_w + kx);
                                if iy < s.pad_top || ix < s.pad_left {
                                    continue;
                                }
                                let (iy, ix) = (iy - s.pad_top, ix - s.pad_left);
                                if iy < s.h && ix < s.w {
                                    visit(
                                        ((image * s.c + c) * s.h + iy) * s.w + ix,
                                        ((oc * s.c + c) * s.kh + ky) * s.kw + kx,
                                        ((image * s.oc + oc) * out_h + oy) * out_w + ox,
                                    );
                                }
                            }
                        }
                    }
                }
            }
        }
    }
}

/// See [`crate::conv::Conv::forward`].
pub fn conv_forward(s: &ConvShape, n: usize, x: &[f32], weight: &[f32], bias: &[f32], y: &mut [f32]) {
    let pixels = s.out_h() * s.out_w();
    let mut sums: Vec<f64> = (0..y.len()).map(|i| f64::from(bias[i / pixels % s.oc])).collect();
    for_each_product(s, n, |i, k, o| sums[o] += f64::from(x[i]) * f64::from(weight[k]));
    for (y, sum) in y.iter_mut().zip(sums) {
        *y = sum as f32;
    }
}

/// See [`crate::conv::Conv::backward_input`].
pub fn conv_backward_input(s: &ConvShape, n: usize, dy: &[f32], weight: &[f32], dx: &mut [f32]) {
    let mut sums = vec![0.0f64; dx.len()];
    for_each_product(s, n, |i, k, o| sums[i] += f64::from(dy[o]) * f64::from(weight[k]));
    for (dx, sum) in dx.iter_mut().zip(sums) {
        *dx = sum as f32;
    }
}

/// See [`crate::conv::Conv::backward_weight`].
pub fn conv_backward_weight(s: &ConvShape, n: usize, x: &[f32], dy: &[f32], dweight: &mut [f32], dbias: &mut [f32]) {
    let mut sums: Vec<f64> = dweight.iter().map(|&d| f64::from(d)).collect();
    for_each_product(s, n, |i, k, o| sums[k] += f64::from(x[i]) * f64::from(dy[o]));
    for (dweight, sum) in dweight.iter_mut().zip(sums) {
        *dweight = sum as f32;
    }
    let pixels = s.out_h() * s.out_w();
    let mut sums: Vec<f64> = dbias.iter().map(|&d| f64::from(d)).collect();
    for (o, &dy) in dy.iter().enumerate() {
        sums[o / pixels % s.oc] += f64::from(dy);
    }
    for (dbias, sum) in dbias.iter_mut().zip(sums) {
        *dbias = sum as f32;
    }
}

/// The input positions of each window, in row-major window order, with the index of the output.
fn for_each_window(s: &PoolShape, n: usize, mut visit: impl FnMut(&[usize], usize)) {
    let (out_h, out_w) = (s.out_h(), s.out_w());
    for plane in 0..n * s.c {
        for oy in 0..out_h {
            for ox in 0..out_w {
                let mut window = Vec::new();
                for iy in oy * s.stride_h..oy * s.stride_h + s.kh {
                    for ix in ox * s.stride_w..ox * s.stride_w + s.kw {
                        window.push((plane * s.h + iy) * s.w + ix);
                    }
                }
                visit(&window, (plane * out_h + oy) * out_w + ox);
            }
        }
    }
}

/// See [`crate::pool::max_forward`].
pub fn max_forward(s: &PoolShape, n: usize, x: &[f32], y: &mut [f32]) {
    for_each_window(s, n, |window, o| y[o] = window.iter().map(|&i| x[i]).fold(f32::NEG_INFINITY, f32::max));
}

/// See [`crate::pool::max_backward`].
pub fn max_backward(s: &PoolShape, n: usize, x: &[f32], y: &[f32], dy: &[f32], dx: &mut [f32]) {
    dx.fill(0.0);
    for_each_window(s, n, |window, o| {
        if let Some(&first) = window.iter().find(|&&i| x[i] == y[o]) {
            dx[first] += dy[o];
        }
    });
}

/// See [`crate::pool::average_forward`].
pub fn average_forward(s: &PoolShape, n: usize, x: &[f32], y: &mut [f32]) {
    for_each_window(s, n, |window, o| {
        y[o] = (window.iter().map(|&i| f64::from(x[i])).sum::<f64>() / window.len() as f64) as f32;
    });
}

/// See [`crate::pool::average_backward`].
pub fn average_backward(s: &PoolShape, n: usize, dy: &[f32], dx: &mut [f32]) {
    dx.fill(0.0);
    for_each_window(s, n, |window, o| window.iter().for_each(|&i| dx[i] += dy[o] / window.len() as f32));
}

/// Weight of place `k` of a window of a blur: the product of two binomial coefficients over the sum of all.
fn blur_weight(s: &PoolShape, k: usize) -> f64 {
    let choose = |n: usize, k: usize| (0..k).fold(1.0, |c, i| c * (n - i) as f64 / (i + 1) as f64);
    let along = |taps: usize, k: usize| choose(taps - 1, k) / 2f64.powi(taps as i32 - 1);
    along(s.kh, k / s.kw) * along(s.kw, k % s.kw)
}

/// For each position of the maps with their padding, the index in the maps; `None` in the padding.
fn unpadded(s: &BlurShape, n: usize) -> Vec<Option<usize>> {
    let (map, padded) = (s.windows, s.padded());
    let position = |i: usize| {
        let y = (i / padded.w % padded.h).checked_sub(s.pad_h).filter(|y| *y < map.h)?;
        let x = (i % padded.w).checked_sub(s.pad_w).filter(|x| *x < map.w)?;
        Some((i / (padded.h * padded.w) * map.h + y) * map.w + x)
    };
    (0..n * map.c * padded.h * padded.w).map(position).collect()
}

/// See [`crate::blur::blur_forward`].
pub fn blur_forward(s: &BlurShape, n: usize, x: &[f32], y: &mut [f32]) {
    let index = unpadded(s, n);
    for_each_window(&s.padded(), n, |window, o| {
        let value = |i: usize| index[i].map_or(0.0, |i| f64::from(x[i]));
        y[o] = window.iter().enumerate().map(|(k, &i)| blur_weight(&s.windows, k) * value(i)).sum::<f64>() as f32;
    });
}

/// See [`crate::blur::blur_backward`].
pub fn blur_backward(s: &BlurShape, n: usize, dy: &[f32], dx: &mut [f32]) {
    dx.fill(0.0);
    let index = unpadded(s, n);
    for_each_window(&s.padded(), n, |window, o| {
        for (k, &i) in window.iter().enumerate() {
            if let Some(i) = index[i] {
                dx[i] += (blur_weight(&s.windows, k) * f64::from(dy[o])) as f32;
            }
        }
    });
}

/// See [`crate::activation::relu_forward`].
pub fn relu_forward(x: &[f32], y: &mut [f32]) {
    for i in 0..x.len() {
        y[i] = x[i].max(0.0);
    }
}

/// See [`crate::activation::relu_backward`].
pub fn relu_backward(y: &[f32], dy: &[f32], dx: &mut [f32]) {
    for i in 0..y.len() {
        dx[i] = if y[i] > 0.0 { dy[i] } else { 0.0 };
    }
}

/// See [`crate::activation::elu_forward`].
pub fn elu_forward(alpha: f32, x: &[f32], y: &mut [f32]) {
    for i in 0..x.len() {
        y[i] = if x[i] > 0.0 { x[i] } else { (f64::from(alpha) * f64::from(x[i]).exp_m1()) as f32 };
    }
}

/// See [`crate::activation::elu_backward`]. Where `y <= 0`, the slope `alpha e^x` is `y + alpha`.
pub fn elu_backward(alpha: f32, y: &[f32], dy: &[f32], dx: &mut [f32]) {
    for i in 0..y.len() {
        dx[i] = if y[i] > 0.0 { dy[i] } else { dy[i] * (y[i] + alpha) };
    }
}

/// See [`crate::activation::leaky_relu_forward`].
pub fn leaky_relu_forward(slope: f32, x: &[f32], y: &mut [f32]) {
    for i in 0..x.len() {
        y[i] = if x[i] > 0.0 { x[i] } else { slope * x[i] };
    }
}

/// See [`crate::activation::leaky_relu_backward`].
pub fn leaky_relu_backward(slope: f32, x: &[f32], dy: &[f32], dx: &mut [f32]) {
    for i in 0..x.len() {
        dx[i] = if x[i] > 0.0 { dy[i] } else { slope * dy[i] };
    }
}

/// See [`crate::activation::tanh_forward`].
pub fn tanh_forward(x: &[f32], y: &mut [f32]) {
    for i in 0..x.len() {
        y[i] = f64::from(x[i]).tanh() as f32;
    }
}

/// See [`crate::activation::tanh_backward`].
pub fn tanh_backward(y: &[f32], dy: &[f32], dx: &mut [f32]) {
    for i in 0..y.len() {
        dx[i] = (f64::from(dy[i]) * (1.0 - f64::from(y[i]).powi(2))) as f32;
    }
}

/// See [`crate::activation::softsign_forward`].
pub fn softsign_forward(x: &[f32], y: &mut [f32]) {
    for i in 0..x.len() {
        y[i] = (f64::from(x[i]) / (1.0 + f64::from(x[i]).abs())) as f32;
    }
}

/// See [`crate::activation::softsign_backward`].
pub fn softsign_backward(y: &[f32], dy: &[f32], dx: &mut [f32]) {
    for i in 0..y.len() {
        dx[i] = (f64::from(dy[i]) * (1.0 - f64::from(y[i]).abs()).powi(2)) as f32;
    }
}

fn sigmoid(x: f32) -> f64 {
    1.0 / (1.0 + (-f64::from(x)).exp())
}

/// See [`crate::activation::swish_forward`].
pub fn swish_forward(x: &[f32], y: &mut [f32]) {
    for i in 0..x.len() {
        y[i] = (f64::from(x[i]) * sigmoid(x[i])) as f32;
    }
}

/// See [`crate::activation::swish_backward`].
pub fn swish_backward(x: &[f32], dy: &[f32], dx: &mut [f32]) {
    for i in 0..x.len() {
        let s = sigmoid(x[i]);
        dx[i] = (f64::from(dy[i]) * (s + f64::from(x[i]) * s * (1.0 - s))) as f32;
    }
}

/// See [`crate::activation::prelu_forward`].
pub fn prelu_forward(slopes: &[f32], repeat: usize, x: &[f32], y: &mut [f32]) {
    for i in 0..x.len() {
        let slope = slopes[i / repeat % slopes.len()];
        y[i] = if x[i] > 0.0 { x[i] } else { slope * x[i] };
    }
}

/// See [`crate::activation::prelu_backward`].
pub fn prelu_backward(slopes: &[f32], repeat: usize, x: &[f32], dy: &[f32], dx: &mut [f32], dslopes: &mut [f32]) {
    let mut sums: Vec<f64> = dslopes.iter().map(|&d| f64::from(d)).collect();
    for i in 0..x.len() {
        let s = i / repeat % slopes.len();
        dx[i] = if x[i] > 0.0 { dy[i] } else { slopes[s] * dy[i] };
        if x[i] <= 0.0 {
            sums[s] += f64::from(x[i]) * f64::from(dy[i]);
        }
    }
    for (dslope, sum) in dslopes.iter_mut().zip(sums) {
        *dslope = sum as f32;
    }
}

/// See [`crate::norm::channel_sums`].
pub fn channel_sums(c: usize, hw: usize, x: &[f32], sums: &mut [f64]) {
    for (i, &x) in x.iter().enumerate() {
        sums[i / hw % c] += f64::from(x);
        sums[c + i / hw % c] += f64::from(x).powi(2);
    }
}

/// See [`crate::norm::normalize`].
pub fn normalize(c: usize, hw: usize, x: &[f32], scale: &[f32], shift: &[f32], y: &mut [f32]) {
    for i in 0..x.len() {
        y[i] = x[i] * scale[i / hw % c] + shift[i / hw % c];
    }
}

/// See [`crate::norm::norm_backward_sums`].
pub fn norm_backward_sums(
    (c, hw): (usize, usize),
    x: &[f32],
    dy: &[f32],
    mean: &[f32],
    inv_std: &[f32],
    sums: &mut [f64],
) {
    for i in 0..x.len() {
        let channel = i / hw % c;
        let xhat = f64::from(x[i] - mean[channel]) * f64::from(inv_std[channel]);
        sums[channel] += f64::from(dy[i]);
        sums[c + channel] += f64::from(dy[i]) * xhat;
    }
}

/// See [`crate::norm::norm_backward`]; `stats` are mean, inv_std, a, b and g.
pub fn norm_backward((c, hw): (usize, usize), x: &[f32], dy: &[f32], stats: [&[f32]; 5], dx: &mut [f32]) {
    for i in 0..x.len() {
        let [mean, inv_std, a, b, g] = stats.map(|s| s[i / hw % c]);
        dx[i] = g * (dy[i] - a - (x[i] - mean) * inv_std * b);
    }
}

/// See [`crate::update::adam`].
pub fn adam(step: &AdamStep, params: &mut [f32], grads: &[f32], m: &mut [f32], v: &mut [f32]) {
    let AdamStep { lr, beta1, beta2, epsilon, bias_correction1, bias_correction2, l2, decoupled_decay } = *step;
    for i in 0..params.len() {
        let g = grads[i] + l2 * params[i];
        m[i] = beta1 * m[i] + (1.0 - beta1) * g;
        v[i] = beta2 * v[i] + (1.0 - beta2) * g * g;
        let adaptive = lr * bias_correction2.sqrt() / bias_correction1 * m[i] / (v[i].sqrt() + epsilon);
        params[i] -= lr * decoupled_decay * params[i] + adaptive;
    }
}

/// See [`crate::update::sgd_momentum`].
pub fn sgd_momentum(lr: f32, momentum: f32, l2: f32, params: &mut [f32], grads: &[f32], velocity: &mut [f32]) {
    for i in 0..params.len() {
        velocity[i] = momentum * velocity[i] - lr * (grads[i] + l2 * params[i]);
        params[i] += velocity[i];
    }
}

/// See [`crate::pixels::add_grey`].
pub fn add_grey(constant: &[f32], slope: &[f32], factor: f32, rgb: &mut [u8]) {
    for (x, px) in rgb.chunks_exact_mut(3).enumerate() {
        let error = (constant[x] + factor * slope[x] + 0.5).floor() as i32;
        px.iter_mut().for_each(|grey| *grey = (i32::from(*grey) + error).clamp(0, 255) as u8);
    }
}

/// See [`crate::pixels::recolour`].
pub fn recolour(matrix: &[[f32; 3]; 3], offset: f32, rgb: &mut [u8]) {
    for px in rgb.chunks_exact_mut(3) {
        let before = [f32::from(px[0]), f32::from(px[1]), f32::from(px[2])];
        for k in 0..3 {
            px[k] = (matrix[k][0] * before[0] + matrix[k][1] * before[1] + matrix[k][2] * before[2] + offset) as u8;
        }
    }
}

/// See [`crate::pixels::u8_to_f32`].
pub fn u8_to_f32(src: &[u8], scale: f32, offset: f32, dst: &mut [f32]) {
    for i in 0..src.len() {
        dst[i] = f32::from(src[i]) * scale + offset;
    }
}
