//! A batch: which samples it holds, and where they stand when others could not be decoded.

use super::Loader;
use crate::Result;
use crate::dataset::recording::View;
use crate::dataset::samples::pairs::Wanted;
use crate::dataset::samples::{Group, Item};
use crate::engine::loss::Pairs;
use std::ops::Range;

/// Which image a sample shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SampleId {
    /// Which recording.
    pub recording: u16,
    /// Which row of it.
    pub row: u32,
    /// Which camera.
    pub camera: View,
    /// Whether the image is mirrored, and the label negated.
    pub mirrored: bool,
}

/// Samples for one step. The buffers are reused from batch to batch.
#[derive(Debug, Clone, Default)]
pub struct Batch {
    /// Network input, `[share][c][h][w]`.
    pub x: Vec<f32>,
    /// Labels, `[share][outputs]`: steering with the corrections of camera and shift, + = right, not clamped; then the others of the row,
    /// as they are.
    pub labels: Vec<f32>,
    /// Which of its samples `x` and `labels` hold: all, unless other processes have a share of the batch.
    pub share: Range<usize>,
    /// Number of samples; less than asked for at the end of an epoch, and where images cannot be decoded.
    pub n: usize,
    /// Where each sample comes from, `[n]`.
    pub samples: Vec<SampleId>,
    /// The pairs among its first samples.
    pub pairs: Pairs,
    /// What it is to hold; kept to be used again.
    pub(super) work: Vec<Wanted>,
}

/// Which of so many samples are those of this process, if there are pairs among them or not.
pub type ShareOf<'a> = &'a dyn Fn(usize, bool) -> Range<usize>;

impl Loader {
    /// Fills `out` with batch number `batch` of the epoch. Allocates nothing once all images are cached and `out` has
    /// held a full batch.
    ///
    /// # Errors
    /// If the cache file fails. An image that cannot be decoded is no error: it is left out and counted.
    ///
    /// # Panics
    /// If there is no such batch.
    pub fn fill(&self, batch: usize, out: &mut Batch) -> Result<()> {
        let whole = |n: usize, _: bool| 0..n;
        let complete = self.fill_share(batch, out, &whole)?;
        self.settle(out, complete, &whole);
        Ok(())
    }

    /// The first half of [`fill`](Loader::fill), where this process has but a share of the batch: `share` says which of so many samples,
    /// with pairs among them or not. Answers whether all samples of the share could be decoded. [`settle`](Loader::settle) must follow.
    ///
    /// # Errors
    /// As [`fill`](Loader::fill).
    ///
    /// # Panics
    /// As [`fill`](Loader::fill).
    pub fn fill_share(&self, batch: usize, out: &mut Batch, share: ShareOf) -> Result<bool> {
        let per_batch = self.per_batch();
        let taken = &self.order[batch * per_batch..self.order.len().min((batch + 1) * per_batch)];
        let variants = self.variants() as u32;
        out.work.clear();
        out.pairs = Pairs::default();
        match (self.spec.samples.group, &self.pairing) {
            (Group::Images, None) => out.work.extend(taken.iter().map(|&sample| Wanted::single(sample))),
            (Group::Images, Some(pairing)) => out.pairs = pairing.lay_out(taken, variants, &mut out.work),
            (Group::Rows, _) => {
                for &item in taken {
                    let images = self.first_images[item as usize]..self.first_images[item as usize + 1];
                    out.work.extend((images.start * variants..images.end * variants).map(Wanted::single));
                }
            }
        }
        out.n = out.work.len();
        // Those of the others count as decoded until `settle` knows better.
        out.work.iter_mut().for_each(|wanted| wanted.decoded = true);
        out.share = share(out.n, out.pairs.images() > 0);
        self.make_samples(out)?;
        Ok(out.work[out.share.clone()].iter().all(|wanted| wanted.decoded))
    }

    /// Moves samples up to where others could not be decoded, and notes where the rest come from. A pair goes as a whole.
    pub(super) fn close_gaps(&self, out: &mut Batch) {
        let (len, outputs) = (self.spec.preprocessing.output_len(), self.targets.outputs());
        let mut n = 0;
        out.samples.clear();
        let whole = out.share == (0..out.n);
        let pairs = out.pairs;
        for i in 0..out.n {
            let Wanted { sample, draws, decoded, .. } = out.work[i];
            let is_paired = i < pairs.images();
            if !decoded || (is_paired && !out.work[i ^ 1].decoded) {
                let of_kind = if i < 2 * pairs.spatial { &mut out.pairs.spatial } else { &mut out.pairs.temporal };
                *of_kind -= usize::from(is_paired && i % 2 == 0);
                continue;
            }
            if n < i {
                out.x.copy_within(i * len..(i + 1) * len, n * len);
                out.labels.copy_within(i * outputs..(i + 1) * outputs, n * outputs);
            }
            let (item, camera) = self.images[sample as usize / self.variants()];
            let Item { recording, row, .. } = self.items[item as usize];
            out.samples.push(SampleId { recording, row, camera, mirrored: self.is_mirrored(draws) });
            n += 1;
        }
        out.n = n;
        if whole {
            out.share = 0..n;
            out.x.truncate(n * len);
            out.labels.truncate(n * outputs);
        }
    }
}
