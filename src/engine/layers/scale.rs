//! Fixed scaling inside the network.

use serde::{Deserialize, Serialize};
use steersman_kernels::Backend;

use super::{ExportForm, Family, Formula, Grads, Layer, LayerKind, Pair, Pass, ReceptiveField};
use crate::engine::tensor::Shape;

/// Scaling by fixed numbers: the normalisation layer at the start of many Keras networks.
///
/// - **Forward** `y = x · factor + offset`.
/// - **Backward** of `y = x · factor + offset`: `dx = dy · factor`. Needs nothing.
/// - **Training and evaluation** are the same.
/// - **Limits** factor and offset are finite and never trained.
///
/// # Shapes
///
/// x, y, dx, dy: `[n][c][h][w]`.
#[derive(Debug)]
pub struct Scale {
    shape: Shape,
    factor: f32,
    offset: f32,
}

impl Scale {
    /// `x · factor + offset` on maps of `shape`.
    pub fn new(shape: Shape, factor: f32, offset: f32) -> Result<Scale, String> {
        if !(factor.is_finite() && offset.is_finite()) {
            return Err(format!("factor and offset must be finite numbers, not {factor} and {offset}"));
        }
        Ok(Scale { shape, factor, offset })
    }
}

impl Layer for Scale {
    fn input(&self) -> Shape {
        self.shape
    }

    fn output(&self) -> Shape {
        self.shape
    }

    fn infer(&self, _params: &[f32], _statistics: &[f32], _n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        assert_eq!(x.len(), y.len());
        for (y, x) in y.iter_mut().zip(x) {
            *y = x * self.factor + self.offset;
        }
    }

    fn forward(&self, params: &[f32], _pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.infer(params, &[], n, x, y, scratch);
    }

    fn backward(&self, _params: &[f32], _pass: &Pass, _n: usize, pair: Pair, dx: Option<&mut [f32]>, _grads: Grads) {
        let Some(dx) = dx else { return };
        assert_eq!(dx.len(), pair.dy.len());
        for (dx, dy) in dx.iter_mut().zip(pair.dy) {
            *dx = dy * self.factor;
        }
    }
}

/// Options of [`Scale`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScaleSpec {
    /// Multiplies the input.
    pub factor: f32,
    /// Added after that.
    pub offset: f32,
}

impl LayerKind for ScaleSpec {
    fn base_name(&self) -> &'static str {
        "scale"
    }

    fn describe(&self) -> String {
        format!("x * {} + {}", self.factor, self.offset).replace("+ -", "- ")
    }

    fn family(&self) -> Family {
        Family::Normalization
    }

    fn receptive_field(&self, _input: Shape) -> ReceptiveField {
        ReceptiveField::Element
    }

    fn check(&self, _input: Shape) -> Result<(), String> {
        Ok(())
    }

    fn layer(&self, input: Shape, _backend: Backend) -> Result<Box<dyn Layer>, String> {
        Ok(Box::new(Scale::new(input, self.factor, self.offset)?))
    }

    fn export_form(&self, _input: Shape, _params: &[f32], _statistics: &[f32]) -> ExportForm {
        ExportForm::Elementwise(Formula::X * Formula::Number(self.factor) + Formula::Number(self.offset))
    }
}

#[cfg(test)]
mod tests {
    use super::super::gradcheck::check_layer;
    use super::*;

    #[test]
    fn gradients_hold() {
        check_layer(&Scale::new(Shape::new(2, 3, 5), 0.7, -0.4).unwrap(), 3);
        check_layer(&Scale::new(Shape::vector(1), -2.0, 0.0).unwrap(), 1);
    }

    #[test]
    fn grey_levels_become_minus_one_to_one() {
        let layer = Scale::new(Shape::vector(3), 1.0 / 127.5, -1.0).unwrap();
        let mut y = [f32::NAN; 3];
        layer.infer(&[], &[], 1, &[0.0, 127.5, 255.0], &mut y, &mut []);
        assert_eq!(y, [-1.0, 0.0, 1.0]);
    }
}
