//! The main job: record the expert, train on it, drive where it was trained and where it was not.

pub mod dagger;
pub mod dagger_on_log;
pub mod experiment;
pub mod job;
pub mod on_recording;
pub mod replay_experiment;
pub mod training_set;
pub mod with_simulator;

use std::path::Path;

use serde::Serialize;

use crate::error::{Error, Result};
use crate::files::new_folder::NewFolder;
use crate::observer::{Observer, Progress};
use crate::pilot::Pilot;
use crate::report::charts::map;
use crate::simulator::camera::front_camera::FrontCamera;
use crate::simulator::recorder::expert_drive::drive_expert;
use crate::simulator::trial::drive::drive;
use crate::simulator::trial::trajectory::write_trajectories;
use crate::simulator::{DriveOptions, DriveSummary, Driver, RecordOptions, Track};
use crate::training::TrainResult;

/// Tracks that the main job drives on: those of the training set, then held-out ones.
pub const TRACKS: [&str; 9] = [
    "lake",
    "mountain",
    "coast",
    "forest",
    "random:1000001",
    "random:1000002",
    "random:1000003",
    "random:1000004",
    "random:1000005",
];
/// Frames of the expert's drive that the offline error is taken over.
const OFFLINE_FRAMES: usize = 300;

/// Results of a model on one track: its drive, and its offline error on the expert's frames.
#[derive(Clone, Debug, Serialize)]
pub struct TrackResult {
    /// Closed loop.
    #[serde(flatten)]
    pub drive: DriveSummary,
    /// Mean absolute error on 300 fresh frames of the expert's drive, in degrees of the front wheels.
    pub offline_mae_deg: f64,
}

/// The result of the main job; `train --json` without a recording prints it.
#[derive(Clone, Debug, Serialize)]
pub struct MainJobResult {
    /// The training.
    #[serde(flatten)]
    pub training: TrainResult,
    /// One for each track.
    pub drives: Vec<TrackResult>,
}

/// Tests `pilot` on `track`. Call it inside a rayon pool; `observer` is told the share of the runs that are
/// done. The trajectories are saved in a folder below `keep`, if that is given; a folder that this test left
/// there before a stop is kept.
///
/// # Errors
///
/// As [`drive()`] and `write_trajectories`.
pub fn test_on_track(
    pilot: &Pilot,
    track: &Track,
    options: &DriveOptions,
    keep: Option<&Path>,
    observer: &mut (dyn Observer<Progress> + Send),
) -> Result<TrackResult> {
    let new_driver = || -> Result<Box<dyn Driver>> { Ok(Box::new(pilot.clone())) };
    let offline_mae_deg = offline_mae_deg(pilot, track, options.seed)?;
    let mut drive = drive(track, new_driver, options, observer)?;
    drive.summary.trained_on_held_out = pilot.trained_on_held_out().to_vec();
    // Names of random tracks have a colon, which no file's name has everywhere.
    let folder =
        keep.map(|keep| keep.join(track.name().replace(['/', '\\', ':'], "-"))).filter(|folder| !folder.exists());
    if let Some(folder) = folder {
        let folder = NewFolder::create(&folder)?;
        map::write(track, &drive, &folder)?;
        write_trajectories(&drive, folder)?;
    }
    Ok(TrackResult { drive: drive.summary, offline_mae_deg })
}

/// Mean absolute error of `pilot` on frames that the expert sees on `track` in a drive drawn by `seed`, in degrees of the
/// front wheels: what evaluation of recordings calls MAE.
///
/// # Errors
///
/// [`Error::Codec`] if a picture cannot be encoded.
pub fn offline_mae_deg(pilot: &Pilot, track: &Track, seed: u64) -> Result<f64> {
    let samples = drive_expert(track, &RecordOptions { seed, ..Default::default() });
    let (mut pilot, mut eye) = (pilot.clone(), FrontCamera::new(track, seed));
    if samples.is_empty() {
        return Err(Error::Data {
            place: track.name().into(),
            message: "the expert makes no way on this track".into(),
        });
    }
    let mut sum = 0.0;
    let count = samples.len().min(OFFLINE_FRAMES);
    for sample in spread(samples.len(), count).map(|k| &samples[k]) {
        let frame = eye.look_from(&sample.body)?;
        let steering = pilot.steer(frame.view())?;
        sum += (f64::from(steering) - sample.steering).abs();
    }
    Ok(sum / count as f64 * pilot.recipe().full_lock_deg)
}

/// `count` of the indices 0 to `len`, evenly spread.
fn spread(len: usize, count: usize) -> impl Iterator<Item = usize> {
    (0..count).map(move |k| k * len / count)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_frames_of_the_offline_error_are_spread_over_the_whole_drive() {
        for len in [300, 301, 599, 899, 1500] {
            let places: Vec<usize> = spread(len, OFFLINE_FRAMES).collect();
            assert!(places.len() == OFFLINE_FRAMES && places[0] == 0, "{len}");
            assert!(places.is_sorted_by(|a, b| a < b) && *places.last().unwrap() >= len - len.div_ceil(OFFLINE_FRAMES));
        }
    }
}
