//! Swish (SiLU).

use serde::{Deserialize, Serialize};
use steersman_kernels::Isa;
use steersman_kernels::activation::{swish_backward, swish_forward};

use super::{Curve, Elementwise};
use crate::engine::layers::{Formula, Function, Pair};
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
pub type Swish = Elementwise<SwishSpec>;

impl Swish {
    /// Swish of maps of `shape`.
    pub fn new(shape: Shape, isa: Isa) -> Swish {
        Elementwise { shape, curve: SwishSpec {}, isa }
    }
}

/// Options of [`Swish`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SwishSpec {}

impl Curve for SwishSpec {
    const BASE_NAME: &'static str = "swish";

    fn title(&self) -> String {
        "swish".into()
    }

    fn activate(&self, isa: Isa, x: &[f32], y: &mut [f32]) {
        swish_forward(isa, x, y);
    }

    fn differentiate(&self, isa: Isa, pair: Pair, dx: &mut [f32]) {
        swish_backward(isa, pair.x, pair.dy, dx);
    }

    fn formula(&self) -> Formula {
        Formula::X * Function::Sigmoid.of(Formula::X)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::layers::Layer;
    use crate::engine::layers::gradcheck::check_layer;

    #[test]
    fn gradients_hold() {
        for isa in Isa::available() {
            for (n, shape) in [(1, Shape::vector(1)), (3, Shape::new(2, 5, 7)), (2, Shape::vector(37))] {
                check_layer(&Swish::new(shape, isa), n);
            }
        }
    }

    #[test]
    fn it_has_its_defined_values() {
        let mut y = [f32::NAN; 4];
        Swish::new(Shape::vector(4), Isa::best()).infer(&[], &[], 1, &[2.0, -2.0, 0.0, 40.0], &mut y, &mut []);
        approx::assert_relative_eq!(y[..], [1.761_594_2, -0.238_405_84, 0.0, 40.0], max_relative = 2e-6);
    }
}
