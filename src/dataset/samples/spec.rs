//! Which images of a row are used: the `[samples]` table of a recipe.

use crate::dataset::recording::{Recording, View};
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
    pub fn label(&self, steering: f32, camera: View) -> f32 {
        steering + camera.correction_sign() * self.side_cameras.unwrap_or(0.0) as f32
    }
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
    pub fn new(recording: u16, row: u32, cameras: impl IntoIterator<Item = View>) -> Self {
        Self { recording, row, cameras: cameras.into_iter().fold(0, |mask, camera| mask | 1 << camera as u8) }
    }

    /// The cameras used.
    pub fn cameras(self) -> impl Iterator<Item = View> {
        View::ALL.into_iter().filter(move |&camera| self.cameras >> camera as u8 & 1 == 1)
    }

    /// Steering of the row.
    pub fn steering(self, recordings: &[Recording]) -> f32 {
        recordings[usize::from(self.recording)].rows[self.row as usize].steering
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::samples::Balance;

    #[test]
    fn labels_are_corrected_and_not_clamped() {
        let spec = SampleSpec { side_cameras: Some(0.25), ..Default::default() };
        assert_eq!(View::ALL.map(|camera| spec.label(1.0, camera)), [1.0, 1.25, 0.75]);
        assert_eq!(SampleSpec::default().label(0.5, View::Left), 0.5);
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
