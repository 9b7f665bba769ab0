//! A training step: forward, loss, backward, over fixed shards of the batch.
//!
//! The batch is cut into shards whose borders depend on the batch size alone. Each shard is worked on by one thread; scratch, the
//! gradient, and without a barrier the activations too, are borrowed from a pool. Losses, gradients and batch-norm sums are added along
//! a fixed binary tree over the shards: two neighbours as soon as both are there, so that few gradients are held at a time. The result
//! has the same bits for any number of threads, and of processes: see [`Ranks`].
//!
//! Between two batch-norm barriers a shard takes a group of a few images through all layers, so that the output of one layer is
//! still in the cache when the next layer reads it. A network without batch norm has no barrier: each group goes forward *and*
//! backward, and the buffers hold one group only.

mod passes;
mod planning;
mod ranks;
mod reduction;
mod shard;
mod shard_tree;
mod step_input;
mod step_profile;
mod traversal;

use std::ops::Range;
use std::sync::Arc;

use ndarray::Axis;
use rayon::prelude::*;
use steersman_kernels::{Isa, update};

pub use ranks::Ranks;
pub use shard_tree::share;
pub use step_input::StepInput;
pub use step_profile::StageTime;

use super::{Network, Parameters};
use crate::engine::loss::{Loss, PairTerms};
use crate::engine::parameters::CHUNK;
use crate::engine::stopwatch::Stopwatch;
use passes::StagePlan;
use reduction::Reduction;
use shard::{Buffers, Shard, Spare};
use shard_tree::Sharding;
use step_input::StepSlices;
use step_profile::StepTimes;

/// The buffers of a training step, planned once for a network and a largest batch.
#[derive(Debug)]
pub struct TrainingPlan {
    shards: Vec<Shard>,
    /// The buffers that no shard is using, in networks without a barrier.
    spare_buffers: Spare<Buffers>,
    /// The scratch that no shard is using.
    spare_scratch: Spare<Vec<f32>>,
    /// The gradients that no shard is using.
    spare_gradients: Spare<Vec<f32>>,
    /// Gradient of the mean loss with respect to [`Parameters::values`].
    gradient: Vec<f32>,
    /// Sum of squares of each chunk of the gradient.
    chunk_squares: Vec<f64>,
    plan: StagePlan,
    /// Means and variances of the batch from the barriers, all stages one after the other.
    moments: Vec<f32>,
    sums: Vec<f64>,
    /// Runs of stages without a barrier inside; each but the first begins with the stage that needs the barrier.
    segments: Vec<Range<usize>>,
    /// Size of a group in each segment.
    segment_groups: Vec<usize>,
    /// The parameters of each segment.
    learning: Vec<Range<usize>>,
    reduction: Reduction,
    capacity: usize,
    /// Outputs of the network.
    outputs: usize,
    isa: Isa,
    /// [`Network::fingerprint`] of the network it was planned for.
    fingerprint: u64,
}

impl TrainingPlan {
    /// This plan, where the loss is the mean over the images of the losses of all outputs, that of output `k` times `weights[k]`.
    /// Without weights each counts 1 / outputs.
    ///
    /// # Panics
    ///
    /// Panics if there is not one weight for each output.
    pub fn with_output_weights(mut self, weights: &[f32]) -> TrainingPlan {
        assert_eq!(weights.len(), self.outputs, "a weight for each output of the network");
        self.plan.output_weights = weights.to_vec();
        self
    }

    /// This plan, for the share of one of several processes that train together.
    pub fn with_ranks(mut self, ranks: Arc<dyn Ranks>) -> TrainingPlan {
        self.set_ranks(ranks);
        self
    }

    pub(crate) fn set_ranks(&mut self, ranks: Arc<dyn Ranks>) {
        self.reduction = Reduction::new(Some(ranks));
    }

    /// Gradient of the mean loss of the last step with respect to [`Parameters::values`].
    pub fn gradient(&self) -> &[f32] {
        &self.gradient
    }

