//! A training step: forward, loss, backward, over fixed shards of the batch.
//!
//! The batch is cut into at most [`MAX_SHARDS`] shards whose borders depend on the batch size alone. Each shard has
//! activations, a gradient arena and scratch of its own, and is worked on by one thread; gradients and batch-norm sums are
//! added in the order of the shards. So the result has the same bits for any number of threads.
//!
//! Between two batch-norm barriers a shard takes a few images at a time through all layers, so that what one layer writes is
//! still in the cache when the next reads it. A network without batch norm has no barrier at all: then a shard takes them
//! forward *and* backward, and needs buffers for no more of them.

use std::ops::Range;
use std::sync::{Mutex, MutexGuard, PoisonError};

use rayon::prelude::*;
use steersman_kernels::{Isa, update};

use super::stages::{Kind, Stage, stages};
use super::step_profile::{StageTime, StepTimes};
use super::{Network, Parameters};
use crate::layers::{BatchStatistics, Grads, Pair, Pass};
use crate::loss::Loss;
use crate::stopwatch::Stopwatch;

/// Most shards a batch is cut into: enough to keep 16 threads busy.
pub const MAX_SHARDS: usize = 16;

/// What goes in and out between two barriers for the images that a shard takes at a time, in numbers: about 2 MiB. Less would fit the
/// second-level cache, but the weight gradient wants several images of a small map in a call.
const SEGMENT_NUMBERS: usize = 512 * 1024;

/// Activations of the images that a shard takes at a time, in numbers, in networks without a barrier: about 1 MiB.
const GROUP_NUMBERS: usize = 256 * 1024;

/// Fewest images that a shard takes at a time, if it has as many: kernels prepare their weights once a call.
const MIN_GROUP: usize = 8;

/// Parameters that are reduced and updated as one task.
pub const CHUNK: usize = 4096;

/// The batch of one training step.
#[derive(Clone, Copy, Debug)]
pub struct StepInput<'a> {
    /// Images, `[n][c][h][w]`.
    pub x: &'a [f32],
    /// What the network should say, `[n][outputs]`.
    pub labels: &'a [f32],
    /// Seed of the run (for dropout).
    pub seed: u64,
    /// Number of the step, from 0 (for dropout).
    pub step: u64,
}

/// The buffers of a training step, planned once for a network and a largest batch.
#[derive(Debug)]
pub struct TrainingPlan {
    shards: Vec<Shard>,
    /// The buffers that no shard is using, in networks without a barrier.
    spare_buffers: Spare<Buffers>,
    /// The scratch that no shard is using.
    spare_scratch: Spare<Vec<f32>>,
    /// Gradient of the mean loss with respect to [`Parameters::values`].
    gradient: Vec<f32>,
    /// Sum of squares of each chunk of the gradient.
    chunk_squares: Vec<f64>,
    stages: Vec<Stage>,
    /// The parameters of each stage as its passes read them, made anew in every step.
    prepared: Vec<Vec<f32>>,
    /// What the barriers found out about the batch, all stages one after the other.
    moments: Vec<f32>,
    /// Where each stage's part of `moments` lies.
    moments_of: Vec<Range<usize>>,
    sums: Vec<f64>,
    /// Runs of stages without a barrier inside; each but the first begins with the stage that needs the barrier.
    segments: Vec<Range<usize>>,
    /// How many images go through each segment at a time.
    segment_groups: Vec<usize>,
    /// The first stage that learns: below it nobody asks for a gradient.
    first_learning: usize,
    capacity: usize,
    isa: Isa,
    times: StepTimes,
}

#[derive(Debug)]
struct Shard {
    /// Which images of the batch.
    images: Range<usize>,
    /// Empty between the steps of a network without a barrier.
    buffers: Buffers,
    /// Empty while the shard is not worked on.
    scratch: Vec<f32>,
    /// The image whose activations come first in the buffers.
    first: usize,
    gradient: Vec<f32>,
    sums: Vec<f64>,
    /// The same of the images that are being worked on.
    group_sums: Vec<f64>,
    /// Sum of the losses of all images.
    loss: f64,
}

/// The maps of a shard. With a barrier the activations have to wait there, and each shard has its own. Without one a shard is done
/// with them when it is done.
#[derive(Debug, Default)]
struct Buffers {
    /// Output of each stage.
    activations: Vec<Vec<f32>>,
    /// Where each [`Kind::PooledConv`] found its largest; empty for the others.
    places: Vec<Vec<u32>>,
    /// Gradient with respect to the current stage's output, and to its input.
    d_output: Vec<f32>,
    d_input: Vec<f32>,
    /// Whether the gradient with respect to the current stage's output has taken the place of that output instead.
    in_place: bool,
}

