//! Leaky rectifier with trainable slopes.

use serde::{Deserialize, Serialize};
use steersman_kernels::Isa;
use steersman_kernels::activation;

use super::{Grads, Layer, Pair, ParamSpec, Pass};
use crate::engine::tensor::Shape;

/// How many slopes a PReLU has.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Slopes {
    /// One for each position of each channel, as Keras has by default.
    #[default]
    PerPosition,
    /// One for each channel, as in the paper.
    PerChannel,
}

/// Parametric rectified linear unit (He et al. 2015).
///
/// **Forward** `y = x` for `x > 0`, else `slope · x`. **Backward** needs x: `dx = dy` for `x > 0`, else `dy · slope`;
/// `dslope` sums `dy · x` where `x ≤ 0`. Training and evaluation are the same.
///
/// Parameters: `slope`, `[c][h][w]` or `[c]`.
#[derive(Debug)]
pub struct PRelu {
    shape: Shape,
    slopes: Slopes,
    initial_slope: f32,
    isa: Isa,
}

impl PRelu {
    /// A PReLU of maps of `shape` whose slopes start at `initial_slope`.
    pub fn new(shape: Shape, slopes: Slopes, initial_slope: f32, isa: Isa) -> PRelu {
        PRelu { shape, slopes, initial_slope, isa }
    }

    /// How many consecutive elements share a slope.
    fn repeat(&self) -> usize {
        match self.slopes {
            Slopes::PerPosition => 1,
            Slopes::PerChannel => self.shape.positions(),
        }
    }
}

impl Layer for PRelu {
    fn input(&self) -> Shape {
        self.shape
    }

    fn output(&self) -> Shape {
        self.shape
    }

    fn params(&self) -> Vec<ParamSpec> {
        let Shape { c, h, w } = self.shape;
        let shape = match self.slopes {
            Slopes::PerPosition if self.shape.positions() > 1 => vec![c, h, w],
            _ => vec![c],
        };
        vec![ParamSpec::constant("slope", shape, self.initial_slope)]
    }

    fn infer(&self, params: &[f32], _statistics: &[f32], n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        activation::prelu_forward(self.isa, n, params, self.repeat(), x, y);
    }

    fn forward(&self, params: &[f32], _pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.infer(params, &[], n, x, y, scratch);
    }

    fn backward(&self, params: &[f32], _pass: &Pass, n: usize, pair: Pair, dx: Option<&mut [f32]>, grads: Grads) {
        let Pair { x, dy, .. } = pair;
        match dx {
            Some(dx) => activation::prelu_backward(self.isa, n, params, self.repeat(), x, dy, dx, grads.dparams),
            None => {
                let dx = &mut grads.scratch[..n * self.shape.len()];
                activation::prelu_backward(self.isa, n, params, self.repeat(), x, dy, dx, grads.dparams);
            }
        }
    }

    fn scratch_len(&self, n: usize) -> usize {
        n * self.shape.len()
    }
}

#[cfg(test)]
mod tests {
    use super::super::gradcheck::check_layer;
    use super::*;

    #[test]
    fn gradients_hold_for_both_kinds_of_slopes() {
        for isa in Isa::available() {
            for slopes in [Slopes::PerPosition, Slopes::PerChannel] {
                for (n, shape) in [(1, Shape::new(3, 3, 5)), (4, Shape::new(2, 3, 7)), (3, Shape::vector(19))] {
                    check_layer(&PRelu::new(shape, slopes, 0.0, isa), n);
                }
            }
        }
    }

    #[test]
    fn slopes_have_the_shape_of_the_map_or_of_its_channels() {
        let shape = Shape::new(24, 16, 76);
        let per_position = PRelu::new(shape, Slopes::PerPosition, 0.0, Isa::PORTABLE);
        assert_eq!(per_position.params()[0].shape, [24, 16, 76]);
        assert_eq!(PRelu::new(shape, Slopes::PerChannel, 0.0, Isa::PORTABLE).params()[0].shape, [24]);
    }
}