    /// The gradient, to be clipped in place.
    pub fn gradient_mut(&mut self) -> &mut [f32] {
        &mut self.gradient
    }

    /// L2 norm of the gradient, as it was after the last step.
    pub fn gradient_norm(&self) -> f64 {
        self.chunk_squares.iter().sum::<f64>().sqrt()
    }

    /// Measures the time of each stage from now on; `reduce` gets the time of the reduction of the shards' gradients.
    pub fn measure(&mut self, reduce: Stopwatch) {
        self.plan.times = StepTimes::on(self.plan.stages.len(), reduce);
    }

    /// The times since [`measure`](TrainingPlan::measure), in the order of the layers.
    pub fn stage_times(&self, network: &Network) -> Vec<StageTime> {
        StageTime::of(network, &self.plan.stages, &self.plan.times, self.plan.first_learning)
    }

    /// Computes the mean loss of the batch and writes its gradient to [`gradient`](TrainingPlan::gradient). Of the
    /// parameters only the running statistics change. Allocates nothing when called inside a rayon pool.
    ///
    /// # Panics
    ///
    /// Panics if `network` differs from the one the plan was made for (in input shape, layers, options, frozen layers or vector
    /// code), if `parameters` are not those of such a network, or if the batch is empty, larger than planned, of the wrong shape
    /// or not in standard order.
    pub fn step(&mut self, network: &Network, parameters: &mut Parameters, loss: &Loss, input: StepInput) -> f64 {
        self.step_with_pairs(network, parameters, loss, &PairTerms::default(), input)
    }

    /// As [`step`](TrainingPlan::step), with the terms of the pairs in the batch added to the mean loss.
    ///
    /// # Panics
    ///
    /// As [`step`](TrainingPlan::step).
    pub fn step_with_pairs(
        &mut self,
        network: &Network,
        parameters: &mut Parameters,
        loss: &Loss,
        pairs: &PairTerms,
        input: StepInput,
    ) -> f64 {
        let of = input.x.len_of(Axis(0));
        self.step_of_share(network, parameters, loss, pairs, input, of)
    }

    /// As [`step_with_pairs`](TrainingPlan::step_with_pairs), on all ranks at once: `input` has the images of this process's
    /// [`share`](super::share) of a batch of `of` images. The result, in all ranks, is that of the whole batch.
    ///
    /// # Panics
    ///
    /// As [`step`](TrainingPlan::step), also if the images are not as many as the share has.
    pub fn step_of_share(
        &mut self,
        network: &Network,
        parameters: &mut Parameters,
        loss: &Loss,
        pairs: &PairTerms,
        input: StepInput,
        of: usize,
    ) -> f64 {
        let (input, used) = self.begin_step(network, parameters, pairs, input, of);
        if self.segments.len() == 1 {
            self.lend_gradient(used);
            self.step_without_barriers(network, parameters, loss, input, used);
        } else {
            self.forward_with_barriers(network, parameters, Some(loss), input, used);
            self.lend_gradient(used);
            self.backward_with_barriers(network, parameters, input, used);
        }
        self.reduce_gradient(network, used);
        let mut total = [0.0];
        self.reduction.sum(&self.shards[..used], |shard| std::slice::from_ref(&shard.loss), &mut total);
        let StepSlices { of, .. } = input;
        let count = if self.plan.output_weights.is_empty() { of * self.outputs } else { of };
        total[0] / count as f64
    }

    /// Lets the running statistics go on over one batch as [`step`](TrainingPlan::step) does, and changes nothing else: the forward
    /// pass alone, as far as the last batch normalisation. Without any it does nothing. `pairs`, `input` and `of` are as in
    /// [`step_of_share`](TrainingPlan::step_of_share).
    ///
    /// # Panics
    ///
    /// As [`step_of_share`](TrainingPlan::step_of_share).
    pub fn pass_statistics(
        &mut self,
        network: &Network,
        parameters: &mut Parameters,
        pairs: &PairTerms,
        input: StepInput,
        of: usize,
    ) {
        if self.segments.len() > 1 {
            let (input, used) = self.begin_step(network, parameters, pairs, input, of);
            self.forward_with_barriers(network, parameters, None, input, used);
        }
    }

