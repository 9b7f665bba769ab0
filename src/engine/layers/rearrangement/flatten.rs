//! From a map to a vector.

use serde::{Deserialize, Serialize};
use steersman_kernels::Backend;

use crate::engine::layers::{ExportForm, Family, Grads, Layer, LayerKind, Pair, Pass, ReceptiveField};
use crate::engine::tensor::Shape;

/// A map as a vector, in the order channel, row, column. (Keras' order is row, column, channel.)
///
/// - **Forward** `y[(c · h + i) · w + j] = x[c][i][j]`: the values stay where they are. A planned network skips the layer.
/// - **Backward** of `y[(c · h + i) · w + j] = x[c][i][j]`: `dx[c][i][j] = dy[(c · h + i) · w + j]`. Needs nothing.
/// - **Training and evaluation** are the same.
///
/// # Shapes
///
/// x, dx: `[n][c][h][w]`; y, dy: `[n][c · h · w]`.
#[derive(Debug)]
pub struct Flatten {
    input: Shape,
}

impl Flatten {
    /// Flattens maps of `input`.
    pub fn new(input: Shape) -> Flatten {
        Flatten { input }
    }
}

impl Layer for Flatten {
    fn input(&self) -> Shape {
        self.input
    }

    fn output(&self) -> Shape {
        Shape::vector(self.input.len())
    }

    fn is_view(&self) -> bool {
        true
    }

    fn infer(&self, _params: &[f32], _statistics: &[f32], _n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        y.copy_from_slice(x);
    }

    fn forward(&self, _params: &[f32], _pass: &Pass, _n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        y.copy_from_slice(x);
    }

    fn backward(&self, _params: &[f32], _pass: &Pass, _n: usize, pair: Pair, dx: Option<&mut [f32]>, _grads: Grads) {
        if let Some(dx) = dx {
            dx.copy_from_slice(pair.dy);
        }
    }
}

/// Options of [`Flatten`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlattenSpec {}

impl LayerKind for FlattenSpec {
    fn base_name(&self) -> &'static str {
        "flatten"
    }

    fn describe(&self) -> String {
        "flatten".into()
    }

    fn family(&self) -> Family {
        Family::Rearrangement
    }

    fn receptive_field(&self, _input: Shape) -> ReceptiveField {
        ReceptiveField::All
    }

    fn check(&self, _input: Shape) -> Result<(), String> {
        Ok(())
    }

    fn layer(&self, input: Shape, _backend: Backend) -> Result<Box<dyn Layer>, String> {
        Ok(Box::new(Flatten::new(input)))
    }

    fn export_form(&self, _input: Shape, _params: &[f32], _statistics: &[f32]) -> ExportForm {
        ExportForm::Flatten
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::layers::gradcheck::check_layer;

    #[test]
    fn gradients_hold() {
        check_layer(&Flatten::new(Shape::new(2, 3, 5)), 2);
    }
}
