//! Convolution the textbook way, [`im2col`](crate::im2col) and the `sgemm` of `matrixmultiply`: what the kernels of
//! [`conv`](crate::conv) are measured against, and one more opinion on what they should compute.
//!
//! It is on no hot path, because it allocates: the patches here, and a packing buffer in every `sgemm`.

use crate::conv::ConvShape;
use crate::im2col::{col2im, im2col};

/// `C = A B`, with A `[m][k]` and B `[k][n]` in any strides (row, column) and C `[m][n]` row-major, overwritten.
///
/// # Panics
/// If a stride leads beyond its slice.
pub fn sgemm(
    (m, k, n): (usize, usize, usize),
    a: &[f32],
    a_strides: (usize, usize),
    b: &[f32],
    b_strides: (usize, usize),
    c: &mut [f32],
) {
    let fits = |rows: usize, cols: usize, (row, col): (usize, usize), len: usize| {
        rows == 0 || cols == 0 || (rows - 1) * row + (cols - 1) * col < len
    };
    assert!(fits(m, k, a_strides, a.len()), "sgemm: A has {} elements", a.len());
    assert!(fits(k, n, b_strides, b.len()), "sgemm: B has {} elements", b.len());
    assert_eq!(c.len(), m * n, "sgemm: length of C");
    let stride = |stride: usize| stride as isize;
    // SAFETY: the assertions above keep every element that the strides reach inside its slice, and C, a mutable slice,
    // overlaps neither A nor B. With beta 0, C is written without being read.
    unsafe {
        matrixmultiply::sgemm(
            m,
            k,
            n,
            1.0,
            a.as_ptr(),
            stride(a_strides.0),
            stride(a_strides.1),
            b.as_ptr(),
            stride(b_strides.0),
            stride(b_strides.1),
            0.0,
            c.as_mut_ptr(),
            stride(n),
            1,
        );
    }
}

/// Forward pass of `n` images: as [`Conv::forward`](crate::conv::Conv::forward).
pub fn conv_forward(shape: &ConvShape, n: usize, x: &[f32], weight: &[f32], bias: &[f32], y: &mut [f32]) {
    let (taps, pixels) = (shape.c * shape.kh * shape.kw, shape.out_h() * shape.out_w());
    let mut patches = vec![0.0; pixels * taps];
    // A kernel that does not fit gives no pixels, and chunks of nothing are not allowed.
    let images = x.chunks_exact(shape.c * shape.h * shape.w).zip(y.chunks_exact_mut((shape.oc * pixels).max(1)));
    for (x, y) in images.take(n) {
        im2col(shape, x, &mut patches);
        sgemm((shape.oc, taps, pixels), weight, (taps, 1), &patches, (1, taps), y);
        for (y, bias) in y.chunks_exact_mut(pixels.max(1)).zip(bias) {
            y.iter_mut().for_each(|y| *y += bias);
        }
    }
}

/// Input gradient of `n` images: as [`Conv::backward_input`](crate::conv::Conv::backward_input).
pub fn conv_backward_input(shape: &ConvShape, n: usize, dy: &[f32], weight: &[f32], dx: &mut [f32]) {
    let (taps, pixels) = (shape.c * shape.kh * shape.kw, shape.out_h() * shape.out_w());
    let mut patches = vec![0.0; pixels * taps];
    dx.fill(0.0);
    let images = dy.chunks_exact((shape.oc * pixels).max(1)).zip(dx.chunks_exact_mut(shape.c * shape.h * shape.w));
    for (dy, dx) in images.take(n) {
        sgemm((pixels, shape.oc, taps), dy, (1, pixels), weight, (taps, 1), &mut patches);
        col2im(shape, &patches, dx);
    }
}
