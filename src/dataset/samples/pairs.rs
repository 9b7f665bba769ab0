//! Pairs inside the batches of training, for the smoothness terms of the loss.
//!
//! A batch begins with its spatial pairs, each an image twice under two augmentations, then come its temporal pairs, each an image and
//! its neighbour in time under one augmentation, then single images. The batches of an epoch are as many and as large as without pairs:
//! the images at the end of its random order make room for the partners.

use std::collections::BTreeMap;

use super::Item;
use crate::dataset::recording::{Recording, View};
use crate::engine::loss::{Pairs, Smoothness};

/// Longest time between neighbouring frames, ms: recordings of 4 Hz or more have neighbours.
const MAX_GAP_MS: i64 = 250;

/// A sample that a batch is to hold.
#[derive(Debug, Clone, Copy)]
pub(super) struct Wanted {
    /// Number of the sample in the loader.
    pub sample: u32,
    /// The sample whose random numbers it takes, for mirror and augmentation.
    pub draws: u32,
    /// Whether the augmentation is drawn a second time.
    pub again: bool,
    /// Whether it could be decoded.
    pub decoded: bool,
}

impl Wanted {
    pub fn single(sample: u32) -> Wanted {
        Wanted { sample, draws: sample, again: false, decoded: false }
    }
}

/// How a loader makes pairs.
#[derive(Debug)]
pub(super) struct Pairing {
    /// Pairs of a full batch.
    pub pairs: Pairs,
    /// The neighbour in time of each image, from the same camera.
    neighbours: Vec<Option<u32>>,
}

impl Pairing {
    /// Pairs for batches of `batch` among `images`, each an item and a camera.
    pub fn new(
        smoothness: &Smoothness,
        batch: usize,
        recordings: &[Recording],
        items: &[Item],
        images: &[(u32, View)],
    ) -> Pairing {
        let place = |(item, camera): (u32, View)| {
            let Item { recording, row, .. } = items[item as usize];
            (recording, row, camera as u8)
        };
        let known: BTreeMap<_, u32> = images.iter().map(|image| place(*image)).zip(0..).collect();
        let neighbour = |image: &(u32, View)| {
            let (number, row, camera) = place(*image);
            let Recording { rows, sessions, .. } = &recordings[usize::from(number)];
            let session = sessions.iter().find(|session| session.contains(&(row as usize)))?;
            let time_ms = rows[row as usize].time_ms;
            let near = |other: &usize| (rows[*other].time_ms - time_ms).abs() <= MAX_GAP_MS;
            let image_of = |other: usize| known.get(&(number, other as u32, camera)).copied();
            let after = (row as usize + 1..session.end).take_while(near).find_map(image_of);
            after.or_else(|| (session.start..row as usize).rev().take_while(near).find_map(image_of))
        };
        Pairing { pairs: smoothness.pairs(batch), neighbours: images.iter().map(neighbour).collect() }
    }

    /// Number of images that have a neighbour.
    pub fn with_neighbour(&self) -> usize {
        self.neighbours.iter().flatten().count()
    }

    /// Samples of a batch of `batch` that are drawn from the order of the epoch; the others are their partners.
    pub fn leaders(&self, batch: usize) -> usize {
        batch - self.pairs.images() / 2
    }

    /// Lays out the batch of `leaders`, samples of `variants` an image, in `work`, and returns the pairs in it.
    pub fn lay_out(&self, leaders: &[u32], variants: u32, work: &mut Vec<Wanted>) -> Pairs {
        let (twice, rest) = leaders.split_at(self.pairs.spatial.min(leaders.len()));
        for &sample in twice {
            work.push(Wanted::single(sample));
            work.push(Wanted { again: true, ..Wanted::single(sample) });
        }
        let partner = |sample: u32| {
            let neighbour = self.neighbours[(sample / variants) as usize]?;
            Some(Wanted { draws: sample, ..Wanted::single(neighbour * variants + sample % variants) })
        };
        let mut temporal = 0;
        for &sample in rest {
            if let Some(partner) = partner(sample).filter(|_| temporal < self.pairs.temporal) {
                work.push(Wanted::single(sample));
                work.push(partner);
                temporal += 1;
            }
        }
        let mut paired = 0;
        for &sample in rest {
            if paired < temporal && partner(sample).is_some() {
                paired += 1;
            } else {
                work.push(Wanted::single(sample));
            }
        }
        Pairs { spatial: twice.len(), temporal }
    }
}
