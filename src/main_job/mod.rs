//! The main job: record the expert, train on it, drive where it was trained and where it was not.

pub mod dagger;
pub mod dagger_on_log;
pub mod experiment;
pub mod job;
pub mod on_recording;
pub mod replay_experiment;
pub mod training_set;
pub mod with_simulator;

use serde::Serialize;

use crate::simulator::DriveSummary;
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
