//! The layout of images for a sum over taps: padded, with the columns of each phase side by side.

use crate::conv_shape::ConvShape;
use crate::simd::Simd;

/// How many images of `image` elements are copied at a time, within a budget of elements.
pub(super) fn group_of(image: usize, budget: usize) -> usize {
    (budget / image.max(1)).clamp(1, 8)
}

/// The layout of an input image for a sum over taps of stride 1.
///
/// With stride `s`, the input row `oy * s + ky` is row `oy + ky / s` among the rows that leave the remainder `ky % s`. The same
/// holds for columns. So splitting the padded image into its `s x s` phases turns any convolution into one of stride 1,
/// with a table of tap offsets. A convolution of stride 1 without padding reads the image as it is.
#[derive(Clone, Debug)]
pub(crate) struct Layout {
    shape: ConvShape,
    /// Number of phases of rows and of columns. Phases that no tap reads are left out.
    phases: (usize, usize),
    /// Rows of a phase plane.
    pub rows: usize,
    /// Elements between two rows of a phase plane.
    pub pitch: usize,
    /// Whether images must be copied into this layout.
    pub copies: bool,
}

impl Layout {
    pub fn new(shape: ConvShape) -> Layout {
        let ConvShape { h, w, kh, kw, stride_h, stride_w, .. } = shape;
        if stride_h == 1 && stride_w == 1 && !shape.is_padded() {
            return Layout { shape, phases: (1, 1), rows: h, pitch: w, copies: false };
        }
        Layout {
            shape,
            phases: (kh.min(stride_h), kw.min(stride_w)),
            rows: shape.out_h() + (kh - 1) / stride_h,
            pitch: shape.out_w() + (kw - 1) / stride_w,
            copies: true,
        }
    }

    /// Length of one image in this layout.
    pub fn image(&self) -> usize {
        self.shape.c * self.phases.0 * self.phases.1 * self.rows * self.pitch
    }

    /// The offset of each tap, in the order of the weights: channel, ky, kx.
    pub fn taps(&self) -> Vec<usize> {
        let ConvShape { c, kh, kw, stride_h, stride_w, .. } = self.shape;
        let mut taps = Vec::with_capacity(c * kh * kw);
        for channel in 0..c {
            for ky in 0..kh {
                for kx in 0..kw {
                    let phase = (channel * self.phases.0 + ky % stride_h) * self.phases.1 + kx % stride_w;
                    taps.push((phase * self.rows + ky / stride_h) * self.pitch + kx / stride_w);
                }
            }
        }
        taps
    }
}

per_isa! {
    /// Copies images `[c][h][w]` into the layout; `to` is overwritten.
    pub fn copy<S>(simd: S, layout: &Layout, x: &[f32], to: &mut [f32]) {
        let ConvShape { c, h, w, stride_h, stride_w, pad_top, pad_left, .. } = layout.shape;
        let plane = layout.rows * layout.pitch;
        if h * w == 0 || plane == 0 {
            to.fill(0.0);
            return;
        }
        debug_assert_eq!(x.len() / (c * h * w), to.len() / layout.image());
        let phases = layout.phases.0 * layout.phases.1;
        for (x, planes) in x.chunks_exact(h * w).zip(to.chunks_exact_mut(phases * plane)) {
            for (phase, to) in planes.chunks_exact_mut(plane).enumerate() {
                let (phase_y, phase_x) = (phase / layout.phases.1, phase % layout.phases.1);
                // The columns `q` of the phase with `0 <= q stride + phase - pad < w`.
                let first = pad_left.saturating_sub(phase_x).div_ceil(stride_w).min(layout.pitch);
                let last = (w + pad_left).saturating_sub(phase_x).div_ceil(stride_w).clamp(first, layout.pitch);
                for (q, to) in to.chunks_exact_mut(layout.pitch).enumerate() {
                    let row = q * stride_h + phase_y;
                    if row < pad_top || row - pad_top >= h || first == last {
                        to.fill(0.0);
                        continue;
                    }
                    let x = &x[(row - pad_top) * w..][..w];
                    to[..first].fill(0.0);
                    to[last..].fill(0.0);
                    take_every(simd, &x[first * stride_w + phase_x - pad_left..], stride_w, &mut to[first..last]);
                }
            }
        }
    }
}

/// `to[i] = x[i * stride]`.
#[inline(always)]
fn take_every<S: Simd>(simd: S, x: &[f32], stride: usize, to: &mut [f32]) {
    assert!((to.len() - 1) * stride < x.len(), "a row ends too early");
    match stride {
        1 => to.copy_from_slice(&x[..to.len()]),
        2 => {
            for (i, to) in to.chunks_mut(S::LANES).enumerate() {
                // SAFETY: a chunk has 1 to `LANES` elements, and the last value of the last one lies in `x`.
                unsafe {
                    let values = simd.load_every_second(x.as_ptr().add(2 * S::LANES * i), to.len());
                    simd.store_first(to.as_mut_ptr(), values, to.len());
                }
            }
        }
        _ => to.iter_mut().zip(x.iter().step_by(stride)).for_each(|(to, &x)| *to = x),
    }
}

/// `to[i * stride] = from[i]`.
#[inline(always)]
pub(crate) fn put_every<S: Simd>(simd: S, from: &[f32], stride: usize, to: &mut [f32]) {
    assert!((from.len() - 1) * stride < to.len(), "a row ends too early");
    if stride == 2 {
        for (i, from) in from.chunks(S::LANES).enumerate() {
            // SAFETY: a chunk has 1 to `LANES` elements, and the last place of the last one lies in `to`.
            unsafe {
                let values = simd.load_first(from.as_ptr(), from.len());
                simd.store_every_second(to.as_mut_ptr().add(2 * S::LANES * i), values, from.len());
            }
        }
    } else {
        to.iter_mut().step_by(stride).zip(from).for_each(|(to, &from)| *to = from);
    }
}
