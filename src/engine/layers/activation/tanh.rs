//! Hyperbolic tangent.

use serde::{Deserialize, Serialize};
use steersman_kernels::activation;
use steersman_kernels::{Backend, Isa};

use crate::engine::layers::{
    ExportForm, Family, Formula, Function, Grads, Layer, LayerKind, Pair, Pass, ReceptiveField,
};
use crate::engine::tensor::Shape;

/// Hyperbolic tangent.
///
/// - **Forward** `y = tanh(x)`.
/// - **Backward** of `y = tanh(x)`: `dx = dy · (1 − y²)`. Needs y.
/// - **Training and evaluation** are the same.
/// - **Limits** Relative error of y below 2·10⁻⁶.
///
/// # Shapes
///
/// x, y, dx, dy: `[n][c][h][w]`.
#[derive(Debug)]
pub struct Tanh {
    shape: Shape,
    isa: Isa,
}

impl Tanh {
    /// The hyperbolic tangent of maps of `shape`.
    pub fn new(shape: Shape, isa: Isa) -> Tanh {
        Tanh { shape, isa }
    }
}

impl Layer for Tanh {
    fn input(&self) -> Shape {
        self.shape
    }

    fn output(&self) -> Shape {
        self.shape
    }

    fn infer(&self, _params: &[f32], _statistics: &[f32], _n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        activation::tanh_forward(self.isa, x, y);
    }

    fn forward(&self, params: &[f32], _pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.infer(params, &[], n, x, y, scratch);
    }

    fn backward(&self, _params: &[f32], _pass: &Pass, _n: usize, pair: Pair, dx: Option<&mut [f32]>, _grads: Grads) {
        if let Some(dx) = dx {
            activation::tanh_backward(self.isa, pair.y, pair.dy, dx);
        }
    }
}

/// Options of [`Tanh`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TanhSpec {}

impl LayerKind for TanhSpec {
    fn base_name(&self) -> &'static str {
        "tanh"
    }

    fn describe(&self) -> String {
        "tanh".into()
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
        Ok(Box::new(Tanh::new(input, backend.isa)))
    }

    fn export_form(&self, _input: Shape, _params: &[f32], _statistics: &[f32]) -> ExportForm {
        ExportForm::Elementwise(Function::Tanh.of(Formula::X))
    }
}
