//! The gradients of a convolution from a few positions of its output: the argmax of each window of a max pooling.
//!
//! Behind a 4x4 pooling 15 of 16 output gradients are 0. One multiply-add at a time over the rest takes less than whole
//! vectors over all of it.

use crate::conv_shape::ConvShape;
use crate::simd::Simd;

/// Whether there is code for the shape: 3x3 and 5x5 kernels that read the image as it is.
pub(crate) fn supports(shape: &ConvShape) -> bool {
    (shape.stride_h, shape.stride_w) == (1, 1) && !shape.is_padded() && matches!((shape.kh, shape.kw), (3, 3) | (5, 5))
}

/// Every window must lie in a plane of the input.
#[inline(always)]
fn check<const K: usize>(shape: &ConvShape, argmax: &[u32]) {
    let reach = (K - 1) * shape.w + K;
    let farthest = argmax.iter().fold(0, |max, &at| if at > max { at } else { max });
    assert!(
        argmax.is_empty() || farthest as usize + reach <= shape.h * shape.w,
        "sparse conv gradient: a window outside the image"
    );
}

per_isa! {
    /// Adds to `dweight` and `dbias`; `argmax` and `dy` are `[n][oc][count]`.
    pub(crate) fn weight_gradient<S>(
        simd: S,
        shape: &ConvShape,
        x: &[f32],
        argmax: &[u32],
        dy: &[f32],
        dweight: &mut [f32],
        dbias: &mut [f32],
    ) {
        if shape.kh == 3 {
            weight_gradient_of::<S, 3>(simd, shape, x, argmax, dy, dweight, dbias);
        } else {
            weight_gradient_of::<S, 5>(simd, shape, x, argmax, dy, dweight, dbias);
        }
    }
}

#[inline(always)]
fn weight_gradient_of<S: Simd, const K: usize>(
    _simd: S,
    shape: &ConvShape,
    x: &[f32],
    argmax: &[u32],
    dy: &[f32],
    dweight: &mut [f32],
    dbias: &mut [f32],
) {
    let plane = shape.h * shape.w;
    check::<K>(shape, argmax);
    let images = x.len() / shape.x_len();
    let count = dy.len() / (images * shape.oc).max(1);
    for image in 0..images {
        for o in 0..shape.oc {
            let entries = (image * shape.oc + o) * count..(image * shape.oc + o + 1) * count;
            let (argmax, dy) = (&argmax[entries.clone()], &dy[entries]);
            dbias[o] += dy.iter().sum::<f32>();
            for c in 0..shape.c {
                let x = &x[(image * shape.c + c) * plane..][..plane];
                let mut sums = [[0.0f32; K]; K];
                for (&at, &dy) in argmax.iter().zip(dy) {
                    for (ky, sums) in sums.iter_mut().enumerate() {
                        for kx in 0..K {
                            // SAFETY: the window lies in the plane, by `check`.
                            sums[kx] += dy * unsafe { x.get_unchecked(at as usize + ky * shape.w + kx) };
                        }
                    }
                }
                let to = &mut dweight[(o * shape.c + c) * K * K..][..K * K];
                for (to, sum) in to.iter_mut().zip(sums.as_flattened()) {
                    *to += sum;
                }
            }
        }
    }
}

per_isa! {
    /// Overwrites `dx`; `argmax` and `dy` are `[n][oc][count]`.
    pub(crate) fn input_gradient<S>(
        simd: S,
        shape: &ConvShape,
        argmax: &[u32],
        dy: &[f32],
        weight: &[f32],
        dx: &mut [f32],
    ) {
        if shape.kh == 3 {
            input_gradient_of::<S, 3>(simd, shape, argmax, dy, weight, dx);
        } else {
            input_gradient_of::<S, 5>(simd, shape, argmax, dy, weight, dx);
        }
    }
}

#[inline(always)]
fn input_gradient_of<S: Simd, const K: usize>(
    _simd: S,
    shape: &ConvShape,
    argmax: &[u32],
    dy: &[f32],
    weight: &[f32],
    dx: &mut [f32],
) {
    dx.fill(0.0);
    let plane = shape.h * shape.w;
    check::<K>(shape, argmax);
    let images = dx.len() / shape.x_len();
    let count = dy.len() / (images * shape.oc).max(1);
    for image in 0..images {
        for o in 0..shape.oc {
            let entries = (image * shape.oc + o) * count..(image * shape.oc + o + 1) * count;
            let (argmax, dy) = (&argmax[entries.clone()], &dy[entries]);
            for c in 0..shape.c {
                let dx = &mut dx[(image * shape.c + c) * plane..][..plane];
                let mut weights = [[0.0f32; K]; K];
                weights.as_flattened_mut().copy_from_slice(&weight[(o * shape.c + c) * K * K..][..K * K]);
                for (&at, &dy) in argmax.iter().zip(dy) {
                    for (ky, weights) in weights.iter().enumerate() {
                        for kx in 0..K {
                            // SAFETY: the window lies in the plane, by `check`.
                            unsafe { *dx.get_unchecked_mut(at as usize + ky * shape.w + kx) += dy * weights[kx] };
                        }
                    }
                }
            }
        }
    }
}
