//! Pooling.

use serde::{Deserialize, Serialize};
use steersman_kernels::pool::{self, PoolShape};
use steersman_kernels::{Backend, Isa};

use super::kind::{check_sizes, pair};
use super::{ExportForm, Family, Grads, Layer, LayerKind, Pair, Pass, ReceptiveField};
use crate::engine::tensor::Shape;

pub(super) fn pool_shape(input: Shape, window: [usize; 2], stride: [usize; 2]) -> Result<PoolShape, String> {
    let ([kh, kw], [stride_h, stride_w]) = (window, stride);
    if kh == 0 || kw == 0 || stride_h == 0 || stride_w == 0 {
        return Err("window and stride must be at least 1".into());
    }
    if kh > input.h || kw > input.w {
        return Err(format!("a {kh}x{kw} window does not fit into the {}x{} input", input.h, input.w));
    }
    Ok(PoolShape { c: input.c, h: input.h, w: input.w, kh, kw, stride_h, stride_w })
}

/// The largest value of each window, for stride s.
///
/// - **Forward** `y[c][i][j] = max_{k,l} x[c][i·s + k][j·s + l]`.
/// - **Backward** of `y[c][i][j] = max_{k,l} x[c][i·s + k][j·s + l]`: `dx += dy[c][i][j]` at the argmax, the first of equal ones in
///   row-major order; `dx = 0` elsewhere. Needs x and y.
/// - **Training and evaluation** are the same.
/// - **Limits** No padding: rows and columns that do not fill a window are left out.
///
/// # Shapes
///
/// x, dx: `[n][c][h][w]`; y, dy: `[n][c][⌊(h − kh) / s⌋ + 1][⌊(w − kw) / s⌋ + 1]`.
#[derive(Debug)]
pub struct MaxPool {
    shape: PoolShape,
    isa: Isa,
}

impl MaxPool {
    /// Windows of `window` (height, width), `stride` apart.
    pub fn new(input: Shape, window: [usize; 2], stride: [usize; 2], isa: Isa) -> Result<MaxPool, String> {
        Ok(MaxPool { shape: pool_shape(input, window, stride)?, isa })
    }
}

impl Layer for MaxPool {
    fn input(&self) -> Shape {
        Shape::new(self.shape.c, self.shape.h, self.shape.w)
    }

    fn output(&self) -> Shape {
        Shape::new(self.shape.c, self.shape.out_h(), self.shape.out_w())
    }

    fn infer(&self, _params: &[f32], _statistics: &[f32], n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        pool::max_forward(self.isa, &self.shape, n, x, y);
    }

    fn forward(&self, params: &[f32], _pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.infer(params, &[], n, x, y, scratch);
    }

    fn backward(&self, _params: &[f32], _pass: &Pass, n: usize, pair: Pair, dx: Option<&mut [f32]>, _grads: Grads) {
        if let Some(dx) = dx {
            pool::max_backward(self.isa, &self.shape, n, pair.x, pair.y, pair.dy, dx);
        }
    }
}

/// The mean of each window, for stride s.
///
/// - **Forward** `y[c][i][j] = Σ_{k,l} x[c][i·s + k][j·s + l] / (kh · kw)`.
/// - **Backward** of `y[c][i][j] = Σ_{k,l} x[c][i·s + k][j·s + l] / (kh · kw)`: `dx[c][i·s + k][j·s + l] += dy[c][i][j] / (kh · kw)`.
///   Needs nothing.
/// - **Training and evaluation** are the same.
/// - **Limits** No padding: rows and columns that do not fill a window are left out.
///
/// # Shapes
///
/// x, dx: `[n][c][h][w]`; y, dy: `[n][c][⌊(h − kh) / s⌋ + 1][⌊(w − kw) / s⌋ + 1]`.
#[derive(Debug)]
pub struct AveragePool {
    shape: PoolShape,
    isa: Isa,
}

impl AveragePool {
    /// Windows of `window` (height, width), `stride` apart.
    pub fn new(input: Shape, window: [usize; 2], stride: [usize; 2], isa: Isa) -> Result<AveragePool, String> {
        Ok(AveragePool { shape: pool_shape(input, window, stride)?, isa })
    }
}

impl Layer for AveragePool {
    fn input(&self) -> Shape {
        Shape::new(self.shape.c, self.shape.h, self.shape.w)
    }

    fn output(&self) -> Shape {
        Shape::new(self.shape.c, self.shape.out_h(), self.shape.out_w())
    }

    fn infer(&self, _params: &[f32], _statistics: &[f32], n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        pool::average_forward(self.isa, &self.shape, n, x, y);
    }

    fn forward(&self, params: &[f32], _pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.infer(params, &[], n, x, y, scratch);
    }

