//! Which images of a row are used: the `[samples]` table of a recipe.

use super::labels::Targets;
use crate::dataset::recording::View;
use crate::geometry::Offset;
use crate::{Error, Result};
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// How much a displaced view changes the label.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Correction {
    /// By this much steering.
    Fixed(f64),
    /// As the mount of the camera, the speed and the driven path say; `"geometry"` in a recipe.
    Geometry,
}

impl Correction {
    /// The number, 0 for geometry.
    pub fn fixed(self) -> f64 {
        match self {
            Correction::Fixed(steering) => steering,
            Correction::Geometry => 0.0,
        }
    }
}

impl Serialize for Correction {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Correction::Fixed(steering) => serializer.serialize_f64(*steering),
            Correction::Geometry => serializer.serialize_str("geometry"),
        }
    }
}

impl<'de> Deserialize<'de> for Correction {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged)]
        enum Written {
            Number(f64),
            Word(String),
        }
        match Written::deserialize(deserializer) {
            Ok(Written::Number(steering)) => Ok(Correction::Fixed(steering)),
            Ok(Written::Word(word)) if word == "geometry" => Ok(Correction::Geometry),
            _ => Err(D::Error::custom("expected a number or \"geometry\"")),
        }
    }
}

/// How a picture is mirrored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Mirror {
    /// Column by column: what a camera would see that is mounted the other way round.
    #[default]
    Picture,
    /// The world is mirrored, and the camera stays as it is mounted: rolled and turned cameras see the horizon where it was.
    Geometry,
}

impl Mirror {
    fn is_picture(&self) -> bool {
        *self == Mirror::Picture
    }
}

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
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SampleSpec {
    /// Steering added to the label of the left camera and taken from the label of the right one, in the unit of the
    /// labels; or `"geometry"`. The sum is not clamped. Without it, only the centre camera is used.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub side_cameras: Option<Correction>,
    /// Mirroring of training images.
    pub flip: Flip,
    /// How they are mirrored.
    #[serde(skip_serializing_if = "Mirror::is_picture")]
    pub mirror: Mirror,
    /// Rows with this throttle or less are left out, on both sides of the split.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub min_throttle: Option<f64>,
    /// What is shuffled.
    pub group: Group,
    /// Validate on the side cameras as well.
    pub validation_side_cameras: bool,
    /// Validate on the mirror of each image as well.
    pub validation_flips: bool,
    /// How often each training row counts in which a person took the wheel from a model that drove; the part behind the point is
    /// the share of such rows that count once more.
    #[serde(skip_serializing_if = "is_one")]
    pub takeover_weight: f64,
    /// Share of an epoch's samples that are the simulator's, where a run trains on its set as well; they are drawn anew in each
    /// epoch. It says nothing of other runs.
    #[serde(skip_serializing_if = "is_usual_share")]
    pub simulator_share: f64,
}

impl Default for SampleSpec {
    fn default() -> Self {
        Self {
            side_cameras: None,
            flip: Flip::default(),
            mirror: Mirror::default(),
            min_throttle: None,
            group: Group::default(),
            validation_side_cameras: false,
            validation_flips: false,
            takeover_weight: 1.0,
            simulator_share: USUAL_SIMULATOR_SHARE,
        }
    }
}

/// Half of what is seen is the user's own.
const USUAL_SIMULATOR_SHARE: f64 = 0.5;

fn is_usual_share(share: &f64) -> bool {
    *share == USUAL_SIMULATOR_SHARE
}

fn is_one(weight: &f64) -> bool {
    *weight == 1.0
}

impl SampleSpec {
    /// Checks the numbers.
    ///
    /// # Errors
    /// [`Error::Usage`] naming the key.
    pub fn validate(&self) -> Result<()> {
        if self.side_cameras.is_some_and(|by| !(0.0..=1.0).contains(&by.fixed())) {
            return Err(Error::Usage("[samples] side_cameras: must be 0 to 1 (full lock), or \"geometry\"".into()));
        }
        if self.min_throttle.is_some_and(|x| !x.is_finite()) {
            return Err(Error::Usage("[samples] min_throttle: must be a finite number".into()));
        }
        if !(self.simulator_share > 0.0 && self.simulator_share <= 0.95) {
            return Err(Error::Usage("[samples] simulator_share: must be more than 0 and at most 0.95".into()));
        }
        if !(0.0..=100.0).contains(&self.takeover_weight) {
            return Err(Error::Usage("[samples] takeover_weight: must be 0 to 100".into()));
        }
        Ok(())
    }

