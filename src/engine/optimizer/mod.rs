//! Optimizers, weight decay in its three meanings, gradient clipping, learning-rate schedules and averages of the weights.
//!
//! | name | what it does | also known as |
//! |---|---|---|
//! | `l2` | adds `l2 · p` to the gradient of each weight | L2 regularisation, PyTorch's `weight_decay` of `Adam` and `SGD` |
//! | `decoupled_weight_decay` | takes `lr · decoupled_weight_decay · p` off each weight, beside the step | AdamW (Loshchilov and Hutter 2017) |
//! | schedule `time_decay` | `lr / (1 + decay_per_update · updates)`; touches no weight | Keras 1's `decay` |
//!
//! The first two apply to the weights of convolutions and dense layers only, never to biases, slopes or batch norm.

mod averaging;
mod schedule;

use std::ops::Range;

pub use averaging::{AveragingSpec, WeightAverage};
use rayon::prelude::*;
pub use schedule::{Plateau, Schedule, ScheduleSpec};
use serde::{Deserialize, Serialize};
use steersman_kernels::Isa;
use steersman_kernels::update::{AdamStep, adam, scale, sgd_momentum};

use crate::engine::parameters::{CHUNK, Tensor};
use crate::engine::stopwatch::Stopwatch;

/// The algorithm that updates parameters along the gradient.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum OptimizerSpec {
    /// Adam with bias correction (Kingma and Ba 2014), in the form of Keras:
    /// `p −= lr · √(1 − beta2ᵗ) / (1 − beta1ᵗ) · m / (√v + epsilon)`; epsilon stands outside the root and is not corrected.
    Adam {
        /// Step size before the schedule.
        learning_rate: f64,
        /// Weight of the old value in the mean of the gradient.
        #[serde(default = "default_beta1")]
        beta1: f64,
        /// Weight of the old value in the mean of the squared gradient.
        #[serde(default = "default_beta2")]
        beta2: f64,
        /// Added to the root.
        #[serde(default = "default_epsilon")]
        epsilon: f64,
        /// Added to the gradient, times the weight.
        #[serde(default)]
        l2: f64,
        /// Taken off the weight, times weight and learning rate.
        #[serde(default)]
        decoupled_weight_decay: f64,
    },
    /// Gradient descent with momentum, in the form of Keras: `velocity = momentum · velocity − lr · gradient`,
    /// `p += velocity`.
    Sgd {
        /// Step size before the schedule.
        learning_rate: f64,
        /// Weight of the old velocity.
        #[serde(default)]
        momentum: f64,
        /// Added to the gradient, times the weight.
        #[serde(default)]
        l2: f64,
        /// Taken off the weight, times weight and learning rate.
        #[serde(default)]
        decoupled_weight_decay: f64,
    },
}

fn default_beta1() -> f64 {
    0.9
}

fn default_beta2() -> f64 {
    0.999
}

fn default_epsilon() -> f64 {
    1e-8
}

impl OptimizerSpec {
    /// Step size before the schedule.
    pub fn learning_rate(&self) -> f64 {
        match *self {
            OptimizerSpec::Adam { learning_rate, .. } | OptimizerSpec::Sgd { learning_rate, .. } => learning_rate,
        }
    }

