//! Rectified linear unit.

use serde::{Deserialize, Serialize};
use steersman_kernels::Isa;
use steersman_kernels::activation::{relu_backward, relu_forward};

use super::{Curve, Elementwise};
use crate::engine::layers::{Formula, Function, Pair};
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
pub type Relu = Elementwise<ReluSpec>;

impl Relu {
    /// A ReLU of maps of `shape`.
    pub fn new(shape: Shape, isa: Isa) -> Relu {
        Elementwise { shape, curve: ReluSpec {}, isa }
    }
}

/// Options of [`Relu`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReluSpec {}

impl Curve for ReluSpec {
    const BASE_NAME: &'static str = "relu";

    fn title(&self) -> String {
        "ReLU".into()
    }

    fn activate(&self, isa: Isa, x: &[f32], y: &mut [f32]) {
        relu_forward(isa, x, y);
    }

    fn differentiate(&self, isa: Isa, pair: Pair, dx: &mut [f32]) {
        relu_backward(isa, pair.y, pair.dy, dx);
    }

    fn formula(&self) -> Formula {
        Function::Relu.of(Formula::X)
    }
}
