//! Activations without parameters.

use steersman_kernels::Isa;
use steersman_kernels::activation;

use super::{Grads, Layer, Pair, Pass};
use crate::engine::tensor::Shape;

/// Rectified linear unit.
///
/// **Forward** `y = max(x, 0)`. **Backward** needs y: `dx = dy` where `y > 0`, else 0.
/// Training and evaluation are the same.
#[derive(Debug)]
pub struct Relu {
    shape: Shape,
    isa: Isa,
}

impl Relu {
    /// A ReLU of maps of `shape`.
    pub fn new(shape: Shape, isa: Isa) -> Relu {
        Relu { shape, isa }
    }
}

impl Layer for Relu {
    fn input(&self) -> Shape {
        self.shape
    }

    fn output(&self) -> Shape {
        self.shape
    }

    fn infer(&self, _params: &[f32], _statistics: &[f32], _n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        activation::relu_forward(self.isa, x, y);
    }

    fn forward(&self, params: &[f32], _pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.infer(params, &[], n, x, y, scratch);
    }

    fn backward(&self, _params: &[f32], _pass: &Pass, _n: usize, pair: Pair, dx: Option<&mut [f32]>, _grads: Grads) {
        if let Some(dx) = dx {
            activation::relu_backward(self.isa, pair.y, pair.dy, dx);
        }
    }
}

/// Exponential linear unit (Clevert et al. 2015).
///
/// **Forward** `y = x` for `x > 0`, else `alpha · (eˣ − 1)`. **Backward** needs y: `dx = dy` for `y > 0`, else
/// `dy · (y + alpha)`. Training and evaluation are the same.
#[derive(Debug)]
pub struct Elu {
    shape: Shape,
    alpha: f32,
    isa: Isa,
}

impl Elu {
    /// An ELU of maps of `shape` that goes to −`alpha` for large negative inputs.
    pub fn new(shape: Shape, alpha: f32, isa: Isa) -> Result<Elu, String> {
        if !(alpha.is_finite() && alpha > 0.0) {
            return Err(format!("alpha must be a positive number, not {alpha}"));
        }
        Ok(Elu { shape, alpha, isa })
    }
}

impl Layer for Elu {
    fn input(&self) -> Shape {
        self.shape
    }

    fn output(&self) -> Shape {
        self.shape
    }

    fn infer(&self, _params: &[f32], _statistics: &[f32], _n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        activation::elu_forward(self.isa, self.alpha, x, y);
    }

    fn forward(&self, params: &[f32], _pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.infer(params, &[], n, x, y, scratch);
    }

    fn backward(&self, _params: &[f32], _pass: &Pass, _n: usize, pair: Pair, dx: Option<&mut [f32]>, _grads: Grads) {
        if let Some(dx) = dx {
            activation::elu_backward(self.isa, self.alpha, pair.y, pair.dy, dx);
        }
    }
}

/// Leaky rectified linear unit (Maas et al. 2013).
///
/// **Forward** `y = x` for `x > 0`, else `slope · x`. **Backward** needs x: `dx = dy` for `x > 0`, else `dy · slope`.
/// Training and evaluation are the same.
#[derive(Debug)]
pub struct LeakyRelu {
    shape: Shape,
    slope: f32,
    isa: Isa,
}

impl LeakyRelu {
    /// A leaky ReLU of maps of `shape` with `slope` below zero.
    pub fn new(shape: Shape, slope: f32, isa: Isa) -> Result<LeakyRelu, String> {
        if !slope.is_finite() {
            return Err(format!("slope must be a finite number, not {slope}"));
        }
        Ok(LeakyRelu { shape, slope, isa })
    }
}

impl Layer for LeakyRelu {
    fn input(&self) -> Shape {
        self.shape
    }

    fn output(&self) -> Shape {
        self.shape
    }

    fn infer(&self, _params: &[f32], _statistics: &[f32], _n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        activation::leaky_relu_forward(self.isa, self.slope, x, y);
    }

    fn forward(&self, params: &[f32], _pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.infer(params, &[], n, x, y, scratch);
    }

    fn backward(&self, _params: &[f32], _pass: &Pass, _n: usize, pair: Pair, dx: Option<&mut [f32]>, _grads: Grads) {
        if let Some(dx) = dx {
            activation::leaky_relu_backward(self.isa, self.slope, pair.x, pair.dy, dx);
        }
    }
}

