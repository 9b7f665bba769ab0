//! Finite-difference check of any layer's backward pass.
//!
//! The loss is `Σ dy · y` with a random `dy` (never ones: batch-norm would then have no gradient at all). Each input and each
//! parameter is moved by ±h with h = 10⁻³ and the loss, summed in f64, must change as the backward pass says; the two
//! gradients are compared per tensor in relative L2. With inputs of unit scale the rounding noise of f32 is about 3·10⁻⁴, so
//! the tolerance is 2·10⁻³; a forgotten term is off by far more. Inputs lie on a shuffled lattice whose points are more than
//! 2h apart and away from 0, so no step crosses the kink of a rectifier or changes the maximum of a window.

use rand::Rng;

use super::{Grads, Layer, Pair, Pass};
use crate::engine::random::{Purpose, rng, shuffle, uniform};

const STEP: f32 = 1e-3;
const TOLERANCE: f64 = 2e-3;

/// A layer with buffers of its own, run on one batch in one piece. For tests and for learning; networks plan their buffers
/// instead.
#[derive(Debug)]
pub struct Harness<'a> {
    layer: &'a dyn Layer,
    n: usize,
    /// Input, `n` images.
    pub x: Vec<f32>,
    /// Output, `n` images.
    pub y: Vec<f32>,
    /// Gradient of the loss with respect to the output.
    pub dy: Vec<f32>,
    /// Gradient of the loss with respect to the input.
    pub dx: Vec<f32>,
    /// Trainable parameters.
    pub params: Vec<f32>,
    /// Gradient of the loss with respect to the parameters.
    pub dparams: Vec<f32>,
    /// Running statistics.
    pub statistics: Vec<f32>,
    moments: Vec<f32>,
    sums: Vec<f64>,
    scratch: Vec<f32>,
}

