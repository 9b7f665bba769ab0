//! How a trial is driven, and what it came to.

use crate::calm::CalmFrame;
use crate::simulator::car::dynamics::{MAX_STEER_DEG, MPS_PER_MPH, STEP_S};
use crate::simulator::car::speed::Speed;
use crate::statistics::quantile;

/// Frames that a driver sees in each second. At 50 steps a second they come after 3 and 2 steps in turn.
pub const DRIVE_HZ: u64 = 20;
/// Distance from the line at which the car of an assisted trial is put back, m (NVIDIA 2016).
pub const INTERVENTION_M: f64 = 1.0;
/// Time charged for an intervention, s (NVIDIA 2016).
pub const INTERVENTION_S: f64 = 6.0;

/// Why a free trial ended early.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Failure {
    /// Hit a wall.
    Crash,
    /// More than one pair of wheels off the road for more than 1 s.
    LeftRoad,
    /// Stood still for more than 10 s.
    StoodStill,
    /// Disqualified from a race, which only other simulators do.
    Disqualified,
}

/// The state of a trial at one frame.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Moment {
    /// Time since the start, s.
    pub time_s: f64,
    /// East, m.
    pub x: f64,
    /// North, m.
    pub y: f64,
    /// Where the car points: deg, anticlockwise from east.
    pub heading_deg: f64,
    /// Place along the line, m.
    pub s_m: f64,
    /// Cross-track error, m, + = right as driven.
    pub cte_m: f64,
    /// What the driver asked for, [-1, 1].
    pub steering: f64,
    /// Throttle, [-1, 1].
    pub throttle: f64,
    /// Speed, mph.
    pub speed_mph: f64,
    /// Whether the car was just put back.
    pub intervention: bool,
}

/// The result of one trial of a driver.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Trial {
    /// Moments at 20 Hz.
    pub moments: Vec<Moment>,
    /// Whole laps driven.
    pub laps_completed: usize,
    /// Distance driven along the line, m.
    pub distance_m: f64,
    /// Simulated time, s.
    pub time_s: f64,
    /// Time with more than two wheels off the road, s.
    pub off_road_s: f64,
    /// Why the trial ended early; always `None` in an assisted trial.
    pub failure: Option<Failure>,
    /// Times the car was put back; 0 in a free trial.
    pub interventions: usize,
    /// Largest distance from the line at any step, m.
    pub worst_cte_m: f64,
    /// Sum of squared changes of the wheel's angle, deg²/s, to be divided by the time for the whiteness squared.
    pub whiteness_sum: f64,
}

impl Trial {
    /// Autonomy of the trial, %: see the function of this name.
    pub fn autonomy_percent(&self) -> f64 {
        autonomy_percent(self.interventions, self.time_s)
    }

    /// Root mean square rate of the steering, deg/s.
    pub fn whiteness_deg_s(&self) -> f64 {
        (self.whiteness_sum / self.time_s.max(STEP_S)).sqrt()
    }

    /// The moments and the time, s, as [`Calm::of`](crate::calm::Calm::of) takes them.
    pub fn calm_frames(&self) -> (Vec<CalmFrame>, f64) {
        let frames = self.moments.iter().map(|moment| CalmFrame {
            time_s: moment.time_s,
            angle_deg: moment.steering * MAX_STEER_DEG,
            heading_deg: moment.heading_deg,
            speed_mps: moment.speed_mph * MPS_PER_MPH,
            put_back: moment.intervention,
        });
        (frames.collect(), self.time_s)
    }

    /// Mean speed over the moments, mph.
    pub fn mean_speed_mph(&self) -> f64 {
        self.moments.iter().map(|m| m.speed_mph).sum::<f64>() / self.moments.len().max(1) as f64
    }
}

/// Autonomy (NVIDIA 2016): share of `time_s` without help, where each intervention is charged 6 s:
/// `100 (1 - 6 s * interventions / time_s)` %, at least 0.
pub fn autonomy_percent(interventions: usize, time_s: f64) -> f64 {
    (100.0 * (1.0 - INTERVENTION_S * interventions as f64 / time_s.max(STEP_S))).max(0.0)
}

/// Distance from the line over the moments of trials: mean, root mean square and 95th percentile, m.
pub fn line_errors_m<'a>(moments: impl Iterator<Item = &'a Moment>) -> [f64; 3] {
    let mut errors: Vec<f64> = moments.map(|m| m.cte_m.abs()).collect();
    errors.sort_by(f64::total_cmp);
    let n = errors.len().max(1) as f64;
    let rms = (errors.iter().map(|e| e * e).sum::<f64>() / n).sqrt();
    [errors.iter().sum::<f64>() / n, rms, quantile(&errors, 0.95)]
}

/// How a trial is driven.
#[derive(Clone, Copy, Debug)]
pub struct TrialOptions {
    /// Laps to drive.
    pub laps: usize,
    /// Speed to hold.
    pub speed: Speed,
    /// Time from a picture to the wheels, ms, in steps of 20.
    pub latency_ms: f64,
    /// Standard deviation of a disturbance of the steering, [-1, 1].
    pub noise: f64,
    /// Put the car back when it is too far from the line, instead of ending the trial when it fails.
    pub assisted: bool,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_intervention_costs_six_seconds() {
        assert_eq!(autonomy_percent(0, 100.0), 100.0);
        assert_eq!(autonomy_percent(3, 100.0), 82.0);
        assert_eq!(autonomy_percent(20, 100.0), 0.0);
    }
}
