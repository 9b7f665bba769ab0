//! The input gradient of maps of few rows, patch by patch.
//!
//! A map of few rows is mostly border. There the sum over taps of [`input_gradient`](super::input_gradient) multiplies zeros.
//! Here each output's gradient is turned into the gradient of its patch, `dY' W`, as one matrix product, and the patches are added
//! up where they overlap.
//!
//! In `im2col` patches are columns; here they are rows, `[OH*OW][C*KH*KW]`. The maps have few outputs and many taps, and the
//! matrix product fills its vectors along the rows.

use crate::Isa;
use crate::conv_shape::ConvShape;
use crate::gemm::{gemm, gemm_scratch_len};
use crate::matrix::{Matrix, MatrixMut};

/// The input gradient of one shape.
#[derive(Clone, Debug)]
pub(super) struct PatchGradient {
    shape: ConvShape,
    isa: Isa,
}

impl PatchGradient {
    pub fn new(shape: ConvShape, isa: Isa) -> PatchGradient {
        PatchGradient { shape, isa }
    }

    /// Length of the scratch of [`PatchGradient::run`].
    pub fn scratch_len(&self) -> usize {
        let (pixels, taps) = (self.shape.out_pixels(), self.shape.taps());
        pixels * taps + gemm_scratch_len(pixels, self.shape.oc, taps)
    }

    /// The input gradient of the images in `dy`; `dx` is overwritten.
    pub fn run(&self, dy: &[f32], weight: &[f32], dx: &mut [f32], scratch: &mut [f32]) {
        let shape = &self.shape;
        let (oc, pixels, taps) = (shape.oc, shape.out_pixels(), shape.taps());
        let (patches, scratch) = scratch.split_at_mut(pixels * taps);
        dx.fill(0.0);
        for (dy, dx) in dy.chunks_exact(shape.y_len()).zip(dx.chunks_exact_mut(shape.x_len())) {
            let (dy, weight) = (Matrix::new(dy, oc, pixels).transposed(), Matrix::new(weight, oc, taps));
            gemm(self.isa, 1.0, dy, weight, 0.0, MatrixMut::new(patches, pixels, taps), scratch);
            add_patches(shape, patches, dx);
        }
    }
}

/// Adds each element of the patches, `[out_h * out_w][c * kh * kw]`, to the element of the image it came from.
fn add_patches(shape: &ConvShape, patches: &[f32], dx: &mut [f32]) {
    let &ConvShape { c, h, w, kh, kw, stride_h, stride_w, pad_top, pad_left, .. } = shape;
    let (out_h, out_w) = (shape.out_h(), shape.out_w());
    for oy in 0..out_h {
        // The taps that fall into the image.
        let ky_first = pad_top.saturating_sub(oy * stride_h).min(kh);
        let ky_end = (h + pad_top).saturating_sub(oy * stride_h).clamp(ky_first, kh);
        for ox in 0..out_w {
            let kx_first = pad_left.saturating_sub(ox * stride_w).min(kw);
            let kx_end = (w + pad_left).saturating_sub(ox * stride_w).clamp(kx_first, kw);
            if kx_first == kx_end {
                continue;
            }
            let patch = &patches[(oy * out_w + ox) * c * kh * kw..][..c * kh * kw];
            let ix = ox * stride_w + kx_first - pad_left;
            for channel in 0..c {
                for ky in ky_first..ky_end {
                    let iy = oy * stride_h + ky - pad_top;
                    let dx = &mut dx[(channel * h + iy) * w + ix..][..kx_end - kx_first];
                    let patch = &patch[(channel * kh + ky) * kw + kx_first..];
                    dx.iter_mut().zip(patch).for_each(|(dx, &patch)| *dx += patch);
                }
            }
        }
    }
}
