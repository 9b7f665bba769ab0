//! Leaky rectified linear unit with a fixed slope.

use serde::{Deserialize, Serialize};
use steersman_kernels::Isa;
use steersman_kernels::activation::{leaky_relu_backward, leaky_relu_forward};

use super::{Curve, Elementwise};
use crate::engine::layers::{Formula, Function, Pair};
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
pub type LeakyRelu = Elementwise<LeakyReluSpec>;

impl LeakyRelu {
    /// A leaky ReLU of maps of `shape` with `slope` below zero.
    ///
    /// # Errors
    ///
    /// As [`Curve::check_options`].
    pub fn new(shape: Shape, slope: f32, isa: Isa) -> Result<LeakyRelu, String> {
        Elementwise::of(shape, LeakyReluSpec { slope }, isa)
    }
}

/// Options of [`LeakyRelu`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LeakyReluSpec {
    /// Slope below zero.
    pub slope: f32,
}

impl Curve for LeakyReluSpec {
    const BASE_NAME: &'static str = "leaky_relu";

    fn title(&self) -> String {
        format!("leaky ReLU {}", self.slope)
    }

    fn check_options(&self) -> Result<(), String> {
        if !self.slope.is_finite() {
            return Err(format!("slope must be a finite number, not {}", self.slope));
        }
        Ok(())
    }

    fn activate(&self, isa: Isa, x: &[f32], y: &mut [f32]) {
        leaky_relu_forward(isa, self.slope, x, y);
    }

    fn differentiate(&self, isa: Isa, pair: Pair, dx: &mut [f32]) {
        leaky_relu_backward(isa, self.slope, pair.x, pair.dy, dx);
    }

    fn formula(&self) -> Formula {
        Function::LeakyRelu { slope: self.slope }.of(Formula::X)
    }
}
