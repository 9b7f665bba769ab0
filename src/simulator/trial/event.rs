//! The events of a trial, for videos and live pages.

use std::time::Duration;

use crate::simulator::camera::pinhole::RgbFrame;
use crate::simulator::car::simulation::Simulation;
use crate::simulator::trial::outcome::{Trial, TrialOptions};

/// One frame of a trial, after the driver has answered it and before the car moves.
pub struct DriveFrame<'a> {
    /// The camera's picture, 320x160, after JPEG: what the driver saw, or would have seen if it looked.
    pub picture: &'a RgbFrame,
    /// The car on its track: place, direction, cross-track error, wheels off the road, time.
    pub simulation: &'a Simulation<'a>,
    /// How the trial is driven.
    pub options: &'a TrialOptions,
    /// The driver's steering, [-1, 1], + = right.
    pub steering: f64,
    /// What the expert would steer here, [-1, 1], + = right.
    pub expert_steering: f64,
    /// Throttle, [-1, 1].
    pub throttle: f64,
    /// Speed as telemetry carries it, mph.
    pub speed_mph: f64,
    /// Whether the car was put back since the last frame.
    pub put_back: bool,
    /// Times the car was put back so far; 0 in a free trial.
    pub interventions: usize,
    /// How long the driver took to answer; the one entry that differs between runs.
    pub answered_in: Duration,
}

impl DriveFrame<'_> {
    /// The lap that is being driven, from 1.
    pub fn lap(&self) -> usize {
        let begun = (self.simulation.progress_m / self.simulation.track.length_m).max(0.0) as usize;
        (begun + 1).min(self.options.laps.max(1))
    }
}

/// What happens in a trial. Observers cannot change a trial, but may end it.
#[derive(Clone, Copy)]
pub enum DriveEvent<'a> {
    /// A trial begins.
    Begin {
        /// What draws its start, light and noise.
        seed: u64,
        /// How it is driven.
        options: &'a TrialOptions,
    },
    /// The driver has answered a frame.
    Frame(&'a DriveFrame<'a>),
    /// The trial is over.
    End(&'a Trial),
}
