//! Hyperbolic tangent.

use serde::{Deserialize, Serialize};
use steersman_kernels::Isa;
use steersman_kernels::activation::{tanh_backward, tanh_forward};

use super::{Curve, Elementwise};
use crate::engine::layers::{Formula, Function, Pair};
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
pub type Tanh = Elementwise<TanhSpec>;

impl Tanh {
    /// The hyperbolic tangent of maps of `shape`.
    pub fn new(shape: Shape, isa: Isa) -> Tanh {
        Elementwise { shape, curve: TanhSpec {}, isa }
    }
}

/// Options of [`Tanh`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TanhSpec {}

impl Curve for TanhSpec {
    const BASE_NAME: &'static str = "tanh";

    fn title(&self) -> String {
        "tanh".into()
    }

    fn activate(&self, isa: Isa, x: &[f32], y: &mut [f32]) {
        tanh_forward(isa, x, y);
    }

    fn differentiate(&self, isa: Isa, pair: Pair, dx: &mut [f32]) {
        tanh_backward(isa, pair.y, pair.dy, dx);
    }

    fn formula(&self) -> Formula {
        Function::Tanh.of(Formula::X)
    }
}
