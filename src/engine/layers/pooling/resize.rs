//! Resizing inside the network.

use std::ops::Range;

use serde::{Deserialize, Serialize};
use steersman_kernels::Backend;

use crate::engine::layers::kind::{MAX_NUMBERS, check_sizes, pair};
use crate::engine::layers::{ExportForm, Family, Grads, Layer, LayerKind, Pair, Pass, ReceptiveField};
use crate::engine::tensor::Shape;

/// How a map is resized. All are those of TensorFlow's `tf.image.resize` without antialiasing, so those of Keras' `Resizing`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ResizeMethod {
    /// Between the two values around `(i + ½) · size ÷ new size − ½` in each direction; at the border the outermost one.
    #[default]
    Bilinear,
    /// The value at `⌊(i + ½) · size ÷ new size⌋`.
    Nearest,
    /// The mean over what an output covers, `i · size ÷ new size` to `(i + 1) · size ÷ new size`; values that are covered in part count
    /// by that part.
    Area,
}

impl ResizeMethod {
    fn name(self) -> &'static str {
        match self {
            ResizeMethod::Bilinear => "bilinear",
            ResizeMethod::Nearest => "nearest",
            ResizeMethod::Area => "area",
        }
    }
}

/// Along one axis, the inputs that each output is a weighted sum of.
#[derive(Clone, Debug, PartialEq)]
pub struct Taps {
    first: Vec<usize>,
    /// One more than there are outputs.
    starts: Vec<usize>,
    weights: Vec<f32>,
}

impl Taps {
    /// From `from` inputs to `to` outputs. Positions are computed in 32-bit floats, as TensorFlow computes them: near whole
    /// numbers their rounding decides which input is taken.
    pub fn new(from: usize, to: usize, method: ResizeMethod) -> Taps {
        let scale = from as f32 / to as f32;
        let last = from - 1;
        let mut taps = Taps { first: Vec::with_capacity(to), starts: vec![0], weights: Vec::new() };
        for i in 0..to {
            match method {
                ResizeMethod::Bilinear => {
                    let position = (i as f32 + 0.5) * scale - 0.5;
                    let share = position - position.floor();
                    let low = (position.floor().max(0.0) as usize).min(last);
                    let high = (position.ceil().max(0.0) as usize).min(last);
                    if low == high {
                        taps.push(low, &[1.0]);
                    } else {
                        taps.push(low, &[1.0 - share, share]);
                    }
                }
                ResizeMethod::Nearest => taps.push((((i as f32 + 0.5) * scale).floor() as usize).min(last), &[1.0]),
                ResizeMethod::Area => {
                    let (begin, end) = (i as f32 * scale, (i + 1) as f32 * scale);
                    let first = (begin.floor() as usize).min(last);
                    let covered = |at: usize| (end.min((at + 1) as f32) - begin.max(at as f32)) / scale;
                    let positions = first..(end.ceil() as usize).clamp(first + 1, from);
                    // Rounding may leave a part of nothing at the end.
                    let weights: Vec<f32> = positions.map(covered).take_while(|weight| *weight > 0.0).collect();
                    taps.push(first, &weights);
                }
            }
        }
        taps
    }

    fn push(&mut self, first: usize, weights: &[f32]) {
        self.first.push(first);
        self.weights.extend(weights);
        self.starts.push(self.weights.len());
    }

    /// Number of outputs.
    pub fn outputs(&self) -> usize {
        self.first.len()
    }

    /// First input and weights of output `i`.
    pub fn of(&self, i: usize) -> (usize, &[f32]) {
        (self.first[i], &self.weights[self.starts[i]..self.starts[i + 1]])
    }

    /// The inputs that output `i` sees.
    pub fn seen(&self, i: usize) -> Range<usize> {
        let (first, weights) = self.of(i);
        first..first + weights.len()
    }
}

