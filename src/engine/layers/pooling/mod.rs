//! Layers that make a map smaller, or give it another size, each channel by itself and without trainable numbers.

mod average;
mod blur;
mod max;
mod resize;
mod window;

pub use average::{AveragePool, AveragePoolSpec};
pub use blur::{Blur, BlurSpec};
pub use max::{MaxPool, MaxPoolSpec};
pub use resize::{Resize, ResizeMethod, ResizeSpec, Taps};

#[cfg(test)]
mod tests {
    use steersman_kernels::Isa;

    use super::*;
    use crate::engine::layers::gradcheck::check_layer;
    use crate::engine::tensor::Shape;

    #[test]
    fn gradients_hold_for_any_window_and_stride() {
        for isa in Isa::available() {
            for (n, [c, h, w], window, stride) in [
                (1, [1, 2, 2], [2, 2], [2, 2]),
                (2, [2, 5, 7], [2, 2], [2, 2]),
                (2, [1, 9, 10], [4, 4], [4, 4]),
                (1, [3, 7, 8], [3, 2], [1, 3]),
                (2, [2, 6, 6], [3, 3], [2, 2]),
            ] {
                let input = Shape::new(c, h, w);
                check_layer(&MaxPool::new(input, window, stride, isa).unwrap(), n);
                check_layer(&AveragePool::new(input, window, stride, isa).unwrap(), n);
            }
        }
    }
}