/// Buffers that are not in use. Those put back last are taken first, so that no more are ever touched than threads are at work,
/// and they are still in the cache.
#[derive(Debug)]
struct Spare<T>(Mutex<Vec<T>>);

impl<T> Spare<T> {
    fn new(items: Vec<T>) -> Spare<T> {
        Spare(Mutex::new(items))
    }

    fn take(&self) -> T {
        self.items().pop().expect("there are as many as shards")
    }

    fn put(&self, item: T) {
        self.items().push(item);
    }

    fn items(&self) -> MutexGuard<'_, Vec<T>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl TrainingPlan {
    /// Buffers for batches of up to `capacity` images.
    pub fn new(network: &Network, capacity: usize) -> TrainingPlan {
        TrainingPlan::with_stages(network, capacity, stages(network))
    }

    pub(super) fn with_stages(network: &Network, capacity: usize, stages: Vec<Stage>) -> TrainingPlan {
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
        // What is not put in the place of an activation: the gradient of the last output, and of the inputs of the others.
        let gradients = stages.iter().enumerate().filter(|(index, _)| !replaces_input(network, &stages, *index));
        let largest = gradients.map(|(_, stage)| stage.input_len(network)).chain([network.output().len()]).max();
        let largest = largest.unwrap_or(0);

        let shard_capacity = capacity.div_ceil(MAX_SHARDS).max(1);
        let group = if segments.len() > 1 {
            shard_capacity
        } else {
            (GROUP_NUMBERS / per_image.max(1)).clamp(MIN_GROUP.min(shard_capacity), shard_capacity)
        };
        let segment_groups = (0..segments.len())
            .map(|segment| segment_group(network, &stages, &segments, segment).unwrap_or(shard_capacity))
            .map(|images| images.min(shard_capacity))
            .collect();
        let scratch_len = stages.iter().map(|stage| stage.scratch_len(network, group)).max().unwrap_or(0);
        let mut spare: Vec<Buffers> = (0..capacity.min(MAX_SHARDS))
            .map(|_| Buffers {
                activations: stages.iter().map(|stage| vec![0.0; group * stage.output_len(network)]).collect(),
                places: stages.iter().map(|stage| vec![0; stage.places_len(network) * group]).collect(),
                d_output: vec![0.0; group * largest],
                d_input: vec![0.0; group * largest],
                in_place: false,
            })
            .collect();
        let shards = (0..capacity.min(MAX_SHARDS))
            .map(|_| Shard {
                images: 0..0,
                buffers: if segments.len() > 1 { spare.pop().unwrap_or_default() } else { Buffers::default() },
                scratch: Vec::new(),
                gradient: vec![0.0; network.count(true)],
                first: 0,
                sums: vec![0.0; sums_len],
                group_sums: vec![0.0; sums_len],
                loss: 0.0,
            })
            .collect();
        TrainingPlan {
            shards,
            spare_buffers: Spare::new(spare),
            spare_scratch: Spare::new((0..capacity.min(MAX_SHARDS)).map(|_| vec![0.0; scratch_len]).collect()),
            gradient: vec![0.0; network.count(true)],
            chunk_squares: vec![0.0; network.count(true).div_ceil(CHUNK)],
            first_learning: stages.iter().position(|stage| stage.learns(network)).unwrap_or(stages.len()),
            times: StepTimes::off(stages.len()),
            prepared: stages
                .iter()
                .map(|stage| stage.prepared(network).map_or(0, |prepared| prepared.prepared_for_training_len()))
                .map(|len| vec![0.0; len])
                .collect(),
            stages,
            moments: vec![0.0; moments_end],
            moments_of,
            sums: vec![0.0; sums_len],
            segments,
            segment_groups,
            capacity,
            isa: network.isa(),
        }
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

    /// Measures from now on how long each stage takes; `reduce` gets the time for adding the shards' gradients up.
    pub fn measure(&mut self, reduce: Stopwatch) {
        self.times = StepTimes::on(self.stages.len(), reduce);
    }

    /// What [`measure`](TrainingPlan::measure) has found so far, in the order of the layers.
    pub fn stage_times(&self, network: &Network) -> Vec<StageTime> {
        StageTime::of(network, &self.stages, &self.times, self.first_learning)
    }

    /// Computes the mean loss of the batch and leaves its gradient in [`gradient`](TrainingPlan::gradient). Of the
    /// parameters only the running statistics change. Allocates nothing when called inside a rayon pool.
    ///
    /// # Panics
    ///
    /// Panics if `network` is not the one the plan was made for, or the batch is empty or larger than planned.
    pub fn step(&mut self, network: &Network, parameters: &mut Parameters, loss: &Loss, input: StepInput) -> f64 {
        let n = input.x.len() / network.input().len();
        assert!(n > 0 && n <= self.capacity, "a batch of {n} images in a plan for 1 to {}", self.capacity);
        assert_eq!(input.x.len(), n * network.input().len());
        assert_eq!(input.labels.len(), n * network.output().len());
        let planned = self.stages.last().map_or(0, |stage| stage.layers.end);
        assert!(network.layers()[planned..].iter().all(|layer| layer.layer.is_view()), "a plan for another network");

        let shard_images = n.div_ceil(MAX_SHARDS);
        let used = n.div_ceil(shard_images);
        for (index, shard) in self.shards[..used].iter_mut().enumerate() {
            shard.images = index * shard_images..((index + 1) * shard_images).min(n);
        }
        self.freeze_moments(network, parameters);
        self.prepare(network, parameters);
        if self.segments.len() == 1 {
            self.step_without_barriers(network, parameters, loss, input, used);
        } else {
            self.step_with_barriers(network, parameters, loss, input, used);
        }
        self.reduce_gradient(network, used);
        self.shards[..used].iter().map(|shard| shard.loss).sum::<f64>() / input.labels.len() as f64
    }

    /// Puts the parameters in the order in which the passes read them, once for all shards.
    fn prepare(&mut self, network: &Network, parameters: &Parameters) {
        self.prepared.par_iter_mut().zip(&self.stages).for_each(|(to, stage)| {
            if let Some(prepared) = stage.prepared(network) {
                prepared.prepare_for_training(&parameters.values[stage.params(network)], to);
            }
        });
    }

    /// The moments of frozen batch normalisation.
    fn freeze_moments(&mut self, network: &Network, parameters: &Parameters) {
        for (stage, moments_of) in self.stages.iter().zip(&self.moments_of) {
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
        input: StepInput,
        used: usize,
    ) {
        let TrainingPlan {
            shards,
            spare_buffers,
            spare_scratch,
            stages,
            prepared,
            moments,
            moments_of,
            first_learning,
            times,
            ..
        } = self;
        let first_learning = *first_learning;
        let run = Run { network, parameters, stages, prepared, moments, moments_of, first_learning, input, times };
        shards[..used].par_iter_mut().for_each(|shard| {
            shard.reset();
            shard.buffers = spare_buffers.take();
            shard.scratch = spare_scratch.take();
            let group = shard.group_capacity(network);
            for images in groups(shard.images.clone(), group) {
                shard.first = images.start;
                run.forward(0..stages.len(), shard, images.clone());
                run.loss(loss, shard, images.clone());
                run.backward(0..stages.len(), shard, images);
            }
            spare_buffers.put(std::mem::take(&mut shard.buffers));
            spare_scratch.put(std::mem::take(&mut shard.scratch));
        });
    }

    fn step_with_barriers(
        &mut self,
        network: &Network,
        parameters: &mut Parameters,
        loss: &Loss,
        input: StepInput,
        used: usize,
    ) {
        let TrainingPlan {
            shards,
            spare_scratch,
            stages,
            prepared,
            moments,
            moments_of,
            sums,
            segments,
            segment_groups,
            first_learning,
            times,
            ..
        } = self;
        let first_learning = *first_learning;
        let shards = &mut shards[..used];
        let images = shards.last().map_or(0, |shard| shard.images.end);
        let barrier = |stage: usize| {
            stages[stage].barrier(network).expect("segments begin with a stage that has batch statistics")
        };
        let last = segments.len() - 1;

        for (index, segment) in segments.iter().enumerate() {
            let run = Run { network, parameters, stages, prepared, moments, moments_of, first_learning, input, times };
            let next_barrier = segments.get(index + 1).map(|next| next.start);
            shards.par_iter_mut().for_each(|shard| {
                if index == 0 {
                    shard.reset();
                }
                shard.begin_segment(spare_scratch);
                for images in groups(shard.images.clone(), segment_groups[index]) {
                    run.forward(segment.clone(), shard, images.clone());
                    if let Some(stage) = next_barrier {
                        run.forward_sums(stage, barrier(stage), shard, images);
                    }
                }
                if next_barrier.is_none() {
                    run.loss(loss, shard, shard.images.clone());
                }
                spare_scratch.put(std::mem::take(&mut shard.scratch));
            });
            if let Some(stage) = next_barrier {
                let layer = &network.layers()[stages[stage].layers.start];
                let sums = total(shards, barrier(stage).sums_len(), sums);
                barrier(stage).finish_forward(
                    &parameters.values[layer.params.clone()],
                    images,
                    sums,
                    &mut moments[moments_of[stage].clone()],
                    &mut parameters.statistics[layer.statistics.clone()],
                );
            }
        }
        for (index, segment) in segments.iter().enumerate().rev() {
            let run = Run { network, parameters, stages, prepared, moments, moments_of, first_learning, input, times };
            // The stage at the start of a segment waits for the sums over all shards.
            let rest = if index > 0 { segment.start + 1..segment.end } else { segment.clone() };
            shards.par_iter_mut().for_each(|shard| {
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
            });
            if index > 0 {
                let stage = segment.start;
                let sums = total(shards, barrier(stage).sums_len(), sums);
                let params = &parameters.values[network.layers()[stages[stage].layers.start].params.clone()];
                let moments = &mut moments[moments_of[stage].clone()];
                barrier(stage).finish_backward(params, images, sums, moments);
            }
        }
    }

    /// Adds the shards' gradients up, in their order. Those of frozen layers count as 0.
    fn reduce_gradient(&mut self, network: &Network, used: usize) {
        let TrainingPlan { shards, gradient, chunk_squares, isa, times, .. } = self;
        let shards = &shards[..used];
        gradient.par_chunks_mut(CHUNK).zip(chunk_squares.par_iter_mut()).enumerate().for_each(
            |(index, (chunk, squares))| {
                times.reduce.time(|| {
                    let range = index * CHUNK..index * CHUNK + chunk.len();
                    chunk.copy_from_slice(&shards[0].gradient[range.clone()]);
                    for shard in &shards[1..] {
                        update::sum_into(*isa, chunk, &shard.gradient[range.clone()]);
                    }
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

impl Shard {
    fn reset(&mut self) {
        self.gradient.fill(0.0);
        self.loss = 0.0;
    }

    /// Takes scratch for the images between two barriers.
    fn begin_segment(&mut self, spare_scratch: &Spare<Vec<f32>>) {
        self.scratch = spare_scratch.take();
        self.first = self.images.start;
        self.sums.fill(0.0);
    }

    /// Adds the sums of a group.
    fn add_group_sums(&mut self, len: usize) {
        for (sum, group) in self.sums[..len].iter_mut().zip(&self.group_sums) {
            *sum += group;
        }
    }

    /// How many images the activations have room for.
    fn group_capacity(&self, network: &Network) -> usize {
        self.buffers.activations.last().map_or(self.images.len(), |last| last.len() / network.output().len()).max(1)
    }

    /// Output of stage `stage` and of its source, which comes before it.
    fn source_and_output(&mut self, stage: usize, source: usize) -> (&mut [f32], &mut [f32]) {
        let (before, from_here) = self.buffers.activations.split_at_mut(stage);
        (&mut before[source], &mut from_here[0])
    }
}

/// `images`, `group` at a time.
fn groups(images: Range<usize>, group: usize) -> impl Iterator<Item = Range<usize>> {
    images.clone().step_by(group).map(move |start| start..(start + group).min(images.end))
}

/// How many images should go through a segment at a time: `None` where they cannot be told apart, because a gradient on the way
/// back leaves its place among the activations.
fn segment_group(network: &Network, stages: &[Stage], segments: &[Range<usize>], segment: usize) -> Option<usize> {
    let stays = |index: usize| stages[index].source.is_none() || replaces_input(network, stages, index);
    let next = segments.get(segment + 1)?.start;
    let after_next = next + 1 < stages.len() && replaces_input(network, stages, next + 1);
    let all_stay = (segments[segment].start + 1..=next).all(stays);
    let stages = &stages[segments[segment].clone()];
    let numbers: usize = stages.iter().map(|stage| stage.input_len(network).max(stage.output_len(network))).sum();
    (after_next && all_stay).then_some((SEGMENT_NUMBERS / numbers.max(1)).max(1))
}

/// Whether the gradient of the stage's input takes the place of that input.
fn replaces_input(network: &Network, stages: &[Stage], index: usize) -> bool {
    let Some(source) = stages[index].source else { return false };
    match &stages[index].kind {
        Kind::NormRectify(_) => true,
        Kind::PooledConv(_) => false,
        Kind::Layer => {
            let layer = &network.layers()[stages[index].layers.start].layer;
            layer.linear().is_some() && stages[source].forgets_output(network)
        }
    }
}

/// Adds the shards' sums up, in their order.
fn total<'a>(shards: &[Shard], len: usize, sums: &'a mut [f64]) -> &'a [f64] {
    let sums = &mut sums[..len];
    sums.fill(0.0);
    for shard in shards {
        for (total, sum) in sums.iter_mut().zip(&shard.sums) {
            *total += sum;
        }
    }
    sums
}

/// What all shards share during a pass.
#[derive(Clone, Copy)]
struct Run<'a> {
    network: &'a Network,
    parameters: &'a Parameters,
    stages: &'a [Stage],
    prepared: &'a [Vec<f32>],
    moments: &'a [f32],
    moments_of: &'a [Range<usize>],
    first_learning: usize,
    input: StepInput<'a>,
    times: &'a StepTimes,
}

impl<'a> Run<'a> {
    fn pass(&self, stage: usize, first_image: usize) -> Pass<'a> {
        let moments = &self.moments[self.moments_of[stage].clone()];
        let layer = self.stages[stage].layers.start;
        Pass {
            seed: self.input.seed,
            step: self.input.step,
            layer,
            first_image,
            moments,
            prepared: &self.prepared[stage],
        }
    }

    fn params(&self, stage: usize) -> &'a [f32] {
        &self.parameters.values[self.stages[stage].params(self.network)]
    }

    /// The input of `stage` for `images` of the batch; `first` is that whose activations come first.
    fn stage_input<'b>(
        &self,
        stage: usize,
        activations: &'b [Vec<f32>],
        first: usize,
        images: Range<usize>,
    ) -> &'b [f32]
    where
        'a: 'b,
    {
        let len = self.stages[stage].input_len(self.network);
        match self.stages[stage].source {
            Some(source) => &activations[source][(images.start - first) * len..][..images.len() * len],
            None => &self.input.x[images.start * len..images.end * len],
        }
    }

    fn forward(&self, stages: Range<usize>, shard: &mut Shard, images: Range<usize>) {
        for index in stages {
            let stage = &self.stages[index];
            let (before, from_here) = shard.buffers.activations.split_at_mut(index);
            let x = self.stage_input(index, before, shard.first, images.clone());
            let (n, before) = (images.len(), images.start - shard.first);
            let outputs = stage.output_len(self.network);
            let y = &mut from_here[0][before * outputs..][..n * outputs];
            let (params, pass) = (self.params(index), self.pass(index, images.start));
            self.times.stages[index][0].time(|| match &stage.kind {
                Kind::Layer => {
                    let layer = &self.network.layers()[stage.layers.start].layer;
                    layer.forward(params, &pass, n, x, y, &mut shard.scratch);
                }
                Kind::NormRectify(fused) => fused.forward(params, &pass, n, x, y),
                Kind::PooledConv(fused) => {
                    let places = &mut shard.buffers.places[index][before * outputs..][..n * outputs];
                    fused.forward(&pass, n, x, y, places, &mut shard.scratch);
                }
            });
        }
    }

    /// Adds the images' losses to the shard's, and puts the gradient of the mean loss into `d_output`.
    fn loss(&self, loss: &Loss, shard: &mut Shard, images: Range<usize>) {
        let outputs = self.network.output().len();
        let predictions = match shard.buffers.activations.last() {
            Some(last) => &last[..images.len() * outputs],
            None => &self.input.x[images.start * outputs..images.end * outputs],
        };
        let labels = &self.input.labels[images.start * outputs..images.end * outputs];
        let scale = 1.0 / self.input.labels.len() as f32;
        shard.loss +=
            loss.value_and_gradient(predictions, labels, scale, &mut shard.buffers.d_output[..predictions.len()]);
        shard.buffers.in_place = false;
    }

    /// Takes the gradient of the output of the last of `stages` back to the input of the first.
    fn backward(&self, stages: Range<usize>, shard: &mut Shard, images: Range<usize>) {
        for index in stages.rev().filter(|index| *index >= self.first_learning) {
            let stage = &self.stages[index];
            let n = images.len();
            let before = images.start - shard.first;
            let place = |len: usize| before * len..(before + n) * len;
            let (of_x, of_y) = (place(stage.input_len(self.network)), place(stage.output_len(self.network)));
            let (params, pass) = (self.params(index), self.pass(index, images.start));
            let replaces = stage.source.filter(|_| replaces_input(self.network, self.stages, index));
            // Nobody asks for the gradient of the images themselves, or of what comes before all that learns.
            let wanted = stage.source.filter(|source| *source >= self.first_learning);
            self.times.stages[index][1].time(|| match &stage.kind {
                Kind::NormRectify(fused) => {
                    let source = replaces.expect("batch norm runs fused only after another stage");
                    let (in_place, d_output) = (shard.buffers.in_place, std::mem::take(&mut shard.buffers.d_output));
                    let (x, y) = shard.source_and_output(index, source);
                    let dy = if in_place { &y[of_y] } else { &d_output[of_y] };
                    fused.backward(params, &pass, n, &mut x[of_x], dy);
                    shard.buffers.d_output = d_output;
                }
                Kind::PooledConv(fused) => {
                    let x = self.stage_input(index, &shard.buffers.activations, shard.first, images.clone());
                    let y = &shard.buffers.activations[index][of_y.clone()];
                    let pair = Pair { x, y, dy: &shard.buffers.d_output[of_y.clone()] };
                    let dx = wanted.map(|_| &mut shard.buffers.d_input[of_x]);
                    let dparams = &mut shard.gradient[stage.params(self.network)];
                    let grads = Grads { dparams, scratch: &mut shard.scratch };
                    fused.backward(params, n, pair, &shard.buffers.places[index][of_y], dx, grads);
                }
                Kind::Layer => {
                    let layer = &self.network.layers()[stage.layers.start].layer;
                    let x = self.stage_input(index, &shard.buffers.activations, shard.first, images.clone());
                    let y = &shard.buffers.activations[index][of_y.clone()];
                    let dy = if shard.buffers.in_place { y } else { &shard.buffers.d_output[of_y.clone()] };
                    let pair = Pair { x, y, dy };
                    let apart = wanted.is_some() && replaces.is_none();
                    let dx = if apart { Some(&mut shard.buffers.d_input[of_x.clone()]) } else { None };
                    let dparams = &mut shard.gradient[stage.params(self.network)];
                    layer.backward(params, &pass, n, pair, dx, Grads { dparams, scratch: &mut shard.scratch });
                    if let (Some(linear), Some(source)) = (layer.linear(), replaces.and(wanted)) {
                        let (before, from_here) = shard.buffers.activations.split_at_mut(index);
                        let dy =
                            if shard.buffers.in_place { &from_here[0][of_y] } else { &shard.buffers.d_output[of_y] };
                        linear.backward_input(params, &pass, n, dy, &mut before[source][of_x], &mut shard.scratch);
                    }
                }
            });
            shard.buffers.in_place = replaces.is_some();
            if !shard.buffers.in_place {
                std::mem::swap(&mut shard.buffers.d_output, &mut shard.buffers.d_input);
            }
        }
    }

    /// Adds the sums over the images that the barrier is for to the shard's.
    fn forward_sums(&self, stage: usize, barrier: &dyn BatchStatistics, shard: &mut Shard, images: Range<usize>) {
        let x = self.stage_input(stage, &shard.buffers.activations, shard.first, images.clone());
        let sums = &mut shard.group_sums[..barrier.sums_len()];
        self.times.stages[stage][0].time(|| barrier.forward_sums(images.len(), x, sums));
        shard.add_group_sums(barrier.sums_len());
    }

    /// The same on the way back.
    fn backward_sums(&self, index: usize, barrier: &dyn BatchStatistics, shard: &mut Shard, images: Range<usize>) {
        let stage = &self.stages[index];
        let n = images.len();
        let x = self.stage_input(index, &shard.buffers.activations, shard.first, images.clone());
        let outputs = stage.output_len(self.network);
        let of_y = (images.start - shard.first) * outputs..(images.end - shard.first) * outputs;
        let dy = if shard.buffers.in_place {
            &shard.buffers.activations[index][of_y]
        } else {
            &shard.buffers.d_output[of_y]
        };
        let sums = &mut shard.group_sums[..barrier.sums_len()];
        let moments = self.pass(index, images.start).moments;
        let dparams = &mut shard.gradient[stage.params(self.network)];
        self.times.stages[index][1].time(|| match &stage.kind {
            Kind::Layer | Kind::PooledConv(_) => barrier.backward_sums(moments, n, x, dy, sums, dparams),
            Kind::NormRectify(fused) => fused.backward_sums(self.params(index), moments, x, dy, sums, dparams),
        });
    }
}
