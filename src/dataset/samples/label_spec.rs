//! The `labels` entry of a recipe.

use std::ops::RangeInclusive;

use serde::{Deserialize, Serialize};

use crate::geometry::{CarGeometry, LookAhead};
use crate::{Error, Result};

/// Where the label of a row comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LabelKind {
    /// The recorded steering.
    #[default]
    Wheel,
    /// The steering that leads to the point of the driven path a little way ahead (pure pursuit).
    Path,
}

/// The `labels` entry of a recipe.
///
/// How far ahead the path is aimed at counts for `kind = "path"`, and for everything in a recipe that is `"geometry"`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LabelSpec {
    /// Where labels come from.
    pub kind: LabelKind,
    /// How far ahead the driven path is aimed at, s.
    pub look_ahead_s: f64,
    /// But never nearer than this, wheelbases.
    pub min_wheelbases: f64,
    /// Each row takes the label of this time later in its session, s, interpolated between rows: the model then answers what will be
    /// needed when the wheels act, for cars with latency. Rows at the end of a session have no label then.
    pub shift_s: f64,
    /// What the simulator's expert labels while it records or watches for the main job, is the steering towards the point of the line this
    /// far ahead of the rear axle, m, instead of its own, for which it looks 6.13 m ahead at 20 mph. A place beside the line then asks for
    /// less, in proportion to 1 / distance². Labels of recordings that are there stay as they are.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub expert_ahead_m: Option<f64>,
}

impl Default for LabelSpec {
    fn default() -> Self {
        Self { kind: LabelKind::Wheel, look_ahead_s: 0.7, min_wheelbases: 2.0, shift_s: 0.0, expert_ahead_m: None }
    }
}

/// What [`LabelSpec::expert_ahead_m`] may be, m.
pub const EXPERT_AHEAD_M: RangeInclusive<f64> = 3.0..=30.0;

impl LabelSpec {
    /// What to tell of an entry that has no effect on recordings, where some are trained on, if there is one.
    pub fn notice_of_recordings(&self) -> Option<&'static str> {
        self.expert_ahead_m.map(|_| {
            "labels.expert_ahead_m acts on the simulator's expert only (train without a recording, or --with-simulator); the labels of these \
             recordings, for which side_cameras and shift_steering_per_px of the recipe may be wrong, stay as they are"
        })
    }

    /// Whether this is what stands for an entry that is absent.
    pub fn is_default(&self) -> bool {
        *self == Self::default()
    }

    /// Checks the numbers.
    ///
    /// # Errors
    /// [`Error::Usage`] naming the key.
    pub fn validate(&self) -> Result<()> {
        if !(0.0..=10.0).contains(&self.look_ahead_s) {
            return Err(Error::Usage("labels.look_ahead_s: must be 0 to 10 s".into()));
        }
        if !(0.5..=100.0).contains(&self.min_wheelbases) {
            return Err(Error::Usage("labels.min_wheelbases: must be 0.5 to 100".into()));
        }
        if !(0.0..=5.0).contains(&self.shift_s) {
            return Err(Error::Usage("labels.shift_s: must be 0 to 5 s".into()));
        }
        if self.expert_ahead_m.is_some_and(|ahead_m| !EXPERT_AHEAD_M.contains(&ahead_m)) {
            let (low, high) = (EXPERT_AHEAD_M.start(), EXPERT_AHEAD_M.end());
            return Err(Error::Usage(format!("labels.expert_ahead_m: must be {low} to {high} m")));
        }
        Ok(())
    }

    /// How far ahead `car` aims at the driven path.
    pub fn look_ahead(&self, car: &CarGeometry) -> LookAhead {
        LookAhead { seconds: self.look_ahead_s, min_m: self.min_wheelbases * car.wheelbase_m }
    }
}