impl<'a> Harness<'a> {
    /// Buffers for `n` images, with an input and a `dy` of unit scale and parameters a little off their first values.
    pub fn new(layer: &'a dyn Layer, n: usize) -> Harness<'a> {
        let mut random = rng(7, Purpose::Test, 0, 0);
        let (x_len, y_len) = (n * layer.input().len(), n * layer.output().len());
        let mut params = Vec::new();
        for spec in layer.params() {
            let start = params.len();
            params.resize(start + spec.len(), 0.0);
            spec.init.fill(spec.fans, &mut random, &mut params[start..]);
        }
        params.iter_mut().for_each(|p| *p += uniform(&mut random, -0.3, 0.3) as f32);
        let mut statistics = Vec::new();
        for spec in layer.statistics() {
            let start = statistics.len();
            statistics.resize(start + spec.len(), 0.0);
            spec.init.fill(spec.fans, &mut random, &mut statistics[start..]);
        }
        let (sums_len, moments_len) =
            layer.batch_statistics().map_or((0, 0), |barrier| (barrier.sums_len(), barrier.moments_len()));
        Harness {
            layer,
            n,
            x: lattice(x_len, &mut random),
            y: vec![f32::NAN; y_len],
            dy: (0..y_len).map(|_| uniform(&mut random, -1.0, 1.0) as f32).collect(),
            dx: vec![f32::NAN; x_len],
            dparams: vec![0.0; params.len()],
            params,
            statistics,
            moments: vec![0.0; moments_len],
            sums: vec![0.0; sums_len],
            scratch: vec![f32::NAN; layer.scratch_len(n)],
        }
    }

    /// Training pass forward: fills `y` and moves the running statistics.
    pub fn forward(&mut self) {
        if let Some(barrier) = self.layer.batch_statistics() {
            barrier.forward_sums(self.n, &self.x, &mut self.sums);
            barrier.finish_forward(&self.params, self.n, &self.sums, &mut self.moments, &mut self.statistics);
        }
        let pass = Pass { seed: 1, step: 2, layer: 3, first_image: 0, moments: &self.moments, packed: &[] };
        self.layer.forward(&self.params, &pass, self.n, &self.x, &mut self.y, &mut self.scratch);
    }

    /// Training pass backward, after [`forward`](Harness::forward): fills `dx`, adds to `dparams`.
    pub fn backward(&mut self) {
        if let Some(barrier) = self.layer.batch_statistics() {
            barrier.backward_sums(&self.moments, self.n, &self.x, &self.dy, &mut self.sums, &mut self.dparams);
            barrier.finish_backward(&self.params, self.n, &self.sums, &mut self.moments);
        }
        let pass = Pass { seed: 1, step: 2, layer: 3, first_image: 0, moments: &self.moments, packed: &[] };
        let pair = Pair { x: &self.x, y: &self.y, dy: &self.dy };
        let grads = Grads { dparams: &mut self.dparams, scratch: &mut self.scratch };
        self.layer.backward(&self.params, &pass, self.n, pair, Some(&mut self.dx), grads);
    }

    fn loss(&mut self) -> f64 {
        self.forward();
        self.y.iter().zip(&self.dy).map(|(y, dy)| f64::from(*y) * f64::from(*dy)).sum()
    }

    /// Central difference of the loss for each element of what `select` picks.
    fn numerical(&mut self, select: for<'b> fn(&'b mut Harness<'a>) -> &'b mut Vec<f32>) -> Vec<f64> {
        (0..select(self).len())
            .map(|i| {
                let value = select(self)[i];
                let (up, down) = (value + STEP, value - STEP);
                select(self)[i] = up;
                let loss_up = self.loss();
                select(self)[i] = down;
                let loss_down = self.loss();
                select(self)[i] = value;
                (loss_up - loss_down) / f64::from(up - down)
            })
            .collect()
    }
}

/// Checks input and parameter gradients of `layer` on a batch of `n` images.
///
/// # Panics
///
/// Panics, naming the tensor, if a gradient is wrong.
pub fn check_layer(layer: &dyn Layer, n: usize) {
    let mut harness = Harness::new(layer, n);
    harness.forward();
    harness.backward();
    let (dx, dparams) = (harness.dx.clone(), harness.dparams.clone());

    let numerical = harness.numerical(|h| &mut h.x);
    assert_close(layer, n, "input", &dx, &numerical);

    let numerical = harness.numerical(|h| &mut h.params);
    let mut start = 0;
    for spec in layer.params() {
        let range = start..start + spec.len();
        assert_close(layer, n, spec.name, &dparams[range.clone()], &numerical[range.clone()]);
        start = range.end;
    }
}

/// Relative L2 distance of a gradient from its finite differences.
pub fn relative_error(analytic: &[f32], numerical: &[f64]) -> f64 {
    assert_eq!(analytic.len(), numerical.len());
    let square = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>();
    let distance = square(&mut analytic.iter().zip(numerical).map(|(a, b)| f64::from(*a) - b));
    let size = square(&mut analytic.iter().map(|a| f64::from(*a))).max(square(&mut numerical.iter().copied()));
    // Where the true gradient vanishes (a batch of one number, normalised) only noise is left to compare.
    (distance / size.max(1e-6 * analytic.len() as f64)).sqrt()
}

fn assert_close(layer: &dyn Layer, n: usize, tensor: &str, analytic: &[f32], numerical: &[f64]) {
    let error = relative_error(analytic, numerical);
    assert!(error <= TOLERANCE, "gradient of {tensor} is off by {error:.1e} (n = {n}) in {layer:?}");
}

/// Numbers in (−1, 1), each at least 2.5 steps from every other and from 0, in random order. Long tensors reach beyond 1.
fn lattice(len: usize, random: &mut impl Rng) -> Vec<f32> {
    let spacing = (2.0 / len.max(1) as f32).max(2.5 * STEP);
    let mut values: Vec<f32> = (0..len).map(|i| (i as f32 + 0.5 - (len / 2) as f32) * spacing).collect();
    shuffle(random, &mut values);
    values
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn relative_error_of_a_spoilt_gradient_is_large_and_of_nan_fails_the_comparison() {
        let numerical = [1.0, -2.0, 0.5];
        assert!(relative_error(&[1.0, -2.0, 0.5], &numerical) < 1e-7);
        assert!(relative_error(&[1.0, 2.0, 0.5], &numerical) > 1.0);
        let error = relative_error(&[f32::NAN, -2.0, 0.5], &numerical);
        assert_eq!(error.partial_cmp(&TOLERANCE), None, "so `error <= TOLERANCE` is false, as it must be");
    }

    #[test]
    fn lattice_keeps_its_distances() {
        let mut values = lattice(1001, &mut rng(1, Purpose::Test, 0, 0));
        values.push(0.0);
        values.sort_by(f32::total_cmp);
        assert!(values.windows(2).all(|pair| pair[1] - pair[0] > 1.2 * STEP));
    }
}
