//! Zeros around the border.

use super::{Grads, Layer, Pair, Pass};
use crate::engine::tensor::Shape;

/// Adds rows and columns of zeros (Keras' `ZeroPadding2D`).
///
/// **Forward** copies the input into the middle; the border is 0. **Backward** `dx` is the middle of `dy`.
/// Training and evaluation are the same.
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

    /// Start of each row of the input: in the input, in the output.
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

#[cfg(test)]
mod tests {
    use super::super::gradcheck::check_layer;
    use super::*;

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
