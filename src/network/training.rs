//! A training step: forward, loss, backward, over fixed shards of the batch.
//!
//! The batch is cut into at most [`MAX_SHARDS`] shards whose borders depend on the batch size alone. Each shard has
//! activations, a gradient arena and scratch of its own, and is worked on by one thread; gradients and batch-norm sums are
//! added in the order of the shards. So the result has the same bits for any number of threads.
//!
//! Between two batch-norm barriers a shard goes through all layers in one go. A network without batch norm has no barrier at
//! all: then a shard takes a few images at a time forward *and* backward, and their activations stay in the cache.

use std::ops::Range;

use rayon::prelude::*;
use steersman_kernels::{Isa, update};

use super::{NamedLayer, Network, Parameters};
use crate::layers::{BatchStatistics, Grads, Pair, Pass};
use crate::loss::Loss;

/// Most shards a batch is cut into: enough to keep 16 threads busy.
pub const MAX_SHARDS: usize = 16;

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
    /// Gradient of the mean loss with respect to [`Parameters::values`].
    gradient: Vec<f32>,
    /// Sum of squares of each chunk of the gradient.
    chunk_squares: Vec<f64>,
    /// What the barriers found out about the batch, all layers one after the other.
    moments: Vec<f32>,
    /// Where each layer's part of `moments` lies.
    moments_of: Vec<Range<usize>>,
    sums: Vec<f64>,
    /// Runs of layers without a barrier inside; each but the first begins with the layer that needs the barrier.
    segments: Vec<Range<usize>>,
    /// For each layer, which earlier layer's output is its input; `None` is the batch itself.
    source: Vec<Option<usize>>,
    /// The first layer that learns: below it nobody asks for a gradient.
    first_learning: usize,
    capacity: usize,
    isa: Isa,
}

#[derive(Debug, Default)]
struct Shard {
    /// Which images of the batch.
    images: Range<usize>,
    /// Output of each layer; empty for views.
    activations: Vec<Vec<f32>>,
    /// Gradient with respect to the current layer's output, and to its input.
    d_output: Vec<f32>,
    d_input: Vec<f32>,
    gradient: Vec<f32>,
    sums: Vec<f64>,
    scratch: Vec<f32>,
    /// Sum of the losses of all images.
    loss: f64,
}