    /// The label of an image, before it is mirrored: that of the row with the correction of the camera.
    ///
    /// # Panics
    /// If there is no such row, or the row has no label.
    pub fn label(&self, targets: &Targets, item: Item, camera: View) -> f32 {
        targets.beside(item, self.offset(targets, item, camera)) + self.added(camera)
    }

    /// Where a car would stand whose centre camera saw what `camera` saw; at the row's own place with a fixed correction.
    pub(super) fn offset(&self, targets: &Targets, item: Item, camera: View) -> Offset {
        let right_m = match self.side_cameras {
            Some(Correction::Geometry) => targets.camera_right_m(item, camera),
            _ => 0.0,
        };
        Offset { right_m, ..Offset::default() }
    }

    /// The fixed correction of `camera`.
    pub(super) fn added(&self, camera: View) -> f32 {
        camera.correction_sign() * self.side_cameras.map_or(0.0, Correction::fixed) as f32
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
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::samples::Balance;
    use crate::dataset::testing::recording_of;

    #[test]
    fn labels_are_corrected_and_not_clamped() {
        let spec = SampleSpec { side_cameras: Some(Correction::Fixed(0.25)), ..Default::default() };
        let targets = Targets::wheel(&[recording_of(&[1.0, 0.5], 100)]);
        let item = |row| Item::new(0, row, [View::Centre]);
        assert_eq!(View::ALL.map(|camera| spec.label(&targets, item(0), camera)), [1.0, 1.25, 0.75]);
        assert_eq!(SampleSpec::default().label(&targets, item(1), View::Left), 0.5);
    }

    #[test]
    fn tables_read_from_toml_and_wrong_ones_are_errors() {
        let spec: SampleSpec =
            toml::from_str("side_cameras = 0.15\nflip = 'both'\ngroup = 'rows'\nvalidation_flips = true").unwrap();
        let by = Some(Correction::Fixed(0.15));
        assert_eq!(
            (spec.flip, spec.group, spec.side_cameras, spec.mirror),
            (Flip::Both, Group::Rows, by, Mirror::Picture)
        );
        assert!(spec.validate().is_ok());
        let read = |text: &str| toml::from_str::<SampleSpec>(text).map_err(|error| error.message().to_string());
        let geometric = read("side_cameras = 'geometry'\nmirror = 'geometry'").unwrap();
        assert_eq!((geometric.side_cameras, geometric.mirror), (Some(Correction::Geometry), Mirror::Geometry));
        assert_eq!(read(&toml::to_string(&geometric).unwrap()), Ok(geometric));
        assert_eq!(read("side_cameras = 0").unwrap().side_cameras, Some(Correction::Fixed(0.0)));
        assert_eq!(read("side_cameras = 'wide'"), Err("expected a number or \"geometry\"".into()));
        assert!(!toml::to_string(&spec).unwrap().contains("mirror"), "recipes of today are written as they were");
        assert!(!toml::to_string(&spec).unwrap().contains("simulator"));
        for (text, named) in [("simulator_share = 0", "simulator_share"), ("takeover_weight = -1", "takeover_weight")] {
            let error = toml::from_str::<SampleSpec>(text).unwrap().validate().unwrap_err().to_string();
            assert!(error.contains(named), "{error}");
        }
        assert!(toml::from_str::<SampleSpec>("flips = 'both'").is_err());
        assert!(SampleSpec { side_cameras: Some(Correction::Fixed(25.0)), ..spec }.validate().is_err());
        assert!(Balance { keep_zero: Some(1.5), ..Default::default() }.validate().is_err());
        assert!(Balance { histogram_bins: Some(5), ..Default::default() }.validate().is_err());
    }
}
