//! Batches of which this process has but a share, and what the processes tell each other of pictures that cannot be decoded.

use super::{Batch, Loader, ShareOf, lock};
use crate::Result;
use rayon::prelude::*;
use std::ops::Range;

/// What a rank could not decode.
#[derive(Debug, serde::Serialize, serde::Deserialize)]
pub struct Losses {
    /// Numbers of samples in the batch.
    samples: Vec<usize>,
    /// Pictures of the side, with the reasons.
    pictures: Vec<(u32, String)>,
}

impl Loader {
    /// Makes all samples of `out` here, where not all could be decoded everywhere.
    ///
    /// # Errors
    /// As [`fill`](Loader::fill).
    pub fn make_whole(&self, out: &mut Batch) -> Result<()> {
        if out.share != (0..out.n) {
            out.share = 0..out.n;
            self.make_samples(out)?;
        }
        Ok(())
    }

    /// Which samples of the whole batch `out` this rank could not decode, and which pictures so far, with the reasons.
    pub fn losses(&self, out: &Batch) -> Losses {
        let lost = out.work.iter().enumerate().filter(|(_, wanted)| !wanted.decoded).map(|(sample, _)| sample);
        let pictures = lock(&self.undecodable).iter().map(|(picture, reason)| (*picture, reason.clone())).collect();
        Losses { samples: lost.collect(), pictures }
    }

    /// Leaves out of `out` what another rank could not decode.
    pub fn take_losses(&self, out: &mut Batch, losses: Losses) {
        for sample in losses.samples {
            if let Some(wanted) = out.work.get_mut(sample) {
                wanted.decoded = false;
            }
        }
        let mut undecodable = lock(&self.undecodable);
        for (picture, reason) in losses.pictures {
            undecodable.entry(picture).or_insert(reason);
        }
    }

    /// The second half of [`fill`](Loader::fill). `complete` says whether all ranks could decode all samples of their shares; if not, `out`
    /// has been [made whole](Loader::make_whole) and the losses of all ranks are known. What is left is closed up, and cut to the share.
    pub fn settle(&self, out: &mut Batch, complete: bool, share: ShareOf) {
        self.close_gaps(out);
        if complete {
            return;
        }
        out.share = share(out.n, out.pairs.images() > 0);
        let Range { start, end } = out.share;
        for (values, len) in
            [(&mut out.x, self.spec.preprocessing.output_len()), (&mut out.labels, self.targets.outputs())]
        {
            values.copy_within(start * len..end * len, 0);
            values.truncate((end - start) * len);
        }
    }

    /// Makes the samples of the share of `out`.
    pub(super) fn make_samples(&self, out: &mut Batch) -> Result<()> {
        let len = self.spec.preprocessing.output_len();
        out.x.resize(out.share.len() * len, 0.0);
        let outputs = self.targets.outputs();
        out.labels.resize(out.share.len() * outputs, 0.0);
        let labels = out.labels.par_chunks_exact_mut(outputs);
        let samples = out.x.par_chunks_exact_mut(len).zip(labels).zip(&mut out.work[out.share.clone()]);
        samples.try_for_each(|((x, labels), wanted)| -> Result<()> {
            wanted.decoded = self.with_scratch(|scratch| self.make_sample(wanted, x, labels, scratch))??;
            Ok(())
        })
    }
}
