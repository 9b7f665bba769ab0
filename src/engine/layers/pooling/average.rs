//! The mean of each window.

use serde::{Deserialize, Serialize};
use steersman_kernels::pool::{self, PoolShape};
use steersman_kernels::{Backend, Isa};

use super::window::{check, describe, input_of, output_of, pool_shape};
use crate::engine::layers::{ExportForm, Family, Grads, Layer, LayerKind, Pair, Pass, ReceptiveField};
use crate::engine::tensor::Shape;

/// The mean of each window, for stride s.
///
/// - **Forward** `y[c][i][j] = Σ_{k,l} x[c][i·s + k][j·s + l] / (kh · kw)`.
/// - **Backward** of `y[c][i][j] = Σ_{k,l} x[c][i·s + k][j·s + l] / (kh · kw)`: `dx[c][i·s + k][j·s + l] += dy[c][i][j] / (kh · kw)`.
///   Needs nothing.
/// - **Training and evaluation** are the same.
/// - **Limits** No padding: rows and columns that do not fill a window are left out.
///
/// # Shapes
///
/// x, dx: `[n][c][h][w]`; y, dy: `[n][c][⌊(h − kh) / s⌋ + 1][⌊(w − kw) / s⌋ + 1]`.
#[derive(Debug)]
pub struct AveragePool {
    shape: PoolShape,
    isa: Isa,
}

impl AveragePool {
    /// Windows of `window` (height, width), `stride` apart.
    pub fn new(input: Shape, window: [usize; 2], stride: [usize; 2], isa: Isa) -> Result<AveragePool, String> {
        Ok(AveragePool { shape: pool_shape(input, window, stride)?, isa })
    }
}

impl Layer for AveragePool {
    fn input(&self) -> Shape {
        input_of(&self.shape)
    }

    fn output(&self) -> Shape {
        output_of(&self.shape)
    }

    fn infer(&self, _params: &[f32], _statistics: &[f32], n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        pool::average_forward(self.isa, &self.shape, n, x, y);
    }

    fn forward(&self, params: &[f32], _pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.infer(params, &[], n, x, y, scratch);
    }

    fn backward(&self, _params: &[f32], _pass: &Pass, n: usize, pair: Pair, dx: Option<&mut [f32]>, _grads: Grads) {
        if let Some(dx) = dx {
            pool::average_backward(self.isa, &self.shape, n, pair.dy, dx);
        }
    }
}

/// Options of [`AveragePool`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AveragePoolSpec {
    /// Height and width of the window.
    pub window: [usize; 2],
    /// Rows and columns from one window to the next; the window's size when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stride: Option<[usize; 2]>,
}

impl LayerKind for AveragePoolSpec {
    fn base_name(&self) -> &'static str {
        "pool"
    }

    fn describe(&self) -> String {
        describe("average pool", self.window, self.stride)
    }

    fn family(&self) -> Family {
        Family::Pooling
    }

    fn receptive_field(&self, _input: Shape) -> ReceptiveField {
        ReceptiveField::Window { size: self.window, stride: self.stride.unwrap_or(self.window), before: [0, 0] }
    }

    fn check(&self, _input: Shape) -> Result<(), String> {
        check(self.window, self.stride)
    }

    fn layer(&self, input: Shape, backend: Backend) -> Result<Box<dyn Layer>, String> {
        Ok(Box::new(AveragePool::new(input, self.window, self.stride.unwrap_or(self.window), backend.isa)?))
    }

    fn export_form(&self, _input: Shape, _params: &[f32], _statistics: &[f32]) -> ExportForm {
        ExportForm::AveragePool { window: self.window, stride: self.stride.unwrap_or(self.window) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_average_of_a_window_is_its_mean() {
        let layer = AveragePool::new(Shape::new(1, 2, 2), [2, 2], [2, 2], Isa::best()).unwrap();
        let mut y = [f32::NAN; 1];
        layer.infer(&[], &[], 1, &[1.0, 2.0, 3.0, 6.0], &mut y, &mut []);
        assert_eq!(y, [3.0]);
    }
}
