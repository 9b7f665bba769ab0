//! The layers: forward pass and hand-written backward pass of each, one file a kind; families of several kinds have a folder each. What
//! the program asks a kind of layer lies in `kind/`.
//!
//! A [`Layer`] is a description: sizes and options, no state. Parameters, activations and gradients live in buffers that
//! [`network`](crate::engine::network) plans once, so a training step allocates nothing and threads share a network without a
//! lock. Each call of a layer works on `n` images, `[n][c][h][w]`, on one thread.
//!
//! # Training and evaluation
//!
//! [`Layer::infer`] is evaluation: running statistics, no dropout; it has no way to change anything but its output.
//! [`Layer::forward`] and [`Layer::backward`] are training. Batch normalisation needs sums over the *whole* batch before it
//! can go on; that barrier is [`BatchStatistics`].
//!
//! # To add a layer
//!
//! Search the tree for `swish` to see each place.
//!
//! 1. **Kernel and reference**, if the layer computes something new: a fast loop in `kernels/src/` (as in `activation.rs`), and a
//!    naive one in double precision in `kernels/src/reference.rs`.
//! 2. **Kernel test**: the two loops against each other in `kernels/tests/against_reference/` (as in `elementwise.rs`).
//! 3. **Layer**: a file in this folder or in that of its family, with its `mod` and `pub use` lines. It holds the layer, which
//!    implements [`Layer`]; its options, which implement [`LayerKind`]: name, family, receptive field, checks, export form; and
//!    gradient checks with [`gradcheck::check_layer`] (odd sizes, batch 1). Spoil a gradient on purpose and see the check fail. The
//!    options of an activation without trainable numbers implement [`Curve`] instead: layer and answers follow.
//! 4. **Spec entry**: one line in `network/spec.rs`, the `kind` of recipes with an example.
//! 5. **Documentation**: the `layers` entry in `data/README.md`, and CHANGELOG.
//! 6. **Keras reader**, if Keras has the layer: an arm in `exchange/keras/translate.rs`.
//!
//! Nothing else needs an edit. Recipes, summaries, model files and the optimizer go by [`ParamSpec`]; exports to ONNX, C and Rust
//! by [`ExportForm`]; saliency, feature maps and diagrams by [`ReceptiveField`] and [`Family`]. The tests of `spec.rs`,
//! `tests/export.rs` and `benches/layers.rs` take every spec entry.
//!
//! What happens if one is forgotten: without an answer of [`LayerKind`], or with a spec entry but no layer, nothing compiles. A
//! wrong answer fails [`check_kind`], a missing entry in `data/README.md` a test of `spec.rs`. Without a spec entry, recipes do not
//! know the layer. `tests/new_layer.rs` follows this recipe outside the crate.

mod activation;
mod batch_norm;
mod conv2d;
mod dense;
mod dropout;
pub mod gradcheck;
mod kind;
mod pooling;
mod rearrangement;
mod scale;

use std::fmt::Debug;

pub use activation::{
    Curve, Elementwise, Elu, EluSpec, LeakyRelu, LeakyReluSpec, PRelu, PReluSpec, Relu, ReluSpec, Slopes, Softsign,
    SoftsignSpec, Swish, SwishSpec, Tanh, TanhSpec,
};
pub(crate) use batch_norm::Moments;
pub use batch_norm::{BatchNorm, BatchNormSpec};
pub use conv2d::{Conv2d, Conv2dSpec, Padding};
pub use dense::{Dense, DenseSpec};
pub use dropout::{Dropout, DropoutSpec};
pub use kind::{ExportForm, Family, Formula, Function, LayerKind, Pads, ReceptiveField, check_kind};
pub use pooling::{
    AveragePool, AveragePoolSpec, Blur, BlurSpec, MaxPool, MaxPoolSpec, Resize, ResizeMethod, ResizeSpec, Taps,
};
pub use rearrangement::{Crop, CropSpec, Flatten, FlattenSpec, ZeroPad, ZeroPadSpec};
pub use scale::{Scale, ScaleSpec};

