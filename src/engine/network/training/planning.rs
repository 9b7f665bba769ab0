//! Planning of a training step: the buffers for a network and a largest batch.

use std::ops::Range;

use super::TrainingPlan;
use super::passes::StagePlan;
use super::reduction::Reduction;
use super::shard::{Buffers, Shard, Spare};
use super::shard_tree::Sharding;
use super::step_profile::StepTimes;
use crate::engine::layers::BatchStatistics;
use crate::engine::network::Network;
use crate::engine::network::fused::{FusedStage, replaces_input, stages};
use crate::engine::parameters::CHUNK;

/// Limits of a group: the images that a shard takes through the layers at a time.
#[derive(Clone, Copy, Debug)]
pub(in crate::engine::network) struct GroupLimits {
    /// Length of the inputs and outputs between two barriers.
    pub segment_numbers: usize,
    /// Length of all activations, in networks without a barrier.
    pub group_numbers: usize,
    /// Minimum of images in networks without a barrier, if the shard has as many.
    pub min_group: usize,
}

/// About 2 MiB between barriers: less would fit the second-level cache, but the weight gradient wants several images of a small map
/// in a call. About 1 MiB without barriers, but 8 images where a shard has as many, because the weight gradient has a cost for each call.
pub(in crate::engine::network) const GROUP_LIMITS: GroupLimits =
    GroupLimits { segment_numbers: 512 * 1024, group_numbers: 256 * 1024, min_group: 8 };

impl TrainingPlan {
    /// Buffers for batches of up to `capacity` images.
    pub fn new(network: &Network, capacity: usize) -> TrainingPlan {
        TrainingPlan::with_stages(network, capacity, stages(network), GROUP_LIMITS)
    }

    pub(in crate::engine::network) fn with_stages(
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
