//! Exponential linear unit.

use serde::{Deserialize, Serialize};
use steersman_kernels::Isa;
use steersman_kernels::activation::{elu_backward, elu_forward};

use super::{Curve, Elementwise};
use crate::engine::layers::{Formula, Function, Pair};
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
pub type Elu = Elementwise<EluSpec>;

impl Elu {
    /// An ELU of maps of `shape` that goes to −`alpha` for large negative inputs.
    ///
    /// # Errors
    ///
    /// As [`Curve::check_options`].
    pub fn new(shape: Shape, alpha: f32, isa: Isa) -> Result<Elu, String> {
        Elementwise::of(shape, EluSpec { alpha }, isa)
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

impl Curve for EluSpec {
    const BASE_NAME: &'static str = "elu";

    fn title(&self) -> String {
        match self.alpha {
            1.0 => "ELU".into(),
            alpha => format!("ELU alpha {alpha}"),
        }
    }

    fn check_options(&self) -> Result<(), String> {
        if !(self.alpha.is_finite() && self.alpha > 0.0) {
            return Err(format!("alpha must be a positive number, not {}", self.alpha));
        }
        Ok(())
    }

    fn activate(&self, isa: Isa, x: &[f32], y: &mut [f32]) {
        elu_forward(isa, self.alpha, x, y);
    }

    fn differentiate(&self, isa: Isa, pair: Pair, dx: &mut [f32]) {
        elu_backward(isa, self.alpha, pair.y, pair.dy, dx);
    }

    fn formula(&self) -> Formula {
        Function::Elu { alpha: self.alpha }.of(Formula::X)
    }
}