use crate::engine::tensor::{Fans, Initializer, Shape};

/// One tensor of a layer: a trainable parameter or a running statistic.
#[derive(Clone, Debug, PartialEq)]
pub struct ParamSpec {
    /// Name within the layer: `weight`, `bias`, `gamma`, `beta`, `slope`, `running_mean`, `running_variance`.
    pub name: &'static str,
    /// Extent of each axis, row-major.
    pub shape: Vec<usize>,
    /// First values.
    pub init: Initializer,
    /// Fans for `init`.
    pub fans: Fans,
    /// Whether weight decay applies: true for the weights of convolutions and dense layers, false for everything else.
    pub decays: bool,
}

impl ParamSpec {
    /// A weight tensor: drawn by `init`, subject to weight decay.
    pub fn weight(shape: Vec<usize>, init: Initializer, fans: Fans) -> ParamSpec {
        ParamSpec { name: "weight", shape, init, fans, decays: true }
    }

    /// A tensor that starts with the same `value` everywhere and does not decay.
    pub fn constant(name: &'static str, shape: Vec<usize>, value: f32) -> ParamSpec {
        ParamSpec {
            name,
            shape,
            init: Initializer::Constant(value),
            fans: Fans { fan_in: 1, fan_out: 1 },
            decays: false,
        }
    }

    /// Length of the tensor.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Whether the tensor is empty.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// What the images of one training pass have in common.
#[derive(Clone, Copy, Debug)]
pub struct Pass<'a> {
    /// Seed of the run.
    pub seed: u64,
    /// Number of the training step, from 0.
    pub step: u64,
    /// Index of the layer in the network, so that two dropout layers drop different elements.
    pub layer: usize,
    /// Index in the batch of the first image of `x`.
    pub first_image: usize,
    /// What the barrier of [`BatchStatistics`] computed for this layer; empty for layers without a barrier.
    pub moments: &'a [f32],
    /// The layer's packed weights, from [`Packing::pack_for_training`] at the start of the step. If empty, the layer packs its
    /// weights in every call.
    pub packed: &'a [f32],
}

/// A layer whose input shape is known.
///
/// In every method `x` holds `n` images of [`input`](Layer::input), `y` holds `n` of [`output`](Layer::output), `dx` and
/// `dy` their gradients, `params` the tensors of [`params`](Layer::params) one after the other and `dparams` their
/// gradients. `scratch` has at least [`scratch_len`](Layer::scratch_len)`(n)` elements of arbitrary content.
///
/// # Panics
///
/// All methods panic if a slice has another length.
pub trait Layer: Send + Sync + Debug {
    /// Shape of one input image.
    fn input(&self) -> Shape;

    /// Shape of one output image.
    fn output(&self) -> Shape;

    /// The trainable tensors, in their fixed order.
    fn params(&self) -> Vec<ParamSpec> {
        Vec::new()
    }

    /// The running statistics, in their fixed order. Training changes them, the optimizer does not.
    fn statistics(&self) -> Vec<ParamSpec> {
        Vec::new()
    }

    /// Multiply-adds of one image's forward pass in convolutions and dense layers; 0 for all others.
    fn multiply_adds(&self) -> u64 {
        0
    }

    /// Length of the scratch buffer that any method needs for `n` images.
    fn scratch_len(&self, n: usize) -> usize {
        let _ = n;
        0
    }

    /// Whether the output is the input with another shape. Planned networks skip such layers.
    fn is_view(&self) -> bool {
        false
    }

    /// Evaluation: overwrites `y`.
    fn infer(&self, params: &[f32], statistics: &[f32], n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]);

    /// Training: overwrites `y`.
    fn forward(&self, params: &[f32], pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]);

    /// Gradients of the loss: overwrites `dx` if it is given, adds to `dparams`. `x` and `y` are those of `forward`.
    fn backward(&self, params: &[f32], pass: &Pass, n: usize, pair: Pair, dx: Option<&mut [f32]>, grads: Grads);

    /// Packed weights, for layers that compute faster with them.
    fn packing(&self) -> Option<&dyn Packing> {
        None
    }

    /// The input gradient by itself, for layers that compute it from `dy` and the parameters alone.
    fn linear(&self) -> Option<&dyn Linear> {
        None
    }

    /// The whole-batch barrier, for layers that need one.
    fn batch_statistics(&self) -> Option<&dyn BatchStatistics> {
        None
    }
}

