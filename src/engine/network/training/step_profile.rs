//! Where the time of training steps goes, stage by stage.

use crate::engine::network::Network;
use crate::engine::network::fused::FusedStage;
use crate::engine::stopwatch::Stopwatch;

/// The stopwatches of a plan; off until [`measure`](super::TrainingPlan::measure).
#[derive(Clone, Debug)]
pub(super) struct StepTimes {
    /// Forward and backward of each stage.
    pub stages: Vec<[Stopwatch; 2]>,
    /// The reduction of the shards' gradients.
    pub reduce: Stopwatch,
}

impl StepTimes {
    pub fn off(stages: usize) -> StepTimes {
        StepTimes { stages: vec![Default::default(); stages], reduce: Stopwatch::default() }
    }

    pub fn on(stages: usize, reduce: Stopwatch) -> StepTimes {
        StepTimes { stages: (0..stages).map(|_| [Stopwatch::on(), Stopwatch::on()]).collect(), reduce }
    }
}

/// CPU time of one stage (layers that run as one) in all steps so far, summed over threads.
#[derive(Clone, Debug, PartialEq)]
pub struct StageTime {
    /// The layers' names, joined by `+`.
    pub layers: String,
    /// Seconds of the forward pass, batch-norm sums included.
    pub forward_s: f64,
    /// Seconds of the backward pass.
    pub backward_s: f64,
    /// Multiply-adds of one image in the stage's convolutions and dense layers, forward.
    pub forward_multiply_adds: u64,
    /// The same, backward: as many again for each gradient that is computed (weights; input).
    pub backward_multiply_adds: u64,
}

impl StageTime {
    pub(super) fn of(
        network: &Network,
        stages: &[FusedStage],
        times: &StepTimes,
        first_learning: usize,
    ) -> Vec<StageTime> {
        let of_stage = |(index, (stage, [forward, backward])): (usize, (&FusedStage, &[Stopwatch; 2]))| {
            let layers = &network.layers()[stage.layers.clone()];
            let names: Vec<&str> = layers.iter().map(|layer| layer.name.as_str()).collect();
            let multiply_adds: u64 = layers.iter().map(|layer| layer.layer.multiply_adds()).sum();
            let of_input = stage.source.is_some_and(|source| source >= first_learning);
            let gradients = if index < first_learning { 0 } else { 1 + u64::from(of_input) };
            StageTime {
                layers: names.join("+"),
                forward_s: forward.seconds(),
                backward_s: backward.seconds(),
                forward_multiply_adds: multiply_adds,
                backward_multiply_adds: gradients * multiply_adds,
            }
        };
        stages.iter().zip(&times.stages).enumerate().map(of_stage).collect()
    }
}
