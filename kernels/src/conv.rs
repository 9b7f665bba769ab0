//! Convolution and its gradients.
//!
//! A convolution has three passes. For each of them [`ConvAlgorithm::Auto`] takes the first algorithm of this table that
//! its condition admits; [`ConvAlgorithm::Im2col`] takes the last one for all three.
//!
//! | algorithm | passes | condition | how |
//! |---|---|---|---|
//! | `patch_gradient` | input gradient | maps of so few rows that most taps would multiply zeros (3x18) | a matrix product gives the gradient of each patch; overlapping patches are added up |
//! | `winograd` | all | kernels of 3 rows, or 5 with a stride of 2, on maps large enough to gain (`winograd::choice`) | Winograd minimal filtering along the rows: half to two thirds of the products |
//! | `im2col` with `gemm` | weight gradient | one output and more than 32 channels, on vectors of 16 lanes | a matrix product |
//! | `direct` | forward, weight gradient | any | a sum over taps, with vectors along the output rows |
//! | `input_gradient` | input gradient | any | the same sum over the zero-padded output gradient, with the kernel turned by 180 degrees |
//! | `pooled` | forward | before 4x4 max pooling; the caller asks for it: [`PooledConv`] | the same sum over taps, with vectors along the windows of the pooling |
//! | `sparse` | both gradients | the same | one multiply-add at a time at the few positions with a gradient |
//! | `im2col` with `sgemm` | all | when asked for | the textbook: the image as a matrix of patches, and one matrix product a pass |
//!
//! To read how a convolution works, begin with `im2col`: it is the shortest, and the others compute the same.
//!
//! Within a pass the sizes of tiles and blocks follow from the shape and the instruction set: see `tap_sum`.

mod direct;
mod im2col;
mod input_gradient;
mod layout;
mod patch_gradient;
mod phase;
mod pooled;
mod span;
mod sparse;
mod tap_sum;
mod weight_gradient;
mod winograd;

use crate::Isa;
use crate::backend::Backend;
pub use crate::conv_algorithm::ConvAlgorithm;
pub use crate::conv_shape::ConvShape;
use direct::Direct;
use im2col::Im2col;
use patch_gradient::PatchGradient;
pub use pooled::PooledConv;

/// A convolution of one shape on one backend. It holds the tables of each pass.
#[derive(Clone, Debug)]
pub struct Conv {
    shape: ConvShape,
    backend: Backend,
    forward: Forward,
    input_gradient: InputGradient,
    weight_gradient: WeightGradient,
}

/// The algorithm of the forward pass.
#[derive(Clone, Debug)]
enum Forward {
    Direct(Direct),
    Winograd(winograd::Forward),
    Im2col(Im2col),
}

/// The algorithm of the input gradient.
#[derive(Clone, Debug)]
enum InputGradient {
    Direct(input_gradient::InputGradient),
    Winograd(winograd::InputGradient),
    Patches(PatchGradient),
    Im2col(Im2col),
}

/// The algorithm of the weight gradient.
#[derive(Clone, Debug)]
enum WeightGradient {
    Direct(Direct),
    Winograd(winograd::WeightGradient),
    Im2col(Im2col),
}

impl WeightGradient {
    /// The fastest algorithm for the shape.
    fn fastest(shape: ConvShape, isa: Isa) -> WeightGradient {
        if let Some(winograd) = winograd::WeightGradient::new(shape, isa) {
            return WeightGradient::Winograd(winograd);
        }
        // A single output leaves 15 of 16 lanes of `direct` idle. On 8 images the matrix product takes half of its time (16x5x5-120,
        // 64x3x3-64 and 64x3x3-128). With fewer channels or fewer lanes it takes as long or longer.
        if shape.out_pixels() == 1 && shape.oc > 32 && isa.lanes() == 16 {
            return WeightGradient::Im2col(Im2col::with_gemm(shape, isa));
        }
        WeightGradient::Direct(Direct::new(shape, isa))
    }
}