/// What [`Layer::backward`] reads: input and output of the forward pass, and the gradient of the output.
#[derive(Clone, Copy, Debug)]
pub struct Pair<'a> {
    /// Input of the forward pass.
    pub x: &'a [f32],
    /// Output of the forward pass.
    pub y: &'a [f32],
    /// Gradient of the loss with respect to `y`.
    pub dy: &'a [f32],
}

/// What [`Layer::backward`] writes beside `dx`.
#[derive(Debug)]
pub struct Grads<'a> {
    /// Gradient of the loss with respect to the parameters; added to.
    pub dparams: &'a mut [f32],
    /// Scratch buffer of [`Layer::scratch_len`] elements.
    pub scratch: &'a mut [f32],
}

/// Packed weights: a layer's parameters in the order in which its kernels read them, packed once and used for many images.
///
/// Evaluation needs the weights of the forward pass, training those of the input gradient too.
///
/// # Panics
///
/// Methods panic if `packed` has another length than is said here, as weights packed for the other purpose have.
pub trait Packing {
    /// Length of the weights packed for evaluation.
    fn packed_len(&self) -> usize;

    /// Packs `params` for evaluation: overwrites `packed`.
    fn pack(&self, params: &[f32], packed: &mut [f32]);

    /// Length of the weights packed for training.
    fn training_packed_len(&self) -> usize;

    /// Packs `params` for training: overwrites `packed`, which becomes [`Pass::packed`].
    fn pack_for_training(&self, params: &[f32], packed: &mut [f32]);

    /// [`Layer::infer`] with packed weights, to the same bits.
    fn infer_packed(&self, packed: &[f32], n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]);
}

/// A layer whose input gradient needs neither input nor output. So `dx` may overwrite the buffer of `x` once
/// [`Layer::backward`] has computed the gradients of the parameters.
pub trait Linear {
    /// Overwrites `dx`, as [`Layer::backward`] does.
    fn backward_input(&self, params: &[f32], pass: &Pass, n: usize, dy: &[f32], dx: &mut [f32], scratch: &mut [f32]);
}

/// The barrier of a layer that needs sums over the whole batch (batch normalisation).
///
/// Forward: [`forward_sums`](Self::forward_sums) on each shard of the batch, the sums added in a fixed order,
/// [`finish_forward`](Self::finish_forward) once, then [`Layer::forward`] on each shard. Backward likewise.
pub trait BatchStatistics {
    /// Number of sums.
    fn sums_len(&self) -> usize;

    /// Length of `moments`.
    fn moments_len(&self) -> usize;

    /// Overwrites `sums` with the sums over the `n` images of `x`.
    fn forward_sums(&self, n: usize, x: &[f32], sums: &mut [f64]);

    /// From the sums over all `images` of the batch: overwrites the moments that [`Layer::forward`] needs and updates the running
    /// statistics.
    fn finish_forward(&self, params: &[f32], images: usize, sums: &[f64], moments: &mut [f32], statistics: &mut [f32]);

    /// Overwrites `moments` for a frozen layer: it takes its running statistics, as in evaluation, and needs no barrier.
    fn frozen_moments(&self, params: &[f32], statistics: &[f32], moments: &mut [f32]);

    /// Overwrites `sums` with the sums over the `n` images of `x` and `dy`, and adds the gradients of the parameters that
    /// follow from them to `dparams`.
    fn backward_sums(&self, moments: &[f32], n: usize, x: &[f32], dy: &[f32], sums: &mut [f64], dparams: &mut [f32]);

    /// From the sums over all `images` of the batch: writes the moments that only [`Layer::backward`] needs.
    fn finish_backward(&self, params: &[f32], images: usize, sums: &[f64], moments: &mut [f32]);
}