/// Resizes each channel (Keras' `Resizing`).
///
/// - **Forward** `y[c][i][j] = Σ_k Σ_l a_ik b_jl x[c][k][l]`, with the weights a and b of [`ResizeMethod`].
/// - **Backward** of `y[c][i][j] = Σ_k Σ_l a_ik b_jl x[c][k][l]`: `dx[c][k][l] = Σ_i Σ_j a_ik b_jl dy[c][i][j]`. Needs nothing.
/// - **Training and evaluation** are the same.
/// - **Limits** No antialiasing: the bilinear method reads two inputs in each direction, however many lie between two outputs.
///
/// # Shapes
///
/// x, dx: `[n][c][h][w]`; y, dy: `[n][c][to_h][to_w]`.
#[derive(Debug)]
pub struct Resize {
    input: Shape,
    rows: Taps,
    columns: Taps,
}

impl Resize {
    /// Resizes `input` to `to` (height, width).
    ///
    /// # Errors
    ///
    /// A sentence, if a size is 0.
    pub fn new(input: Shape, to: [usize; 2], method: ResizeMethod) -> Result<Resize, String> {
        if to.contains(&0) || input.positions() == 0 {
            return Err(format!("cannot resize {}x{} to {}", input.h, input.w, pair(to)));
        }
        Ok(Resize { input, rows: Taps::new(input.h, to[0], method), columns: Taps::new(input.w, to[1], method) })
    }
}

impl Layer for Resize {
    fn input(&self) -> Shape {
        self.input
    }

    fn output(&self) -> Shape {
        Shape::new(self.input.c, self.rows.outputs(), self.columns.outputs())
    }

    fn scratch_len(&self, _n: usize) -> usize {
        self.input.w
    }

    fn infer(&self, _params: &[f32], _statistics: &[f32], n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        let Shape { c, h, w } = self.input;
        let output = self.output();
        let sums = &mut scratch[..w];
        let maps = x.chunks_exact(h * w).zip(y.chunks_exact_mut(output.positions()));
        for (map, out) in maps.take(n * c) {
            for (i, out) in out.chunks_exact_mut(output.w).enumerate() {
                // Down first: that loop runs along whole rows.
                let (first, weights) = self.rows.of(i);
                sums.fill(0.0);
                for (row, weight) in map.chunks_exact(w).skip(first).zip(weights) {
                    sums.iter_mut().zip(row).for_each(|(sum, x)| *sum += weight * x);
                }
                for (j, out) in out.iter_mut().enumerate() {
                    let (first, weights) = self.columns.of(j);
                    *out = sums[first..].iter().zip(weights).map(|(sum, weight)| weight * sum).sum();
                }
            }
        }
    }

    fn forward(&self, params: &[f32], _pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.infer(params, &[], n, x, y, scratch);
    }

    fn backward(&self, _params: &[f32], _pass: &Pass, n: usize, pair: Pair, dx: Option<&mut [f32]>, grads: Grads) {
        let Some(dx) = dx else { return };
        let Shape { c, h, w } = self.input;
        let output = self.output();
        let sums = &mut grads.scratch[..w];
        dx.fill(0.0);
        let maps = dx.chunks_exact_mut(h * w).zip(pair.dy.chunks_exact(output.positions()));
        for (dx, dy) in maps.take(n * c) {
            for (i, dy) in dy.chunks_exact(output.w).enumerate() {
                sums.fill(0.0);
                for (j, dy) in dy.iter().enumerate() {
                    let (first, weights) = self.columns.of(j);
                    sums[first..].iter_mut().zip(weights).for_each(|(sum, weight)| *sum += weight * dy);
                }
                let (first, weights) = self.rows.of(i);
                for (row, weight) in dx.chunks_exact_mut(w).skip(first).zip(weights) {
                    row.iter_mut().zip(&*sums).for_each(|(dx, sum)| *dx += weight * sum);
                }
            }
        }
    }
}

/// Options of [`Resize`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ResizeSpec {
    /// Height and width of the output.
    pub to: [usize; 2],
    /// How.
    #[serde(default)]
    pub method: ResizeMethod,
}

