//! Convolution, activation and pooling as one.

use steersman_kernels::{Isa, activation, conv};

use crate::engine::layers::{Conv2d, Grads, Packing, Pair, Pass};

/// A monotonic activation: it commutes with the maximum of a window.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum MonotonicActivation {
    /// [`Relu`](crate::engine::layers::Relu).
    Relu,
    /// [`Elu`](crate::engine::layers::Elu) with its alpha.
    Elu(f32),
}

/// What [`Conv2d`], an activation and [`MaxPool`](crate::engine::layers::MaxPool) of 4x4 windows do one after the other.
///
/// The pooling comes first, in the pass of the convolution: then the activation has 16 times fewer values to compute, and the maps
/// of the convolution are never written. The positions of the largest are kept; the gradient is 0 everywhere else, and the
/// convolution's gradients are taken from these positions alone. Parameters are those of the convolution.
///
/// Where the activation rounds different values to the same one (ELU far below 0), the gradient goes to the value that was the
/// largest before the activation, not to the first of the equals.
#[derive(Clone, Debug)]
pub struct PooledConv {
    conv: Conv2d,
    kernel: conv::PooledConv,
    activation: MonotonicActivation,
    isa: Isa,
}

impl PooledConv {
    /// `conv`, then `activation`, then the maximum of 4x4 windows; `None` where the kernels have no such pass.
    pub fn new(conv: Conv2d, activation: MonotonicActivation, isa: Isa) -> Option<PooledConv> {
        let kernel = conv::PooledConv::new(*conv.kernel().shape(), conv.kernel().backend())?;
        Some(PooledConv { conv, kernel, activation, isa })
    }

    /// Length of the scratch buffer that any method needs for `n` images.
    pub fn scratch_len(&self, n: usize) -> usize {
        n * self.kernel.y_len() + self.kernel.scratch_len()
    }

    fn activate(&self, x: &[f32], y: &mut [f32]) {
        match self.activation {
            MonotonicActivation::Relu => activation::relu_forward(self.isa, x, y),
            MonotonicActivation::Elu(alpha) => activation::elu_forward(self.isa, alpha, x, y),
        }
    }

    /// Overwrites `y`, and `argmax` of the same length: for each output the index, in a plane of the image, of the first element
    /// of the kernel window that gave the largest value. An empty `argmax` asks for none.
    ///
    /// # Panics
    ///
    /// If the pass has no [`Pass::packed`]: unlike a layer, it does not pack the weights itself.
    pub fn forward(&self, pass: &Pass, n: usize, x: &[f32], y: &mut [f32], argmax: &mut [u32], scratch: &mut [f32]) {
        self.run(pass.packed, n, x, y, argmax, scratch);
    }

    fn run(&self, packed: &[f32], n: usize, x: &[f32], y: &mut [f32], argmax: &mut [u32], scratch: &mut [f32]) {
        let (pooled, scratch) = scratch.split_at_mut(n * self.kernel.y_len());
        self.kernel.forward(n, x, packed, pooled, argmax, scratch);
        self.activate(pooled, y);
    }

    /// Gradients: overwrites `dx` where it is asked for, adds to the parameters'. `argmax` are those of
    /// [`forward`](PooledConv::forward).
    pub fn backward(&self, params: &[f32], n: usize, pair: Pair, argmax: &[u32], dx: Option<&mut [f32]>, grads: Grads) {
        let Pair { x, y, dy } = pair;
        let Grads { dparams, scratch } = grads;
        let dz = &mut scratch[..n * self.kernel.y_len()];
        match self.activation {
            MonotonicActivation::Relu => activation::relu_backward(self.isa, y, dy, dz),
            MonotonicActivation::Elu(alpha) => activation::elu_backward(self.isa, alpha, y, dy, dz),
        }
        let (weight, _) = self.conv.split(params);
        let (dweight, dbias) = dparams.split_at_mut(weight.len());
        self.kernel.backward_weight(n, x, argmax, dz, dweight, dbias);
        if let Some(dx) = dx {
            self.kernel.backward_input(n, argmax, dz, weight, dx);
        }
    }
}

/// Evaluation: the weights are those of the convolution.
impl Packing for PooledConv {
    fn packed_len(&self) -> usize {
        self.kernel.packed_len()
    }

    fn pack(&self, params: &[f32], packed: &mut [f32]) {
        let (weight, bias) = self.conv.split(params);
        self.kernel.pack(weight, bias, packed);
    }

    fn training_packed_len(&self) -> usize {
        self.packed_len()
    }

    fn pack_for_training(&self, params: &[f32], packed: &mut [f32]) {
        self.pack(params, packed);
    }

    fn infer_packed(&self, packed: &[f32], n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.run(packed, n, x, y, &mut [], scratch);
    }
}