    fn backward(&self, _params: &[f32], _pass: &Pass, n: usize, pair: Pair, dx: Option<&mut [f32]>, _grads: Grads) {
        if let Some(dx) = dx {
            pool::average_backward(self.isa, &self.shape, n, pair.dy, dx);
        }
    }
}

/// Options of [`MaxPool`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MaxPoolSpec {
    /// Height and width of the window.
    pub window: [usize; 2],
    /// Rows and columns from one window to the next; the window's size when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stride: Option<[usize; 2]>,
}

impl LayerKind for MaxPoolSpec {
    fn base_name(&self) -> &'static str {
        "pool"
    }

    fn describe(&self) -> String {
        describe("max pool", self.window, self.stride)
    }

    fn family(&self) -> Family {
        Family::Pooling
    }

    fn receptive_field(&self, _input: Shape) -> ReceptiveField {
        ReceptiveField::Window { size: self.window, stride: self.stride.unwrap_or(self.window), before: [0, 0] }
    }

    fn check(&self, _input: Shape) -> Result<(), String> {
        check(self.window, self.stride)
    }

    fn layer(&self, input: Shape, backend: Backend) -> Result<Box<dyn Layer>, String> {
        Ok(Box::new(MaxPool::new(input, self.window, self.stride.unwrap_or(self.window), backend.isa)?))
    }

    fn export_form(&self, _input: Shape, _params: &[f32], _statistics: &[f32]) -> ExportForm {
        ExportForm::MaxPool { window: self.window, stride: self.stride.unwrap_or(self.window) }
    }
}

/// Options of [`AveragePool`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AveragePoolSpec {
    /// Height and width of the window.
    pub window: [usize; 2],
    /// Rows and columns from one window to the next; the window's size when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stride: Option<[usize; 2]>,
}

impl LayerKind for AveragePoolSpec {
    fn base_name(&self) -> &'static str {
        "pool"
    }

    fn describe(&self) -> String {
        describe("average pool", self.window, self.stride)
    }

    fn family(&self) -> Family {
        Family::Pooling
    }

    fn receptive_field(&self, _input: Shape) -> ReceptiveField {
        ReceptiveField::Window { size: self.window, stride: self.stride.unwrap_or(self.window), before: [0, 0] }
    }

    fn check(&self, _input: Shape) -> Result<(), String> {
        check(self.window, self.stride)
    }

    fn layer(&self, input: Shape, backend: Backend) -> Result<Box<dyn Layer>, String> {
        Ok(Box::new(AveragePool::new(input, self.window, self.stride.unwrap_or(self.window), backend.isa)?))
    }

    fn export_form(&self, _input: Shape, _params: &[f32], _statistics: &[f32]) -> ExportForm {
        ExportForm::AveragePool { window: self.window, stride: self.stride.unwrap_or(self.window) }
    }
}

/// `max pool 2x2`, `max pool 3x3 stride 2x2`.
fn describe(what: &str, window: [usize; 2], stride: Option<[usize; 2]>) -> String {
    match stride.filter(|stride| *stride != window) {
        None => format!("{what} {}", pair(window)),
        Some(stride) => format!("{what} {} stride {}", pair(window), pair(stride)),
    }
}

fn check([h, w]: [usize; 2], stride: Option<[usize; 2]>) -> Result<(), String> {
    let [sh, sw] = stride.unwrap_or([1, 1]);
    check_sizes(&[("window", h), ("window", w), ("stride", sh), ("stride", sw)])
}

#[cfg(test)]
mod tests {
    use super::super::gradcheck::check_layer;
    use super::*;

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

    #[test]
    fn the_average_of_a_window_is_its_mean() {
        let layer = AveragePool::new(Shape::new(1, 2, 2), [2, 2], [2, 2], Isa::best()).unwrap();
        let mut y = [f32::NAN; 1];
        layer.infer(&[], &[], 1, &[1.0, 2.0, 3.0, 6.0], &mut y, &mut []);
        assert_eq!(y, [3.0]);
    }

    #[test]
    fn the_first_of_equal_maxima_gets_the_gradient() {
        let layer = MaxPool::new(Shape::new(1, 2, 2), [2, 2], [2, 2], Isa::best()).unwrap();
        let pass = Pass { seed: 0, step: 0, layer: 0, first_image: 0, moments: &[], packed: &[] };
        let (x, y, dy, mut dx) = ([0.0, 3.0, 3.0, 1.0], [3.0], [2.0], [f32::NAN; 4]);
        let grads = Grads { dparams: &mut [], scratch: &mut [] };
        layer.backward(&[], &pass, 1, Pair { x: &x, y: &y, dy: &dy }, Some(&mut dx), grads);
        assert_eq!(dx, [0.0, 2.0, 0.0, 0.0]);
    }
}
