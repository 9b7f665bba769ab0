//! Activations: each value by itself. One without trainable numbers says what it computes as a [`Curve`].

mod elementwise;
mod elu;
mod leaky_relu;
mod prelu;
mod relu;
mod softsign;
mod swish;
mod tanh;

pub use elementwise::{Curve, Elementwise};
pub use elu::{Elu, EluSpec};
pub use leaky_relu::{LeakyRelu, LeakyReluSpec};
pub use prelu::{PRelu, PReluSpec, Slopes};
pub use relu::{Relu, ReluSpec};
pub use softsign::{Softsign, SoftsignSpec};
pub use swish::{Swish, SwishSpec};
pub use tanh::{Tanh, TanhSpec};

#[cfg(test)]
mod tests {
    use steersman_kernels::Isa;

    use super::*;
    use crate::engine::layers::Layer;
    use crate::engine::layers::gradcheck::check_layer;
    use crate::engine::tensor::Shape;

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
