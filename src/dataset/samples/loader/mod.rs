//! Batches for training and validation: decoded once, cached, augmented, ready for the network.
//!
//! [`Loader::fill`] makes one batch on the threads of the rayon pool it is called from, so it can run beside the training
//! step of the batch before (`rayon::join`). What a batch holds depends on the seed, the epoch and its number, not on
//! threads, cache or order of calls.

use super::augment::Augmentation;
use super::leak::{Thumbnail, compared_every};
use super::pairs::Pairing;
use super::split::Split;
use super::{Flip, Group, Item, Mirror, SampleSpec, Targets};
use crate::dataset::pictures::cache::{CacheSpec, ImageCache};
use crate::dataset::pictures::preprocess::Preprocessing;
use crate::dataset::recording::{Recording, View};
use crate::engine::loss::Smoothness;
use crate::engine::random::{Purpose, rng, shuffle, unit};
use crate::engine::stopwatch::Stopwatch;
use crate::{Error, Result};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

mod audit;
mod batch;
mod sample;
mod share;

pub use batch::{Batch, SampleId, ShareOf};
pub use share::Losses;

use sample::Scratch;

/// Everything that decides what batches look like.
#[derive(Debug, Clone, PartialEq)]
pub struct LoaderSpec {
    /// From image to network input.
    pub preprocessing: Preprocessing,
    /// Cameras and mirrors.
    pub samples: SampleSpec,
    /// Random changes to training images.
    pub augmentation: Augmentation,
    /// Images in a batch. With [`Group::Rows`] a batch holds as many whole rows as fit, at least one.
    pub batch: usize,
    /// Seed of the run.
    pub seed: u64,
    /// How much is kept, and where.
    pub cache: CacheSpec,
}

/// Makes the batches of one side of a split.
#[derive(Debug)]
pub struct Loader {
    recordings: Arc<[Recording]>,
    targets: Arc<Targets>,
    spec: LoaderSpec,
    /// Only the training side shuffles, mirrors at random and augments.
    training: bool,
    flip: Flip,
    /// The rows of the side, as often as each counts; then those of the simulator.
    items: Vec<Item>,
    /// Each image: its item and camera. Images of an item stand together.
    images: Vec<(u32, View)>,
    /// The picture of each image: images of the same row and camera have the same one.
    pictures: Vec<u32>,
    /// First image of each item, and their number at the end.
    first_images: Vec<u32>,
    /// What is the side's own.
    own: Counts,
    /// Samples or items of the simulator that are drawn in each epoch, among all of them.
    drawn: usize,
    pool: Vec<u32>,
    /// What is taken in this order: samples, or items with [`Group::Rows`].
    order: Vec<u32>,
    pairing: Option<Pairing>,
    epoch: u64,
    cache: ImageCache,
    /// One row in how many the audit of near twins looks at.
    compared_every: usize,
    /// Of each picture that was decoded: what the audit compares, if it is the centre camera's.
    thumbnails: Vec<OnceLock<Option<Thumbnail>>>,
    undecodable: Mutex<BTreeMap<u32, String>>,
    scratch: Mutex<Vec<Scratch>>,
    times: LoaderTimes,
}

/// A part of a side.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Counts {
    items: usize,
    images: usize,
    pictures: usize,
}

/// The rows that a loader shows.
#[derive(Clone, Copy)]
struct Rows<'a> {
    own: &'a [Item],
    /// How often each of them counts; once if there is nothing.
    times: &'a [u32],
    simulator: &'a [Item],
}

/// Where the time of making samples goes, summed over threads; nothing is measured by default.
#[derive(Debug, Clone, Default)]
pub struct LoaderTimes {
    /// Reading and decoding files.
    pub decode: Stopwatch,
    /// Crop, size, colour, scaling, mirroring.
    pub preprocess: Stopwatch,
    /// Random changes.
    pub augment: Stopwatch,
}

impl Loader {
    /// Loaders of both sides of `split`, whose labels are `targets`; they share the memory budget in proportion to what they hold.
    ///
    /// # Errors
    /// If a table of `spec` is wrong, or if the cache file cannot be created.
    pub fn pair(
        recordings: &Arc<[Recording]>,
        targets: &Arc<Targets>,
        split: &Split,
        spec: &LoaderSpec,
    ) -> Result<(Loader, Loader)> {
        let bytes = |training: bool, flip: Flip, items: &[Item]| {
            let images: usize = items.iter().map(|item| item.cameras().count()).sum();
            images * cached_len(spec, training, flip)
        };
        let (training, validation) = (
            bytes(true, spec.samples.flip, &split.training) + bytes(true, spec.samples.flip, &split.simulator),
            bytes(false, validation_flip(&spec.samples), &split.validation),
        );
        let share = training as f64 / (training + validation).max(1) as f64;
        let for_training = ((spec.cache.memory_bytes as f64 * share) as usize).min(spec.cache.memory_bytes);
        let with =
            |memory_bytes| LoaderSpec { cache: CacheSpec { memory_bytes, ..spec.cache.clone() }, ..spec.clone() };
        Ok((
            Loader::training(recordings, targets, split, &with(for_training))?,
            Loader::validation(recordings, targets, split, &with(spec.cache.memory_bytes - for_training))?,
        ))
    }