impl TrainingPlan {
    /// Buffers for batches of up to `capacity` images.
    pub fn new(network: &Network, capacity: usize) -> TrainingPlan {
        let layers = network.layers();
        let mut moments_of = Vec::new();
        let mut segment_starts = vec![0];
        let (mut moments_end, mut sums_len) = (0, 0);
        for (index, layer) in layers.iter().enumerate() {
            let barrier = layer.layer.batch_statistics();
            let len = barrier.map_or(0, BatchStatistics::moments_len);
            moments_of.push(moments_end..moments_end + len);
            moments_end += len;
            if let Some(barrier) = barrier.filter(|_| !layer.frozen) {
                sums_len = sums_len.max(barrier.sums_len());
                segment_starts.push(index);
            }
        }
        // A network that begins with a barrier has an empty first segment, which only takes the sums of the input.
        let ends = segment_starts[1..].iter().copied().chain([layers.len()]);
        let segments: Vec<_> = segment_starts.iter().copied().zip(ends).map(|(start, end)| start..end).collect();

        let source: Vec<Option<usize>> =
            (0..layers.len()).map(|i| (0..i).rev().find(|&j| !is_view(&layers[j]))).collect();
        let activations_len = |layer: &NamedLayer| if is_view(layer) { 0 } else { layer.layer.output().len() };
        let per_image: usize = layers.iter().map(activations_len).sum();
        let largest = layers.iter().map(|l| l.layer.input().len().max(l.layer.output().len())).max().unwrap_or(0);

        let shard_capacity = capacity.div_ceil(MAX_SHARDS).max(1);
        let group = if segments.len() > 1 {
            shard_capacity
        } else {
            (GROUP_NUMBERS / per_image.max(1)).clamp(MIN_GROUP.min(shard_capacity), shard_capacity)
        };
        let scratch_len = layers.iter().map(|l| l.layer.scratch_len(group)).max().unwrap_or(0);
        let shards = (0..capacity.min(MAX_SHARDS))
            .map(|_| Shard {
                images: 0..0,
                activations: layers.iter().map(|l| vec![0.0; group * activations_len(l)]).collect(),
                d_output: vec![0.0; group * largest],
                d_input: vec![0.0; group * largest],
                gradient: vec![0.0; network.count(true)],
                sums: vec![0.0; sums_len],
                scratch: vec![0.0; scratch_len],
                loss: 0.0,
            })
            .collect();
        TrainingPlan {
            shards,
            gradient: vec![0.0; network.count(true)],
            chunk_squares: vec![0.0; network.count(true).div_ceil(CHUNK)],
            moments: vec![0.0; moments_end],
            moments_of,
            sums: vec![0.0; sums_len],
            segments,
            source,
            first_learning: layers.iter().position(|l| !l.params.is_empty() && !l.frozen).unwrap_or(layers.len()),
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
        assert_eq!(network.layers().len(), self.source.len());

        for (layer, moments_of) in network.layers().iter().zip(&self.moments_of).filter(|(layer, _)| layer.frozen) {
            if let Some(statistics) = layer.layer.batch_statistics() {
                let params = &parameters.values[layer.params.clone()];
                let running = &parameters.statistics[layer.statistics.clone()];
                statistics.frozen_moments(params, running, &mut self.moments[moments_of.clone()]);
            }
        }
        let shard_images = n.div_ceil(MAX_SHARDS);
        let used = n.div_ceil(shard_images);
        for (index, shard) in self.shards[..used].iter_mut().enumerate() {
            shard.images = index * shard_images..((index + 1) * shard_images).min(n);
        }
        if self.segments.len() == 1 {
            self.step_without_barriers(network, parameters, loss, input, used);
        } else {
            self.step_with_barriers(network, parameters, loss, input, used);
        }
        self.reduce_gradient(network, used);
        self.shards[..used].iter().map(|shard| shard.loss).sum::<f64>() / input.labels.len() as f64
    }

    fn step_without_barriers(
        &mut self,
        network: &Network,
        parameters: &Parameters,
        loss: &Loss,
        input: StepInput,
        used: usize,
    ) {
        let TrainingPlan { shards, source, moments, moments_of, first_learning, .. } = self;
        let run = Run { network, parameters, source, moments, moments_of, first_learning: *first_learning, input };
        shards[..used].par_iter_mut().for_each(|shard| {
            shard.reset();
            let group = shard.group_capacity(network);
            for start in shard.images.clone().step_by(group) {
                let images = start..(start + group).min(shard.images.end);
                run.forward(0..network.layers().len(), shard, images.clone());
                run.loss(loss, shard, images.clone());
                run.backward(0..network.layers().len(), shard, images);
            }
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
        let TrainingPlan { shards, moments, moments_of, sums, segments, source, first_learning, .. } = self;
        let first_learning = *first_learning;
        let shards = &mut shards[..used];
        let images = shards.last().map_or(0, |shard| shard.images.end);
        let layers = network.layers();
        let last = segments.len() - 1;

        for (index, segment) in segments.iter().enumerate() {
            let run = Run { network, parameters, source, moments, moments_of, first_learning, input };
            let next_barrier = segments.get(index + 1).map(|next| next.start);
            shards.par_iter_mut().for_each(|shard| {
                if index == 0 {
                    shard.reset();
                }
                run.forward(segment.clone(), shard, shard.images.clone());
                match next_barrier {
                    Some(layer) => run.forward_sums(layer, shard),
                    None => run.loss(loss, shard, shard.images.clone()),
                }
            });
            if let Some(layer) = next_barrier {
                let NamedLayer { params, statistics, .. } = &layers[layer];
                let sums = total(shards, barrier(&layers[layer]).sums_len(), sums);
                barrier(&layers[layer]).finish_forward(
                    &parameters.values[params.clone()],
                    images,
                    sums,
                    &mut moments[moments_of[layer].clone()],
                    &mut parameters.statistics[statistics.clone()],
                );
            }
        }
        for (index, segment) in segments.iter().enumerate().rev() {
            let run = Run { network, parameters, source, moments, moments_of, first_learning, input };
            // The layer at the start of a segment waits for the sums over all shards.
            let rest = if index > 0 { segment.start + 1..segment.end } else { segment.clone() };
            shards.par_iter_mut().for_each(|shard| {
                if index < last {
                    let barrier_layer = segments[index + 1].start;
                    run.backward(barrier_layer..barrier_layer + 1, shard, shard.images.clone());
                }
                run.backward(rest.clone(), shard, shard.images.clone());
                if index > 0 {
                    run.backward_sums(segment.start, shard);
                }
            });
            if index > 0 {
                let layer = segment.start;
                let sums = total(shards, barrier(&layers[layer]).sums_len(), sums);
                let params = &parameters.values[layers[layer].params.clone()];
                let moments = &mut moments[moments_of[layer].clone()];
                barrier(&layers[layer]).finish_backward(params, images, sums, moments);
            }
        }
    }

    /// Adds the shards' gradients up, in their order. Those of frozen layers count as 0.
    fn reduce_gradient(&mut self, network: &Network, used: usize) {
        let TrainingPlan { shards, gradient, chunk_squares, isa, .. } = self;
        let shards = &shards[..used];
        gradient.par_chunks_mut(CHUNK).zip(chunk_squares.par_iter_mut()).enumerate().for_each(
            |(index, (chunk, squares))| {
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
            },
        );
    }
}

impl Shard {
    fn reset(&mut self) {
        self.gradient.fill(0.0);
        self.loss = 0.0;
    }

    /// How many images the activations have room for.
    fn group_capacity(&self, network: &Network) -> usize {
        let last = network.layers().iter().rposition(|layer| !is_view(layer)).expect("a planned network has a layer");
        self.activations[last].len() / network.output().len()
    }
}

fn is_view(layer: &NamedLayer) -> bool {
    layer.layer.is_view()
}

fn barrier(layer: &NamedLayer) -> &dyn BatchStatistics {
    layer.layer.batch_statistics().expect("segments begin with a layer that has batch statistics")
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
    source: &'a [Option<usize>],
    moments: &'a [f32],
    moments_of: &'a [Range<usize>],
    first_learning: usize,
    input: StepInput<'a>,
}

impl<'a> Run<'a> {
    fn pass(&self, layer: usize, first_image: usize) -> Pass<'a> {
        let moments = &self.moments[self.moments_of[layer].clone()];
        Pass { seed: self.input.seed, step: self.input.step, layer, first_image, moments }
    }

    fn params(&self, layer: usize) -> &'a [f32] {
        &self.parameters.values[self.network.layers()[layer].params.clone()]
    }

    /// The input of `layer` for `images` of the batch.
    fn layer_input<'b>(&self, layer: usize, activations: &'b [Vec<f32>], images: Range<usize>) -> &'b [f32]
    where
        'a: 'b,
    {
        let len = self.network.layers()[layer].layer.input().len();
        match self.source[layer] {
            Some(source) => &activations[source][..images.len() * len],
            None => &self.input.x[images.start * len..images.end * len],
        }
    }

