//! The layers: forward pass and hand-written backward pass of each, one file a kind.
//!
//! A [`Layer`] is a description: sizes and options, no state. Parameters, activations and gradients live in buffers that
//! [`network`](crate::engine::network) plans once, so a training step allocates nothing and threads share a network without a
//! lock. Each layer works on a few images at a time (`n` of them, `[n][c][h][w]`), on one thread.
//!
//! # Training and evaluation
//!
//! [`Layer::infer`] is evaluation: running statistics, no dropout; it has no way to change anything but its output.
//! [`Layer::forward`] and [`Layer::backward`] are training. Batch normalisation needs sums over the *whole* batch before it
//! can go on; that barrier is [`BatchStatistics`].
//!
//! # To add a layer
//!
//! 1. If it computes something new, write the kernel in `kernels/`, with its naive loop in `kernels/src/reference.rs` and a
//!    case in `kernels/tests/against_reference.rs`.
//! 2. Write `src/engine/layers/your_layer.rs`: a struct that implements [`Layer`], and gradient checks with
//!    [`gradcheck::check_layer`] below it (odd sizes, batch 1). Add the `mod` and `pub use` lines here.
//! 3. Add an arm to [`LayerSpec`](crate::engine::network::LayerSpec): its options, its base name and `build`.
//! 4. Spoil a gradient on purpose and see the check fail; then add a row to `benches/layers.rs`.
//!
//! Nothing else has to know: recipes, summaries, model files and the optimizer go by [`ParamSpec`].

mod activation;
mod batch_norm;
mod conv2d;
mod crop;
mod dense;
mod dropout;
mod flatten;
pub mod gradcheck;
mod pool;
mod prelu;
mod scale;
mod zero_pad;

use std::fmt::Debug;

pub use activation::{Elu, LeakyRelu, Relu, Softsign, Tanh};
pub use batch_norm::BatchNorm;
pub(crate) use batch_norm::Moments;
pub use conv2d::{Conv2d, Padding};
pub use crop::Crop;
pub use dense::Dense;
pub use dropout::Dropout;
pub use flatten::Flatten;
pub use pool::{AveragePool, MaxPool};
pub use prelu::{PRelu, Slopes};
pub use scale::Scale;
pub use zero_pad::ZeroPad;

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

    /// How many numbers the tensor has.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Whether the tensor has no numbers.
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
    /// Place of the layer in the network, so that two dropout layers drop different elements.
    pub layer: usize,
    /// Place of the first image of `x` in the batch.
    pub first_image: usize,
    /// What [`BatchStatistics`] has put there for this layer; empty for all others.
    pub moments: &'a [f32],
    /// What [`Prepared::prepare_for_training`] made of the layer's parameters at the start of the step. Empty if nobody asked it
    /// to; then the layer does so in every call.
    pub prepared: &'a [f32],
}

/// A layer whose input shape is known.
///
/// In every method `x` holds `n` images of [`input`](Layer::input), `y` holds `n` of [`output`](Layer::output), `dx` and
/// `dy` their gradients, `params` the tensors of [`params`](Layer::params) one after the other and `dparams` their
/// gradients. `scratch` has at least [`scratch_len`](Layer::scratch_len)`(n)` numbers of arbitrary content.
///
/// # Panics
///
/// All methods panic if a slice has another length than that.
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

    /// How many numbers of scratch any method needs for `n` images.
    fn scratch_len(&self, n: usize) -> usize {
        let _ = n;
        0
    }

    /// Whether the output is the input with another shape, so that no pass has anything to do.
    fn is_view(&self) -> bool {
        false
    }

    /// Evaluation: overwrites `y`.
    fn infer(&self, params: &[f32], statistics: &[f32], n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]);

    /// Training: overwrites `y`.
    fn forward(&self, params: &[f32], pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]);

    /// Gradients of the loss: overwrites `dx` where it is asked for, adds to `dparams`. `x` and `y` are those of `forward`.
    fn backward(&self, params: &[f32], pass: &Pass, n: usize, pair: Pair, dx: Option<&mut [f32]>, grads: Grads);

    /// Evaluation with parameters prepared for it, for layers that gain by that.
    fn prepared(&self) -> Option<&dyn Prepared> {
        None
    }

    /// The input gradient by itself, for layers that find it from `dy` and the parameters alone.
    fn linear(&self) -> Option<&dyn Linear> {
        None
    }

    /// The whole-batch barrier, for layers that need one.
    fn batch_statistics(&self) -> Option<&dyn BatchStatistics> {
        None
    }
}

/// What [`Layer::backward`] reads: what went in and out, and the gradient of what came out.
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
    /// Working space.
    pub scratch: &'a mut [f32],
}

/// A layer that reads its parameters in another order than they are kept in: one for evaluation, and one for training, where the
/// input gradient needs them too.
///
/// # Panics
///
/// Methods panic if `prepared` has another length than is said here, or was prepared for the other purpose and so has.
pub trait Prepared {
    /// How many numbers the prepared parameters are.
    fn prepared_len(&self) -> usize;

    /// Overwrites `prepared`.
    fn prepare(&self, params: &[f32], prepared: &mut [f32]);

    /// How many numbers the parameters prepared for training are.
    fn prepared_for_training_len(&self) -> usize;

    /// Overwrites `prepared` with what [`Pass::prepared`] is to be.
    fn prepare_for_training(&self, params: &[f32], prepared: &mut [f32]);

    /// As [`Layer::infer`], to the same bits.
    fn infer_prepared(&self, prepared: &[f32], n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]);
}

/// A layer whose input gradient needs neither input nor output, so that it may take the place of the input once
/// [`Layer::backward`] has found the gradients of the parameters.
pub trait Linear {
    /// Overwrites `dx`, as [`Layer::backward`] does.
    fn backward_input(&self, params: &[f32], pass: &Pass, n: usize, dy: &[f32], dx: &mut [f32], scratch: &mut [f32]);
}

/// The barrier of a layer that looks at the whole batch at once (batch normalisation).
///
/// Forward: [`forward_sums`](Self::forward_sums) on every part of the batch, the sums added up in a fixed order,
/// [`finish_forward`](Self::finish_forward) once, then [`Layer::forward`] on every part. Backward likewise.
pub trait BatchStatistics {
    /// How many sums there are.
    fn sums_len(&self) -> usize;

    /// How many numbers `moments` has.
    fn moments_len(&self) -> usize;

    /// Overwrites `sums` with the sums over the `n` images of `x`.
    fn forward_sums(&self, n: usize, x: &[f32], sums: &mut [f64]);

    /// From the sums over all `images` of the batch: what [`Layer::forward`] needs into `moments`, and the running
    /// statistics moved on.
    fn finish_forward(&self, params: &[f32], images: usize, sums: &[f64], moments: &mut [f32], statistics: &mut [f32]);

    /// What [`Layer::forward`] and [`Layer::backward`] need where the layer is frozen: it goes by its running statistics then,
    /// as in evaluation, and needs no barrier.
    fn frozen_moments(&self, params: &[f32], statistics: &[f32], moments: &mut [f32]);

    /// Overwrites `sums` with the sums over the `n` images of `x` and `dy`, and adds the gradients of the parameters that
    /// follow from them to `dparams`.
    fn backward_sums(&self, moments: &[f32], n: usize, x: &[f32], dy: &[f32], sums: &mut [f64], dparams: &mut [f32]);

    /// From the sums over all `images` of the batch: what [`Layer::backward`] needs, added to `moments`.
    fn finish_backward(&self, params: &[f32], images: usize, sums: &[f64], moments: &mut [f32]);
}