    /// The training side: shuffled in every epoch, mirrored and augmented as `spec` says. Of the simulator's rows each epoch shows so
    /// many that they are the share of it that `spec` says, or all of them.
    ///
    /// # Errors
    /// As [`Loader::pair`].
    pub fn training(
        recordings: &Arc<[Recording]>,
        targets: &Arc<Targets>,
        split: &Split,
        spec: &LoaderSpec,
    ) -> Result<Loader> {
        let rows = Rows { own: &split.training, times: &split.times, simulator: &split.simulator };
        Self::new(recordings, targets, rows, spec, true, spec.samples.flip)
    }

    /// The validation side: in the order of the log, never augmented.
    ///
    /// # Errors
    /// As [`Loader::pair`].
    pub fn validation(
        recordings: &Arc<[Recording]>,
        targets: &Arc<Targets>,
        split: &Split,
        spec: &LoaderSpec,
    ) -> Result<Loader> {
        let rows = Rows { own: &split.validation, times: &[], simulator: &[] };
        Self::new(recordings, targets, rows, spec, false, validation_flip(&spec.samples))
    }

    fn new(
        recordings: &Arc<[Recording]>,
        targets: &Arc<Targets>,
        rows: Rows,
        spec: &LoaderSpec,
        training: bool,
        flip: Flip,
    ) -> Result<Loader> {
        spec.preprocessing.validate()?;
        spec.samples.validate()?;
        spec.augmentation.validate()?;
        if spec.batch == 0 {
            return Err(Error::Usage("a batch must hold at least one image".into()));
        }
        let (mut items, mut images, mut pictures, mut first_images) = (Vec::new(), Vec::new(), Vec::new(), vec![0]);
        let mut known = 0;
        let mut add = |item: Item, times: u32| {
            for _ in 0..times {
                let number = items.len() as u32;
                images.extend(item.cameras().map(|camera| (number, camera)));
                pictures.extend((known..).take(item.cameras().count()));
                first_images.push(images.len() as u32);
                items.push(item);
            }
            known += item.cameras().count() as u32;
            Counts { items: items.len(), images: images.len(), pictures: known as usize }
        };
        let mut own = Counts { items: 0, images: 0, pictures: 0 };
        for (i, item) in rows.own.iter().enumerate() {
            own = add(*item, rows.times.get(i).copied().unwrap_or(1));
        }
        let all = rows.simulator.iter().fold(own, |_, item| add(*item, 1));
        let mut loader = Loader {
            recordings: Arc::clone(recordings),
            targets: Arc::clone(targets),
            training,
            flip,
            cache: ImageCache::new(all.pictures, cached_len(spec, training, flip), &spec.cache)?,
            compared_every: compared_every(items.len()),
            thumbnails: (0..all.pictures).map(|_| OnceLock::new()).collect(),
            items,
            images,
            pictures,
            first_images,
            own,
            drawn: 0,
            pool: Vec::new(),
            order: Vec::new(),
            pairing: None,
            epoch: 0,
            undecodable: Mutex::default(),
            scratch: Mutex::default(),
            times: LoaderTimes::default(),
            spec: spec.clone(),
        };
        let ratio = spec.samples.simulator_share / (1.0 - spec.samples.simulator_share);
        let own = loader.entries(loader.own);
        loader.drawn = ((ratio * own as f64).round() as usize).min(loader.entries(all) - own);
        loader.begin_epoch(0);
        Ok(loader)
    }

    /// Lets batches hold the pairs of `smoothness` from now on. Returns the number of images that have a neighbour in time.
    ///
    /// # Panics
    /// If whole rows are grouped.
    pub fn pair_up(&mut self, smoothness: &Smoothness) -> usize {
        assert!(self.spec.samples.group == Group::Images, "pairs are made of single images");
        let pairing = Pairing::new(smoothness, self.spec.batch, &self.recordings, &self.items, &self.images);
        self.pairing.insert(pairing).with_neighbour()
    }

    /// Adds the time that samples take from now on to `times`.
    pub fn measure(&mut self, times: &LoaderTimes) {
        self.times = times.clone();
    }

    /// Number of different images, mirrors not counted.
    pub fn images(&self) -> usize {
        self.thumbnails.len()
    }

    /// Number of samples in an epoch: images as often as they count, twice if each is also mirrored.
    pub fn samples(&self) -> usize {
        let own = self.own.images * self.variants();
        match self.spec.samples.group {
            Group::Images => own + self.drawn,
            // Rows may have one camera or three.
            Group::Rows => {
                let of_simulator = (self.images.len() - self.own.images) * self.variants();
                own + self.drawn * of_simulator / self.simulator_items().max(1)
            }
        }
    }

