//! Blur before a stride.

use serde::{Deserialize, Serialize};
use steersman_kernels::blur::{self, MAX_TAPS, binomial};
use steersman_kernels::pool::PoolShape;
use steersman_kernels::{Backend, Isa};

use super::window::{input_of, output_of, pool_shape};
use crate::engine::layers::kind::{MAX_NUMBERS, check_sizes, pair};
use crate::engine::layers::{ExportForm, Family, Grads, Layer, LayerKind, Pads, Pair, Pass, ReceptiveField};
use crate::engine::tensor::Shape;

/// Blurs each channel by fixed binomial weights (Zhang 2019, "Making Convolutional Networks Shift-Invariant Again"). A map that is
/// blurred before a stride changes little when the picture moves by a pixel; one that is not takes fine texture for coarse.
///
/// - **Forward** `y[c][i][j] = Σ_{k,l} a_k b_l x[c][i·s + k][j·s + l]`, where a and b are rows of Pascal's triangle over their sums.
/// - **Backward** of `y[c][i][j] = Σ_{k,l} a_k b_l x[c][i·s + k][j·s + l]`: `dx[c][i·s + k][j·s + l] += a_k b_l dy[c][i][j]`.
///   Needs nothing.
/// - **Training and evaluation** are the same.
/// - **Limits** No padding: rows and columns that do not fill a window are left out. Exports write it as a convolution, which has
///   `c²` kernels.
///
/// # Shapes
///
/// x, dx: `[n][c][h][w]`; y, dy: `[n][c][⌊(h − kh) / s⌋ + 1][⌊(w − kw) / s⌋ + 1]`.
#[derive(Debug)]
pub struct Blur {
    shape: PoolShape,
    isa: Isa,
}

impl Blur {
    /// Windows of `window` (height, width), `stride` apart.
    ///
    /// # Errors
    ///
    /// A sentence that says what does not fit.
    pub fn new(input: Shape, window: [usize; 2], stride: [usize; 2], isa: Isa) -> Result<Blur, String> {
        Ok(Blur { shape: pool_shape(input, window, stride)?, isa })
    }
}

impl Layer for Blur {
    fn input(&self) -> Shape {
        input_of(&self.shape)
    }

    fn output(&self) -> Shape {
        output_of(&self.shape)
    }

    fn scratch_len(&self, _n: usize) -> usize {
        self.shape.w
    }

    fn infer(&self, _params: &[f32], _statistics: &[f32], n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        blur::blur_forward(self.isa, &self.shape, n, x, y, scratch);
    }

    fn forward(&self, params: &[f32], _pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.infer(params, &[], n, x, y, scratch);
    }

    fn backward(&self, _params: &[f32], _pass: &Pass, n: usize, pair: Pair, dx: Option<&mut [f32]>, grads: Grads) {
        if let Some(dx) = dx {
            blur::blur_backward(self.isa, &self.shape, n, pair.dy, dx, grads.scratch);
        }
    }
}

/// Options of [`Blur`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BlurSpec {
    /// Height and width of the window.
    #[serde(default = "three")]
    pub window: [usize; 2],
    /// Rows and columns from one window to the next.
    #[serde(default = "one")]
    pub stride: [usize; 2],
}

fn three() -> [usize; 2] {
    [3, 3]
}

fn one() -> [usize; 2] {
    [1, 1]
}

impl LayerKind for BlurSpec {
    fn base_name(&self) -> &'static str {
        "blur"
    }

    fn describe(&self) -> String {
        match self.stride {
            [1, 1] => format!("blur {}", pair(self.window)),
            stride => format!("blur {} stride {}", pair(self.window), pair(stride)),
        }
    }

    fn family(&self) -> Family {
        Family::Pooling
    }

    fn receptive_field(&self, _input: Shape) -> ReceptiveField {
        ReceptiveField::Window { size: self.window, stride: self.stride, before: [0, 0] }
    }

    fn check(&self, input: Shape) -> Result<(), String> {
        let [h, w] = self.window;
        if h > MAX_TAPS || w > MAX_TAPS {
            return Err(format!("window must be at most {MAX_TAPS}, not {h}x{w}"));
        }
        if input.c.saturating_mul(input.c).saturating_mul(h * w) > MAX_NUMBERS {
            return Err(format!("a blur of {} channels is more than exports can write", input.c));
        }
        check_sizes(&[("stride", self.stride[0]), ("stride", self.stride[1])])
    }

    fn layer(&self, input: Shape, backend: Backend) -> Result<Box<dyn Layer>, String> {
        Ok(Box::new(Blur::new(input, self.window, self.stride, backend.isa)?))
    }

    fn export_form(&self, input: Shape, _params: &[f32], _statistics: &[f32]) -> ExportForm {
        let [kh, kw] = self.window;
        let (down, along) = (binomial(kh), binomial(kw));
        let mut weight = vec![0.0; input.c * input.c * kh * kw];
        for channel in 0..input.c {
            let kernel = &mut weight[channel * (input.c + 1) * kh * kw..][..kh * kw];
            for (k, weight) in kernel.iter_mut().enumerate() {
                *weight = down[k / kw] * along[k % kw];
            }
        }
        let pads = Pads { top: 0, left: 0, bottom: 0, right: 0 };
        ExportForm::Conv { kernel: self.window, stride: self.stride, pads, weight, bias: vec![0.0; input.c] }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::layers::check_kind;
    use crate::engine::layers::gradcheck::check_layer;

    #[test]
    fn gradients_hold_for_any_window_and_stride() {
        for isa in Isa::available() {
            for (n, [c, h, w], window, stride) in [
                (1, [1, 3, 3], [3, 3], [1, 1]),
                (2, [2, 5, 7], [3, 3], [2, 2]),
                (1, [3, 7, 8], [5, 2], [1, 3]),
                (2, [1, 7, 20], [1, 7], [3, 1]),
            ] {
                check_layer(&Blur::new(Shape::new(c, h, w), window, stride, isa).unwrap(), n);
            }
        }
    }

    #[test]
    fn it_answers_truly_for_any_window_and_stride() {
        for (window, stride) in [([3, 2], [2, 1]), ([5, 5], [1, 2]), ([1, 1], [1, 1])] {
            check_kind(&BlurSpec { window, stride }, Shape::new(2, 7, 6));
        }
    }

    #[test]
    fn the_weights_are_binomial_and_keep_the_mean() {
        let blur = |h, w, window, x: &[f32]| {
            let layer = Blur::new(Shape::new(1, h, w), window, [1, 1], Isa::best()).unwrap();
            let mut y = vec![f32::NAN; layer.output().len()];
            layer.infer(&[], &[], 1, x, &mut y, &mut vec![f32::NAN; w]);
            y
        };
        assert_eq!(blur(1, 5, [1, 3], &[0.0, 0.0, 16.0, 0.0, 0.0]), [4.0, 8.0, 4.0]);
        assert_eq!(blur(5, 1, [5, 1], &[16.0, 32.0, 0.0, 0.0, 16.0]), [1.0 + 8.0 + 1.0]);
        assert_eq!(blur(3, 3, [3, 3], &[7.0; 9]), [7.0]);
        // Stripes of one pixel, which a stride of 2 would take for a plain map, become grey.
        assert_eq!(blur(1, 6, [1, 3], &[0.0, 2.0, 0.0, 2.0, 0.0, 2.0]), [1.0; 4]);
    }
}
