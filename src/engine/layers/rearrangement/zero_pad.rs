//! Zero padding as a layer of its own.

use serde::{Deserialize, Serialize};
use steersman_kernels::Backend;

use crate::engine::layers::kind::MAX_NUMBERS;
use crate::engine::layers::{ExportForm, Family, Grads, Layer, LayerKind, Pair, Pass, ReceptiveField};
use crate::engine::tensor::Shape;

/// Adds rows and columns of zeros (Keras' `ZeroPadding2D`).
///
/// - **Forward** `y[c][i + top][j + left] = x[c][i][j]`, and `y = 0` around it.
/// - **Backward** of `y[c][i + top][j + left] = x[c][i][j]`: `dx[c][i][j] = dy[c][i + top][j + left]`. Needs nothing.
/// - **Training and evaluation** are the same.
/// - **Limits** The output has at most 2²⁶ values an image.
///
/// # Shapes
///
/// x, dx: `[n][c][h][w]`; y, dy: `[n][c][h + top + bottom][w + left + right]`.
#[derive(Debug)]
pub struct ZeroPad {
    input: Shape,
    output: Shape,
    top: usize,
    left: usize,
}

impl ZeroPad {
    /// Adds `rows` (at the top, at the bottom) and `columns` (left, right) to `input`.
    pub fn new(input: Shape, rows: [usize; 2], columns: [usize; 2]) -> ZeroPad {
        let ([top, bottom], [left, right]) = (rows, columns);
        ZeroPad { input, output: Shape::new(input.c, input.h + top + bottom, input.w + left + right), top, left }
    }

    /// Index of the first value of each row of the input, in the input and in the output.
    fn rows(&self, n: usize) -> impl Iterator<Item = (usize, usize)> {
        let (input, output, top, left) = (self.input, self.output, self.top, self.left);
        (0..n * input.c * input.h).map(move |row| {
            let (map, y) = (row / input.h, row % input.h);
            (row * input.w, (map * output.h + top + y) * output.w + left)
        })
    }
}

impl Layer for ZeroPad {
    fn input(&self) -> Shape {
        self.input
    }

    fn output(&self) -> Shape {
        self.output
    }

    fn infer(&self, _params: &[f32], _statistics: &[f32], n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        y.fill(0.0);
        let width = self.input.w;
        for (from, to) in self.rows(n) {
            y[to..to + width].copy_from_slice(&x[from..from + width]);
        }
    }

    fn forward(&self, params: &[f32], _pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.infer(params, &[], n, x, y, scratch);
    }

    fn backward(&self, _params: &[f32], _pass: &Pass, n: usize, pair: Pair, dx: Option<&mut [f32]>, _grads: Grads) {
        let Some(dx) = dx else { return };
        let width = self.input.w;
        for (from, to) in self.rows(n) {
            dx[from..from + width].copy_from_slice(&pair.dy[to..to + width]);
        }
    }
}

/// Options of [`ZeroPad`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ZeroPadSpec {
    /// Rows added at the top and at the bottom.
    #[serde(default)]
    pub rows: [usize; 2],
    /// Columns added on the left and on the right.
    #[serde(default)]
    pub columns: [usize; 2],
}

impl LayerKind for ZeroPadSpec {
    fn base_name(&self) -> &'static str {
        "pad"
    }

    fn describe(&self) -> String {
        "zero padding".into()
    }

    fn family(&self) -> Family {
        Family::Rearrangement
    }

    fn receptive_field(&self, _input: Shape) -> ReceptiveField {
        let before = [self.rows[0] as isize, self.columns[0] as isize];
        ReceptiveField::Window { size: [1, 1], stride: [1, 1], before }
    }

    fn check(&self, input: Shape) -> Result<(), String> {
        let sum = |inside: usize, border: [usize; 2]| border.iter().fold(inside, |a, b| a.saturating_add(*b));
        let outputs = sum(input.h, self.rows).saturating_mul(sum(input.w, self.columns)).saturating_mul(input.c);
        match outputs > MAX_NUMBERS {
            true => Err(format!("the padded map would have more than {MAX_NUMBERS} numbers")),
            false => Ok(()),
        }
    }

    fn layer(&self, input: Shape, _backend: Backend) -> Result<Box<dyn Layer>, String> {
        Ok(Box::new(ZeroPad::new(input, self.rows, self.columns)))
    }

    fn export_form(&self, _input: Shape, _params: &[f32], _statistics: &[f32]) -> ExportForm {
        ExportForm::ZeroPad { top: self.rows[0], left: self.columns[0] }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::layers::gradcheck::check_layer;

    #[test]
    fn gradients_hold() {
        check_layer(&ZeroPad::new(Shape::new(2, 3, 5), [3, 1], [0, 2]), 3);
        check_layer(&ZeroPad::new(Shape::new(1, 3, 3), [0, 0], [0, 0]), 1);
    }

    #[test]
    fn the_first_numbers_are_added_at_the_top_and_on_the_left() {
        let layer = ZeroPad::new(Shape::new(1, 1, 2), [1, 0], [2, 0]);
        let mut y = [f32::NAN; 8];
        layer.infer(&[], &[], 1, &[5.0, 6.0], &mut y, &mut []);
        assert_eq!(y, [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 5.0, 6.0]);
    }
}
