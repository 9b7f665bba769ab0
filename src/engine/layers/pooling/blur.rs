//! Blur before a stride.

use serde::{Deserialize, Serialize};
use steersman_kernels::blur::{self, BlurShape, MAX_TAPS, binomial};
use steersman_kernels::pool::PoolShape;
use steersman_kernels::{Backend, Isa};

use super::window::{input_of, pool_shape};
use crate::engine::layers::kind::{MAX_NUMBERS, check_sizes, pair};
use crate::engine::layers::{ExportForm, Family, Grads, Layer, LayerKind, Linear, Pads, Pair, Pass, ReceptiveField};
use crate::engine::tensor::Shape;

/// Blurs each channel by fixed binomial weights (Zhang 2019, "Making Convolutional Networks Shift-Invariant Again"). A map that is
/// blurred before a stride changes little when the picture moves by a pixel; one that is not takes fine texture for coarse.
///
/// - **Forward** `y[c][i][j] = Σ_{k,l} a_k b_l x[c][i·s + k − p][j·s + l − p]`, where a and b are rows of Pascal's triangle over their
///   sums, and x is 0 outside the map.
/// - **Backward** of `y[c][i][j] = Σ_{k,l} a_k b_l x[c][i·s + k − p][j·s + l − p]`: `dx[c][i·s + k − p][j·s + l − p] += a_k b_l
///   dy[c][i][j]`. Needs nothing.
/// - **Training and evaluation** are the same.
/// - **Limits** Rows and columns that do not fill a window are left out. The padding is less than the window.
///
/// # Shapes
///
/// x, dx: `[n][c][h][w]`; y, dy: `[n][c][⌊(h + 2p − kh) / s⌋ + 1][⌊(w + 2p − kw) / s⌋ + 1]`.
#[derive(Debug)]
pub struct Blur {
    shape: BlurShape,
    isa: Isa,
}

impl Blur {
    /// Windows of `window` (height, width), `stride` apart, on maps with `padding` rows and columns of zeros on each side.
    ///
    /// # Errors
    ///
    /// A sentence that says what does not fit.
    pub fn new(
        input: Shape,
        window: [usize; 2],
        stride: [usize; 2],
        padding: [usize; 2],
        isa: Isa,
    ) -> Result<Blur, String> {
        let [pad_h, pad_w] = padding;
        // A window without any input would be a row of zeros.
        for (what, pad, size) in [("rows", pad_h, window[0]), ("columns", pad_w, window[1])] {
            if pad >= size.max(1) {
                let most = size.saturating_sub(1);
                return Err(format!("a padding of {pad} {what} in a window of {size}: {most} at most"));
            }
        }
        let padded = Shape::new(input.c, input.h + 2 * pad_h, input.w + 2 * pad_w);
        let windows = pool_shape(padded, window, stride)
            .map_err(|message| if padding == [0, 0] { message } else { format!("{message} with its padding") })?;
        let windows = PoolShape { h: input.h, w: input.w, ..windows };
        Ok(Blur { shape: BlurShape { windows, pad_h, pad_w }, isa })
    }
}

impl Layer for Blur {
    fn input(&self) -> Shape {
        input_of(&self.shape.windows)
    }

    fn output(&self) -> Shape {
        Shape::new(self.shape.windows.c, self.shape.out_h(), self.shape.out_w())
    }

    fn scratch_len(&self, _n: usize) -> usize {
        self.shape.scratch_len()
    }

    fn infer(&self, _params: &[f32], _statistics: &[f32], n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        blur::blur_forward(self.isa, &self.shape, n, x, y, scratch);
    }

    fn forward(&self, params: &[f32], _pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.infer(params, &[], n, x, y, scratch);
    }

    fn backward(&self, params: &[f32], pass: &Pass, n: usize, pair: Pair, dx: Option<&mut [f32]>, grads: Grads) {
        if let Some(dx) = dx {
            self.backward_input(params, pass, n, pair.dy, dx, grads.scratch);
        }
    }

    fn linear(&self) -> Option<&dyn Linear> {
        Some(self)
    }
}

impl Linear for Blur {
    fn backward_input(&self, _params: &[f32], _pass: &Pass, n: usize, dy: &[f32], dx: &mut [f32], scratch: &mut [f32]) {
        blur::blur_backward(self.isa, &self.shape, n, dy, dx, scratch);
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
    /// Rows of zeros above and below the map, columns of zeros on its left and right.
    #[serde(default, skip_serializing_if = "is_none")]
    pub padding: [usize; 2],
}

fn three() -> [usize; 2] {
    [3, 3]
}

fn one() -> [usize; 2] {
    [1, 1]
}

/// Files of recipes and models without padding stay as they were.
fn is_none(padding: &[usize; 2]) -> bool {
    *padding == [0, 0]
}

impl LayerKind for BlurSpec {
    fn base_name(&self) -> &'static str {
        "blur"
    }

