//! The direct algorithm: a sum over taps ([`TapSum`]) over the image itself or a copy in another [`Layout`].

use super::layout::{self, Layout, group_of};
use super::span;
use super::tap_sum::{self, Band, TapSum};
use super::weight_gradient;
use crate::Isa;
use crate::conv_shape::ConvShape;
use crate::simd::MAX_LANES;

/// Elements of copied images that the forward pass works on at a time: 256 KiB leaves room in the second-level cache.
pub(super) const FORWARD_COPIES: usize = 1 << 16;
/// The same for the weight gradient: 2 MiB. It sums over lanes once a group, so groups should be large.
const GRADIENT_COPIES: usize = 1 << 19;

/// The tables of the forward pass and the weight gradient of one shape.
#[derive(Clone, Debug)]
pub(super) struct Direct {
    shape: ConvShape,
    isa: Isa,
    layout: Layout,
    sum: TapSum,
}

impl Direct {
    pub fn new(shape: ConvShape, isa: Isa) -> Direct {
        let layout = Layout::new(shape);
        let spans = span::spans(shape.out_h(), shape.out_w(), layout.pitch, isa.lanes());
        let bands = if spans.is_empty() { vec![] } else { vec![Band { spans: 0..spans.len(), taps: 0..shape.taps() }] };
        let sum = TapSum {
            taps: layout.taps(),
            weights: (0..shape.taps()).collect(),
            weight_stride: shape.taps(),
            spans,
            bands,
            origin: 0,
            in_image: layout.image(),
            channels: shape.oc,
            plane: shape.out_pixels(),
        };
        Direct { shape, isa, layout, sum }
    }

    /// Length of the copies of a group of images, within a budget of elements; 0 where the image is read as it is.
    fn copy_len(&self, budget: usize) -> usize {
        let image = self.layout.image();
        if self.layout.copies { group_of(image, budget) * image + MAX_LANES } else { 0 }
    }

    /// Length of the scratch of [`Direct::forward`].
    pub fn forward_scratch_len(&self) -> usize {
        self.copy_len(FORWARD_COPIES)
    }

    /// Length of the scratch of [`Direct::backward_weight`].
    pub fn backward_weight_scratch_len(&self) -> usize {
        self.copy_len(GRADIENT_COPIES) + weight_gradient::scratch_len(self.shape.taps())
    }

    /// Length of the packed weights and bias.
    pub fn packed_len(&self) -> usize {
        self.sum.packed_len()
    }

    /// Packs weights and bias for [`Direct::forward`].
    pub fn pack(&self, weight: &[f32], bias: &[f32], packed: &mut [f32]) {
        self.sum.pack(self.isa, Some(bias), weight, packed);
    }

    /// Calls `run` for each group of images in the layout: with the images, and with the range of the output images.
    fn for_each_group(
        &self,
        x: &[f32],
        y_len: usize,
        copy: &mut [f32],
        budget: usize,
        mut run: impl FnMut(&[f32], std::ops::Range<usize>),
    ) {
        if !self.layout.copies {
            return run(x, 0..y_len);
        }
        let image = self.layout.image();
        let (x_image, y_image) = (self.shape.x_len(), self.shape.y_len());
        let group = group_of(image, budget);
        let groups = x.chunks(group * x_image).zip((0..y_len).step_by(group * y_image));
        for (x, first) in groups {
            let y = first..y_len.min(first + group * y_image);
            let used = y.len() / y_image * image;
            layout::copy(self.isa, &self.layout, x, &mut copy[..used]);
            copy[used..used + MAX_LANES].fill(0.0);
            run(&copy[..used + MAX_LANES], y);
        }
    }

    /// `y = conv(x, weight) + bias` with weights from [`Direct::pack`]; `y` is overwritten.
    pub fn forward(&self, x: &[f32], packed: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.for_each_group(x, y.len(), scratch, FORWARD_COPIES, |x, images| {
            tap_sum::run(self.isa, &self.sum, x, packed, &mut y[images]);
        });
    }

    /// Adds the gradients of `y = conv(x, weight) + bias` with respect to weight and bias to `dweight` and `dbias`.
    pub fn backward_weight(&self, x: &[f32], dy: &[f32], dweight: &mut [f32], dbias: &mut [f32], scratch: &mut [f32]) {
        let (copy, scratch) = scratch.split_at_mut(self.copy_len(GRADIENT_COPIES));
        self.for_each_group(x, dy.len(), copy, GRADIENT_COPIES, |x, images| {
            weight_gradient::run(self.isa, &self.sum, x, &dy[images], dweight, dbias, scratch);
        });
    }
}
