//! Training and validation rows, chosen before anything is augmented.
//!
//! Neighbouring frames of a drive are almost the same picture. A split by single rows therefore leaks: nearly every
//! validation frame has a twin among the training frames, and the validation loss says little about new road. The
//! default, `blocks`, holds out contiguous stretches of time with a guard of a second on both sides.

use super::{Balance, Item, SampleSpec, Targets};
use crate::dataset::recording::{Recording, View};
use crate::engine::random::{Purpose, rng, shuffle};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::ops::Range;

mod blocks;

/// Sessions of at least this length, in seconds, are cut; shorter ones go whole to one side.
pub const LONG_SESSION_S: f64 = 60.0;
/// Rows this near to a held-out row, in milliseconds, are used on neither side.
pub const GUARD_MS: i64 = 1000;
/// How validation rows are chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SplitMode {
    /// Contiguous blocks of time: in each session of at least 60 s, one block in each of as many equal periods as
    /// whole minutes fit, at a random place of its period.
    #[default]
    Blocks,
    /// Single rows. Leaks; to reproduce the past.
    Random,
    /// Single images, so that even the cameras of one instant fall on both sides. Leaks; to reproduce the second
    /// write-up.
    RandomImages,
}

impl SplitMode {
    /// Whether validation frames have near twins among the training frames.
    pub fn leaks(self) -> bool {
        self != SplitMode::Blocks
    }

    /// Name in recipes.
    pub fn name(self) -> &'static str {
        match self {
            SplitMode::Blocks => "blocks",
            SplitMode::Random => "random",
            SplitMode::RandomImages => "random-images",
        }
    }
}

/// The `[split]` table of a recipe.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SplitSpec {
    /// How validation rows are chosen.
    pub mode: SplitMode,
    /// Share of the rows (images with `random-images`) that is held out; 0 holds out nothing.
    pub validation_share: f64,
}

impl Default for SplitSpec {
    fn default() -> Self {
        Self { mode: SplitMode::Blocks, validation_share: 0.2 }
    }
}

impl SplitSpec {
    /// Checks the numbers.
    ///
    /// # Errors
    /// [`Error::Usage`] naming the key.
    pub fn validate(&self) -> Result<()> {
        if (0.0..=0.9).contains(&self.validation_share) {
            return Ok(());
        }
        Err(Error::Usage(format!("[split] validation_share: must be 0 to 0.9, found {}", self.validation_share)))
    }
}

/// The two sides of a split, in the order of the recordings.
#[derive(Debug, Clone, PartialEq)]
pub struct Split {
    /// How it was made.
    pub spec: SplitSpec,
    /// Whether the sides are whole recordings instead; see [`split_whole`](super::whole::split_whole).
    pub whole: bool,
    /// Training rows.
    pub training: Vec<Item>,
    /// How often each of them counts in an epoch; each once if this is empty.
    pub times: Vec<u32>,
    /// Rows of the simulator's set, of which each epoch draws some.
    pub simulator: Vec<Item>,
    /// Validation rows.
    pub validation: Vec<Item>,
    /// Rows next to validation blocks, used on neither side.
    pub guard_rows: usize,
    /// Rows left out for their throttle.
    pub low_throttle_rows: usize,
    /// Rows left out because the driven path does not say how to steer.
    pub unlabelled_rows: usize,
    /// Whether some of them are without because their recording lacks a label beside the steering.
    pub unrecorded: bool,
    /// Rows left out to balance the labels.
    pub balanced_rows: usize,
    /// What the reader should know.
    pub notices: Vec<String>,
}

