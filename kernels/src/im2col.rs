//! An image as the matrix of its patches, and back (Chellapilla et al. 2006).
//!
//! The identity: with `taps = C * KH * KW` and `pixels = OH * OW`, the *columns* of an image are a matrix `[taps][pixels]`,
//! written `[C*KH*KW, OH*OW]`. Column `oy * OW + ox` holds the patch of the image that output `(oy, ox)` sees. Row
//! `(c * KH + ky) * KW + kx` holds what tap `(c, ky, kx)` of the kernel sees at each output:
//!
//! ```text
//! columns[(c, ky, kx)][(oy, ox)] = x[c][oy * stride_h + ky - pad_top][ox * stride_w + kx - pad_left],   0 outside the image
//! ```
//!
//! A convolution is then one matrix product: `y [OC, OH*OW] = weight [OC, C*KH*KW] * columns [C*KH*KW, OH*OW]`.
//! This holds for any kernel, stride and padding. The price is memory: an element of the image is written up to `KH * KW`
//! times.
//!
//! # Example
//! A 3x3 image and a 2x2 kernel: 4 taps, 4 outputs. The first column is the patch in the upper left corner.
//!
//! ```
//! use steersman_kernels::conv::ConvShape;
//! use steersman_kernels::im2col::{col2im, im2col};
//!
//! let [pad_top, pad_bottom, pad_left, pad_right] = [0; 4];
//! let shape = ConvShape { c: 1, h: 3, w: 3, oc: 1, kh: 2, kw: 2, stride_h: 1, stride_w: 1,
//!                         pad_top, pad_bottom, pad_left, pad_right };
//! let x = [1., 2., 3.,
//!          4., 5., 6.,
//!          7., 8., 9.];
//! let mut columns = [0.; 16];
//! im2col(&shape, &x, &mut columns);
//! assert_eq!(columns, [1., 2., 4., 5.,    // tap (0, 0) at the four outputs
//!                      2., 3., 5., 6.,    // tap (0, 1)
//!                      4., 5., 7., 8.,    // tap (1, 0)
//!                      5., 6., 8., 9.]);  // tap (1, 1)
//!
//! // The way back adds up: the middle of the image lies in four patches.
//! let mut dx = [0.; 9];
//! col2im(&shape, &[1.; 16], &mut dx);
//! assert_eq!(dx, [1., 2., 1.,
//!                 2., 4., 2.,
//!                 1., 2., 1.]);
//! ```

use std::ops::Range;

use crate::conv_shape::ConvShape;

/// The outputs `o` along one axis, of `outputs`, whose tap `k` falls into the image: `0 <= o * stride + k - pad < size`.
fn inside(size: usize, pad: usize, stride: usize, k: usize, outputs: usize) -> Range<usize> {
    let end = (size + pad).saturating_sub(k).div_ceil(stride).min(outputs);
    pad.saturating_sub(k).div_ceil(stride).min(end)..end
}

/// Checks the lengths of one image and its columns.
fn check(kernel: &str, shape: &ConvShape, image: usize, columns: usize) {
    assert_eq!(image, shape.x_len(), "{kernel}: length of the image of {shape:?}");
    assert_eq!(columns, shape.taps() * shape.out_pixels(), "{kernel}: length of the columns of {shape:?}");
}

/// Writes the columns of one image.
///
/// # Shapes
/// `x`: `[c][h][w]`, `columns`: `[c * kh * kw][out_h * out_w]`, overwritten.
///
/// # Panics
/// If a slice has another length.
pub fn im2col(shape: &ConvShape, x: &[f32], columns: &mut [f32]) {
    check("im2col", shape, x.len(), columns.len());
    let &ConvShape { c, h, w, kh, kw, stride_h, stride_w, pad_top, pad_left, .. } = shape;
    let (out_h, out_w) = (shape.out_h(), shape.out_w());
    if columns.is_empty() {
        return;
    }
    let mut rows = columns.chunks_exact_mut(out_w);
    for channel in 0..c {
        for ky in 0..kh {
            for kx in 0..kw {
                let (oys, oxs) = (inside(h, pad_top, stride_h, ky, out_h), inside(w, pad_left, stride_w, kx, out_w));
                for (oy, row) in rows.by_ref().take(out_h).enumerate() {
                    if !oys.contains(&oy) || oxs.is_empty() {
                        row.fill(0.0);
                        continue;
                    }
                    let (iy, ix) = (oy * stride_h + ky - pad_top, oxs.start * stride_w + kx - pad_left);
                    let x = &x[(channel * h + iy) * w + ix..(channel * h + iy + 1) * w];
                    row[..oxs.start].fill(0.0);
                    row[oxs.end..].fill(0.0);
                    let row = &mut row[oxs.clone()];
                    if stride_w == 1 {
                        row.copy_from_slice(&x[..row.len()]);
                    } else {
                        row.iter_mut().zip(x.iter().step_by(stride_w)).for_each(|(to, &x)| *to = x);
                    }
                }
            }
        }
    }
}

/// Adds each element of the columns to the element of the image it came from: the transpose of [`im2col`].
///
/// # Shapes
/// As for [`im2col`]. What `columns` holds for positions outside the image is ignored.
///
/// # Panics
/// If a slice has another length.
pub fn col2im(shape: &ConvShape, columns: &[f32], dx: &mut [f32]) {
    check("col2im", shape, dx.len(), columns.len());
    let &ConvShape { c, h, w, kh, kw, stride_h, stride_w, pad_top, pad_left, .. } = shape;
    let (out_h, out_w) = (shape.out_h(), shape.out_w());
    if columns.is_empty() {
        return;
    }
    let mut rows = columns.chunks_exact(out_w);
    for channel in 0..c {
        for ky in 0..kh {
            for kx in 0..kw {
                let (oys, oxs) = (inside(h, pad_top, stride_h, ky, out_h), inside(w, pad_left, stride_w, kx, out_w));
                for (oy, row) in rows.by_ref().take(out_h).enumerate() {
                    if !oys.contains(&oy) || oxs.is_empty() {
                        continue;
                    }
                    let (iy, ix) = (oy * stride_h + ky - pad_top, oxs.start * stride_w + kx - pad_left);
                    let dx = &mut dx[(channel * h + iy) * w + ix..(channel * h + iy + 1) * w];
                    let row = &row[oxs.clone()];
                    if stride_w == 1 {
                        dx.iter_mut().zip(row).for_each(|(dx, &value)| *dx += value);
                    } else {
                        dx.iter_mut().step_by(stride_w).zip(row).for_each(|(dx, &value)| *dx += value);
                    }
                }
            }
        }
    }
}