    fn describe(&self) -> String {
        let mut text = format!("blur {}", pair(self.window));
        for (word, sizes, default) in [("stride", self.stride, [1, 1]), ("padding", self.padding, [0, 0])] {
            if sizes != default {
                text += &format!(" {word} {}", pair(sizes));
            }
        }
        text
    }

    fn family(&self) -> Family {
        Family::Pooling
    }

    fn receptive_field(&self, _input: Shape) -> ReceptiveField {
        ReceptiveField::Window { size: self.window, stride: self.stride, before: self.padding.map(|pad| pad as isize) }
    }

    fn check(&self, input: Shape) -> Result<(), String> {
        let [h, w] = self.window;
        if h > MAX_TAPS || w > MAX_TAPS {
            return Err(format!("window must be at most {MAX_TAPS}, not {h}x{w}"));
        }
        // Exports write a kernel for each channel.
        if input.c.saturating_mul(h * w) > MAX_NUMBERS {
            return Err(format!("a blur of {} channels is more than exports can write", input.c));
        }
        // The output is not larger than the map with its padding.
        let [rows, columns] = [(input.h, self.padding[0]), (input.w, self.padding[1])]
            .map(|(inside, padding)| inside.saturating_add(padding.saturating_mul(2)));
        if rows.saturating_mul(columns).saturating_mul(input.c) > MAX_NUMBERS {
            return Err(format!("the map with its padding would have more than {MAX_NUMBERS} numbers"));
        }
        check_sizes(&[("stride", self.stride[0]), ("stride", self.stride[1])])
    }

    fn layer(&self, input: Shape, backend: Backend) -> Result<Box<dyn Layer>, String> {
        Ok(Box::new(Blur::new(input, self.window, self.stride, self.padding, backend.isa)?))
    }

