//! The trained numbers of a network and their layout: named tensors, each a range of one of two arenas.

use std::ops::Range;

use ndarray::{ArrayViewD, ArrayViewMutD, IxDyn};

use crate::engine::layers::ParamSpec;

/// Parameters that are reduced and updated as one task.
pub(crate) const CHUNK: usize = 4096;

/// One named tensor of a network.
#[derive(Clone, Debug)]
pub struct Tensor {
    /// `layer.tensor`, as in `conv1.weight`.
    pub name: String,
    /// Shape, initial values, decay.
    pub spec: ParamSpec,
    /// Whether the optimizer changes it; running statistics are not trainable.
    pub trainable: bool,
    /// Its range of [`Parameters::values`] if trainable, else of [`Parameters::statistics`].
    pub range: Range<usize>,
    /// Whether training leaves it unchanged, because its layer is frozen.
    pub frozen: bool,
}

/// The numbers of a network, in two arenas: the optimizer and a checkpoint see one slice each.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameters {
    /// All trainable tensors, one after the other.
    pub values: Vec<f32>,
    /// All running statistics, one after the other.
    pub statistics: Vec<f32>,
}

impl Parameters {
    /// The numbers of `tensor`, row-major.
    ///
    /// # Panics
    ///
    /// Panics if `tensor` belongs to a larger network.
    pub fn tensor(&self, tensor: &Tensor) -> &[f32] {
        let arena = if tensor.trainable { &self.values } else { &self.statistics };
        &arena[tensor.range.clone()]
    }

    /// [`tensor`](Self::tensor), to be changed.
    ///
    /// # Panics
    ///
    /// As [`tensor`](Self::tensor).
    pub fn tensor_mut(&mut self, tensor: &Tensor) -> &mut [f32] {
        let arena = if tensor.trainable { &mut self.values } else { &mut self.statistics };
        &mut arena[tensor.range.clone()]
    }

    /// The numbers of `tensor` as an array of its shape: `(out, in, kh, kw)` for the weight of a convolution.
    ///
    /// # Panics
    ///
    /// As [`tensor`](Self::tensor).
    pub fn array(&self, tensor: &Tensor) -> ArrayViewD<'_, f32> {
        ArrayViewD::from_shape(IxDyn(&tensor.spec.shape), self.tensor(tensor))
            .expect("a range is as long as its shape says")
    }

    /// [`array`](Self::array), to be changed.
    ///
    /// # Panics
    ///
    /// As [`tensor`](Self::tensor).
    pub fn array_mut(&mut self, tensor: &Tensor) -> ArrayViewMutD<'_, f32> {
        let shape = IxDyn(&tensor.spec.shape);
        ArrayViewMutD::from_shape(shape, self.tensor_mut(tensor)).expect("a range is as long as its shape says")
    }
}
