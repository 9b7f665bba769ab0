//! How the shards of a batch go through a network: without a barrier each by itself, forward and backward; with barriers all of them from
//! one to the next.

use super::TrainingPlan;
use super::passes::StepContext;
use super::shard::{Shard, groups};
use super::shard_tree::sum_subtrees;
use super::step_input::StepSlices;
use crate::engine::layers::BatchStatistics;
use crate::engine::loss::Loss;
use crate::engine::network::fused::FusedStage;
use crate::engine::network::{Network, Parameters};

impl TrainingPlan {
    pub(super) fn step_without_barriers(
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
    pub(super) fn forward_with_barriers(
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

    pub(super) fn backward_with_barriers(
        &mut self,
        network: &Network,
        parameters: &Parameters,
        input: StepSlices,
        used: usize,
    ) {
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
}

/// The barrier of `stage`, with which a segment begins.
fn barrier_of<'a>(stages: &'a [FusedStage], network: &'a Network, stage: usize) -> &'a dyn BatchStatistics {
    stages[stage].barrier(network).expect("segments begin with a stage that has batch statistics")
}
