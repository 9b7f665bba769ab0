//! Leaky rectified linear unit with a fixed slope.

use serde::{Deserialize, Serialize};
use steersman_kernels::activation;
use steersman_kernels::{Backend, Isa};

use crate::engine::layers::{
    ExportForm, Family, Formula, Function, Grads, Layer, LayerKind, Pair, Pass, ReceptiveField,
};
use crate::engine::tensor::Shape;

/// Leaky rectified linear unit with a fixed slope (Maas et al. 2013).
///
/// - **Forward** `y = x` where `x > 0`, else `y = slope · x`.
/// - **Backward** of `y = x`: `dx = dy`; of `y = slope · x`: `dx = dy · slope`. Needs x, as a negative slope makes y positive on
///   both sides.
/// - **Training and evaluation** are the same.
/// - **Limits** The slope is finite, of either sign. Trainable slopes: [`PRelu`](super::PRelu).
///
/// # Shapes
///
/// x, y, dx, dy: `[n][c][h][w]`.
#[derive(Debug)]
pub struct LeakyRelu {
    shape: Shape,
    slope: f32,
    isa: Isa,
}

impl LeakyRelu {
    /// A leaky ReLU of maps of `shape` with `slope` below zero.
    pub fn new(shape: Shape, slope: f32, isa: Isa) -> Result<LeakyRelu, String> {
        if !slope.is_finite() {
            return Err(format!("slope must be a finite number, not {slope}"));
        }
        Ok(LeakyRelu { shape, slope, isa })
    }
}

impl Layer for LeakyRelu {
    fn input(&self) -> Shape {
        self.shape
    }

    fn output(&self) -> Shape {
        self.shape
    }

    fn infer(&self, _params: &[f32], _statistics: &[f32], _n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        activation::leaky_relu_forward(self.isa, self.slope, x, y);
    }

    fn forward(&self, params: &[f32], _pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.infer(params, &[], n, x, y, scratch);
    }

    fn backward(&self, _params: &[f32], _pass: &Pass, _n: usize, pair: Pair, dx: Option<&mut [f32]>, _grads: Grads) {
        if let Some(dx) = dx {
            activation::leaky_relu_backward(self.isa, self.slope, pair.x, pair.dy, dx);
        }
    }
}

/// Options of [`LeakyRelu`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LeakyReluSpec {
    /// Slope below zero.
    pub slope: f32,
}

impl LayerKind for LeakyReluSpec {
    fn base_name(&self) -> &'static str {
        "leaky_relu"
    }

    fn describe(&self) -> String {
        format!("leaky ReLU {}", self.slope)
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
        Ok(Box::new(LeakyRelu::new(input, self.slope, backend.isa)?))
    }

    fn export_form(&self, _input: Shape, _params: &[f32], _statistics: &[f32]) -> ExportForm {
        ExportForm::Elementwise(Function::LeakyRelu { slope: self.slope }.of(Formula::X))
    }
}
