//! Convolution and its gradients.
//!
//! | pass | algorithm |
//! |---|---|
//! | all three, where it gains | the same sums at points of the rows: minimal filtering takes half to two thirds of the products (`winograd`, which says for which shapes) |
//! | forward | a sum over taps with vectors along the output rows (`direct`), of the image itself when the stride is 1 and nothing is padded, else of a copy that is padded and split into phases (`prepare`) |
//! | input gradient | for each phase of the input the same sum over the zero-padded output gradient, with the kernel turned round (`input_gradient`); where that would mostly multiply zeros, a matrix product and [`crate::im2col::col2im`] |
//! | weight gradient | vectors along the output rows, summed over lanes at the end (`weight_gradient`) |
//! | both gradients, behind 4x4 pooling | one position at a time (`sparse`) |
//!
//! Within a pass the sizes of tiles and blocks follow from the shape and the instruction set: see `direct`.

mod direct;
mod grid;
mod input_gradient;
mod prepare;
mod shape;
mod sparse;
mod weight_gradient;
mod winograd;

use crate::Isa;
use crate::simd::MOST_LANES;
use direct::{Band, TapSum};
use input_gradient::InputGradient;
use prepare::Layout;
pub use shape::ConvShape;

/// Elements of copied images that the forward pass works on at a time: 256 KiB leaves room in the second-level cache.
const FORWARD_COPIES: usize = 1 << 16;
/// The same for the weight gradient: 2 MiB. It sums over lanes once a group, so groups should be large.
const GRADIENT_COPIES: usize = 1 << 19;

/// How many images of `image` elements are copied at a time, within a budget of elements.
fn group_of(image: usize, budget: usize) -> usize {
    (budget / image.max(1)).clamp(1, 8)
}

/// A convolution of one shape on one instruction set, with the tables of each pass worked out.
#[derive(Clone, Debug)]
pub struct Conv {
    shape: ConvShape,
    isa: Isa,
    layout: Layout,
    sum: TapSum,
    input_gradient: InputGradient,
    /// The passes that gain by minimal filtering, in place of those above.
    fast_forward: Option<winograd::Forward>,
    fast_input_gradient: Option<winograd::InputGradient>,
    fast_weight_gradient: Option<winograd::WeightGradient>,
}

impl Conv {
    /// Plans the convolution.
    ///
    /// # Panics
    /// If a size other than the padding is 0.
    pub fn new(shape: ConvShape, isa: Isa) -> Conv {
        let ConvShape { c, h, w, oc, kh, kw, stride_h, stride_w, .. } = shape;
        assert!(
            [c, h, w, oc, kh, kw, stride_h, stride_w].iter().all(|&size| size > 0),
            "convolution: every size but the padding must be at least 1 in {shape:?}"
        );
        let layout = Layout::new(shape);
        let spans = grid::spans(shape.out_h(), shape.out_w(), layout.pitch, isa.lanes());
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
        let input_gradient = InputGradient::new(shape, isa);
        let fast_input_gradient = if input_gradient.by_product() { None } else { winograd::InputGradient::new(shape) };
        Conv {
            shape,
            isa,
            layout,
            sum,
            input_gradient,
            fast_forward: winograd::Forward::new(shape),
            fast_input_gradient,
            fast_weight_gradient: winograd::WeightGradient::new(shape),
        }
    }

    /// The sizes.
    pub fn shape(&self) -> &ConvShape {
        &self.shape
    }

    /// The instruction set it runs on.
    pub fn isa(&self) -> Isa {
        self.isa
    }

    /// Elements of `scratch` that are enough for every pass, whatever the number of images.
    pub fn scratch_len(&self) -> usize {
        let forward = self.forward_scratch_len() + self.packed_len();
        let input_gradient = match &self.fast_input_gradient {
            Some(fast) => fast.scratch_len(),
            None => self.input_gradient.scratch_len(),
        };
        let weight_gradient = match &self.fast_weight_gradient {
            Some(fast) => fast.scratch_len(),
            None => self.copy_len(GRADIENT_COPIES) + weight_gradient::scratch_len(self.shape.taps()),
        };
        forward.max(weight_gradient).max(input_gradient + self.packed_gradient_len())
    }