    /// Checks the ranges of all numbers; the error names the first that is wrong.
    pub fn check(&self) -> Result<(), String> {
        let (positive, fractions, not_negative) = match *self {
            OptimizerSpec::Adam { learning_rate, beta1, beta2, epsilon, l2, decoupled_weight_decay } => (
                vec![("learning_rate", learning_rate), ("epsilon", epsilon)],
                vec![("beta1", beta1), ("beta2", beta2)],
                [("l2", l2), ("decoupled_weight_decay", decoupled_weight_decay)],
            ),
            OptimizerSpec::Sgd { learning_rate, momentum, l2, decoupled_weight_decay } => (
                vec![("learning_rate", learning_rate)],
                vec![("momentum", momentum)],
                [("l2", l2), ("decoupled_weight_decay", decoupled_weight_decay)],
            ),
        };
        for (name, value) in positive {
            if !(value.is_finite() && value > 0.0) {
                return Err(format!("{name} must be a positive number, not {value}"));
            }
        }
        for (name, value) in fractions {
            if !(0.0..1.0).contains(&value) {
                return Err(format!("{name} must lie in [0, 1), not be {value}"));
            }
        }
        for (name, value) in not_negative {
            if !(value.is_finite() && value >= 0.0) {
                return Err(format!("{name} must not be negative or infinite, but is {value}"));
            }
        }
        Ok(())
    }
}

/// The state of an optimizer: its number of updates, and its moving averages, each with one element for each parameter.
#[derive(Clone, Debug)]
pub struct Optimizer {
    spec: OptimizerSpec,
    /// L2 norm to which larger gradients are scaled down.
    clip_norm: Option<f64>,
    /// Updates done so far.
    pub updates: u64,
    /// Adam's mean of the gradient; SGD's velocity.
    pub first: Vec<f32>,
    /// Adam's mean of the squared gradient; empty for SGD.
    pub second: Vec<f32>,
    /// Ranges of a chunk that decay or do not, in order; frozen parameters belong to none.
    pieces: Vec<Piece>,
    /// The range of `pieces` of each chunk.
    pieces_of_chunk: Vec<Range<usize>>,
    isa: Isa,
    /// Sums the time of all updates.
    time: Stopwatch,
}

#[derive(Clone, Debug)]
struct Piece {
    /// Relative to the chunk.
    range: Range<usize>,
    decays: bool,
}

impl Optimizer {
    /// A fresh optimizer for those of a network's `tensors` that are trainable and not frozen, with the vector code of `isa`. A
    /// gradient whose L2 norm exceeds `clip_norm` is scaled down to that norm.
    pub fn new(spec: OptimizerSpec, clip_norm: Option<f64>, tensors: &[Tensor], isa: Isa) -> Optimizer {
        let count = tensors.iter().filter(|t| t.trainable).map(|t| t.range.len()).sum();
        let mut pieces = Vec::new();
        let mut pieces_of_chunk = Vec::new();
        for start in (0..count).step_by(CHUNK) {
            let end = (start + CHUNK).min(count);
            let first = pieces.len();
            for tensor in tensors.iter().filter(|t| t.trainable && !t.frozen) {
                let (from, to) = (tensor.range.start.max(start), tensor.range.end.min(end));
                if from < to {
                    pieces.push(Piece { range: from - start..to - start, decays: tensor.spec.decays });
                }
            }
            pieces_of_chunk.push(first..pieces.len());
        }
        let second = match spec {
            OptimizerSpec::Adam { .. } => vec![0.0; count],
            OptimizerSpec::Sgd { .. } => Vec::new(),
        };
        Optimizer {
            spec,
            clip_norm,
            updates: 0,
            first: vec![0.0; count],
            second,
            pieces,
            pieces_of_chunk,
            isa,
            time: Stopwatch::default(),
        }
    }

    /// Measures from now on: adds the time of updates to `time`.
    pub fn measure(&mut self, time: Stopwatch) {
        self.time = time;
    }

