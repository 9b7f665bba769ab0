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

use std::ops::Range;
use std::sync::Arc;

use ndarray::Axis;
use rayon::prelude::*;
use steersman_kernels::{Isa, update};

use super::fused::{FusedStage, replaces_input, stages};
use super::passes::{StagePlan, StepContext};
use super::ranks::Ranks;
use super::reduction::Reduction;
use super::shard::{Buffers, Shard, Spare, groups};
use super::shard_tree::{Sharding, sum_subtrees};
use super::step_input::{StepInput, StepSlices};
use super::step_profile::{StageTime, StepTimes};
use super::{Network, Parameters};
use crate::engine::layers::BatchStatistics;
use crate::engine::loss::{Loss, PairTerms};
use crate::engine::parameters::CHUNK;
use crate::engine::stopwatch::Stopwatch;

/// Limits of a group: the images that a shard takes through the layers at a time.
#[derive(Clone, Copy, Debug)]
pub(super) struct GroupLimits {
    /// Length of the inputs and outputs between two barriers.
    pub segment_numbers: usize,
    /// Length of all activations, in networks without a barrier.
    pub group_numbers: usize,
    /// Minimum of images in networks without a barrier, if the shard has as many.
    pub min_group: usize,
}

/// About 2 MiB between barriers: less would fit the second-level cache, but the weight gradient wants several images of a small map
/// in a call. About 1 MiB without barriers, but 8 images where a shard has as many, because the weight gradient has a cost for each call.
pub(super) const GROUP_LIMITS: GroupLimits =
    GroupLimits { segment_numbers: 512 * 1024, group_numbers: 256 * 1024, min_group: 8 };

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
    /// Buffers for batches of up to `capacity` images.
    pub fn new(network: &Network, capacity: usize) -> TrainingPlan {
        TrainingPlan::with_stages(network, capacity, stages(network), GROUP_LIMITS)
    }

    pub(super) fn with_stages(
        network: &Network,
        capacity: usize,
        stages: Vec<FusedStage>,
        limits: GroupLimits,
    ) -> TrainingPlan {
        let mut moments_of = Vec::new();
        let mut segment_starts = vec![0];
        let (mut moments_end, mut sums_len) = (0, 0);
        for (index, stage) in stages.iter().enumerate() {
            let barrier = stage.barrier(network);
            let len = stage.batch_statistics(network).map_or(0, BatchStatistics::moments_len);
            moments_of.push(moments_end..moments_end + len);
            moments_end += len;
            if let Some(barrier) = barrier {
                sums_len = sums_len.max(barrier.sums_len());
                segment_starts.push(index);
            }
        }
        // A network that begins with a barrier has an empty first segment, which only takes the sums of the input.
        let ends = segment_starts[1..].iter().copied().chain([stages.len()]);
        let segments: Vec<_> = segment_starts.iter().copied().zip(ends).map(|(start, end)| start..end).collect();

        let per_image: usize = stages.iter().map(|stage| stage.output_len(network)).sum();
        // The gradients that replace no activation: that of the network's output, and of the inputs of the other stages.
        let gradients = stages.iter().enumerate().filter(|(index, _)| !replaces_input(network, &stages, *index));
        let largest = gradients.map(|(_, stage)| stage.input_len(network)).chain([network.output().len()]).max();
        let largest = largest.unwrap_or(0);

        // Pairs make the shards even.
        let shard_capacity = Sharding::new(capacity, true).shard_images().min(capacity.max(1));
        let shard_count = (1..=capacity).map(|images| Sharding::new(images, false).count()).max().unwrap_or(0);
        let group = if segments.len() > 1 {
            shard_capacity
        } else {
            (limits.group_numbers / per_image.max(1)).clamp(limits.min_group.min(shard_capacity), shard_capacity)
        };
        let segment_groups = (0..segments.len())
            .map(|segment| segment_group(network, &stages, &segments, segment, limits).unwrap_or(shard_capacity))
            .map(|images| images.min(shard_capacity))
            .collect();
        let scratch_len = stages.iter().map(|stage| stage.scratch_len(network, group)).max().unwrap_or(0);
        let mut spare: Vec<Buffers> = (0..shard_count)
            .map(|_| Buffers {
                activations: stages.iter().map(|stage| vec![0.0; group * stage.output_len(network)]).collect(),
                argmax: stages.iter().map(|stage| vec![0; stage.argmax_len(network) * group]).collect(),
                d_output: vec![0.0; group * largest],
                d_input: vec![0.0; group * largest],
                in_place: false,
            })
            .collect();
        let shards = (0..shard_count)
            .map(|_| Shard {
                images: 0..0,
                buffers: if segments.len() > 1 { spare.pop().unwrap_or_default() } else { Buffers::default() },
                scratch: Vec::new(),
                gradient: Vec::new(),
                first: 0,
                sums: vec![0.0; sums_len],
                group_sums: vec![0.0; sums_len],
                loss: 0.0,
                learning: 0..0,
            })
            .collect();
        let learning = segments.iter().map(|segment| match &stages[segment.clone()] {
            [] => 0..0,
            [first, .., last] => first.params(network).start..last.params(network).end,
            [only] => only.params(network),
        });
        TrainingPlan {
            learning: learning.collect(),
            reduction: Reduction::new(None),
            shards,
            spare_buffers: Spare::new(spare),
            spare_scratch: Spare::new((0..shard_count).map(|_| vec![0.0; scratch_len]).collect()),
            // A buffer that was never used takes no memory.
            spare_gradients: Spare::new((0..shard_count).map(|_| vec![0.0; network.count(true)]).collect()),
            gradient: vec![0.0; network.count(true)],
            chunk_squares: vec![0.0; network.count(true).div_ceil(CHUNK)],
            plan: StagePlan {
                first_learning: stages.iter().position(|stage| stage.learns(network)).unwrap_or(stages.len()),
                output_weights: Vec::new(),
                times: StepTimes::off(stages.len()),
                packed: stages
                    .iter()
                    .map(|stage| stage.packing(network).map_or(0, |packing| packing.training_packed_len()))
                    .map(|len| vec![0.0; len])
                    .collect(),
                stages,
                moments_of,
            },
            moments: vec![0.0; moments_end],
            sums: vec![0.0; sums_len],
            segments,
            segment_groups,
            capacity,
            outputs: network.output().len(),
            isa: network.isa(),
            fingerprint: network.fingerprint(),
        }
    }

    /// The same, where the loss is the mean over the images of the losses of all outputs, that of output `k` times `weights[k]`.
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

    /// The same, for the share of one of several processes that train together.
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

    fn step_without_barriers(
        &mut self,
        network: &Network,
        parameters: &Parameters,
        loss: &Loss,
        input: StepSlices,
        used: usize,
    ) {
        let TrainingPlan { shards, spare_buffers, spare_scratch, spare_gradients, plan, moments, isa, .. } = self;
        let run = StepContext { plan, network, parameters, moments, input };
        let work = |shard: &mut Shard| {
            shard.loss = 0.0;
            shard.begin_gradient(spare_gradients, 0..network.count(true));
            shard.buffers = spare_buffers.take();
            shard.scratch = spare_scratch.take();
            let mut group = shard.group_capacity(network);
            if input.pairs.images() > 0 {
                group -= group % 2;
            }
            for images in groups(shard.images.clone(), group) {
                shard.first = images.start;
                run.forward(0..plan.stages.len(), shard, images.clone());
                run.loss(loss, shard, images.clone());
                run.backward(0..plan.stages.len(), shard, images);
            }
            spare_buffers.put(std::mem::take(&mut shard.buffers));
            spare_scratch.put(std::mem::take(&mut shard.scratch));
        };
        let add = |shard: &mut Shard, next: &mut Shard| {
            plan.times.reduce.time(|| shard.add_gradient(next, *isa, spare_gradients));
            shard.loss += next.loss;
        };
        sum_subtrees(&mut shards[..used], self.reduction.own_roots(), &work, &add);
    }

    /// Without a loss it ends at the last barrier.
    fn forward_with_barriers(
        &mut self,
        network: &Network,
        parameters: &mut Parameters,
        loss: Option<&Loss>,
        input: StepSlices,
        used: usize,
    ) {
        let TrainingPlan { shards, spare_scratch, plan, moments, sums, segments, segment_groups, reduction, .. } = self;
        let shards = &mut shards[..used];
        let barrier = |stage: usize| barrier_of(&plan.stages, network, stage);
        let wanted = segments.len() - usize::from(loss.is_none());
        for (index, segment) in segments[..wanted].iter().enumerate() {
            let run = StepContext { plan, network, parameters, moments, input };
            let next_barrier = segments.get(index + 1).map(|next| next.start);
            let sums_len = next_barrier.map_or(0, |stage| barrier(stage).sums_len());
            let work = |shard: &mut Shard| {
                shard.loss = 0.0;
                shard.begin_segment(spare_scratch);
                for images in groups(shard.images.clone(), segment_groups[index]) {
                    run.forward(segment.clone(), shard, images.clone());
                    if let Some(stage) = next_barrier {
                        run.forward_sums(stage, barrier(stage), shard, images);
                    }
                }
                if let Some(loss) = loss.filter(|_| next_barrier.is_none()) {
                    run.loss(loss, shard, shard.images.clone());
                }
                spare_scratch.put(std::mem::take(&mut shard.scratch));
            };
            let add = |shard: &mut Shard, next: &mut Shard| {
                shard.add_sums(next, sums_len);
                shard.loss += next.loss;
            };
            sum_subtrees(shards, reduction.own_roots(), &work, &add);
            if let Some(stage) = next_barrier {
                let layer = &network.layers()[plan.stages[stage].layers.start];
                let sums = &mut sums[..sums_len];
                reduction.sum(shards, |shard| &shard.sums, sums);
                barrier(stage).finish_forward(
                    &parameters.values[layer.params.clone()],
                    input.of,
                    sums,
                    &mut moments[plan.moments_of[stage].clone()],
                    &mut parameters.statistics[layer.statistics.clone()],
                );
            }
        }
    }

    fn backward_with_barriers(&mut self, network: &Network, parameters: &Parameters, input: StepSlices, used: usize) {
        let TrainingPlan { shards, spare_scratch, spare_gradients, plan, moments, sums, segments, .. } = self;
        let (segment_groups, learning, reduction, isa) =
            (&self.segment_groups, &self.learning, &mut self.reduction, self.isa);
        let shards = &mut shards[..used];
        let barrier = |stage: usize| barrier_of(&plan.stages, network, stage);
        let last = segments.len() - 1;
        for (index, segment) in segments.iter().enumerate().rev() {
            let run = StepContext { plan, network, parameters, moments, input };
            // The stage at the start of a segment waits for the sums over all shards.
            let rest = if index > 0 { segment.start + 1..segment.end } else { segment.clone() };
            let sums_len = if index > 0 { barrier(segment.start).sums_len() } else { 0 };
            let work = |shard: &mut Shard| {
                shard.begin_gradient(spare_gradients, learning[index].clone());
                shard.begin_segment(spare_scratch);
                let in_place = shard.buffers.in_place;
                for images in groups(shard.images.clone(), segment_groups[index]) {
                    shard.buffers.in_place = in_place;
                    if index < last {
                        let next = segments[index + 1].start;
                        run.backward(next..next + 1, shard, images.clone());
                    }
                    run.backward(rest.clone(), shard, images.clone());
                    if index > 0 {
                        run.backward_sums(segment.start, barrier(segment.start), shard, images);
                    }
                }
                spare_scratch.put(std::mem::take(&mut shard.scratch));
            };
            let add = |shard: &mut Shard, next: &mut Shard| {
                plan.times.reduce.time(|| shard.add_gradient(next, isa, spare_gradients));
                shard.add_sums(next, sums_len);
            };
            sum_subtrees(shards, reduction.own_roots(), &work, &add);
            if index > 0 {
                let stage = segment.start;
                let sums = &mut sums[..sums_len];
                reduction.sum(shards, |shard| &shard.sums, sums);
                let params = &parameters.values[network.layers()[plan.stages[stage].layers.start].params.clone()];
                let moments = &mut moments[plan.moments_of[stage].clone()];
                barrier(stage).finish_backward(params, input.of, sums, moments);
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

/// The barrier of `stage`, with which a segment begins.
fn barrier_of<'a>(stages: &'a [FusedStage], network: &'a Network, stage: usize) -> &'a dyn BatchStatistics {
    stages[stage].barrier(network).expect("segments begin with a stage that has batch statistics")
}

/// The size of a group in `segment`; `None` if the shard must go through it as a whole, because the backward pass moves a gradient
/// out of the activations into a buffer of its own.
fn segment_group(
    network: &Network,
    stages: &[FusedStage],
    segments: &[Range<usize>],
    segment: usize,
    limits: GroupLimits,
) -> Option<usize> {
    let stays = |index: usize| stages[index].source.is_none() || replaces_input(network, stages, index);
    let next = segments.get(segment + 1)?.start;
    let after_next = next + 1 < stages.len() && replaces_input(network, stages, next + 1);
    let all_stay = (segments[segment].start + 1..=next).all(stays);
    let stages = &stages[segments[segment].clone()];
    let numbers: usize = stages.iter().map(|stage| stage.input_len(network).max(stage.output_len(network))).sum();
    (after_next && all_stay).then_some((limits.segment_numbers / numbers.max(1)).max(1))
}
