//! Convolution, activation and pooling as one.

use steersman_kernels::activation;
use steersman_kernels::pool::{self, PoolShape};
use steersman_kernels::{Isa, conv::Conv};

use crate::engine::layers::{Conv2d, Grads, Layer, Packing, Pair, Pass};

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
/// The pooling comes first: then the activation has 16 times fewer values to compute, and the maps of the convolution live
/// in the cache for one image only. The positions of the largest are kept; the gradient is 0 everywhere else, and the
/// convolution's gradients are taken from these positions alone. Parameters are those of the convolution.
///
/// Where the activation rounds different values to the same one (ELU far below 0), the gradient goes to the value that was the
/// largest before the activation, not to the first of the equals.
#[derive(Clone, Debug)]
pub struct PooledConv {
    conv: Conv2d,
    activation: MonotonicActivation,
    pool: PoolShape,
    isa: Isa,
}

impl PooledConv {
    /// `conv`, then `activation`, then the maximum of 4x4 windows; `None` where the convolution has no such gradients.
    pub fn new(conv: Conv2d, activation: MonotonicActivation, isa: Isa) -> Option<PooledConv> {
        let output = conv.output();
        let pool = PoolShape { c: output.c, h: output.h, w: output.w, kh: 4, kw: 4, stride_h: 4, stride_w: 4 };
        conv.kernel().has_sparse_gradients().then_some(PooledConv { conv, activation, pool, isa })
    }

    fn kernel(&self) -> &Conv {
        self.conv.kernel()
    }

    fn output_len(&self) -> usize {
        self.pool.c * self.pool.out_h() * self.pool.out_w()
    }

    /// Length of the scratch buffer that any method needs for `n` images.
    pub fn scratch_len(&self, n: usize) -> usize {
        let map = self.pool.c * self.pool.h * self.pool.w;
        (map + self.output_len() + self.kernel().scratch_len()).max(n * self.output_len())
    }

    fn activate(&self, x: &[f32], y: &mut [f32]) {
        match self.activation {
            MonotonicActivation::Relu => activation::relu_forward(self.isa, x, y),
            MonotonicActivation::Elu(alpha) => activation::elu_forward(self.isa, alpha, x, y),
        }
    }

    /// Overwrites `y`, and `argmax` of the same length: for each output the index, in a plane of the image, of the first element
    /// of the kernel window that gave the largest value.
    ///
    /// # Panics
    ///
    /// If the pass has no [`Pass::packed`]: unlike a layer, it does not pack the weights itself.
    pub fn forward(&self, pass: &Pass, n: usize, x: &[f32], y: &mut [f32], argmax: &mut [u32], scratch: &mut [f32]) {
        let (map, scratch) = scratch.split_at_mut(self.pool.c * self.pool.h * self.pool.w);
        let (pooled, scratch) = scratch.split_at_mut(self.output_len());
        let input = self.conv.input();
        let outputs = y.chunks_exact_mut(self.output_len()).zip(argmax.chunks_exact_mut(self.output_len()));
        for (x, (y, argmax)) in x.chunks_exact(input.len()).zip(outputs).take(n) {
            self.kernel().forward_packed(1, x, pass.packed, map, scratch);
            pool::max_forward_with_argmax(self.isa, &self.pool, 1, input.w, map, pooled, argmax);
            self.activate(pooled, y);
        }
    }

    /// Gradients: overwrites `dx` where it is asked for, adds to the parameters'. `argmax` are those of
    /// [`forward`](PooledConv::forward).
    pub fn backward(&self, params: &[f32], n: usize, pair: Pair, argmax: &[u32], dx: Option<&mut [f32]>, grads: Grads) {
        let Pair { x, y, dy } = pair;
        let Grads { dparams, scratch } = grads;
        let dz = &mut scratch[..n * self.output_len()];
        match self.activation {
            MonotonicActivation::Relu => activation::relu_backward(self.isa, y, dy, dz),
            MonotonicActivation::Elu(alpha) => activation::elu_backward(self.isa, alpha, y, dy, dz),
        }
        let (dweight, dbias) = dparams.split_at_mut(self.conv.split(params).0.len());
        self.kernel().sparse_backward_weight(n, x, argmax, dz, dweight, dbias);
        if let Some(dx) = dx {
            self.kernel().sparse_backward_input(n, argmax, dz, self.conv.split(params).0, dx);
        }
    }
}

/// Evaluation: the weights are those of the convolution.
impl Packing for PooledConv {
    fn packed_len(&self) -> usize {
        self.conv.packed_len()
    }

    fn pack(&self, params: &[f32], packed: &mut [f32]) {
        self.conv.pack(params, packed);
    }

    fn training_packed_len(&self) -> usize {
        self.conv.packed_len()
    }

    fn pack_for_training(&self, params: &[f32], packed: &mut [f32]) {
        self.conv.pack(params, packed);
    }

    fn infer_packed(&self, packed: &[f32], n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        let (map, scratch) = scratch.split_at_mut(self.pool.c * self.pool.h * self.pool.w);
        let (pooled, scratch) = scratch.split_at_mut(self.output_len());
        let images = x.chunks_exact(self.conv.input().len()).zip(y.chunks_exact_mut(self.output_len()));
        for (x, y) in images.take(n) {
            self.conv.infer_packed(packed, 1, x, map, scratch);
            pool::max_forward(self.isa, &self.pool, 1, map, pooled);
            self.activate(pooled, y);
        }
    }
}
