//! Which images of a row are used, and which rows: the `[samples]`, `[balance]` and `[split]` tables of a recipe.

use super::recording::{Camera, Recording};
use crate::engine::random::{Purpose, rng, shuffle};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};

/// Whether images are mirrored. A mirrored image has the negated label.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Flip {
    /// Never.
    #[default]
    None,
    /// Each image and its mirror are two samples.
    Both,
    /// Each image is mirrored with probability 1/2, anew in every epoch.
    Random,
}

/// What is shuffled.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Group {
    /// Single samples.
    #[default]
    Images,
    /// Rows: all cameras and mirrors of a row stay in one batch, as in the first write-up.
    Rows,
}

/// The `[samples]` table of a recipe.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SampleSpec {
    /// Steering added to the label of the left camera and taken from the label of the right one, in the unit of the
    /// labels. The sum is not clamped. Without it, only the centre camera is used.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub side_cameras: Option<f64>,
    /// Mirroring of training images.
    pub flip: Flip,
    /// Rows with this throttle or less are left out, on both sides of the split.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub min_throttle: Option<f64>,
    /// What is shuffled.
    pub group: Group,
    /// Validate on the side cameras as well.
    pub validation_side_cameras: bool,
    /// Validate on the mirror of each image as well.
    pub validation_flips: bool,
}

impl SampleSpec {
    /// Checks the numbers.
    ///
    /// # Errors
    /// [`Error::Usage`] naming the key.
    pub fn validate(&self) -> Result<()> {
        if self.side_cameras.is_some_and(|x| !(0.0..=1.0).contains(&x)) {
            return Err(Error::Usage("[samples] side_cameras: must be 0 to 1 (full lock)".into()));
        }
        if self.min_throttle.is_some_and(|x| !x.is_finite()) {
            return Err(Error::Usage("[samples] min_throttle: must be a finite number".into()));
        }
        Ok(())
    }

    /// The label of an image, before it is mirrored: the steering of the row with the correction of the camera.
    pub fn label(&self, steering: f32, camera: Camera) -> f32 {
        steering + camera.correction_sign() * self.side_cameras.unwrap_or(0.0) as f32
    }
}

/// The `[balance]` table of a recipe: fewer rows of the steering values that are too common.
///
/// Which rows are kept is drawn once a run. Only training rows are left out, except that with the split
/// `random-images` it happens before the split, as in the second write-up.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Balance {
    /// Share kept of the rows whose steering is exactly 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub keep_zero: Option<f64>,
    /// Number of equally wide steering bins from -1 to 1; goes with `histogram_max`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub histogram_bins: Option<usize>,
    /// Most rows kept in each bin.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub histogram_max: Option<usize>,
}

impl Balance {
    /// Checks the numbers.
    ///
    /// # Errors
    /// [`Error::Usage`] naming the key.
    pub fn validate(&self) -> Result<()> {
        if self.keep_zero.is_some_and(|x| !(0.0..=1.0).contains(&x)) {
            return Err(Error::Usage("[balance] keep_zero: must be 0 to 1".into()));
        }
        if self.histogram_bins.is_some() != self.histogram_max.is_some() {
            return Err(Error::Usage("[balance] histogram_bins and histogram_max go together".into()));
        }
        if self.histogram_bins.is_some_and(|bins| !(1..=10_000).contains(&bins)) {
            return Err(Error::Usage("[balance] histogram_bins: must be 1 to 10000".into()));
        }
        Ok(())
    }

    /// Leaves out items; returns how many.
    pub(super) fn apply(&self, items: &mut Vec<Item>, recordings: &[Recording], seed: u64) -> usize {
        let before = items.len();
        if let Some(share) = self.keep_zero {
            let zeros: Vec<u32> = positions(items, |item| item.steering(recordings) == 0.0);
            let kept = (share * zeros.len() as f64).round() as usize;
            thin_out(items, zeros, kept, seed, 0);
        }
        if let (Some(bins), Some(most)) = (self.histogram_bins, self.histogram_max) {
            let bin_of = |item: &Item| {
                let share = (f64::from(item.steering(recordings)) + 1.0) / 2.0;
                ((share * bins as f64) as usize).min(bins - 1)
            };
            for bin in 0..bins {
                let members = positions(items, |item| bin_of(item) == bin);
                thin_out(items, members, most, seed, 1 + bin as u64);
            }
        }
        before - items.len()
    }
}

fn positions(items: &[Item], chosen: impl Fn(&Item) -> bool) -> Vec<u32> {
    (0..items.len() as u32).filter(|&i| chosen(&items[i as usize])).collect()
}

