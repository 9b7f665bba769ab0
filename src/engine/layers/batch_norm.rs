//! Batch normalisation.

use serde::{Deserialize, Serialize};
use steersman_kernels::norm;
use steersman_kernels::{Backend, Isa};

use super::{BatchStatistics, ExportForm, Family, Grads, Layer, LayerKind, Pair, ParamSpec, Pass, ReceptiveField};
use crate::engine::tensor::Shape;

/// Batch normalisation of each channel (Ioffe and Szegedy 2015).
///
/// - **Forward** `y = gamma · x̂ + beta` with `x̂ = (x − mean) / √(variance + epsilon)`; mean and population variance are those of
///   the channel over all images and positions of the batch.
/// - **Backward** of `y = gamma · x̂ + beta`, where mean and variance depend on x too:
///   `dx = gamma / √(variance + epsilon) · (dy − mean(dy) − x̂ · mean(dy · x̂))`, `dgamma = Σ dy · x̂`, `dbeta = Σ dy`. Needs x.
/// - **Training** moves the running statistics: `running = running_old_weight · running + (1 − running_old_weight) · batch`.
///   The running variance keeps the population variance (divided by N, as in Keras 1, not by N − 1). **Evaluation** takes the
///   running statistics as mean and variance. A frozen layer does so in training too; they do not depend on x, so
///   `dx = gamma / √(variance + epsilon) · dy`.
/// - **Limits** The whole batch must be seen before any output exists: [`BatchStatistics`] is that barrier. After a dense layer
///   each unit is a channel.
///
/// # Shapes
///
/// x, y, dx, dy: `[n][c][h][w]`. Parameters: `gamma`, `beta` `[c]`; statistics: `running_mean`, `running_variance` `[c]`.
#[derive(Clone, Debug)]
pub struct BatchNorm {
    shape: Shape,
    epsilon: f32,
    running_old_weight: f32,
    isa: Isa,
}

impl BatchNorm {
    /// Normalises maps of `shape`. `running_old_weight` in [0, 1) is the weight of the old value when the running
    /// statistics are updated (Keras' `momentum`; PyTorch's is one minus this).
    pub fn new(shape: Shape, epsilon: f32, running_old_weight: f32, isa: Isa) -> Result<BatchNorm, String> {
        if !(epsilon.is_finite() && epsilon > 0.0) {
            return Err(format!("epsilon must be a positive number, not {epsilon}"));
        }
        if !(0.0..1.0).contains(&running_old_weight) {
            return Err(format!("running_old_weight must lie in [0, 1), not be {running_old_weight}"));
        }
        Ok(BatchNorm { shape, epsilon, running_old_weight, isa })
    }

    /// The parts of what the barrier has found out.
    pub(crate) fn split<'a>(&self, moments: &'a [f32]) -> Moments<'a> {
        let mut parts = moments.chunks_exact(self.shape.c);
        let mut next = || parts.next().expect("moments have 7 values a channel");
        Moments {
            mean: next(),
            inv_std: next(),
            scale: next(),
            shift: next(),
            mean_dy: next(),
            mean_dy_xhat: next(),
            gain: next(),
        }
    }
}

impl BatchNorm {
    /// Evaluation's `y = x · scale + shift`, from the running statistics; `scratch` has at least 2 c numbers.
    pub(crate) fn scale_and_shift<'a>(
        &self,
        params: &[f32],
        statistics: &[f32],
        scratch: &'a mut [f32],
    ) -> (&'a [f32], &'a [f32]) {
        let c = self.shape.c;
        let (gamma, beta) = params.split_at(c);
        let (mean, variance) = statistics.split_at(c);
        let (scale, shift) = scratch[..2 * c].split_at_mut(c);
        for i in 0..c {
            scale[i] = gamma[i] / (variance[i] + self.epsilon).sqrt();
            shift[i] = beta[i] - mean[i] * scale[i];
        }
        (scale, shift)
    }

    /// Adds the gradients of gamma and beta that follow from the sums of the backward pass.
    pub(crate) fn add_gradients(&self, sums: &[f64], dparams: &mut [f32]) {
        let c = self.shape.c;
        let (dgamma, dbeta) = dparams.split_at_mut(c);
        for i in 0..c {
            dgamma[i] += sums[c + i] as f32;
            dbeta[i] += sums[i] as f32;
        }
    }
}

/// What the whole batch says of each channel; every slice has `[c]` numbers.
#[derive(Clone, Copy)]
pub(crate) struct Moments<'a> {
    pub mean: &'a [f32],
    pub inv_std: &'a [f32],
    /// `y = x · scale + shift`.
    pub scale: &'a [f32],
    pub shift: &'a [f32],
    pub mean_dy: &'a [f32],
    pub mean_dy_xhat: &'a [f32],
    /// `gamma · inv_std`.
    pub gain: &'a [f32],
}

