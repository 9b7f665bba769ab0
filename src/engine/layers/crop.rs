//! Cutting the border off inside the network.

use super::{Grads, Layer, Pair, Pass};
use crate::engine::tensor::Shape;

/// Cuts rows and columns off (Keras' `Cropping2D`).
///
/// **Forward** copies what is kept. **Backward** `dx` is `dy` where it was kept, and 0 elsewhere.
/// Training and evaluation are the same.
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

    /// Start of each kept row: in the input, in the output.
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

#[cfg(test)]
mod tests {
    use super::super::gradcheck::check_layer;
    use super::*;

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
