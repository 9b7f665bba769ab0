//! The batch of one training step.

use std::ops::Range;

use ndarray::{ArrayView1, ArrayView4};

use crate::engine::loss::PairTerms;
use crate::engine::network::Network;

/// The batch of one training step.
///
/// Both arrays must be contiguous in standard (row-major) order: the step reads them where they lie, without a copy.
#[derive(Clone, Copy, Debug)]
pub struct StepInput<'a> {
    /// Images, `(n, c, h, w)`.
    pub x: ArrayView4<'a, f32>,
    /// Labels, `(n)`; for a network with several outputs `(n · outputs)`, image by image.
    pub labels: ArrayView1<'a, f32>,
    /// Seed of the run (for dropout).
    pub seed: u64,
    /// Number of the step, from 0 (for dropout).
    pub step: u64,
}

/// A [`StepInput`] whose shapes have been checked, as slices.
#[derive(Clone, Copy)]
pub(super) struct StepSlices<'a> {
    /// `[n][c][h][w]`.
    pub x: &'a [f32],
    /// `[n][outputs]`.
    pub labels: &'a [f32],
    pub seed: u64,
    pub step: u64,
    pub pairs: PairTerms,
    /// The image of the batch that comes first in `x`: not 0 where other processes have images before it.
    pub first: usize,
    /// Number of images of the whole batch.
    pub of: usize,
}

impl<'a> StepSlices<'a> {
    /// The `images` of the batch, `len` numbers each.
    pub fn images(&self, images: Range<usize>, len: usize) -> &'a [f32] {
        &self.x[(images.start - self.first) * len..(images.end - self.first) * len]
    }

    /// Their labels, `outputs` each.
    pub fn labels(&self, images: Range<usize>, outputs: usize) -> &'a [f32] {
        &self.labels[(images.start - self.first) * outputs..(images.end - self.first) * outputs]
    }
}

impl<'a> StepInput<'a> {
    /// The slices of a batch for `network`.
    ///
    /// # Panics
    ///
    /// Panics if a shape does not fit or an array is not contiguous in standard order.
    pub(super) fn slices(&self, network: &Network) -> StepSlices<'a> {
        let (x, n) = (network.image_slice(self.x), self.x.len_of(ndarray::Axis(0)));
        let labels = self.labels.to_slice().expect("labels must be contiguous");
        assert_eq!(labels.len(), n * network.output().len(), "labels for a batch of {n} images");
        StepSlices { x, labels, seed: self.seed, step: self.step, pairs: PairTerms::default(), first: 0, of: n }
    }
}