const MOMENTS: usize = 7;

impl Layer for BatchNorm {
    fn input(&self) -> Shape {
        self.shape
    }

    fn output(&self) -> Shape {
        self.shape
    }

    fn params(&self) -> Vec<ParamSpec> {
        let c = self.shape.c;
        vec![ParamSpec::constant("gamma", vec![c], 1.0), ParamSpec::constant("beta", vec![c], 0.0)]
    }

    fn statistics(&self) -> Vec<ParamSpec> {
        let c = self.shape.c;
        vec![ParamSpec::constant("running_mean", vec![c], 0.0), ParamSpec::constant("running_variance", vec![c], 1.0)]
    }

    fn scratch_len(&self, _n: usize) -> usize {
        2 * self.shape.c
    }

    fn infer(&self, params: &[f32], statistics: &[f32], n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        let (scale, shift) = self.scale_and_shift(params, statistics, scratch);
        norm::normalize(self.isa, n, self.shape.c, self.shape.positions(), x, scale, shift, y);
    }

    fn forward(&self, _params: &[f32], pass: &Pass, n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        let Moments { scale, shift, .. } = self.split(pass.moments);
        norm::normalize(self.isa, n, self.shape.c, self.shape.positions(), x, scale, shift, y);
    }

    fn backward(&self, _params: &[f32], pass: &Pass, n: usize, pair: Pair, dx: Option<&mut [f32]>, _grads: Grads) {
        let Some(dx) = dx else { return };
        let Pair { x, dy, .. } = pair;
        let Moments { mean, inv_std, mean_dy, mean_dy_xhat, gain, .. } = self.split(pass.moments);
        let (c, positions) = (self.shape.c, self.shape.positions());
        norm::norm_backward(self.isa, n, c, positions, x, dy, mean, inv_std, mean_dy, mean_dy_xhat, gain, dx);
    }

    fn batch_statistics(&self) -> Option<&dyn BatchStatistics> {
        Some(self)
    }
}

impl BatchStatistics for BatchNorm {
    fn sums_len(&self) -> usize {
        2 * self.shape.c
    }

    fn moments_len(&self) -> usize {
        MOMENTS * self.shape.c
    }

    fn forward_sums(&self, n: usize, x: &[f32], sums: &mut [f64]) {
        sums.fill(0.0);
        norm::channel_sums(self.isa, n, self.shape.c, self.shape.positions(), x, sums);
    }

    fn finish_forward(&self, params: &[f32], images: usize, sums: &[f64], moments: &mut [f32], statistics: &mut [f32]) {
        let c = self.shape.c;
        let count = (images * self.shape.positions()) as f64;
        let (gamma, beta) = params.split_at(c);
        let (running_mean, running_variance) = statistics.split_at_mut(c);
        for i in 0..c {
            let mean = sums[i] / count;
            let variance = (sums[c + i] / count - mean * mean).max(0.0);
            let inv_std = 1.0 / (variance + f64::from(self.epsilon)).sqrt();
            let scale = f64::from(gamma[i]) * inv_std;
            moments[i] = mean as f32;
            moments[c + i] = inv_std as f32;
            moments[2 * c + i] = scale as f32;
            moments[3 * c + i] = (f64::from(beta[i]) - mean * scale) as f32;
            let old = self.running_old_weight;
            running_mean[i] = old * running_mean[i] + (1.0 - old) * mean as f32;
            running_variance[i] = old * running_variance[i] + (1.0 - old) * variance as f32;
        }
    }

    fn frozen_moments(&self, params: &[f32], statistics: &[f32], moments: &mut [f32]) {
        let c = self.shape.c;
        let (gamma, beta) = params.split_at(c);
        let (mean, variance) = statistics.split_at(c);
        // The means of the gradients stay 0: mean and variance do not depend on x.
        moments.fill(0.0);
        for i in 0..c {
            let inv_std = 1.0 / (variance[i] + self.epsilon).sqrt();
            let scale = gamma[i] * inv_std;
            moments[i] = mean[i];
            moments[c + i] = inv_std;
            moments[2 * c + i] = scale;
            moments[3 * c + i] = beta[i] - mean[i] * scale;
            moments[6 * c + i] = scale;
        }
    }

    fn backward_sums(&self, moments: &[f32], n: usize, x: &[f32], dy: &[f32], sums: &mut [f64], dparams: &mut [f32]) {
        let c = self.shape.c;
        let Moments { mean, inv_std, .. } = self.split(moments);
        sums.fill(0.0);
        norm::norm_backward_sums(self.isa, n, c, self.shape.positions(), x, dy, mean, inv_std, sums);
        self.add_gradients(sums, dparams);
    }