    /// Cuts the batch into shards and packs the weights; returns the images of this process and the number of their shards.
    fn begin_step<'a>(
        &mut self,
        network: &Network,
        parameters: &Parameters,
        pairs: &PairTerms,
        input: StepInput<'a>,
        of: usize,
    ) -> (StepSlices<'a>, usize) {
        assert_eq!(self.fingerprint, network.fingerprint(), "a training plan for another network");
        network.check_parameters(parameters);
        assert!(of > 0 && of <= self.capacity, "a batch of {of} images in a plan for 1 to {}", self.capacity);
        assert!(pairs.images() <= of, "{} images in pairs in a batch of {of}", pairs.images());
        self.reduction.begin(Sharding::new(of, pairs.images() > 0));
        let own = self.reduction.own_images();
        let input = StepSlices { pairs: *pairs, first: own.start, of, ..input.slices(network) };
        let n = input.x.len() / network.input().len();
        assert_eq!(n, own.len(), "the share of a batch of {of} images");
        let used = self.reduction.own().len();
        for (index, shard) in self.shards[..used].iter_mut().enumerate() {
            shard.images = self.reduction.images_of(index);
        }
        self.freeze_moments(network, parameters);
        self.pack(network, parameters);
        (input, used)
    }

    /// The first shard adds to the gradient of the plan itself.
    fn lend_gradient(&mut self, used: usize) {
        if used > 0 {
            self.shards[0].gradient = std::mem::take(&mut self.gradient);
        }
    }

    /// Packs the weights once for all shards.
    fn pack(&mut self, network: &Network, parameters: &Parameters) {
        self.plan.packed.par_iter_mut().zip(&self.plan.stages).for_each(|(to, stage)| {
            if let Some(packing) = stage.packing(network) {
                packing.pack_for_training(&parameters.values[stage.params(network)], to);
            }
        });
    }

    /// The moments of frozen batch normalisation.
    fn freeze_moments(&mut self, network: &Network, parameters: &Parameters) {
        for (stage, moments_of) in self.plan.stages.iter().zip(&self.plan.moments_of) {
            let layer = &network.layers()[stage.layers.start];
            if let Some(statistics) = stage.batch_statistics(network).filter(|_| layer.frozen) {
                let params = &parameters.values[layer.params.clone()];
                let running = &parameters.statistics[layer.statistics.clone()];
                statistics.frozen_moments(params, running, &mut self.moments[moments_of.clone()]);
            }
        }
    }

    /// Takes the gradient back, adds those of the other processes, and takes its sums of squares. The gradients of frozen layers become
    /// 0.
    fn reduce_gradient(&mut self, network: &Network, used: usize) {
        let TrainingPlan { shards, spare_gradients, gradient, chunk_squares, isa, plan, reduction, .. } = self;
        let shards = &mut shards[..used];
        if used > 0 {
            *gradient = std::mem::take(&mut shards[0].gradient);
        }
        reduction.sum_gradients(*isa, shards, gradient);
        for shard in shards.iter_mut().filter(|shard| !shard.gradient.is_empty()) {
            spare_gradients.put(std::mem::take(&mut shard.gradient));
        }
        gradient.par_chunks_mut(CHUNK).zip(chunk_squares.par_iter_mut()).enumerate().for_each(
            |(index, (chunk, squares))| {
                plan.times.reduce.time(|| {
                    let range = index * CHUNK..index * CHUNK + chunk.len();
                    for layer in network.layers().iter().filter(|layer| layer.frozen) {
                        let (from, to) = (layer.params.start.max(range.start), layer.params.end.min(range.end));
                        if from < to {
                            chunk[from - range.start..to - range.start].fill(0.0);
                        }
                    }
                    *squares = update::sum_of_squares(*isa, chunk);
                })
            },
        );
    }
}

#[cfg(test)]
pub(super) use planning::{GROUP_LIMITS, GroupLimits};
