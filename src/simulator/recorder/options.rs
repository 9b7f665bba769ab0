//! The options of a recording, and its description in `recording.toml`.

use std::fs;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::dataset::EXPERT_AHEAD_M;
use crate::geometry::CarGeometry;
use crate::simulator::camera::foreign_car;
use crate::simulator::car::dynamics::STEPS_PER_S;
use crate::simulator::car::expert::{Style, pursue};
use crate::simulator::car::simulation::Simulation;
use crate::simulator::car::speed::before_bends_mph;
use crate::simulator::track::Track;
use crate::{Error, Result};

/// Default rows of the log per second.
pub const RECORD_HZ: u64 = 10;

/// How the log is written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum LogFormat {
    /// As Udacity's sample data: a header, `", "` between fields, paths relative to the log.
    #[default]
    Sample,
    /// As version 2 of the simulator: no header, `","` between fields, absolute paths.
    V2,
}

/// What to record.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct RecordOptions {
    /// Laps of normal driving, or with `recovery` laps along which the car is put off its line.
    pub laps: f64,
    /// Drive against the direction of the track's points.
    pub reverse: bool,
    /// Record only ways back to the line.
    pub recovery: bool,
    /// How the expert moves the wheel.
    pub style: Style,
    /// Draws where the drive begins, light and texture, and what happens on it.
    pub seed: u64,
    /// Speed to hold, mph.
    pub speed_mph: f64,
    /// Drive slower than that before and in bends, so that the car is pushed sideways by at most this, m/s².
    pub bends_mps2: Option<f64>,
    /// The labels are the steering towards the point of the line this far ahead of the rear axle, m, and not the expert's own,
    /// which drives ([`LabelSpec::expert_ahead_m`](crate::dataset::LabelSpec::expert_ahead_m) in a recipe). From farther away a place beside the line asks for less steering, in proportion to 1 / distance².
    pub label_ahead_m: Option<f64>,
    /// Strength of a disturbance of the steering that the labels do not show: standard deviation of the steering.
    pub noise: f64,
    /// Rows of the log for each second: 1, 2, 5, 10, 25 or 50.
    pub hz: u64,
    /// How the log is written.
    pub format: LogFormat,
    /// Camera mount and car to record as; those of the simulator if there is none.
    pub car: Option<CarGeometry>,
}

impl RecordOptions {
    /// The speed to aim at in `simulation`, mph.
    pub fn target_mph(&self, simulation: &Simulation) -> f64 {
        match self.bends_mps2 {
            None => self.speed_mph,
            Some(sideways_mps2) => before_bends_mph(simulation, self.speed_mph, sideways_mps2),
        }
    }

    /// The label at this moment where it is not the expert's own steering.
    pub(super) fn label(&self, simulation: &Simulation) -> Option<f64> {
        self.label_ahead_m.map(|ahead_m| pursue(simulation, ahead_m))
    }

    /// Checks the options that hold for every driver: speed and rows per second.
    ///
    /// # Errors
    /// [`Error::Usage`] with what would be possible.
    pub fn check(&self) -> Result<()> {
        if !(5.0..=30.0).contains(&self.speed_mph) {
            return Err(Error::Usage(format!("speed {} mph: 5 to 30 mph can be recorded", self.speed_mph)));
        }
        if self.bends_mps2.is_some_and(|mps2| !(0.5..=8.0).contains(&mps2)) {
            let mps2 = self.bends_mps2.unwrap_or_default();
            return Err(Error::Usage(format!("{mps2} m/s² in bends: 0.5 to 8 can be recorded")));
        }
        if let Some(ahead_m) = self.label_ahead_m.filter(|ahead_m| !EXPERT_AHEAD_M.contains(ahead_m)) {
            let (low, high) = (EXPERT_AHEAD_M.start(), EXPERT_AHEAD_M.end());
            return Err(Error::Usage(format!("labels that look {ahead_m} m ahead: {low} to {high} m can be recorded")));
        }
        if self.hz == 0 || !STEPS_PER_S.is_multiple_of(self.hz) {
            return Err(Error::Usage(format!("{} rows a second: 1, 2, 5, 10, 25 or 50 can be recorded", self.hz)));
        }
        if let Some(trouble) = self.car.as_ref().and_then(foreign_car::trouble) {
            return Err(Error::Usage(format!("the simulator cannot record with this camera: {trouble}")));
        }
        Ok(())
    }
}

impl Default for RecordOptions {
    fn default() -> Self {
        RecordOptions {
            laps: 1.0,
            reverse: false,
            recovery: false,
            style: Style::Smooth,
            seed: 1,
            speed_mph: 20.0,
            bends_mps2: None,
            label_ahead_m: None,
            noise: 0.0,
            hz: RECORD_HZ,
            format: LogFormat::Sample,
            car: None,
        }
    }
}

/// The description of a recording, saved as `recording.toml`.
#[derive(Clone, Debug, Serialize)]
pub struct RecordingInfo {
    /// Track as given on the command line.
    pub track: String,
    /// Whether training must not see the track.
    pub held_out: bool,
    /// Seed of the recording.
    pub seed: u64,
    /// Laps asked for; laps driven, if by hand.
    pub laps: f64,
    /// Driven against the direction of the track's points.
    pub reverse: bool,
    /// Only ways back to the line.
    pub recovery: bool,
    /// `smooth` or `keyboard`; `manual` if a person drove.
    pub style: String,
    /// Speed held, mph, on the full-size track; the highest, if by hand.
    pub speed_mph: f64,
    /// How many times larger the track is than the model of it on which a small car drove. Speeds in the log are those of the car, divided
    /// by this.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scale: Option<f64>,
    /// Driven slower than that before and in bends, so that the car was pushed sideways by at most this, m/s².
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bends_mps2: Option<f64>,
    /// The labels are the steering towards the point of the line this far ahead, m, and not what was driven.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub label_ahead_m: Option<f64>,
    /// Disturbance of the steering.
    pub noise: f64,
    /// Rows for each second.
    pub hz: u64,
    /// Rows of the log.
    pub rows: usize,
}

impl RecordingInfo {
    /// The description of `rows` rows that were driven as `options` say.
    pub fn new(track: &Track, options: &RecordOptions, rows: usize) -> RecordingInfo {
        RecordingInfo {
            track: track.name().to_string(),
            held_out: track.held_out(),
            seed: options.seed,
            laps: options.laps,
            reverse: options.reverse,
            recovery: options.recovery,
            style: if options.style == Style::Keyboard { "keyboard" } else { "smooth" }.to_string(),
            speed_mph: options.speed_mph,
            scale: options.car.as_ref().map(foreign_car::scale).filter(|scale| *scale != 1.0),
            bends_mps2: options.bends_mps2,
            label_ahead_m: options.label_ahead_m,
            noise: options.noise,
            hz: options.hz,
            rows,
        }
    }

    /// Writes `recording.toml` into `folder`.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn write(&self, folder: &Path) -> Result<()> {
        let side = folder.join("recording.toml");
        let text = toml::to_string(self).map_err(|e| Error::data(&side, e.to_string()))?;
        fs::write(&side, text).map_err(Error::io(&side))
    }
}