/// Keeps `kept` of the items at `members`, chosen at random, and all others.
fn thin_out(items: &mut Vec<Item>, mut members: Vec<u32>, kept: usize, seed: u64, stream: u64) {
    if members.len() <= kept {
        return;
    }
    shuffle(&mut rng(seed, Purpose::Balance, 0, stream), &mut members);
    let mut dropped = members.split_off(kept);
    dropped.sort_unstable();
    let mut dropped = dropped.into_iter().peekable();
    let mut position = 0;
    items.retain(|_| {
        let keep = dropped.next_if_eq(&position).is_none();
        position += 1;
        keep
    });
}

/// A row on one side of a split, with the cameras that are used there.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Item {
    /// Which recording.
    pub recording: u16,
    /// Which row of it.
    pub row: u32,
    /// Bit `camera as u8` is set for each camera.
    cameras: u8,
}

impl Item {
    /// A row with some cameras.
    pub fn new(recording: u16, row: u32, cameras: impl IntoIterator<Item = Camera>) -> Self {
        Self { recording, row, cameras: cameras.into_iter().fold(0, |mask, camera| mask | 1 << camera as u8) }
    }

    /// The cameras used.
    pub fn cameras(self) -> impl Iterator<Item = Camera> {
        Camera::ALL.into_iter().filter(move |&camera| self.cameras >> camera as u8 & 1 == 1)
    }

    /// Steering of the row.
    pub fn steering(self, recordings: &[Recording]) -> f32 {
        recordings[usize::from(self.recording)].rows[self.row as usize].steering
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::testing::recording_of;

    #[test]
    fn labels_are_corrected_and_not_clamped() {
        let spec = SampleSpec { side_cameras: Some(0.25), ..Default::default() };
        assert_eq!(Camera::ALL.map(|camera| spec.label(1.0, camera)), [1.0, 1.25, 0.75]);
        assert_eq!(SampleSpec::default().label(0.5, Camera::Left), 0.5);
    }

    #[test]
    fn zeros_are_thinned_to_the_share_asked_for() {
        let steering: Vec<f32> = (0..1000).map(|i| if i % 2 == 0 { 0.0 } else { 0.3 }).collect();
        let recordings = [recording_of(&steering, 100)];
        let all: Vec<Item> = (0..1000).map(|row| Item::new(0, row, [Camera::Centre])).collect();
        let balance = Balance { keep_zero: Some(0.4), ..Default::default() };
        let run = |seed| {
            let mut items = all.clone();
            assert_eq!(balance.apply(&mut items, &recordings, seed), 300);
            items
        };
        let items = run(1);
        let zeros = items.iter().filter(|item| item.steering(&recordings) == 0.0).count();
        assert_eq!((items.len(), zeros), (700, 200));
        assert!(items.is_sorted());
        assert_eq!(items, run(1));
        assert_ne!(items, run(2));
    }

    #[test]
    fn no_bin_holds_more_than_its_most() {
        let steering: Vec<f32> = (0..1000).map(|i| (i as f32 / 1000.0).powi(3)).collect();
        let recordings = [recording_of(&steering, 100)];
        let mut items: Vec<Item> = (0..1000).map(|row| Item::new(0, row, [Camera::Centre])).collect();
        Balance { histogram_bins: Some(20), histogram_max: Some(50), ..Default::default() }.apply(
            &mut items,
            &recordings,
            3,
        );
        let mut counts = [0; 20];
        for item in &items {
            counts[((item.steering(&recordings) + 1.0) * 10.0) as usize] += 1;
        }
        assert!(counts.iter().all(|&n| n <= 50) && counts[10] == 50, "{counts:?}");
    }

    #[test]
    fn tables_read_from_toml_and_wrong_ones_are_errors() {
        let spec: SampleSpec =
            toml::from_str("side_cameras = 0.15\nflip = 'both'\ngroup = 'rows'\nvalidation_flips = true").unwrap();
        assert_eq!((spec.flip, spec.group, spec.side_cameras), (Flip::Both, Group::Rows, Some(0.15)));
        assert!(spec.validate().is_ok());
        assert!(toml::from_str::<SampleSpec>("flips = 'both'").is_err());
        assert!(SampleSpec { side_cameras: Some(25.0), ..spec }.validate().is_err());
        assert!(Balance { keep_zero: Some(1.5), ..Default::default() }.validate().is_err());
        assert!(Balance { histogram_bins: Some(5), ..Default::default() }.validate().is_err());
    }
}