    fn forward_scratch_len(&self) -> usize {
        self.fast_forward.as_ref().map_or_else(|| self.copy_len(FORWARD_COPIES), winograd::Forward::scratch_len)
    }

    /// Elements of the copied images of a group.
    fn copy_len(&self, budget: usize) -> usize {
        let image = self.layout.image();
        if self.layout.copies { group_of(image, budget) * image + MOST_LANES } else { 0 }
    }

    fn check_scratch(&self, pass: &str, len: usize) {
        assert!(len >= self.scratch_len(), "{pass}: scratch must have {} elements", self.scratch_len());
    }

    /// `y = conv(x, weight) + bias` for `n` images; `y` is overwritten.
    ///
    /// # Shapes
    /// `x`: `[n][c][h][w]`, `weight`: `[oc][c][kh][kw]`, `bias`: `[oc]`, `y`: `[n][oc][out_h][out_w]`. The output of
    /// an image does not depend on the others.
    ///
    /// # Panics
    /// If a slice has another length, or `scratch` less than [`Conv::scratch_len`].
    pub fn forward(&self, n: usize, x: &[f32], weight: &[f32], bias: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.check_scratch("conv forward", scratch.len());
        let (packed, scratch) = scratch.split_at_mut(self.packed_len());
        self.pack(weight, bias, packed);
        self.run_packed(n, x, packed, y, scratch);
    }

    /// Elements that the weights and bias of [`Conv::pack`] take.
    pub fn packed_len(&self) -> usize {
        self.fast_forward.as_ref().map_or_else(|| self.sum.packed_len(), winograd::Forward::packed_len)
    }

    /// Puts weights and bias in the order in which [`Conv::forward_packed`] reads them.
    ///
    /// # Panics
    /// If a slice has another length; that of `packed` is [`Conv::packed_len`].
    pub fn pack(&self, weight: &[f32], bias: &[f32], packed: &mut [f32]) {
        let shape = &self.shape;
        assert_eq!(weight.len(), shape.oc * shape.taps(), "conv pack: length of the weights of {shape:?}");
        assert_eq!(bias.len(), shape.oc, "conv pack: length of the bias of {shape:?}");
        assert_eq!(packed.len(), self.packed_len(), "conv pack: length of the packed weights of {shape:?}");
        pack(self.isa, self, weight, bias, packed);
    }

    /// As [`Conv::forward`], with weights and bias from [`Conv::pack`].
    ///
    /// # Panics
    /// As [`Conv::forward`].
    pub fn forward_packed(&self, n: usize, x: &[f32], packed: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.check_scratch("conv forward", scratch.len());
        assert_eq!(packed.len(), self.packed_len(), "conv forward: length of the packed weights of {:?}", self.shape);
        self.run_packed(n, x, packed, y, scratch);
    }

    fn run_packed(&self, n: usize, x: &[f32], packed: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        let shape = &self.shape;
        assert_eq!(x.len(), n * shape.x_len(), "conv forward: length of the {n} inputs of {shape:?}");
        assert_eq!(y.len(), n * shape.y_len(), "conv forward: length of the {n} outputs of {shape:?}");
        if !y.is_empty() {
            forward(self.isa, self, x, packed, y, scratch);
        }
    }

    /// The gradient with respect to the input of `n` images; `dx` is overwritten.
    ///
    /// # Shapes
    /// As for [`Conv::forward`], `dy` like `y` and `dx` like `x`.
    ///
    /// # Panics
    /// If a slice has another length, or `scratch` less than [`Conv::scratch_len`].
    pub fn backward_input(&self, n: usize, dy: &[f32], weight: &[f32], dx: &mut [f32], scratch: &mut [f32]) {
        self.check_scratch("conv backward_input", scratch.len());
        let (packed, scratch) = scratch.split_at_mut(self.packed_gradient_len());
        self.pack_gradient(weight, packed);
        self.run_packed_gradient(n, dy, packed, dx, scratch);
    }

    /// Elements that the weights of [`Conv::pack_gradient`] take.
    pub fn packed_gradient_len(&self) -> usize {
        match &self.fast_input_gradient {
            Some(fast) => fast.packed_len(),
            None => self.input_gradient.packed_len(),
        }
    }

