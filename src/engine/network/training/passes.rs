//! The passes of a training step over a group of images of a shard: stages forward, loss, stages backward.

use std::ops::Range;

use super::shard::Shard;
use super::step_input::StepSlices;
use super::step_profile::StepTimes;
use crate::engine::layers::{BatchStatistics, Grads, Pair, Pass};
use crate::engine::loss::Loss;
use crate::engine::network::fused::{FusedStage, Kind, replaces_input};
use crate::engine::network::{Network, Parameters};

/// The stages of a network, and what they need in every step.
#[derive(Debug)]
pub(super) struct StagePlan {
    pub stages: Vec<FusedStage>,
    /// The packed weights of each stage, made anew in every step.
    pub packed: Vec<Vec<f32>>,
    /// Where the means and variances of each stage lie among those of all.
    pub moments_of: Vec<Range<usize>>,
    /// The first stage that learns: no gradient is computed before it.
    pub first_learning: usize,
    /// Weight of each output in the loss; empty for 1 / outputs each.
    pub output_weights: Vec<f32>,
    pub times: StepTimes,
}

/// What all shards share during a pass of a training step.
#[derive(Clone, Copy)]
pub(super) struct StepContext<'a> {
    pub plan: &'a StagePlan,
    pub network: &'a Network,
    pub parameters: &'a Parameters,
    /// Means and variances of the batch, all stages one after the other.
    pub moments: &'a [f32],
    pub input: StepSlices<'a>,
}

impl<'a> StepContext<'a> {
    fn pass(&self, stage: usize, first_image: usize) -> Pass<'a> {
        let moments = &self.moments[self.plan.moments_of[stage].clone()];
        let layer = self.plan.stages[stage].layers.start;
        Pass {
            seed: self.input.seed,
            step: self.input.step,
            layer,
            first_image,
            moments,
            packed: &self.plan.packed[stage],
        }
    }

    fn params(&self, stage: usize) -> &'a [f32] {
        &self.parameters.values[self.plan.stages[stage].params(self.network)]
    }

    /// The input of `stage` for `images` of the batch; `first` is the image whose activations come first in the buffers.
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
        let len = self.plan.stages[stage].input_len(self.network);
        match self.plan.stages[stage].source {
            Some(source) => &activations[source][(images.start - first) * len..][..images.len() * len],
            None => self.input.images(images, len),
        }
    }

    pub fn forward(&self, stages: Range<usize>, shard: &mut Shard, images: Range<usize>) {
        for index in stages {
            let stage = &self.plan.stages[index];
            let (before, from_here) = shard.buffers.activations.split_at_mut(index);
            let x = self.stage_input(index, before, shard.first, images.clone());
            let (n, offset) = (images.len(), images.start - shard.first);
            let outputs = stage.output_len(self.network);
            let y = &mut from_here[0][offset * outputs..][..n * outputs];
            let (params, pass) = (self.params(index), self.pass(index, images.start));
            self.plan.times.stages[index][0].time(|| match &stage.kind {
                Kind::Layer => {
                    let layer = &self.network.layers()[stage.layers.start].layer;
                    layer.forward(params, &pass, n, x, y, &mut shard.scratch);
                }
                Kind::NormRectify(fused) => fused.forward(params, &pass, n, x, y),
                Kind::PooledConv(fused) => {
                    let argmax = &mut shard.buffers.argmax[index][offset * outputs..][..n * outputs];
                    fused.forward(&pass, n, x, y, argmax, &mut shard.scratch);
                }
            });
        }
    }

    /// Adds the losses of `images` to the shard's and overwrites `d_output` with the gradient of the mean loss.
    pub fn loss(&self, loss: &Loss, shard: &mut Shard, images: Range<usize>) {
        debug_assert_eq!(images.start, shard.first, "the loss is taken of all images in the buffers");
        let outputs = self.network.output().len();
        let predictions = match shard.buffers.activations.last() {
            Some(last) => &last[..images.len() * outputs],
            None => self.input.images(images.clone(), outputs),
        };
        let labels = self.input.labels(images.clone(), outputs);
        let count = self.loss_count();
        let scale = 1.0 / count as f32;
        let gradient = &mut shard.buffers.d_output[..predictions.len()];
        let weights = &self.plan.output_weights[..];
        shard.loss += match weights {
            [] => loss.value_and_gradient(predictions, labels, scale, gradient),
            _ => loss.weighted_value_and_gradient(predictions, labels, weights, scale, gradient),
        };
        if self.input.pairs.images() > 0 {
            // The sum over the batch is divided by the count in the end.
            let of_mean = self.input.pairs.add(images, outputs, weights, predictions, labels, gradient);
            shard.loss += of_mean * count as f64;
        }
        shard.buffers.in_place = false;
    }

    /// What the sum of the losses of the batch is divided by: the number of labels, or of images if the outputs have weights.
    pub fn loss_count(&self) -> usize {
        let images = self.input.of;
        if self.plan.output_weights.is_empty() { images * self.network.output().len() } else { images }
    }

    /// Backward pass of `stages`: from the gradient of the last one's output to that of the first one's input.
    pub fn backward(&self, stages: Range<usize>, shard: &mut Shard, images: Range<usize>) {
        for index in stages.rev().filter(|index| *index >= self.plan.first_learning) {
            let stage = &self.plan.stages[index];
            let n = images.len();
            let offset = images.start - shard.first;
            let place = |len: usize| offset * len..(offset + n) * len;
            let (of_x, of_y) = (place(stage.input_len(self.network)), place(stage.output_len(self.network)));
            let (params, pass) = (self.params(index), self.pass(index, images.start));
            let replaces = stage.source.filter(|_| replaces_input(self.network, &self.plan.stages, index));
            // No stage needs the gradient of the images, or of the outputs before the first stage that learns.
            let wanted = stage.source.filter(|source| *source >= self.plan.first_learning);
            self.plan.times.stages[index][1].time(|| match &stage.kind {
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
                    fused.backward(params, n, pair, &shard.buffers.argmax[index][of_y], dx, grads);
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

    /// Adds the forward sums of the barrier over `images` to the shard's.
    pub fn forward_sums(&self, stage: usize, barrier: &dyn BatchStatistics, shard: &mut Shard, images: Range<usize>) {
        let x = self.stage_input(stage, &shard.buffers.activations, shard.first, images.clone());
        let sums = &mut shard.group_sums[..barrier.sums_len()];
        self.plan.times.stages[stage][0].time(|| barrier.forward_sums(images.len(), x, sums));
        shard.add_group_sums(barrier.sums_len());
    }

    /// Adds the backward sums of the barrier over `images` to the shard's.
    pub fn backward_sums(&self, index: usize, barrier: &dyn BatchStatistics, shard: &mut Shard, images: Range<usize>) {
        let stage = &self.plan.stages[index];
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
        self.plan.times.stages[index][1].time(|| match &stage.kind {
            Kind::Layer | Kind::PooledConv(_) => barrier.backward_sums(moments, n, x, dy, sums, dparams),
            Kind::NormRectify(fused) => fused.backward_sums(self.params(index), moments, x, dy, sums, dparams),
        });
        shard.add_group_sums(barrier.sums_len());
    }
}