impl Conv {
    /// Chooses the algorithms of `shape` on `backend` and computes their tables.
    ///
    /// # Panics
    /// If a size other than the padding is 0.
    pub fn new(shape: ConvShape, backend: impl Into<Backend>) -> Conv {
        let ConvShape { c, h, w, oc, kh, kw, stride_h, stride_w, .. } = shape;
        assert!(
            [c, h, w, oc, kh, kw, stride_h, stride_w].iter().all(|&size| size > 0),
            "convolution: every size but the padding must be at least 1 in {shape:?}"
        );
        let backend = backend.into();
        let isa = backend.isa;
        let (forward, input_gradient, weight_gradient) = match backend.conv {
            ConvAlgorithm::Im2col => {
                let im2col = || Im2col::textbook(shape);
                (Forward::Im2col(im2col()), InputGradient::Im2col(im2col()), WeightGradient::Im2col(im2col()))
            }
            ConvAlgorithm::Auto => {
                let by_taps = input_gradient::InputGradient::new(shape, isa);
                let input_gradient = if by_taps.mostly_multiplies_zeros() {
                    InputGradient::Patches(PatchGradient::new(shape, isa))
                } else if let Some(winograd) = winograd::InputGradient::new(shape, isa) {
                    InputGradient::Winograd(winograd)
                } else {
                    InputGradient::Direct(by_taps)
                };
                (
                    winograd::Forward::new(shape, isa)
                        .map_or_else(|| Forward::Direct(Direct::new(shape, isa)), Forward::Winograd),
                    input_gradient,
                    WeightGradient::fastest(shape, isa),
                )
            }
        };
        Conv { shape, backend, forward, input_gradient, weight_gradient }
    }

    /// The sizes.
    pub fn shape(&self) -> &ConvShape {
        &self.shape
    }

    /// What it runs on.
    pub fn backend(&self) -> Backend {
        self.backend
    }

    /// Length of the scratch buffer that is enough for every pass, whatever the number of images.
    pub fn scratch_len(&self) -> usize {
        let forward = match &self.forward {
            Forward::Direct(direct) => direct.forward_scratch_len(),
            Forward::Winograd(winograd) => winograd.scratch_len(),
            Forward::Im2col(im2col) => im2col.scratch_len(),
        };
        let input_gradient = match &self.input_gradient {
            InputGradient::Direct(direct) => direct.scratch_len(),
            InputGradient::Winograd(winograd) => winograd.scratch_len(),
            InputGradient::Patches(patches) => patches.scratch_len(),
            InputGradient::Im2col(im2col) => im2col.scratch_len(),
        };
        let weight_gradient = match &self.weight_gradient {
            WeightGradient::Direct(direct) => direct.backward_weight_scratch_len(),
            WeightGradient::Winograd(winograd) => winograd.scratch_len(),
            WeightGradient::Im2col(im2col) => im2col.scratch_len(),
        };
        (forward + self.packed_len()).max(input_gradient + self.packed_gradient_len()).max(weight_gradient)
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
    /// If a slice has another length, or `scratch` is shorter than [`Conv::scratch_len`].
    pub fn forward(&self, n: usize, x: &[f32], weight: &[f32], bias: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.check_scratch("conv forward", scratch.len());
        let (packed, scratch) = scratch.split_at_mut(self.packed_len());
        self.pack(weight, bias, packed);
        self.run_packed(n, x, packed, y, scratch);
    }

    /// Length of the packed weights and bias of the forward pass.
    pub fn packed_len(&self) -> usize {
        match &self.forward {
            Forward::Direct(direct) => direct.packed_len(),
            Forward::Winograd(winograd) => winograd.packed_len(),
            Forward::Im2col(_) => self.shape.oc * (self.shape.taps() + 1),
        }
    }

    /// Packs weights and bias for [`Conv::forward_packed`]: puts them in the order in which it reads them.
    ///
    /// # Panics
    /// If a slice has another length; that of `packed` is [`Conv::packed_len`].
    pub fn pack(&self, weight: &[f32], bias: &[f32], packed: &mut [f32]) {
        let shape = &self.shape;
        assert_eq!(weight.len(), shape.oc * shape.taps(), "conv pack: length of the weights of {shape:?}");
        assert_eq!(bias.len(), shape.oc, "conv pack: length of the bias of {shape:?}");
        assert_eq!(packed.len(), self.packed_len(), "conv pack: length of the packed weights of {shape:?}");
        match &self.forward {
            Forward::Direct(direct) => direct.pack(weight, bias, packed),
            Forward::Winograd(winograd) => winograd.pack(weight, bias, packed),
            Forward::Im2col(_) => {
                let (packed_weight, packed_bias) = packed.split_at_mut(weight.len());
                packed_weight.copy_from_slice(weight);
                packed_bias.copy_from_slice(bias);
            }
        }
    }

    /// As [`Conv::forward`], with packed weights from [`Conv::pack`].
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
        if y.is_empty() {
            return;
        }
        match &self.forward {
            Forward::Direct(direct) => direct.forward(x, packed, y, scratch),
            Forward::Winograd(winograd) => winograd.run(x, packed, y, scratch),
            Forward::Im2col(im2col) => {
                let (weight, bias) = packed.split_at(shape.oc * shape.taps());
                im2col.forward(x, weight, bias, y, scratch);
            }
        }
    }