/// Splits the usable rows of `recordings`, whose labels are `targets`.
///
/// # Errors
/// If a table is wrong, or if one of the sides would be empty.
pub fn split(
    recordings: &[Recording],
    targets: &Targets,
    spec: &SplitSpec,
    samples: &SampleSpec,
    balance: &Balance,
    seed: u64,
) -> Result<Split> {
    spec.validate()?;
    samples.validate()?;
    balance.validate()?;
    refuse_too_many(recordings)?;
    let mut split = Split {
        spec: spec.clone(),
        whole: false,
        training: Vec::new(),
        times: Vec::new(),
        simulator: Vec::new(),
        validation: Vec::new(),
        guard_rows: 0,
        low_throttle_rows: 0,
        unlabelled_rows: 0,
        unrecorded: targets.unrecorded(),
        balanced_rows: 0,
        notices: Vec::new(),
    };
    match spec.mode {
        SplitMode::Blocks => split.by_blocks(recordings, seed),
        SplitMode::Random => split.by_rows(recordings, targets, samples, seed),
        SplitMode::RandomImages => split.by_images(recordings, targets, samples, balance, seed),
    }
    if spec.mode == SplitMode::Blocks {
        split.low_throttle_rows = [&mut split.training, &mut split.validation]
            .map(|side| drop_low_throttle(side, recordings, samples))
            .iter()
            .sum();
        split.unlabelled_rows =
            [&mut split.training, &mut split.validation].map(|side| drop_unlabelled(side, targets)).iter().sum();
    }
    if spec.mode != SplitMode::RandomImages {
        split.balanced_rows = balance.apply(&mut split.training, targets, seed);
        set_cameras(&mut split.training, recordings, samples.side_cameras.is_some());
    }
    let validate_sides = samples.side_cameras.is_some() && samples.validation_side_cameras;
    if spec.mode != SplitMode::RandomImages {
        set_cameras(&mut split.validation, recordings, validate_sides);
    } else if !validate_sides {
        split.validation.retain_mut(|item| {
            let centre = item.cameras().any(|camera| camera == View::Centre);
            *item = Item::new(item.recording, item.row, [View::Centre]);
            centre
        });
    }
    if spec.mode.leaks() {
        let name = spec.mode.name();
        split.notices.push(format!(
            "split `{name}` leaks: validation frames have near twins among the training frames, so the validation loss \
             is too good"
        ));
    }
    split.require_both_sides()?;
    Ok(split)
}

impl Split {
    /// The split in words, one fact a line.
    pub fn summary(&self) -> String {
        let images = |side: &[Item]| side.iter().map(|item| item.cameras().count()).sum::<usize>();
        let mut lines = vec![format!(
            "split {}: {} training rows ({} images), {} validation rows ({} images)",
            if self.whole { "by recording" } else { self.spec.mode.name() },
            self.training.len(),
            images(&self.training),
            self.validation.len(),
            images(&self.validation)
        )];
        let unlabelled = match self.unrecorded {
            false => "left out because the car stands or its session ends, so that no path lies ahead",
            true => "left out because a label was not recorded, or the car stands or its session ends",
        };
        for (rows, why) in [
            (self.guard_rows, "within 1 s of a validation block, used on neither side"),
            (self.low_throttle_rows, "left out for low throttle"),
            (self.unlabelled_rows, unlabelled),
            (self.balanced_rows, "left out to balance the labels"),
        ] {
            if rows > 0 {
                lines.push(format!("{rows} rows {why}"));
            }
        }
        lines.extend(self.notices.iter().cloned());
        lines.join("\n")
    }

    /// Adds all rows of `recordings` from number `first` on to the training side, the centre camera alone: views that a model met,
    /// each with the steering that leads back.
    ///
    /// # Errors
    /// [`Error::Usage`] for too many recordings.
    pub fn train_on(&mut self, recordings: &[Recording], first: usize, targets: &Targets) -> Result<()> {
        let mut views = rows_from(recordings, first)?;
        // Only a label beside the steering can be missing: a view has been given its steering.
        self.unlabelled_rows += drop_unlabelled(&mut views, targets);
        if !views.is_empty() {
            self.notices.push(format!("{} views that a model met are trained on as well", views.len()));
        }
        self.training.extend(views);
        Ok(())
    }

    /// All rows that are trained on, those of the simulator last.
    pub fn trained_on(&self) -> impl Iterator<Item = &Item> {
        self.training.iter().chain(&self.simulator)
    }

    /// Takes the rows of `recordings` from number `first` on, whose labels are among `targets`, as those of the simulator's set.
    ///
    /// # Errors
    /// [`Error::Usage`] for too many recordings, [`Error::Data`] if no row is left.
    pub fn draw_from(
        &mut self,
        recordings: &[Recording],
        first: usize,
        targets: &Targets,
        samples: &SampleSpec,
        balance: &Balance,
        seed: u64,
    ) -> Result<()> {
        let mut rows = rows_from(recordings, first)?;
        drop_low_throttle(&mut rows, recordings, samples);
        drop_unlabelled(&mut rows, targets);
        balance.apply(&mut rows, targets, seed);
        set_cameras(&mut rows, recordings, samples.side_cameras.is_some());
        if rows.is_empty() {
            let message = "the recipe leaves out all of its rows".into();
            return Err(Error::Data { place: "the simulator's set".into(), message });
        }
        self.simulator = rows;
        Ok(())
    }

