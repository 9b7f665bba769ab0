//! An image as the matrix of its patches, and back (Chellapilla et al. 2006).
//!
//! With the patches of an image as rows, a convolution is the product `y = W patches'`, where `W` is `[oc][taps]` and
//! `taps` is `c * kh * kw`. This works for every kernel, stride and padding, but writes each element of the image up to
//! `kh * kw` times.

use crate::conv::ConvShape;

/// Calls `visit` for each run of `kw` or fewer neighbouring elements that a patch shares with the image, with where it
/// begins in the image and in the patches and its length.
#[inline(always)]
fn for_each_run(shape: &ConvShape, mut visit: impl FnMut(usize, usize, usize)) {
    let &ConvShape { c, h, w, kh, kw, stride_h, stride_w, pad_top, pad_left, .. } = shape;
    let (out_h, out_w) = (shape.out_h(), shape.out_w());
    for oy in 0..out_h {
        let ky_first = pad_top.saturating_sub(oy * stride_h).min(kh);
        let ky_end = (h + pad_top).saturating_sub(oy * stride_h).clamp(ky_first, kh);
        for ox in 0..out_w {
            let kx_first = pad_left.saturating_sub(ox * stride_w).min(kw);
            let kx_end = (w + pad_left).saturating_sub(ox * stride_w).clamp(kx_first, kw);
            if kx_first == kx_end {
                continue;
            }
            let patch = (oy * out_w + ox) * c * kh * kw;
            let ix = ox * stride_w + kx_first - pad_left;
            for channel in 0..c {
                for ky in ky_first..ky_end {
                    let iy = oy * stride_h + ky - pad_top;
                    let in_patch = patch + (channel * kh + ky) * kw + kx_first;
                    visit((channel * h + iy) * w + ix, in_patch, kx_end - kx_first);
                }
            }
        }
    }
}

/// Checks the lengths of one image and its patches.
fn check(kernel: &str, shape: &ConvShape, image: usize, patches: usize) {
    assert_eq!(image, shape.c * shape.h * shape.w, "{kernel}: length of the image of {shape:?}");
    let pixels = shape.out_h() * shape.out_w();
    assert_eq!(patches, pixels * shape.c * shape.kh * shape.kw, "{kernel}: length of the patches of {shape:?}");
}

/// Writes the patches of one image.
///
/// # Shapes
/// `x`: `[c][h][w]`, `patches`: `[out_h * out_w][c * kh * kw]`, overwritten; what lies outside the image is 0.
pub fn im2col(shape: &ConvShape, x: &[f32], patches: &mut [f32]) {
    check("im2col", shape, x.len(), patches.len());
    patches.fill(0.0);
    for_each_run(shape, |image, patch, len| patches[patch..patch + len].copy_from_slice(&x[image..image + len]));
}

/// Adds each element of the patches to the element of the image it came from: the transpose of [`im2col`].
///
/// # Shapes
/// As for [`im2col`]; what `patches` holds for positions outside the image is ignored.
pub fn col2im(shape: &ConvShape, patches: &[f32], dx: &mut [f32]) {
    check("col2im", shape, dx.len(), patches.len());
    for_each_run(shape, |image, patch, len| {
        for (dx, &patch) in dx[image..image + len].iter_mut().zip(&patches[patch..patch + len]) {
            *dx += patch;
        }
    });
}
