//! Leaky rectified linear unit with trainable slopes.

use serde::{Deserialize, Serialize};
use steersman_kernels::activation;
use steersman_kernels::{Backend, Isa};

use crate::engine::layers::kind::check_first_value;
use crate::engine::layers::{ExportForm, Family, Grads, Layer, LayerKind, Pair, ParamSpec, Pass, ReceptiveField};
use crate::engine::tensor::Shape;

/// Which values of a map share a slope.
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
/// - **Forward** `y = x` where `x > 0`, else `y = slope · x`.
/// - **Backward** of `y = x`: `dx = dy`; of `y = slope · x`: `dx = dy · slope` and `dslope = Σ dy · x` over the values that share
///   the slope. Needs x.
/// - **Training and evaluation** are the same.
/// - **Limits** Slopes may become negative, as in the paper. With a slope for each position, the layer takes maps of one size only.
///
/// # Shapes
///
/// x, y, dx, dy: `[n][c][h][w]`. Parameters: `slope`, `[c][h][w]` or `[c]`.
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

/// Options of [`PRelu`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PReluSpec {
    /// `per_position` (default) or `per_channel`.
    #[serde(default)]
    pub slopes: Slopes,
    /// Slopes before training.
    #[serde(default)]
    pub initial_slope: f32,
}

impl LayerKind for PReluSpec {
    fn base_name(&self) -> &'static str {
        "prelu"
    }

    fn describe(&self) -> String {
        match self.slopes {
            Slopes::PerPosition => "PReLU".into(),
            Slopes::PerChannel => "PReLU per channel".into(),
        }
    }

    fn family(&self) -> Family {
        Family::Activation
    }

    fn receptive_field(&self, _input: Shape) -> ReceptiveField {
        ReceptiveField::Element
    }

    fn check(&self, _input: Shape) -> Result<(), String> {
        check_first_value(self.initial_slope)
    }

    fn layer(&self, input: Shape, backend: Backend) -> Result<Box<dyn Layer>, String> {
        Ok(Box::new(PRelu::new(input, self.slopes, self.initial_slope, backend.isa)))
    }

    fn export_form(&self, _input: Shape, params: &[f32], _statistics: &[f32]) -> ExportForm {
        ExportForm::PRelu { slopes: params.to_vec() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::layers::gradcheck::check_layer;

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
