//! How a driver is put to the test, and the measures of all its trials.

use serde::{Deserialize, Serialize};

use crate::calm::Calm;
use crate::simulator::car::speed::Speed;
use crate::simulator::trial::outcome::{Trial, TrialOptions};
use crate::{Error, Result};

/// How a driver is put to the test.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct DriveOptions {
    /// Laps of each trial.
    pub laps: usize,
    /// Number of trials; trial `k` has seed `seed + k`.
    pub runs: usize,
    /// First seed.
    pub seed: u64,
    /// Speed to hold.
    pub speed: Speed,
    /// Time from a picture to the wheels, ms.
    pub latency_ms: f64,
    /// Standard deviation of a disturbance of the steering.
    pub noise: f64,
}

impl Default for DriveOptions {
    fn default() -> Self {
        DriveOptions { laps: 1, runs: 10, seed: 1, speed: Speed::Fixed(20.0), latency_ms: 0.0, noise: 0.0 }
    }
}

impl DriveOptions {
    /// Checks that all of it can be driven.
    ///
    /// # Errors
    /// [`Error::Usage`] with what is possible.
    pub fn check(&self) -> Result<()> {
        let fail = |message: String| Err(Error::Usage(message));
        if self.laps == 0 || self.runs == 0 {
            return fail("laps and runs must be at least 1".to_string());
        }
        if let Speed::Fixed(mph) | Speed::Driver(mph) = self.speed
            && !(3.0..=30.0).contains(&mph)
        {
            return fail(format!("speed {mph} mph: 3 to 30 mph can be driven, or `auto`"));
        }
        if !(0.0..=2000.0).contains(&self.latency_ms) {
            return fail(format!("latency {} ms: 0 to 2000 ms can be simulated", self.latency_ms));
        }
        if !(0.0..=1.0).contains(&self.noise) {
            return fail(format!("noise {}: a standard deviation of the steering from 0 to 1 is meant", self.noise));
        }
        Ok(())
    }

    /// How a trial of the drive is driven, free or assisted.
    pub fn trial_options(&self, assisted: bool) -> TrialOptions {
        let DriveOptions { laps, speed, latency_ms, noise, .. } = *self;
        TrialOptions { laps, speed, latency_ms, noise, assisted }
    }
}

/// A seed driven twice.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrialPair {
    /// The seed.
    pub seed: u64,
    /// Nobody helps.
    pub free: Trial,
    /// The car is put back when it is too far from the line.
    pub assisted: Trial,
}

/// The measures of a drive; the fields of `drive --json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DriveSummary {
    /// Track as given on the command line.
    pub track: String,
    /// Whether training must not see the track.
    pub held_out: bool,
    /// Held-out tracks that the driver was trained on all the same; the caller, who knows the driver, sets them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub trained_on_held_out: Vec<String>,
    /// Seeds driven.
    pub runs: usize,
    /// Laps completed without help.
    pub laps_completed: usize,
    /// Laps asked for.
    pub laps_total: usize,
    /// Runs with all laps completed: 95 % interval (Wilson) of their share.
    pub completed_low: f64,
    /// See `completed_low`.
    pub completed_high: f64,
    /// Autonomy over the assisted trials, %, 6 s are charged for each intervention.
    pub autonomy_percent: f64,
    /// Times the car was put back in assisted runs.
    pub interventions: usize,
    /// The same for each km.
    pub interventions_per_km: f64,
    /// Distance driven in the free trials, m.
    pub distance_m: f64,
    /// Distance from the line in free runs: mean, m.
    pub cte_mean_m: f64,
    /// Its root mean square, m.
    pub cte_rms_m: f64,
    /// Its 95th percentile, m.
    pub cte_p95_m: f64,
    /// Time with more than two wheels off the road in free runs, s.
    pub off_road_s: f64,
    /// Free runs that hit a wall.
    pub crashes: usize,
    /// Mean speed of the free runs, mph.
    pub mean_speed_mph: f64,
    /// Whiteness: root mean square rate of the steering, deg/s, over the free trials.
    pub whiteness_deg_s: f64,
    /// The same for the expert with the same seeds.
    pub expert_whiteness_deg_s: f64,
    /// Further measures of how calm the free trials are. Absent in files of older versions, like the next.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub calm: Option<Calm>,
    /// The same for the expert with the same seeds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expert_calm: Option<Calm>,
    /// Simulated seconds for each second in which a thread drives (the expert's runs left out), times the threads that its
    /// runs can keep at work; the one number that differs between runs.
    pub realtime_factor: f64,
}

/// A drive: all trials and their summary.
#[derive(Clone, Debug, PartialEq)]
pub struct DriveResult {
    /// Trials in the order of their seeds.
    pub trials: Vec<TrialPair>,
    /// Measures over all trials.
    pub summary: DriveSummary,
}