    /// Number of samples of the simulator in an epoch.
    pub fn simulator_samples(&self) -> usize {
        self.samples() - self.own.images * self.variants()
    }

    fn simulator_items(&self) -> usize {
        self.items.len() - self.own.items
    }

    /// How many entries of `order` show `part`, each once.
    fn entries(&self, part: Counts) -> usize {
        match self.spec.samples.group {
            Group::Images => part.images * self.variants(),
            Group::Rows => part.items,
        }
    }

    /// Number of batches in an epoch.
    pub fn batches(&self) -> usize {
        // With pairs, an epoch has as many batches as without.
        let per_batch = if self.pairing.is_some() { self.spec.batch } else { self.per_batch() };
        self.order.len().div_ceil(per_batch)
    }

    /// Shape of a sample: channels, height, width.
    pub fn shape(&self) -> [usize; 3] {
        self.spec.preprocessing.output()
    }

    /// Sets the order of the samples and the random choices of `epoch`.
    pub fn begin_epoch(&mut self, epoch: u32) {
        self.epoch = u64::from(epoch);
        let own = self.entries(self.own);
        self.order.clear();
        self.order.extend(0..own as u32);
        if self.drawn > 0 {
            let all = Counts { items: self.items.len(), images: self.images.len(), pictures: self.thumbnails.len() };
            self.pool.clear();
            self.pool.extend(own as u32..self.entries(all) as u32);
            // Stream 1: the order of the epoch is drawn from stream 0.
            shuffle(&mut rng(self.spec.seed, Purpose::Shuffle, self.epoch, 1), &mut self.pool);
            self.order.extend_from_slice(&self.pool[..self.drawn]);
        }
        if self.training {
            shuffle(&mut rng(self.spec.seed, Purpose::Shuffle, self.epoch, 0), &mut self.order);
        }
    }

    /// Images that could not be decoded so far: their number, and the first few with their paths.
    pub fn undecodable(&self) -> (usize, Vec<String>) {
        let undecodable = lock(&self.undecodable);
        (undecodable.len(), undecodable.values().take(3).cloned().collect())
    }

    /// Whether more than a fifth of the images could not be decoded so far, of the side's own ones or of the simulator's.
    pub fn has_decayed(&self) -> bool {
        let undecodable = lock(&self.undecodable);
        let own = undecodable.range(..self.own.pictures as u32).count();
        let simulator = undecodable.len() - own;
        own * 5 > self.own.pictures || simulator * 5 > self.thumbnails.len() - self.own.pictures
    }

    /// Number of samples in an epoch without the images that could not be decoded so far.
    pub fn samples_used(&self) -> usize {
        let undecodable = lock(&self.undecodable);
        let lost = self.pictures[..self.own.images].iter().filter(|picture| undecodable.contains_key(picture)).count();
        self.samples() - lost * self.variants()
    }

    fn variants(&self) -> usize {
        if self.flip == Flip::Both { 2 } else { 1 }
    }

    /// How many entries of `order` make a batch.
    fn per_batch(&self) -> usize {
        match self.spec.samples.group {
            Group::Images => self.pairing.as_ref().map_or(self.spec.batch, |pairing| pairing.leaders(self.spec.batch)),
            Group::Rows => {
                let cameras = self.first_images.windows(2).map(|pair| pair[1] - pair[0]).max().unwrap_or(1);
                (self.spec.batch / (cameras as usize * self.variants()).max(1)).max(1)
            }
        }
    }

    /// Whether a sample that takes the random numbers of `sample` is mirrored.
    fn is_mirrored(&self, sample: u32) -> bool {
        match self.flip {
            Flip::None => false,
            Flip::Both => sample % 2 == 1,
            Flip::Random => unit(&mut rng(self.spec.seed, Purpose::Mirror, self.epoch, u64::from(sample))) < 0.5,
        }
    }
}

/// Whether images are cached at the RGB stage, because they are augmented in each epoch or mirrored with geometry.
fn keeps_rgb(spec: &LoaderSpec, training: bool, flip: Flip) -> bool {
    (training && spec.augmentation.is_active()) || (flip != Flip::None && spec.samples.mirror == Mirror::Geometry)
}

/// Bytes of a cached image.
fn cached_len(spec: &LoaderSpec, training: bool, flip: Flip) -> usize {
    if keeps_rgb(spec, training, flip) { spec.preprocessing.rgb_len() } else { spec.preprocessing.output_len() }
}

/// How the validation side is mirrored.
fn validation_flip(samples: &SampleSpec) -> Flip {
    if samples.validation_flips { Flip::Both } else { Flip::None }
}

/// Every state of the guarded data is whole, so a thread that died with the lock does no harm.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests;
