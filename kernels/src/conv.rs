//! Convolution and its gradients.

mod shape;

use crate::Isa;
pub use shape::ConvShape;

/// A convolution of one shape on one instruction set, with the algorithm of each pass chosen.
#[derive(Clone, Debug)]
pub struct Conv {
    shape: ConvShape,
    isa: Isa,
}

impl Conv {
    /// Plans the convolution.
    pub fn new(shape: ConvShape, isa: Isa) -> Conv {
        Conv { shape, isa }
    }

    /// The instruction set it runs on.
    pub fn isa(&self) -> Isa {
        self.isa
    }

    /// Elements of `scratch` that every pass is content with, whatever the number of images.
    pub fn scratch_len(&self) -> usize {
        0
    }

    /// `y = conv(x, weight) + bias`, for `n` images; `y` is overwritten.
    pub fn forward(&self, n: usize, x: &[f32], weight: &[f32], bias: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        crate::reference::conv_forward(&self.shape, n, x, weight, bias, y);
    }

    /// The gradient with respect to the input; `dx` is overwritten.
    pub fn backward_input(&self, n: usize, dy: &[f32], weight: &[f32], dx: &mut [f32], _scratch: &mut [f32]) {
        crate::reference::conv_backward_input(&self.shape, n, dy, weight, dx);
    }

    /// The gradients with respect to weight and bias, added to `dweight` and `dbias`.
    pub fn backward_weight(
        &self,
        n: usize,
        x: &[f32],
        dy: &[f32],
        dweight: &mut [f32],
        dbias: &mut [f32],
        _scratch: &mut [f32],
    ) {
        crate::reference::conv_backward_weight(&self.shape, n, x, dy, dweight, dbias);
    }
}