    /// Puts the weights in the order in which [`Conv::backward_input_packed`] reads them.
    ///
    /// # Panics
    /// If a slice has another length; that of `packed` is [`Conv::packed_gradient_len`].
    pub fn pack_gradient(&self, weight: &[f32], packed: &mut [f32]) {
        let shape = &self.shape;
        assert_eq!(weight.len(), shape.oc * shape.taps(), "conv pack_gradient: length of the weights of {shape:?}");
        assert_eq!(
            packed.len(),
            self.packed_gradient_len(),
            "conv pack_gradient: length of the packed weights of {shape:?}"
        );
        pack_gradient(self.isa, self, weight, packed);
    }

    /// As [`Conv::backward_input`], with weights from [`Conv::pack_gradient`].
    ///
    /// # Panics
    /// As [`Conv::backward_input`].
    pub fn backward_input_packed(&self, n: usize, dy: &[f32], packed: &[f32], dx: &mut [f32], scratch: &mut [f32]) {
        self.check_scratch("conv backward_input", scratch.len());
        assert_eq!(
            packed.len(),
            self.packed_gradient_len(),
            "conv backward_input: length of the packed weights of {:?}",
            self.shape
        );
        self.run_packed_gradient(n, dy, packed, dx, scratch);
    }

    fn run_packed_gradient(&self, n: usize, dy: &[f32], packed: &[f32], dx: &mut [f32], scratch: &mut [f32]) {
        let shape = &self.shape;
        assert_eq!(dx.len(), n * shape.x_len(), "conv backward_input: length of the {n} inputs of {shape:?}");
        assert_eq!(dy.len(), n * shape.y_len(), "conv backward_input: length of the {n} outputs of {shape:?}");
        if dy.is_empty() || dx.is_empty() {
            dx.fill(0.0);
        } else if let Some(fast) = &self.fast_input_gradient {
            fast_input_gradient(self.isa, fast, dy, packed, dx, scratch);
        } else {
            input_gradient::run(self.isa, &self.input_gradient, dy, packed, dx, scratch);
        }
    }

    /// The gradients with respect to weight and bias, summed over `n` images and added to `dweight` and `dbias`.
    ///
    /// # Shapes
    /// As for [`Conv::forward`], each gradient like what it is the gradient of.
    ///
    /// # Panics
    /// If a slice has another length, or `scratch` less than [`Conv::scratch_len`].
    pub fn backward_weight(
        &self,
        n: usize,
        x: &[f32],
        dy: &[f32],
        dweight: &mut [f32],
        dbias: &mut [f32],
        scratch: &mut [f32],
    ) {
        let shape = &self.shape;
        assert_eq!(x.len(), n * shape.x_len(), "conv backward_weight: length of the {n} inputs of {shape:?}");
        assert_eq!(dy.len(), n * shape.y_len(), "conv backward_weight: length of the {n} outputs of {shape:?}");
        assert_eq!(dweight.len(), shape.oc * shape.taps(), "conv backward_weight: length of the weights of {shape:?}");
        assert_eq!(dbias.len(), shape.oc, "conv backward_weight: length of the bias of {shape:?}");
        self.check_scratch("conv backward_weight", scratch.len());
        if !dy.is_empty() {
            backward_weight(self.isa, self, x, dy, dweight, dbias, scratch);
        }
    }
}

/// Gradients from `count` positions of each output channel, all others being 0.
///
/// `starts` tells the positions, `[n][oc][count]`: where the window of the output begins in a plane of the input,
/// `oy * w + ox`. `dy` are the output gradients there.
impl Conv {
    /// Whether the shape has these: strides of 1, no padding, 3x3 or 5x5 kernels.
    pub fn has_sparse_gradients(&self) -> bool {
        sparse::supports(&self.shape)
    }

    /// As [`Conv::backward_weight`].
    ///
    /// # Panics
    /// If a slice has another length, a start lies outside the plane, or the shape has no sparse gradients.
    pub fn sparse_backward_weight(
        &self,
        n: usize,
        x: &[f32],
        starts: &[u32],
        dy: &[f32],
        dweight: &mut [f32],
        dbias: &mut [f32],
    ) {
        self.check_sparse(n, x.len(), starts.len(), dy.len(), dweight.len());
        assert_eq!(dbias.len(), self.shape.oc, "sparse conv gradient: length of the bias of {:?}", self.shape);
        sparse::weight_gradient(self.isa, &self.shape, x, starts, dy, dweight, dbias);
    }

