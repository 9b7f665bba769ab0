//! Cropping inside the network.

use serde::{Deserialize, Serialize};
use steersman_kernels::Backend;

use crate::engine::layers::kind::check_sizes;
use crate::engine::layers::{ExportForm, Family, Grads, Layer, LayerKind, Pair, Pass, ReceptiveField};
use crate::engine::tensor::Shape;

/// Cuts rows and columns off (Keras' `Cropping2D`).
///
/// - **Forward** `y[c][i][j] = x[c][i + top][j + left]`.
/// - **Backward** of `y[c][i][j] = x[c][i + top][j + left]`: `dx[c][i + top][j + left] = dy[c][i][j]`, and `dx = 0` where x was cut
///   off. Needs nothing.
/// - **Training and evaluation** are the same.
/// - **Limits** At least one row and one column must be left.
///
/// # Shapes
///
/// x, dx: `[n][c][h][w]`; y, dy: `[n][c][h − top − bottom][w − left − right]`.
#[derive(Debug)]
pub struct Crop {
    input: Shape,
    output: Shape,
    top: usize,
    left: usize,
}

impl Crop {
    /// Cuts `rows` (at the top, at the bottom) and `columns` (left, right) off `input`.
    pub fn new(input: Shape, rows: [usize; 2], columns: [usize; 2]) -> Result<Crop, String> {
        let ([top, bottom], [left, right]) = (rows, columns);
        if top + bottom >= input.h || left + right >= input.w {
            return Err(format!("nothing would be left of the {}x{} input", input.h, input.w));
        }
        let output = Shape::new(input.c, input.h - top - bottom, input.w - left - right);
        Ok(Crop { input, output, top, left })
    }

    /// Index of the first value of each kept row, in the input and in the output.
    fn rows(&self, n: usize) -> impl Iterator<Item = (usize, usize)> {
        let (input, output, top, left) = (self.input, self.output, self.top, self.left);
        (0..n * output.c * output.h).map(move |row| {
            let (map, y) = (row / output.h, row % output.h);
            ((map * input.h + top + y) * input.w + left, row * output.w)
        })
    }
}

impl Layer for Crop {
    fn input(&self) -> Shape {
        self.input
    }

    fn output(&self) -> Shape {
        self.output
    }

    fn infer(&self, _params: &[f32], _statistics: &[f32], n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        let width = self.output.w;
        for (from, to) in self.rows(n) {
            y[to..to + width].copy_from_slice(&x[from..from + width]);
        }
    }

    fn forward(&self, params: &[f32], _pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.infer(params, &[], n, x, y, scratch);
    }

    fn backward(&self, _params: &[f32], _pass: &Pass, n: usize, pair: Pair, dx: Option<&mut [f32]>, _grads: Grads) {
        let Some(dx) = dx else { return };
        dx.fill(0.0);
        let width = self.output.w;
        for (from, to) in self.rows(n) {
            dx[from..from + width].copy_from_slice(&pair.dy[to..to + width]);
        }
    }
}

/// Options of [`Crop`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CropSpec {
    /// Rows cut off at the top and at the bottom.
    #[serde(default)]
    pub rows: [usize; 2],
    /// Columns cut off on the left and on the right.
    #[serde(default)]
    pub columns: [usize; 2],
}

impl LayerKind for CropSpec {
    fn base_name(&self) -> &'static str {
        "crop"
    }

    fn describe(&self) -> String {
        "crop".into()
    }

    fn family(&self) -> Family {
        Family::Rearrangement
    }

    fn receptive_field(&self, _input: Shape) -> ReceptiveField {
        let before = [-(self.rows[0] as isize), -(self.columns[0] as isize)];
        ReceptiveField::Window { size: [1, 1], stride: [1, 1], before }
    }

    fn check(&self, _input: Shape) -> Result<(), String> {
        let sizes = [self.rows, self.columns].concat();
        check_sizes(&sizes.into_iter().map(|size| ("rows and columns", size)).collect::<Vec<_>>())
    }

    fn layer(&self, input: Shape, _backend: Backend) -> Result<Box<dyn Layer>, String> {
        Ok(Box::new(Crop::new(input, self.rows, self.columns)?))
    }

    fn export_form(&self, _input: Shape, _params: &[f32], _statistics: &[f32]) -> ExportForm {
        ExportForm::Crop { top: self.rows[0], left: self.columns[0] }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::layers::gradcheck::check_layer;

    #[test]
    fn gradients_hold() {
        check_layer(&Crop::new(Shape::new(2, 7, 5), [3, 1], [0, 2]).unwrap(), 3);
        check_layer(&Crop::new(Shape::new(1, 3, 3), [0, 0], [0, 0]).unwrap(), 1);
    }

    #[test]
    fn the_first_numbers_are_cut_from_the_top_and_the_left() {
        let layer = Crop::new(Shape::new(1, 3, 3), [1, 0], [2, 0]).unwrap();
        let mut y = [f32::NAN; 2];
        layer.infer(&[], &[], 1, &[0., 1., 2., 3., 4., 5., 6., 7., 8.], &mut y, &mut []);
        assert_eq!(y, [5.0, 8.0]);
    }
}
