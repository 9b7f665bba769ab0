//! Rectified linear unit.

use serde::{Deserialize, Serialize};
use steersman_kernels::activation;
use steersman_kernels::{Backend, Isa};

use crate::engine::layers::{
    ExportForm, Family, Formula, Function, Grads, Layer, LayerKind, Pair, Pass, ReceptiveField,
};
use crate::engine::tensor::Shape;

/// Rectified linear unit.
///
/// - **Forward** `y = max(x, 0)`.
/// - **Backward** of `y = max(x, 0)`: `dx = dy` where `y > 0`, else `dx = 0`. Needs y.
/// - **Training and evaluation** are the same.
/// - **Limits** At 0 the slope is taken as 0; a NaN becomes 0.
///
/// # Shapes
///
/// x, y, dx, dy: `[n][c][h][w]`.
#[derive(Debug)]
pub struct Relu {
    shape: Shape,
    isa: Isa,
}

impl Relu {
    /// A ReLU of maps of `shape`.
    pub fn new(shape: Shape, isa: Isa) -> Relu {
        Relu { shape, isa }
    }
}

impl Layer for Relu {
    fn input(&self) -> Shape {
        self.shape
    }

    fn output(&self) -> Shape {
        self.shape
    }

    fn infer(&self, _params: &[f32], _statistics: &[f32], _n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        activation::relu_forward(self.isa, x, y);
    }

    fn forward(&self, params: &[f32], _pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.infer(params, &[], n, x, y, scratch);
    }

    fn backward(&self, _params: &[f32], _pass: &Pass, _n: usize, pair: Pair, dx: Option<&mut [f32]>, _grads: Grads) {
        if let Some(dx) = dx {
            activation::relu_backward(self.isa, pair.y, pair.dy, dx);
        }
    }
}

/// Options of [`Relu`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReluSpec {}

impl LayerKind for ReluSpec {
    fn base_name(&self) -> &'static str {
        "relu"
    }

    fn describe(&self) -> String {
        "ReLU".into()
    }

    fn family(&self) -> Family {
        Family::Activation
    }

    fn receptive_field(&self, _input: Shape) -> ReceptiveField {
        ReceptiveField::Element
    }

    fn check(&self, _input: Shape) -> Result<(), String> {
        Ok(())
    }

    fn layer(&self, input: Shape, backend: Backend) -> Result<Box<dyn Layer>, String> {
        Ok(Box::new(Relu::new(input, backend.isa)))
    }

    fn export_form(&self, _input: Shape, _params: &[f32], _statistics: &[f32]) -> ExportForm {
        ExportForm::Elementwise(Function::Relu.of(Formula::X))
    }
}