    /// As [`Conv::backward_input`].
    ///
    /// # Panics
    /// As [`Conv::sparse_backward_weight`].
    pub fn sparse_backward_input(&self, n: usize, starts: &[u32], dy: &[f32], weight: &[f32], dx: &mut [f32]) {
        self.check_sparse(n, dx.len(), starts.len(), dy.len(), weight.len());
        sparse::input_gradient(self.isa, &self.shape, starts, dy, weight, dx);
    }

    fn check_sparse(&self, n: usize, x_len: usize, starts: usize, dy: usize, weight: usize) {
        let shape = &self.shape;
        assert!(self.has_sparse_gradients(), "no sparse gradients of {shape:?}");
        assert_eq!(x_len, n * shape.x_len(), "sparse conv gradient: length of the {n} inputs of {shape:?}");
        assert_eq!(weight, shape.oc * shape.taps(), "sparse conv gradient: length of the weights of {shape:?}");
        assert!(starts == dy && dy.is_multiple_of((n * shape.oc).max(1)), "sparse conv gradient: uneven positions");
    }
}

per_isa! {
    fn pack<S>(simd: S, conv: &Conv, weight: &[f32], bias: &[f32], packed: &mut [f32]) {
        match &conv.fast_forward {
            Some(fast) => fast.pack(simd, weight, bias, packed),
            None => conv.sum.pack(simd, Some(bias), weight, packed),
        }
    }
}

per_isa! {
    fn pack_gradient<S>(simd: S, conv: &Conv, weight: &[f32], packed: &mut [f32]) {
        match &conv.fast_input_gradient {
            Some(fast) => fast.pack(simd, weight, packed),
            None => conv.input_gradient.pack(simd, weight, packed),
        }
    }
}

per_isa! {
    fn fast_input_gradient<S>(
        simd: S,
        gradient: &winograd::InputGradient,
        dy: &[f32],
        packed: &[f32],
        dx: &mut [f32],
        scratch: &mut [f32],
    ) {
        gradient.run(simd, dy, packed, dx, scratch);
    }
}

per_isa! {
    fn forward<S>(simd: S, conv: &Conv, x: &[f32], packed: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        if let Some(fast) = &conv.fast_forward {
            return fast.run(simd, x, packed, y, scratch);
        }
        let copy = &mut scratch[..conv.copy_len(FORWARD_COPIES)];
        let sum = &conv.sum;
        if !conv.layout.copies {
            return sum.run(simd, x, packed, y);
        }
        let group = group_of(conv.layout.image(), FORWARD_COPIES);
        let groups = x.chunks(group * conv.shape.x_len().max(1)).zip(y.chunks_mut(group * conv.shape.y_len()));
        for (x, y) in groups {
            let used = y.len() / conv.shape.y_len() * conv.layout.image();
            conv.layout.copy(simd, x, &mut copy[..used]);
            copy[used..used + MOST_LANES].fill(0.0);
            sum.run(simd, &copy[..used + MOST_LANES], packed, y);
        }
    }
}

per_isa! {
    fn backward_weight<S>(
        simd: S,
        conv: &Conv,
        x: &[f32],
        dy: &[f32],
        dweight: &mut [f32],
        dbias: &mut [f32],
        scratch: &mut [f32],
    ) {
        if let Some(fast) = &conv.fast_weight_gradient {
            return fast.run(simd, x, dy, dweight, dbias, scratch);
        }
        let (copy, scratch) = scratch.split_at_mut(conv.copy_len(GRADIENT_COPIES));
        if !conv.layout.copies {
            return weight_gradient::run(simd, &conv.sum, x, dy, dweight, dbias, scratch);
        }
        let group = group_of(conv.layout.image(), GRADIENT_COPIES);
        let groups = x.chunks(group * conv.shape.x_len().max(1)).zip(dy.chunks(group * conv.shape.y_len()));
        for (x, dy) in groups {
            let used = dy.len() / conv.shape.y_len() * conv.layout.image();
            conv.layout.copy(simd, x, &mut copy[..used]);
            copy[used..used + MOST_LANES].fill(0.0);
            weight_gradient::run(simd, &conv.sum, &copy[..used + MOST_LANES], dy, dweight, dbias, scratch);
        }
    }
}
