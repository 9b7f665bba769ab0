//! The main job: record the expert, train on it, drive where it was trained and where it was not.

pub mod dagger;
pub mod experiment;
pub mod held_out;
pub mod job;
pub mod training_set;

use serde::Serialize;

use crate::error::{Error, Result};
use crate::pilot::Pilot;
use crate::simulator::jpeg::RoundTrip;
use crate::simulator::recorder::drive_expert;
use crate::simulator::{
    Camera, DriveOptions, DriveSummary, Driver, Mount, RecordOptions, Renderer, RgbFrame, Track, Variant, drive,
};
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

/// How a model does on one track: its drive, and its error on what the expert saw there.
#[derive(Clone, Debug, Serialize)]
pub struct TrackResult {
    /// Closed loop.
    #[serde(flatten)]
    pub drive: DriveSummary,
    /// Mean absolute error on 300 fresh frames of the expert's drive, in degrees of the front wheels.
    pub offline_mae_deg: f64,
}

/// What the main job came to; `train --json` without a recording prints it.
#[derive(Clone, Debug, Serialize)]
pub struct MainJobResult {
    /// The training.
    #[serde(flatten)]
    pub training: TrainResult,
    /// One for each track.
    pub drives: Vec<TrackResult>,
}

/// Puts `pilot` to the test on `track`. Call it inside a rayon pool; `progress` is told the share of the runs that are done
/// and may return `false` to stop.
///
/// # Errors
///
/// As [`drive()`].
pub fn test_on_track(
    pilot: &Pilot,
    track: &Track,
    options: &DriveOptions,
    progress: &(dyn Fn(f64) -> bool + Sync),
) -> Result<TrackResult> {
    let new_driver = || -> Result<Box<dyn Driver>> { Ok(Box::new(pilot.clone())) };
    let offline_mae_deg = offline_mae_deg(pilot, track, options.seed)?;
    Ok(TrackResult { drive: drive(track, new_driver, options, progress)?.summary, offline_mae_deg })
}

/// Mean absolute error of `pilot` on frames that the expert sees on `track` in a drive drawn by `seed`, in degrees of the
/// front wheels: what evaluation of recordings calls MAE.
///
/// # Errors
///
/// [`Error::Usage`] if a picture cannot be encoded.
pub fn offline_mae_deg(pilot: &Pilot, track: &Track, seed: u64) -> Result<f64> {
    let samples = drive_expert(track, &RecordOptions { seed, ..Default::default() });
    let (mut pilot, world) = (pilot.clone(), track.world());
    let variant = Variant::new(world, seed);
    let (mut renderer, mut frame, mut jpeg) = (Renderer::default(), RgbFrame::default(), RoundTrip::default());
    let every = (samples.len() / OFFLINE_FRAMES).max(1);
    let (mut sum, mut count) = (0.0, 0);
    for sample in samples.iter().step_by(every).take(OFFLINE_FRAMES) {
        renderer.render(world, &variant, &Camera::new(&sample.body, Mount::Center), Mount::Center, &mut frame);
        jpeg.apply(&mut frame)?;
        let steering = pilot.steer(crate::simulator::HEIGHT, crate::simulator::WIDTH, &frame.pixels)?;
        sum += (f64::from(steering) - sample.steering).abs();
        count += 1;
    }
    if count == 0 {
        return Err(Error::Usage(format!("the expert makes no way on {}", track.name())));
    }
    Ok(sum / f64::from(count) * pilot.recipe().full_lock_deg)
}