    /// Updates all `params` along `gradient`, whose L2 norm is `gradient_norm`, with learning rate `lr`. Clips the gradient in
    /// place.
    ///
    /// Counts one update for all tensors together. Allocates nothing inside a rayon pool.
    ///
    /// # Panics
    ///
    /// Panics if `params` and `gradient` have another length than the trainable tensors.
    pub fn step(&mut self, lr: f64, params: &mut [f32], gradient: &mut [f32], gradient_norm: f64) {
        assert_eq!(
            (params.len(), gradient.len()),
            (self.first.len(), self.first.len()),
            "parameters of another network"
        );
        self.updates += 1;
        let (isa, time) = (self.isa, &self.time);
        if let Some(limit) = self.clip_norm.filter(|limit| gradient_norm > *limit) {
            let factor = (limit / gradient_norm) as f32;
            gradient.par_chunks_mut(CHUNK).for_each(|chunk| time.time(|| scale(isa, chunk, factor)));
        }
        let (pieces, pieces_of_chunk) = (&self.pieces, &self.pieces_of_chunk);
        let pieces = |chunk: usize| &pieces[pieces_of_chunk[chunk].clone()];
        let chunks = params.par_chunks_mut(CHUNK).zip(gradient.par_chunks(CHUNK)).zip(self.first.par_chunks_mut(CHUNK));
        match self.spec {
            OptimizerSpec::Adam { beta1, beta2, epsilon, l2, decoupled_weight_decay, .. } => {
                let t = self.updates as f64;
                let decaying = AdamStep {
                    lr: lr as f32,
                    beta1: beta1 as f32,
                    beta2: beta2 as f32,
                    epsilon: epsilon as f32,
                    bias_correction1: (1.0 - beta1.powf(t)) as f32,
                    bias_correction2: (1.0 - beta2.powf(t)) as f32,
                    l2: l2 as f32,
                    decoupled_decay: decoupled_weight_decay as f32,
                };
                let plain = AdamStep { l2: 0.0, decoupled_decay: 0.0, ..decaying };
                chunks.zip(self.second.par_chunks_mut(CHUNK)).enumerate().for_each(|(chunk, (((p, g), m), v))| {
                    time.time(|| {
                        for Piece { range, decays } in pieces(chunk) {
                            let (p, g) = (&mut p[range.clone()], &g[range.clone()]);
                            let (m, v) = (&mut m[range.clone()], &mut v[range.clone()]);
                            adam(isa, if *decays { &decaying } else { &plain }, p, g, m, v);
                        }
                    })
                });
            }
            OptimizerSpec::Sgd { momentum, l2, decoupled_weight_decay, .. } => {
                chunks.enumerate().for_each(|(chunk, ((p, g), velocity))| {
                    time.time(|| {
                        for Piece { range, decays } in pieces(chunk) {
                            let (p, g) = (&mut p[range.clone()], &g[range.clone()]);
                            let velocity = &mut velocity[range.clone()];
                            let (l2, shrink) = if *decays { (l2, lr * decoupled_weight_decay) } else { (0.0, 0.0) };
                            if shrink > 0.0 {
                                scale(isa, p, (1.0 - shrink) as f32);
                            }
                            sgd_momentum(isa, lr as f32, momentum as f32, l2 as f32, p, g, velocity);
                        }
                    })
                });
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::layers::DenseSpec;
    use crate::engine::network::{LayerSpec, Network};
    use crate::engine::tensor::{Initializer, Shape};

    /// Two dense layers: 5 x 1000 weights and 1000 biases, then 1000 weights and 1 bias; more than one chunk.
    fn network() -> Network {
        let dense = |units| LayerSpec::Dense(DenseSpec { units, init: Initializer::GlorotUniform });
        Network::new(Shape::vector(5), &[dense(1000), dense(1)], Isa::best()).unwrap()
    }

    fn adam_spec(l2: f64, decoupled_weight_decay: f64) -> OptimizerSpec {
        let learning_rate = 0.1;
        OptimizerSpec::Adam { learning_rate, beta1: 0.9, beta2: 0.999, epsilon: 1e-8, l2, decoupled_weight_decay }
    }

    fn sgd_spec(momentum: f64, l2: f64, decoupled_weight_decay: f64) -> OptimizerSpec {
        OptimizerSpec::Sgd { learning_rate: 0.1, momentum, l2, decoupled_weight_decay }
    }

    /// All parameters after `steps` updates from 1 with a gradient of `g`; weights of both layers, then a bias.
    fn after(spec: OptimizerSpec, clip_norm: Option<f64>, g: f32, steps: usize) -> [f32; 3] {
        let network = network();
        let count = network.count(true);
        let mut optimizer = Optimizer::new(spec, clip_norm, network.tensors(), network.isa());
        let mut params = vec![1.0; count];
        for _ in 0..steps {
            let mut gradient = vec![g; count];
            let norm = f64::from(g.abs()) * (count as f64).sqrt();
            optimizer.step(0.1, &mut params, &mut gradient, norm);
        }
        let first = params[0];
        assert!(params[..5000].iter().all(|p| *p == first), "one tensor moves as one");
        [params[0], params[6500], params[5500]]
    }

    #[test]
    fn the_first_adam_step_has_the_size_of_the_learning_rate_for_every_tensor() {
        // Bias correction makes m / sqrt(v) the sign of the gradient. One update counted for each tensor would shrink the later ones.
        for value in after(adam_spec(0.0, 0.0), None, 0.01, 1) {
            approx::assert_relative_eq!(value, 0.9, max_relative = 1e-4);
        }
    }

    #[test]
    fn two_adam_steps_follow_the_formula() {
        let (beta1, beta2, mut m, mut v, mut p) = (0.9f64, 0.999f64, 0.0, 0.0, 1.0);
        for t in 1..=2 {
            let g = 0.01;
            m = beta1 * m + (1.0 - beta1) * g;
            v = beta2 * v + (1.0 - beta2) * g * g;
            p -= 0.1 * (1.0 - beta2.powi(t)).sqrt() / (1.0 - beta1.powi(t)) * m / (v.sqrt() + 1e-8);
        }
        approx::assert_relative_eq!(after(adam_spec(0.0, 0.0), None, 0.01, 2)[0], p as f32, max_relative = 1e-5);
    }

    #[test]
    fn l2_acts_through_the_gradient_and_spares_biases() {
        // With no gradient of its own a weight of 1 has the gradient l2, which Adam turns into a full step.
        let [first, second, bias] = after(adam_spec(1e-3, 0.0), None, 0.0, 1);
        approx::assert_relative_eq!(first, 0.9, max_relative = 1e-4);
        assert_eq!((first, bias), (second, 1.0));
        let [first, _, bias] = after(sgd_spec(0.0, 0.5, 0.0), None, 0.0, 1);
        approx::assert_relative_eq!(first, 1.0 - 0.1 * 0.5);
        assert_eq!(bias, 1.0);
    }

    #[test]
    fn decoupled_decay_shrinks_the_weight_beside_the_step_and_spares_biases() {
        for spec in [adam_spec(0.0, 0.5), sgd_spec(0.9, 0.0, 0.5)] {
            let [first, second, bias] = after(spec, None, 0.0, 2);
            approx::assert_relative_eq!(first, 0.95 * 0.95, max_relative = 1e-6);
            assert_eq!((first, bias), (second, 1.0));
        }
    }

    #[test]
    fn momentum_is_the_weight_of_the_old_velocity() {
        // Velocities −0.1 and −0.1 − 0.9 · 0.1.
        approx::assert_relative_eq!(
            after(sgd_spec(0.9, 0.0, 0.0), None, 1.0, 2)[0],
            1.0 - 0.1 - 0.19,
            max_relative = 1e-6
        );
    }

    #[test]
    fn a_long_gradient_is_clipped_to_the_norm_and_a_short_one_is_not() {
        let norm = (network().count(true) as f64).sqrt();
        approx::assert_relative_eq!(
            after(sgd_spec(0.0, 0.0, 0.0), Some(norm / 4.0), 1.0, 1)[0],
            0.975,
            max_relative = 1e-6
        );
        approx::assert_relative_eq!(
            after(sgd_spec(0.0, 0.0, 0.0), Some(norm * 4.0), 1.0, 1)[0],
            0.9,
            max_relative = 1e-6
        );
    }
}