    fn forward(&self, layers: Range<usize>, shard: &mut Shard, images: Range<usize>) {
        for index in layers {
            let layer = &self.network.layers()[index].layer;
            if layer.is_view() {
                continue;
            }
            let (before, from_here) = shard.activations.split_at_mut(index);
            let x = self.layer_input(index, before, images.clone());
            let y = &mut from_here[0][..images.len() * layer.output().len()];
            let pass = self.pass(index, images.start);
            layer.forward(self.params(index), &pass, images.len(), x, y, &mut shard.scratch);
        }
    }

    /// Adds the images' losses to the shard's, and puts the gradient of the mean loss into `d_output`.
    fn loss(&self, loss: &Loss, shard: &mut Shard, images: Range<usize>) {
        let outputs = self.network.output().len();
        let after_last = self.network.layers().len();
        let last = (0..after_last).rev().find(|&i| !self.network.layers()[i].layer.is_view());
        let predictions = match last {
            Some(last) => &shard.activations[last][..images.len() * outputs],
            None => &self.input.x[images.start * outputs..images.end * outputs],
        };
        let labels = &self.input.labels[images.start * outputs..images.end * outputs];
        let scale = 1.0 / self.input.labels.len() as f32;
        shard.loss += loss.value_and_gradient(predictions, labels, scale, &mut shard.d_output[..predictions.len()]);
    }

    /// Takes `d_output` of the last of `layers` back to the input of the first.
    fn backward(&self, layers: Range<usize>, shard: &mut Shard, images: Range<usize>) {
        for index in layers.rev() {
            let layer = &self.network.layers()[index].layer;
            if layer.is_view() || index < self.first_learning {
                continue;
            }
            let n = images.len();
            let (x_len, y_len) = (n * layer.input().len(), n * layer.output().len());
            let x = self.layer_input(index, &shard.activations, images.clone());
            let pair = Pair { x, y: &shard.activations[index][..y_len], dy: &shard.d_output[..y_len] };
            // Nobody asks for the gradient of the images themselves, or of layers that do not learn.
            let dx = self.source[index].filter(|source| *source >= self.first_learning);
            let dx = dx.map(|_| &mut shard.d_input[..x_len]);
            let range = self.network.layers()[index].params.clone();
            let grads = Grads { dparams: &mut shard.gradient[range], scratch: &mut shard.scratch };
            layer.backward(self.params(index), &self.pass(index, images.start), n, pair, dx, grads);
            std::mem::swap(&mut shard.d_output, &mut shard.d_input);
        }
    }

    fn forward_sums(&self, layer: usize, shard: &mut Shard) {
        let barrier = barrier(&self.network.layers()[layer]);
        let x = self.layer_input(layer, &shard.activations, shard.images.clone());
        barrier.forward_sums(shard.images.len(), x, &mut shard.sums[..barrier.sums_len()]);
    }

    fn backward_sums(&self, layer: usize, shard: &mut Shard) {
        let named = &self.network.layers()[layer];
        let barrier = barrier(named);
        let n = shard.images.len();
        let x = self.layer_input(layer, &shard.activations, shard.images.clone());
        let dy = &shard.d_output[..n * named.layer.output().len()];
        let sums = &mut shard.sums[..barrier.sums_len()];
        let dparams = &mut shard.gradient[named.params.clone()];
        barrier.backward_sums(self.pass(layer, shard.images.start).moments, n, x, dy, sums, dparams);
    }
}