    fn require_both_sides(&self) -> Result<()> {
        if self.training.is_empty() {
            let message = "no training rows are left: record more, or leave out less".into();
            return Err(Error::Data { place: "the recordings".into(), message });
        }
        if self.validation.is_empty() && self.spec.validation_share > 0.0 {
            let message = "no validation rows: no session is longer than 10 s. Record a longer drive, set \
                           validation_share = 0, or use the (leaking) split mode `random`"
                .into();
            return Err(Error::Data { place: "the recordings".into(), message });
        }
        Ok(())
    }

    fn by_rows(&mut self, recordings: &[Recording], targets: &Targets, samples: &SampleSpec, seed: u64) {
        let mut rows = all_rows(recordings);
        self.low_throttle_rows = drop_low_throttle(&mut rows, recordings, samples);
        self.unlabelled_rows = drop_unlabelled(&mut rows, targets);
        shuffle(&mut rng(seed, Purpose::Split, 0, 0), &mut rows);
        self.training = rows.split_off((self.spec.validation_share * rows.len() as f64).round() as usize);
        self.validation = rows;
        self.training.sort_unstable();
        self.validation.sort_unstable();
    }

    fn by_images(
        &mut self,
        recordings: &[Recording],
        targets: &Targets,
        samples: &SampleSpec,
        balance: &Balance,
        seed: u64,
    ) {
        let mut rows = all_rows(recordings);
        self.low_throttle_rows = drop_low_throttle(&mut rows, recordings, samples);
        self.unlabelled_rows = drop_unlabelled(&mut rows, targets);
        self.balanced_rows = balance.apply(&mut rows, targets, seed);
        set_cameras(&mut rows, recordings, samples.side_cameras.is_some());
        let mut images: Vec<Item> = rows
            .iter()
            .flat_map(|&item| item.cameras().map(move |camera| Item::new(item.recording, item.row, [camera])))
            .collect();
        shuffle(&mut rng(seed, Purpose::Split, 0, 0), &mut images);
        let training = images.split_off((self.spec.validation_share * images.len() as f64).round() as usize);
        self.training = rows_of_images(training);
        self.validation = rows_of_images(images);
    }
}

/// Puts the cameras of a row that lie on the same side together again.
fn rows_of_images(mut images: Vec<Item>) -> Vec<Item> {
    images.sort_unstable();
    images
        .chunk_by(|a, b| (a.recording, a.row) == (b.recording, b.row))
        .map(|row| Item::new(row[0].recording, row[0].row, row.iter().flat_map(|item| item.cameras())))
        .collect()
}

fn rows_of(recording: u16, rows: Range<usize>) -> impl Iterator<Item = Item> {
    rows.map(move |row| Item::new(recording, row as u32, [View::Centre]))
}

/// Refuses more recordings than an [`Item`] can number.
pub(super) fn refuse_too_many(recordings: &[Recording]) -> Result<()> {
    match recordings.len() > usize::from(u16::MAX) {
        true => Err(Error::Usage("more than 65,535 recordings".into())),
        false => Ok(()),
    }
}

/// All rows of `recordings` from number `first` on.
fn rows_from(recordings: &[Recording], first: usize) -> Result<Vec<Item>> {
    refuse_too_many(recordings)?;
    Ok(all_rows(recordings).into_iter().filter(|item| usize::from(item.recording) >= first).collect())
}

pub(super) fn all_rows(recordings: &[Recording]) -> Vec<Item> {
    recordings.iter().enumerate().flat_map(|(i, recording)| rows_of(i as u16, 0..recording.rows.len())).collect()
}

pub(super) fn drop_low_throttle(items: &mut Vec<Item>, recordings: &[Recording], samples: &SampleSpec) -> usize {
    let before = items.len();
    if let Some(min) = samples.min_throttle {
        // Where the throttle was not recorded it is NaN, and the row stays.
        items.retain(|item| {
            let throttle = f64::from(recordings[usize::from(item.recording)].rows[item.row as usize].throttle);
            throttle.is_nan() || throttle > min
        });
    }
    before - items.len()
}

pub(super) fn drop_unlabelled(items: &mut Vec<Item>, targets: &Targets) -> usize {
    let before = items.len();
    items.retain(|item| targets.label(*item).is_some());
    before - items.len()
}

pub(super) fn set_cameras(items: &mut [Item], recordings: &[Recording], sides: bool) {
    for item in items {
        let recording = &recordings[usize::from(item.recording)];
        let used = |camera: &View| *camera == View::Centre || (sides && recording.row_has(item.row as usize, *camera));
        *item = Item::new(item.recording, item.row, View::ALL.into_iter().filter(used));
    }
}

#[cfg(test)]
mod tests;
