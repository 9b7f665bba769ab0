//! A shard of the batch of a training step, and the buffers it works in.

use std::ops::Range;
use std::sync::{Mutex, MutexGuard, PoisonError};

use steersman_kernels::{Isa, update};

use crate::engine::network::Network;

/// A part of the batch with a gradient of its own, worked on by one thread at a time.
#[derive(Debug)]
pub(super) struct Shard {
    /// Which images of the batch.
    pub images: Range<usize>,
    /// Empty between the steps of a network without a barrier.
    pub buffers: Buffers,
    /// Empty while the shard is not worked on.
    pub scratch: Vec<f32>,
    /// The image whose activations come first in the buffers.
    pub first: usize,
    /// Empty unless it holds the gradient of this shard, or of a subtree that begins with it.
    pub gradient: Vec<f32>,
    pub sums: Vec<f64>,
    /// The same of the images that are being worked on.
    pub group_sums: Vec<f64>,
    /// Sum of the losses of all images.
    pub loss: f64,
    /// Of the parameters, those whose gradient is being computed.
    pub learning: Range<usize>,
}

/// The activations and gradients of a shard. In a network with a barrier each shard keeps its own, because they outlive the barrier;
/// without one a shard hands them on when its images are done.
#[derive(Debug, Default)]
pub(super) struct Buffers {
    /// Output of each stage.
    pub activations: Vec<Vec<f32>>,
    /// Argmax indices of each stage that is a pooled convolution; empty for the others.
    pub argmax: Vec<Vec<u32>>,
    /// Gradient with respect to the current stage's output, and to its input.
    pub d_output: Vec<f32>,
    pub d_input: Vec<f32>,
    /// Whether the gradient with respect to the current stage's output has taken the place of that output instead.
    pub in_place: bool,
}

/// Buffers that no shard uses, last in, first out: threads touch no more of them than there are threads, and find them in the
/// cache.
#[derive(Debug)]
pub(super) struct Spare<T>(Mutex<Vec<T>>);

impl<T> Spare<T> {
    pub fn new(items: Vec<T>) -> Spare<T> {
        Spare(Mutex::new(items))
    }

    pub fn take(&self) -> T {
        self.items().pop().expect("there are as many as shards")
    }

    pub fn put(&self, item: T) {
        self.items().push(item);
    }

    fn items(&self) -> MutexGuard<'_, Vec<T>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Shard {
    /// Takes a gradient, unless it has one, and sets that of the parameters `learning` to 0.
    pub fn begin_gradient(&mut self, spare_gradients: &Spare<Vec<f32>>, learning: Range<usize>) {
        if self.gradient.is_empty() {
            self.gradient = spare_gradients.take();
        }
        self.gradient[learning.clone()].fill(0.0);
        self.learning = learning;
    }

    /// Adds the gradient of the next shards to this one's, and gives their buffer back.
    pub fn add_gradient(&mut self, next: &mut Shard, isa: Isa, spare_gradients: &Spare<Vec<f32>>) {
        let learning = self.learning.clone();
        update::sum_into(isa, &mut self.gradient[learning.clone()], &next.gradient[learning]);
        spare_gradients.put(std::mem::take(&mut next.gradient));
    }

    /// Adds the first `len` batch-norm sums of the next shards to this one's.
    pub fn add_sums(&mut self, next: &Shard, len: usize) {
        for (sum, next) in self.sums[..len].iter_mut().zip(&next.sums) {
            *sum += next;
        }
    }

    /// Takes scratch for the images between two barriers.
    pub fn begin_segment(&mut self, spare_scratch: &Spare<Vec<f32>>) {
        self.scratch = spare_scratch.take();
        self.first = self.images.start;
        self.sums.fill(0.0);
    }

    /// Adds the sums of a group.
    pub fn add_group_sums(&mut self, len: usize) {
        for (sum, group) in self.sums[..len].iter_mut().zip(&self.group_sums) {
            *sum += group;
        }
    }

    /// Number of images that the activations have room for.
    pub fn group_capacity(&self, network: &Network) -> usize {
        self.buffers.activations.last().map_or(self.images.len(), |last| last.len() / network.output().len()).max(1)
    }

    /// Output of stage `stage` and of its source, which comes before it.
    pub fn source_and_output(&mut self, stage: usize, source: usize) -> (&mut [f32], &mut [f32]) {
        let (before, from_here) = self.buffers.activations.split_at_mut(stage);
        (&mut before[source], &mut from_here[0])
    }
}

/// `images`, `group` at a time.
pub(super) fn groups(images: Range<usize>, group: usize) -> impl Iterator<Item = Range<usize>> {
    images.clone().step_by(group).map(move |start| start..(start + group).min(images.end))
}
