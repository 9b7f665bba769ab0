//! What is driven on: the sessions of a recording with their paths, and their pictures.

use std::ops::Range;

use crate::dataset::{Recording, View};
use crate::error::{Error, Result};
use crate::geometry::{CarGeometry, DrivenPath, LookAhead};
use crate::picture::RgbImage;
use crate::picture::decode::decode_rgb;

/// Metres a second in a mile an hour.
const MPS_PER_MPH: f64 = 0.447_04;
/// Sessions with a shorter path cannot be driven, m.
const MIN_PATH_M: f64 = 20.0;
/// A car that makes less way stands, in wheelbases a second.
const STANDING_WHEELBASES_PER_S: f64 = 0.1;
/// Speed of a recording that says none, in wheelbases a second: 1.3 m/s for a small car, and no more than a guess.
const ASSUMED_WHEELBASES_PER_S: f64 = 5.0;

/// A recording that can be driven on.
#[derive(Debug)]
pub struct ReplayLog<'a> {
    /// The recording.
    pub recording: &'a Recording,
    /// Its camera and car.
    pub geometry: CarGeometry,
    /// The sessions that are long enough, in the order of the log.
    pub sessions: Vec<ReplaySession>,
    /// Speed that was assumed because the recording says none, m/s.
    pub assumed_speed_mps: Option<f64>,
}

/// A session and the path that was driven in it.
#[derive(Clone, Debug)]
pub struct ReplaySession {
    /// Rows of the recording.
    pub rows: Range<usize>,
    /// Where the car was at each of them.
    pub path: DrivenPath,
    /// Speed at each of them, m/s.
    pub speed_mps: Vec<f64>,
}

impl<'a> ReplayLog<'a> {
    /// The sessions of `recording` that are long enough to be driven.
    ///
    /// # Errors
    ///
    /// [`Error::Data`] if no session is.
    pub fn new(recording: &'a Recording, geometry: CarGeometry) -> Result<ReplayLog<'a>> {
        let log = ReplayLog::of_any_length(recording, geometry);
        let sessions: Vec<_> = log.sessions.into_iter().filter(|s| s.path.length_m() >= MIN_PATH_M).collect();
        if sessions.is_empty() {
            return Err(Error::data(
                &recording.path,
                format!("no session has a path of {MIN_PATH_M} m or more, so nothing can be driven on this recording"),
            ));
        }
        Ok(ReplayLog { sessions, ..log })
    }

    /// All sessions of `recording`, also those that are too short to be driven.
    pub fn of_any_length(recording: &'a Recording, geometry: CarGeometry) -> ReplayLog<'a> {
        let known = recording.rows.iter().any(|row| row.speed_mph.is_finite());
        let assumed_mps = ASSUMED_WHEELBASES_PER_S * geometry.wheelbase_m;
        let sessions = (recording.sessions.iter())
            .map(|rows| {
                let of_session = &recording.rows[rows.clone()];
                // A row without a speed keeps the last one.
                let mut last_mps = if known { 0.0 } else { assumed_mps };
                let speed_mps: Vec<f64> = (of_session.iter())
                    .map(|row| {
                        if known && row.speed_mph.is_finite() {
                            last_mps = f64::from(row.speed_mph).abs() * MPS_PER_MPH;
                        }
                        last_mps
                    })
                    .collect();
                let time_s: Vec<f64> = of_session.iter().map(|row| row.time_ms as f64 / 1000.0).collect();
                let steering: Vec<f64> = of_session.iter().map(|row| f64::from(row.steering)).collect();
                let path = DrivenPath::dead_reckon(&geometry, &time_s, &speed_mps, &steering);
                ReplaySession { rows: rows.clone(), path, speed_mps }
            })
            .collect();
        ReplayLog { recording, geometry, sessions, assumed_speed_mps: (!known).then_some(assumed_mps) }
    }
}

impl ReplayLog<'_> {
    /// The path label of each row of the recording: pursuit of the driven path, `look_ahead` ahead. `None` for rows near the end of
    /// their session, where there is no path ahead, and for rows where the car stands.
    pub fn path_labels(&self, look_ahead: LookAhead) -> Vec<Option<f32>> {
        let mut labels = vec![None; self.recording.rows.len()];
        for session in &self.sessions {
            for (row, &speed_mps) in session.speed_mps.iter().enumerate() {
                let moves = speed_mps > STANDING_WHEELBASES_PER_S * self.geometry.wheelbase_m;
                let label = session.path.label(&self.geometry, row, look_ahead.distance_m(speed_mps));
                labels[session.rows.start + row] = label.filter(|_| moves).map(|label| label as f32);
            }
        }
        labels
    }
}

/// The preset for recordings of this kind, for those that say nothing of their camera.
pub fn usual_preset(recording: &Recording) -> &'static str {
    if recording.kind().contains("tub") { "donkeycar" } else { "udacity" }
}

/// The pictures of a recording, decoded when they are needed; the last one is kept.
#[derive(Debug, Default)]
pub struct Frames {
    file: Vec<u8>,
    image: RgbImage,
    held: Option<(usize, View)>,
}

impl Frames {
    /// The picture of `camera` at `row` of `recording`.
    ///
    /// # Errors
    ///
    /// [`Error::Io`] and [`Error::Data`] with its path if it cannot be read.
    pub fn get(&mut self, recording: &Recording, row: usize, camera: View) -> Result<&RgbImage> {
        if self.held != Some((row, camera)) {
            self.held = None;
            recording.read_picture(row, camera, &mut self.file)?;
            let place = || recording.image_path(row, camera).unwrap_or_else(|| recording.path.clone());
            decode_rgb(&self.file, &mut self.image).map_err(|message| Error::data(place(), message))?;
            self.held = Some((row, camera));
        }
        Ok(&self.image)
    }
}