/// Hyperbolic tangent.
///
/// **Forward** `y = tanh(x)`. **Backward** needs y: `dx = dy · (1 − y²)`. Training and evaluation are the same.
#[derive(Debug)]
pub struct Tanh {
    shape: Shape,
    isa: Isa,
}

impl Tanh {
    /// The hyperbolic tangent of maps of `shape`.
    pub fn new(shape: Shape, isa: Isa) -> Tanh {
        Tanh { shape, isa }
    }
}

impl Layer for Tanh {
    fn input(&self) -> Shape {
        self.shape
    }

    fn output(&self) -> Shape {
        self.shape
    }

    fn infer(&self, _params: &[f32], _statistics: &[f32], _n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        activation::tanh_forward(self.isa, x, y);
    }

    fn forward(&self, params: &[f32], _pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.infer(params, &[], n, x, y, scratch);
    }

    fn backward(&self, _params: &[f32], _pass: &Pass, _n: usize, pair: Pair, dx: Option<&mut [f32]>, _grads: Grads) {
        if let Some(dx) = dx {
            activation::tanh_backward(self.isa, pair.y, pair.dy, dx);
        }
    }
}

/// Softsign (Turian et al. 2009).
///
/// **Forward** `y = x / (1 + |x|)`. **Backward** needs y: `dx = dy · (1 − |y|)²`. Training and evaluation are the same.
#[derive(Debug)]
pub struct Softsign {
    shape: Shape,
    isa: Isa,
}

impl Softsign {
    /// The softsign of maps of `shape`.
    pub fn new(shape: Shape, isa: Isa) -> Softsign {
        Softsign { shape, isa }
    }
}

impl Layer for Softsign {
    fn input(&self) -> Shape {
        self.shape
    }

    fn output(&self) -> Shape {
        self.shape
    }

    fn infer(&self, _params: &[f32], _statistics: &[f32], _n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        activation::softsign_forward(self.isa, x, y);
    }

    fn forward(&self, params: &[f32], _pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.infer(params, &[], n, x, y, scratch);
    }

    fn backward(&self, _params: &[f32], _pass: &Pass, _n: usize, pair: Pair, dx: Option<&mut [f32]>, _grads: Grads) {
        if let Some(dx) = dx {
            activation::softsign_backward(self.isa, pair.y, pair.dy, dx);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::gradcheck::check_layer;
    use super::*;

    #[test]
    fn gradients_hold() {
        for isa in Isa::available() {
            for (n, shape) in [(1, Shape::vector(1)), (3, Shape::new(2, 5, 7)), (2, Shape::vector(37))] {
                check_layer(&Relu::new(shape, isa), n);
                check_layer(&Elu::new(shape, 1.0, isa).unwrap(), n);
                check_layer(&Elu::new(shape, 0.3, isa).unwrap(), n);
                check_layer(&LeakyRelu::new(shape, 0.2, isa).unwrap(), n);
                check_layer(&LeakyRelu::new(shape, -0.4, isa).unwrap(), n);
                check_layer(&Tanh::new(shape, isa), n);
                check_layer(&Softsign::new(shape, isa), n);
            }
        }
    }

    #[test]
    fn elu_is_the_identity_above_zero_and_levels_off_at_minus_alpha() {
        let layer = Elu::new(Shape::vector(4), 2.0, Isa::best()).unwrap();
        let mut y = [f32::NAN; 4];
        layer.infer(&[], &[], 1, &[1.5, 0.0, -1.0, -100.0], &mut y, &mut []);
        approx::assert_relative_eq!(y[..], [1.5, 0.0, 2.0 * ((-1.0f32).exp() - 1.0), -2.0], max_relative = 1e-6);
    }

    #[test]
    fn activations_have_their_defined_values() {
        let x = [2.0, -2.0, 0.0];
        let values = |layer: &dyn Layer| {
            let mut y = [f32::NAN; 3];
            layer.infer(&[], &[], 1, &x, &mut y, &mut []);
            y
        };
        let shape = Shape::vector(3);
        assert_eq!(values(&LeakyRelu::new(shape, 0.1, Isa::best()).unwrap()), [2.0, -0.2, 0.0]);
        assert_eq!(values(&Softsign::new(shape, Isa::best())), [2.0 / 3.0, -2.0 / 3.0, 0.0]);
        let tanh = values(&Tanh::new(shape, Isa::best()));
        approx::assert_relative_eq!(tanh[..], [0.964_027_6, -0.964_027_6, 0.0], max_relative = 2e-6);
    }
}