    fn finish_backward(&self, params: &[f32], images: usize, sums: &[f64], moments: &mut [f32]) {
        let c = self.shape.c;
        let count = (images * self.shape.positions()) as f64;
        for i in 0..c {
            moments[4 * c + i] = (sums[i] / count) as f32;
            moments[5 * c + i] = (sums[c + i] / count) as f32;
            moments[6 * c + i] = params[i] * moments[c + i];
        }
    }
}

/// Options of [`BatchNorm`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BatchNormSpec {
    /// Added to the variance.
    #[serde(default = "default_epsilon")]
    pub epsilon: f32,
    /// Weight of the old value when the running statistics are updated (Keras' `momentum`).
    #[serde(default = "default_running_old_weight")]
    pub running_old_weight: f32,
}

fn default_epsilon() -> f32 {
    1e-3
}

fn default_running_old_weight() -> f32 {
    0.99
}

impl LayerKind for BatchNormSpec {
    fn base_name(&self) -> &'static str {
        "bn"
    }

    fn describe(&self) -> String {
        "batch norm".into()
    }

    fn family(&self) -> Family {
        Family::Normalization
    }

    fn receptive_field(&self, _input: Shape) -> ReceptiveField {
        ReceptiveField::Element
    }

    fn check(&self, _input: Shape) -> Result<(), String> {
        Ok(())
    }

    fn layer(&self, input: Shape, backend: Backend) -> Result<Box<dyn Layer>, String> {
        Ok(Box::new(BatchNorm::new(input, self.epsilon, self.running_old_weight, backend.isa)?))
    }

    fn export_form(&self, _input: Shape, params: &[f32], statistics: &[f32]) -> ExportForm {
        let halves = |values: &[f32]| {
            let (a, b) = values.split_at(values.len() / 2);
            (a.to_vec(), b.to_vec())
        };
        let ((gamma, beta), (mean, variance)) = (halves(params), halves(statistics));
        ExportForm::BatchNorm { gamma, beta, mean, variance, epsilon: self.epsilon }
    }
}

#[cfg(test)]
mod tests {
    use super::super::gradcheck::{Harness, check_layer};
    use super::*;

    fn layer(shape: Shape, isa: Isa) -> BatchNorm {
        BatchNorm::new(shape, 1e-3, 0.99, isa).unwrap()
    }

    #[test]
    fn gradients_hold_after_convolutions_and_after_dense_layers() {
        for isa in Isa::available() {
            for (n, shape) in [(1, Shape::new(2, 3, 5)), (4, Shape::new(3, 5, 7)), (8, Shape::vector(5))] {
                check_layer(&layer(shape, isa), n);
            }
        }
    }

    #[test]
    fn training_output_has_mean_beta_and_deviation_gamma() {
        let layer = layer(Shape::new(2, 6, 6), Isa::best());
        let mut harness = Harness::new(&layer, 5);
        harness.params.copy_from_slice(&[2.0, 0.5, 0.25, -1.0]);
        for x in harness.x.iter_mut() {
            *x = *x * 7.0 + 100.0; // far from zero: a careless variance loses its digits here
        }
        harness.forward();
        for channel in 0..2 {
            let values: Vec<f64> = (0..5)
                .flat_map(|image| harness.y[(image * 2 + channel) * 36..][..36].iter().map(|v| f64::from(*v)))
                .collect();
            let mean = values.iter().sum::<f64>() / 180.0;
            let deviation = (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 180.0).sqrt();
            assert!((mean - f64::from(harness.params[2 + channel])).abs() < 1e-3, "{mean}");
            assert!((deviation - f64::from(harness.params[channel])).abs() < 2e-3, "{deviation}");
        }
    }

    #[test]
    fn running_statistics_keep_99_percent_of_the_old_and_take_the_population_variance() {
        let layer = layer(Shape::vector(1), Isa::best());
        let mut harness = Harness::new(&layer, 2);
        harness.x.copy_from_slice(&[1.0, 3.0]); // mean 2, population variance 1 (the sample variance is 2)
        harness.forward();
        approx::assert_relative_eq!(harness.statistics[..], [0.02, 0.99 + 0.01], max_relative = 1e-5);
    }

    #[test]
    fn evaluation_uses_the_running_statistics() {
        let layer = layer(Shape::vector(1), Isa::best());
        let (mut y, mut scratch) = ([f32::NAN; 1], [f32::NAN; 2]);
        layer.infer(&[3.0, 0.5], &[2.0, 4.0], 1, &[6.0], &mut y, &mut scratch);
        approx::assert_relative_eq!(y[0], 3.0 * 4.0 / 4.001f32.sqrt() + 0.5, max_relative = 1e-6);
    }
}