impl LayerKind for ResizeSpec {
    fn base_name(&self) -> &'static str {
        "resize"
    }

    fn describe(&self) -> String {
        format!("resize to {}, {}", pair(self.to), self.method.name())
    }

    fn family(&self) -> Family {
        Family::Pooling
    }

    fn receptive_field(&self, _input: Shape) -> ReceptiveField {
        ReceptiveField::Resized { to: self.to, method: self.method }
    }

    fn check(&self, input: Shape) -> Result<(), String> {
        if input.c.saturating_mul(self.to[0]).saturating_mul(self.to[1]) > MAX_NUMBERS {
            return Err(format!("{} channels of {} are too many numbers", input.c, pair(self.to)));
        }
        check_sizes(&[("to", self.to[0]), ("to", self.to[1])])
    }

    fn layer(&self, input: Shape, _backend: Backend) -> Result<Box<dyn Layer>, String> {
        Ok(Box::new(Resize::new(input, self.to, self.method)?))
    }

    fn export_form(&self, input: Shape, _params: &[f32], _statistics: &[f32]) -> ExportForm {
        let axis = |from, to| Taps::new(from, to, self.method);
        ExportForm::Resize { rows: axis(input.h, self.to[0]), columns: axis(input.w, self.to[1]) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::layers::check_kind;
    use crate::engine::layers::gradcheck::check_layer;

    const METHODS: [ResizeMethod; 3] = [ResizeMethod::Bilinear, ResizeMethod::Nearest, ResizeMethod::Area];

    #[test]
    fn gradients_hold_for_any_size_and_method() {
        for method in METHODS {
            for (n, [c, h, w], to) in
                [(2, [2, 7, 8], [3, 5]), (1, [3, 4, 4], [2, 4]), (2, [1, 3, 2], [7, 5]), (1, [2, 5, 1], [1, 3])]
            {
                check_layer(&Resize::new(Shape::new(c, h, w), to, method).unwrap(), n);
            }
        }
    }

    #[test]
    fn it_answers_truly_for_any_size_and_method() {
        for method in METHODS {
            for to in [[3, 5], [7, 6], [10, 4], [1, 1]] {
                check_kind(&ResizeSpec { to, method }, Shape::new(2, 7, 6));
            }
        }
    }

    /// By the definition of each method, written out by hand.
    #[test]
    fn outputs_lie_where_tensorflow_puts_them() {
        let row = |x: &[f32], to: usize, method| {
            let layer = Resize::new(Shape::new(1, 1, x.len()), [1, to], method).unwrap();
            let mut y = vec![f32::NAN; to];
            layer.infer(&[], &[], 1, x, &mut y, &mut vec![f32::NAN; x.len()]);
            y
        };
        let x = [0.0, 10.0, 40.0, 100.0, 200.0];
        // Centres at 1/3, 2, 11/3 of five; covered are 0 to 5/3, 5/3 to 10/3, 10/3 to 5.
        let near = |found: Vec<f32>, expected: [f32; 3]| {
            assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-4), "{found:?}, not {expected:?}");
        };
        near(row(&x, 3, ResizeMethod::Bilinear), [10.0 / 3.0, 40.0, 100.0 + 200.0 / 3.0]);
        near(row(&x, 3, ResizeMethod::Nearest), [0.0, 40.0, 200.0]);
        near(
            row(&x, 3, ResizeMethod::Area),
            [4.0, (10.0 / 3.0 + 40.0 + 100.0 / 3.0) * 0.6, (200.0 / 3.0 + 200.0) * 0.6],
        );
        // Enlarged: centres at -1/6, 1/2, 7/6 of two.
        near(row(&[0.0, 60.0], 3, ResizeMethod::Bilinear), [0.0, 30.0, 60.0]);
    }

    #[test]
    fn weights_sum_to_one_for_every_size() {
        for method in METHODS {
            for (from, to) in (1..40).flat_map(|from| (1..40).map(move |to| (from, to))).chain([(160, 66), (320, 200)])
            {
                let taps = Taps::new(from, to, method);
                for i in 0..to {
                    let (_, weights) = taps.of(i);
                    let sum: f32 = weights.iter().sum();
                    assert!((sum - 1.0).abs() < 1e-4 && !weights.is_empty(), "{method:?} {from} to {to}: {weights:?}");
                    assert!(taps.seen(i).end <= from);
                }
            }
        }
    }
}