    fn export_form(&self, input: Shape, _params: &[f32], _statistics: &[f32]) -> ExportForm {
        let [kh, kw] = self.window;
        let (down, along) = (binomial(kh), binomial(kw));
        let kernel: Vec<f32> = (0..kh * kw).map(|k| down[k / kw] * along[k % kw]).collect();
        let weight = kernel.repeat(input.c);
        let [rows, columns] = self.padding;
        let pads = Pads { top: rows, left: columns, bottom: rows, right: columns };
        let (kernel, stride, bias) = (self.window, self.stride, vec![0.0; input.c]);
        ExportForm::Conv { depthwise: true, kernel, stride, pads, weight, bias }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::layers::gradcheck::check_layer;
    use crate::engine::layers::{ZeroPad, check_kind};

    #[test]
    fn gradients_hold_for_any_window_stride_and_padding() {
        for isa in Isa::available() {
            for (n, [c, h, w], window, stride, padding) in [
                (1, [1, 3, 3], [3, 3], [1, 1], [0, 0]),
                (2, [2, 5, 19], [3, 3], [1, 1], [1, 1]),
                (2, [2, 5, 7], [3, 3], [2, 2], [1, 1]),
                (1, [3, 7, 8], [5, 2], [1, 3], [0, 1]),
                (1, [1, 4, 3], [5, 4], [1, 1], [4, 2]),
                (2, [1, 7, 20], [1, 7], [3, 1], [0, 6]),
            ] {
                check_layer(&Blur::new(Shape::new(c, h, w), window, stride, padding, isa).unwrap(), n);
            }
        }
    }

    #[test]
    fn it_answers_truly_for_any_window_stride_and_padding() {
        for (window, stride, padding) in [
            ([3, 2], [2, 1], [0, 0]),
            ([5, 5], [1, 2], [2, 1]),
            ([1, 1], [1, 1], [0, 0]),
            ([3, 3], [1, 1], [1, 1]),
            ([2, 3], [1, 1], [1, 2]),
        ] {
            check_kind(&BlurSpec { window, stride, padding }, Shape::new(2, 7, 6));
        }
    }

    #[test]
    fn padding_is_what_a_layer_of_zeros_before_it_is() {
        let input = Shape::new(2, 4, 21);
        let x: Vec<f32> = (0..input.len()).map(|i| (i * 37 % 101) as f32 / 50.0 - 1.0).collect();
        for isa in Isa::available() {
            let zeros = ZeroPad::new(input, [1, 1], [2, 2]);
            let infer = |layer: &dyn Layer, x: &[f32]| {
                let mut y = vec![f32::NAN; layer.output().len()];
                layer.infer(&[], &[], 1, x, &mut y, &mut vec![f32::NAN; layer.scratch_len(1)]);
                y
            };
            let apart = Blur::new(zeros.output(), [3, 5], [1, 1], [0, 0], isa).unwrap();
            let padded = Blur::new(input, [3, 5], [1, 1], [1, 2], isa).unwrap();
            assert_eq!(padded.output(), apart.output());
            assert_eq!(infer(&padded, &x), infer(&apart, &infer(&zeros, &x)), "{}", isa.name());
        }
    }

    #[test]
    fn padding_as_wide_as_the_window_is_refused() {
        for (window, padding) in [([3, 3], [3, 0]), ([3, 2], [1, 2]), ([3, 3], [usize::MAX, 1])] {
            let spec = BlurSpec { window, stride: [1, 1], padding };
            let spec: &dyn LayerKind = &spec;
            let error = spec.build(Shape::new(1, 9, 9), Isa::PORTABLE).unwrap_err();
            assert!(error.contains("padding"), "{error}");
        }
    }

    #[test]
    fn more_channels_than_exports_can_write_are_refused() {
        let spec = BlurSpec { window: [3, 3], stride: [1, 1], padding: [0, 0] };
        assert_eq!(spec.check(Shape::new(MAX_NUMBERS / 9, 3, 3)), Ok(()));
        let error = spec.check(Shape::new(MAX_NUMBERS / 9 + 1, 3, 3)).unwrap_err();
        assert!(error.contains("channels"), "{error}");
    }

    #[test]
    fn a_blur_cannot_make_a_map_larger_than_any_layer_may() {
        let spec = BlurSpec { window: [7, 7], stride: [1, 1], padding: [6, 6] };
        assert_eq!(spec.check(Shape::new(1, 8180, 8180)), Ok(()));
        for shape in [Shape::new(1, 8181, 8181), Shape::new(MAX_NUMBERS / 100, 1, 1)] {
            let error = spec.check(shape).unwrap_err();
            assert!(error.contains("map with its padding"), "{error}");
        }
    }

    #[test]
    fn padding_is_told_where_there_is_any() {
        let blur = |stride, padding| BlurSpec { window: [3, 5], stride, padding }.describe();
        assert_eq!(blur([1, 1], [0, 0]), "blur 3x5");
        assert_eq!(blur([2, 1], [1, 0]), "blur 3x5 stride 2x1 padding 1x0");
        let new = |padding| Blur::new(Shape::new(1, 2, 2), [5, 5], [1, 1], padding, Isa::PORTABLE).unwrap_err();
        assert_eq!(new([0, 0]), "a 5x5 window does not fit into the 2x2 input");
        assert_eq!(new([1, 1]), "a 5x5 window does not fit into the 4x4 input with its padding");
    }

    #[test]
    fn a_blur_without_padding_is_read_and_written_as_it_always_was() {
        let spec: BlurSpec = toml::from_str("window = [3, 3]").unwrap();
        assert_eq!(spec, BlurSpec { window: [3, 3], stride: [1, 1], padding: [0, 0] });
        assert!(!toml::to_string(&spec).unwrap().contains("padding"));
        let padded = BlurSpec { padding: [0, 1], ..spec };
        assert_eq!(toml::from_str::<BlurSpec>(&toml::to_string(&padded).unwrap()).unwrap(), padded);
    }

    #[test]
    fn the_weights_are_binomial_and_keep_the_mean() {
        let blur = |h, w, window, x: &[f32]| {
            let layer = Blur::new(Shape::new(1, h, w), window, [1, 1], [0, 0], Isa::best()).unwrap();
            let mut y = vec![f32::NAN; layer.output().len()];
            layer.infer(&[], &[], 1, x, &mut y, &mut vec![f32::NAN; layer.scratch_len(1)]);
            y
        };
        assert_eq!(blur(1, 5, [1, 3], &[0.0, 0.0, 16.0, 0.0, 0.0]), [4.0, 8.0, 4.0]);
        assert_eq!(blur(5, 1, [5, 1], &[16.0, 32.0, 0.0, 0.0, 16.0]), [1.0 + 8.0 + 1.0]);
        assert_eq!(blur(3, 3, [3, 3], &[7.0; 9]), [7.0]);
        // Stripes of one pixel, which a stride of 2 would take for a plain map, become grey.
        assert_eq!(blur(1, 6, [1, 3], &[0.0, 2.0, 0.0, 2.0, 0.0, 2.0]), [1.0; 4]);
    }
}
