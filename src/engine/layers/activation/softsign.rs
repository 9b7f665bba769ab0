//! Softsign.

use serde::{Deserialize, Serialize};
use steersman_kernels::Isa;
use steersman_kernels::activation::{softsign_backward, softsign_forward};

use super::{Curve, Elementwise};
use crate::engine::layers::{Formula, Function, Pair};
use crate::engine::tensor::Shape;

/// Softsign (Turian et al. 2009).
///
/// - **Forward** `y = x / (1 + |x|)`.
/// - **Backward** of `y = x / (1 + |x|)`: `dx = dy / (1 + |x|)² = dy · (1 − |y|)²`. Needs y.
/// - **Training and evaluation** are the same.
///
/// # Shapes
///
/// x, y, dx, dy: `[n][c][h][w]`.
pub type Softsign = Elementwise<SoftsignSpec>;

impl Softsign {
    /// The softsign of maps of `shape`.
    pub fn new(shape: Shape, isa: Isa) -> Softsign {
        Elementwise { shape, curve: SoftsignSpec {}, isa }
    }
}

/// Options of [`Softsign`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SoftsignSpec {}

impl Curve for SoftsignSpec {
    const BASE_NAME: &'static str = "softsign";

    fn title(&self) -> String {
        "softsign".into()
    }

    fn activate(&self, isa: Isa, x: &[f32], y: &mut [f32]) {
        softsign_forward(isa, x, y);
    }

    fn differentiate(&self, isa: Isa, pair: Pair, dx: &mut [f32]) {
        softsign_backward(isa, pair.y, pair.dy, dx);
    }

    fn formula(&self) -> Formula {
        Function::Softsign.of(Formula::X)
    }
}
