//! Swish (SiLU).

use serde::{Deserialize, Serialize};
use steersman_kernels::activation;
use steersman_kernels::{Backend, Isa};

use crate::engine::layers::{
    ExportForm, Family, Formula, Function, Grads, Layer, LayerKind, Pair, Pass, ReceptiveField,
};
use crate::engine::tensor::Shape;

/// Swish with beta 1, also called SiLU (Elfwing et al. 2017, Ramachandran et al. 2017).
///
/// - **Forward** `y = x · σ(x)` with `σ(x) = 1 / (1 + e⁻ˣ)`.
/// - **Backward** of `y = x · σ(x)`: `dx = dy · (σ(x) + x · σ(x) · (1 − σ(x)))`. Needs x, as y is not monotonic in it.
/// - **Training and evaluation** are the same.
/// - **Limits** Absolute error of y below 10⁻⁶ · max(1, |x|).
///
/// # Shapes
///
/// x, y, dx, dy: `[n][c][h][w]`.
#[derive(Debug)]
pub struct Swish {
    shape: Shape,
    isa: Isa,
}

impl Swish {
    /// Swish of maps of `shape`.
    pub fn new(shape: Shape, isa: Isa) -> Swish {
        Swish { shape, isa }
    }
}

impl Layer for Swish {
    fn input(&self) -> Shape {
        self.shape
    }

    fn output(&self) -> Shape {
        self.shape
    }

    fn infer(&self, _params: &[f32], _statistics: &[f32], _n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        activation::swish_forward(self.isa, x, y);
    }

    fn forward(&self, params: &[f32], _pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.infer(params, &[], n, x, y, scratch);
    }

    fn backward(&self, _params: &[f32], _pass: &Pass, _n: usize, pair: Pair, dx: Option<&mut [f32]>, _grads: Grads) {
        if let Some(dx) = dx {
            activation::swish_backward(self.isa, pair.x, pair.dy, dx);
        }
    }
}

/// Options of [`Swish`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SwishSpec {}

impl LayerKind for SwishSpec {
    fn base_name(&self) -> &'static str {
        "swish"
    }

    fn describe(&self) -> String {
        "swish".into()
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
        Ok(Box::new(Swish::new(input, backend.isa)))
    }

    fn export_form(&self, _input: Shape, _params: &[f32], _statistics: &[f32]) -> ExportForm {
        ExportForm::Elementwise(Formula::X * Function::Sigmoid.of(Formula::X))
    }
}