    /// The gradient of [`Conv::forward`], `y = conv(x, weight) + bias`, with respect to the input of `n` images; `dx` is
    /// overwritten.
    ///
    /// # Shapes
    /// As for [`Conv::forward`], `dy` like `y` and `dx` like `x`.
    ///
    /// # Panics
    /// If a slice has another length, or `scratch` is shorter than [`Conv::scratch_len`].
    pub fn backward_input(&self, n: usize, dy: &[f32], weight: &[f32], dx: &mut [f32], scratch: &mut [f32]) {
        self.check_scratch("conv backward_input", scratch.len());
        let (packed, scratch) = scratch.split_at_mut(self.packed_gradient_len());
        self.pack_gradient(weight, packed);
        self.run_packed_gradient(n, dy, packed, dx, scratch);
    }

    /// Length of the packed weights of the input gradient.
    pub fn packed_gradient_len(&self) -> usize {
        match &self.input_gradient {
            InputGradient::Direct(direct) => direct.packed_len(),
            InputGradient::Winograd(winograd) => winograd.packed_len(),
            InputGradient::Patches(_) | InputGradient::Im2col(_) => self.shape.oc * self.shape.taps(),
        }
    }

    /// Packs weights for [`Conv::backward_input_packed`]: puts them in the order in which it reads them.
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
        match &self.input_gradient {
            InputGradient::Direct(direct) => direct.pack(weight, packed),
            InputGradient::Winograd(winograd) => winograd.pack(weight, packed),
            InputGradient::Patches(_) | InputGradient::Im2col(_) => packed.copy_from_slice(weight),
        }
    }

    /// As [`Conv::backward_input`], with packed weights from [`Conv::pack_gradient`].
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
            return dx.fill(0.0);
        }
        match &self.input_gradient {
            InputGradient::Direct(direct) => direct.run(dy, packed, dx, scratch),
            InputGradient::Winograd(winograd) => winograd.run(dy, packed, dx, scratch),
            InputGradient::Patches(patches) => patches.run(dy, packed, dx, scratch),
            InputGradient::Im2col(im2col) => im2col.backward_input(dy, packed, dx, scratch),
        }
    }

    /// The gradients of [`Conv::forward`], `y = conv(x, weight) + bias`, with respect to weight and bias, summed over `n` images
    /// and added to `dweight` and `dbias`.
    ///
    /// # Shapes
    /// As for [`Conv::forward`]; each gradient has the shape of its tensor.
    ///
    /// # Panics
    /// If a slice has another length, or `scratch` is shorter than [`Conv::scratch_len`].
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
        if dy.is_empty() {
            return;
        }
        match &self.weight_gradient {
            WeightGradient::Direct(direct) => direct.backward_weight(x, dy, dweight, dbias, scratch),
            WeightGradient::Winograd(winograd) => winograd.run(x, dy, dweight, dbias, scratch),
            WeightGradient::Im2col(im2col) => im2col.backward_weight(x, dy, dweight, dbias, scratch),
        }
    }
}
