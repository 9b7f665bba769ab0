//! From a map to a vector.

use super::{Grads, Layer, Pair, Pass};
use crate::engine::tensor::Shape;

/// The map as a vector, in the order channel, row, column (Keras' order is row, column, channel).
///
/// The numbers stay where they are; all passes are copies, and a planned network leaves even those out.
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

#[cfg(test)]
mod tests {
    use super::super::gradcheck::check_layer;
    use super::*;

    #[test]
    fn gradients_hold() {
        check_layer(&Flatten::new(Shape::new(2, 3, 5)), 2);
    }
}
