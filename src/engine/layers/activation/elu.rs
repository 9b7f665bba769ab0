//! Exponential linear unit.

use serde::{Deserialize, Serialize};
use steersman_kernels::activation;
use steersman_kernels::{Backend, Isa};

use crate::engine::layers::{
    ExportForm, Family, Formula, Function, Grads, Layer, LayerKind, Pair, Pass, ReceptiveField,
};
use crate::engine::tensor::Shape;

/// Exponential linear unit (Clevert et al. 2015).
///
/// - **Forward** `y = x` where `x > 0`, else `y = alpha · (eˣ − 1)`.
/// - **Backward** of `y = x`: `dx = dy`; of `y = alpha · (eˣ − 1)`: `dx = dy · alpha · eˣ = dy · (y + alpha)`. Needs y.
/// - **Training and evaluation** are the same.
/// - **Limits** alpha is positive, so y > 0 exactly where x > 0.
///
/// # Shapes
///
/// x, y, dx, dy: `[n][c][h][w]`.
#[derive(Debug)]
pub struct Elu {
    shape: Shape,
    alpha: f32,
    isa: Isa,
}

impl Elu {
    /// An ELU of maps of `shape` that goes to −`alpha` for large negative inputs.
    pub fn new(shape: Shape, alpha: f32, isa: Isa) -> Result<Elu, String> {
        if !(alpha.is_finite() && alpha > 0.0) {
            return Err(format!("alpha must be a positive number, not {alpha}"));
        }
        Ok(Elu { shape, alpha, isa })
    }
}

impl Layer for Elu {
    fn input(&self) -> Shape {
        self.shape
    }

    fn output(&self) -> Shape {
        self.shape
    }

    fn infer(&self, _params: &[f32], _statistics: &[f32], _n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        activation::elu_forward(self.isa, self.alpha, x, y);
    }

    fn forward(&self, params: &[f32], _pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.infer(params, &[], n, x, y, scratch);
    }

    fn backward(&self, _params: &[f32], _pass: &Pass, _n: usize, pair: Pair, dx: Option<&mut [f32]>, _grads: Grads) {
        if let Some(dx) = dx {
            activation::elu_backward(self.isa, self.alpha, pair.y, pair.dy, dx);
        }
    }
}

/// Options of [`Elu`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EluSpec {
    /// The limit for large negative x is −alpha.
    #[serde(default = "one")]
    pub alpha: f32,
}

fn one() -> f32 {
    1.0
}

impl LayerKind for EluSpec {
    fn base_name(&self) -> &'static str {
        "elu"
    }

    fn describe(&self) -> String {
        match self.alpha {
            1.0 => "ELU".into(),
            alpha => format!("ELU alpha {alpha}"),
        }
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
        Ok(Box::new(Elu::new(input, self.alpha, backend.isa)?))
    }

    fn export_form(&self, _input: Shape, _params: &[f32], _statistics: &[f32]) -> ExportForm {
        ExportForm::Elementwise(Function::Elu { alpha: self.alpha }.of(Formula::X))
    }
}
