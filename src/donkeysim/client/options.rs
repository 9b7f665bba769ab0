//! How to drive in DonkeySim, and what a drive comes to.

use serde::Serialize;

use crate::calm::Calm;
use crate::simulator::Speed;
use crate::simulator::trial::outcome::{Failure, Trial, autonomy_percent, line_errors_m};
use crate::simulator::trial::statistics::wilson_interval;
use crate::statistics::quantile;
use crate::{Error, Result};

/// Settings of the camera that the protocol knows, beside the size of the picture.
pub const CAMERA_SETTINGS: [&str; 9] =
    ["fov", "fish_eye_x", "fish_eye_y", "offset_x", "offset_y", "offset_z", "rot_x", "rot_y", "rot_z"];

/// How to drive.
#[derive(Clone, Debug)]
pub struct DonkeyDriveOptions {
    /// `HOST:PORT` of the simulator.
    pub server: String,
    /// The scene to choose in its menu; `generated_track`, or else the first, if none is named.
    pub scene: Option<String>,
    /// Height and width of the pictures to ask for.
    pub picture: [usize; 2],
    /// Further settings of the camera, of [`CAMERA_SETTINGS`]; the simulator's own if there is none.
    pub camera: Vec<(String, f64)>,
    /// Name of the car.
    pub car_name: String,
    /// Laps of each run.
    pub laps: usize,
    /// Number of runs, each from the start.
    pub runs: usize,
    /// Longest time of a run, s of the clock.
    pub time_limit_s: f64,
    /// Speed to hold or to stay below; not [`Speed::Auto`].
    pub speed: Speed,
    /// Units of the scene in a unit of the telemetry's places and speeds. A unit of the scene counts as a metre.
    pub scale: f64,
    /// Distance from the line beyond which a run has failed, in units of the scene.
    pub max_cte: f64,
    /// Longest time without a word of the simulator, and without a telemetry that can be driven by, s. Loading a scene may take
    /// twelve times as long.
    pub patience_s: f64,
}

impl Default for DonkeyDriveOptions {
    fn default() -> Self {
        DonkeyDriveOptions {
            server: "127.0.0.1:9091".into(),
            scene: None,
            picture: [120, 160],
            camera: Vec::new(),
            car_name: "steersman".into(),
            laps: 1,
            runs: 1,
            time_limit_s: 300.0,
            speed: Speed::Fixed(20.0),
            scale: 8.0,
            max_cte: 8.0,
            patience_s: 10.0,
        }
    }
}

impl DonkeyDriveOptions {
    /// Checks that all of it can be driven.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] with what is possible.
    pub fn check(&self) -> Result<()> {
        let fail = |message: String| Err(Error::Usage(message));
        if self.laps == 0 || self.runs == 0 {
            return fail("laps and runs must be at least 1".into());
        }
        match self.speed {
            Speed::Auto => {
                return fail("--speed auto knows the bends of our own tracks only: give a speed in mph".into());
            }
            Speed::Fixed(mph) | Speed::Driver(mph) if !(1.0..=100.0).contains(&mph) => {
                return fail(format!("--speed {mph}: 1 to 100 mph can be driven in DonkeySim"));
            }
            Speed::Fixed(_) | Speed::Driver(_) => {}
        }
        if !(1.0..=86_400.0).contains(&self.time_limit_s) {
            return fail(format!("--time-limit {}: 1 to 86400 s can be driven", self.time_limit_s));
        }
        if !(0.001..=1000.0).contains(&self.scale) {
            return fail(format!("--scale {}: 0.001 to 1000 is meant; 8, or 1 for older builds", self.scale));
        }
        if !(0.1..=3600.0).contains(&self.patience_s) {
            return fail(format!("--patience {}: 0.1 to 3600 s are meant", self.patience_s));
        }
        if self.max_cte.is_nan() || self.max_cte <= 0.0 {
            return fail(format!("--max-cte {}: a distance of more than 0 is meant", self.max_cte));
        }
        for (name, value) in &self.camera {
            if !CAMERA_SETTINGS.contains(&name.as_str()) || !value.is_finite() {
                let known = CAMERA_SETTINGS.join(", ");
                return fail(format!("--cam {name}={value}: a number for one of {known} is meant"));
            }
        }
        Ok(())
    }
}

/// What was driven.
#[derive(Debug, Default)]
pub struct DonkeyDrive {
    /// The scene that was chosen in the menu, as far as its name can be shown: a simulator may name it at any length.
    pub scene: Option<String>,
    /// The runs, the last of which may be unfinished. Times are the simulator's, distances are summed up from its speeds; places that
    /// it did not tell are no numbers.
    pub runs: Vec<Trial>,
    /// The last run that was to be driven, from 1; if the drive ended while the car was put back for it, it is not in `runs`.
    pub last_run: usize,
    /// Why the drive ended before its last run did, if so. What was driven until then counts.
    pub ended: Option<Error>,
    /// Telemetries that were answered.
    pub answered: u64,
    /// Telemetries that were not, as a newer one had arrived.
    pub superseded: u64,
    /// Telemetries without a picture that can be read.
    pub unreadable: u64,
    /// Times from when a telemetry and all that had arrived with it is read to when the control that answers it is sent, ms. The pause
    /// that the simulator needs between two messages, 15 ms, counts where the answer had to wait for it.
    pub answers_ms: Vec<f64>,
}

/// The measures of a drive; the fields of `drive --donkeysim --json`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DonkeyDriveSummary {
    /// `HOST:PORT` of the simulator.
    pub server: String,
    /// The scene that was chosen in the menu; none where the simulator stood in one already.
    pub scene: Option<String>,
    /// Runs that were begun.
    pub runs: usize,
    /// Whole laps.
    pub laps_completed: usize,
    /// Laps asked for in these runs.
    pub laps_total: usize,
    /// Runs with all laps completed: 95 % interval (Wilson) of their share.
    pub completed_low: f64,
    /// See `completed_low`.
    pub completed_high: f64,
    /// Autonomy, %: 6 s are charged for each run that failed.
    pub autonomy_percent: f64,
    /// Runs that failed: the car hit something, was too far from the line, stood still or was disqualified.
    pub interventions: usize,
    /// The same for each km.
    pub interventions_per_km: f64,
    /// Distance, m (units of the scene).
    pub distance_m: f64,
    /// Time, s.
    pub time_s: f64,
    /// Distance from the line: mean, m (units of the scene). None if the simulator does not tell it, like the next three.
    pub cte_mean_m: Option<f64>,
    /// Its root mean square, m.
    pub cte_rms_m: Option<f64>,
    /// Its 95th percentile, m.
    pub cte_p95_m: Option<f64>,
    /// Its maximum, m.
    pub cte_max_m: Option<f64>,
    /// Runs in which the car hit something.
    pub crashes: usize,
    /// Runs in which the simulator disqualified the car, as for a checkpoint that it missed.
    pub disqualified: usize,
    /// Mean speed, mph.
    pub mean_speed_mph: f64,
    /// Root mean square rate of the steering, deg/s, at 25 degrees of full lock.
    pub whiteness_deg_s: f64,
    /// Further measures of how calm the wheel is, as far as the simulator tells the car's direction.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub calm: Option<Calm>,
    /// Telemetries that were answered.
    pub answered: u64,
    /// Telemetries that were not, as a newer one had arrived.
    pub superseded: u64,
    /// Telemetries without a picture that can be read.
    pub unreadable: u64,
    /// Times from telemetry to control, ms: median.
    pub answer_ms_p50: Option<f64>,
    /// The 99th percentile.
    pub answer_ms_p99: Option<f64>,
}

impl DonkeyDriveSummary {
    /// The measures of `drive`, which was driven as `options` say.
    pub fn new(options: &DonkeyDriveOptions, drive: &DonkeyDrive) -> DonkeyDriveSummary {
        let runs = &drive.runs;
        let sum = |of: fn(&Trial) -> f64| runs.iter().map(of).sum::<f64>();
        let (time_s, distance_m) = (sum(|run| run.time_s), sum(|run| run.distance_m));
        let failed =
            |which: fn(&Failure) -> bool| runs.iter().filter(|run| run.failure.as_ref().is_some_and(which)).count();
        let interventions = failed(|_| true);
        let completed = runs.iter().filter(|run| run.laps_completed == options.laps).count();
        let (completed_low, completed_high) = wilson_interval(completed, runs.len());
        let moments = || runs.iter().flat_map(|run| &run.moments);
        let known = || moments().filter(|moment| moment.cte_m.is_finite());
        let line_errors = known().next().is_some().then(|| line_errors_m(known()));
        let speeds: Vec<f64> = moments().map(|moment| moment.speed_mph).filter(|mph| mph.is_finite()).collect();
        let has_direction =
            moments().next().is_some() && moments().all(|m| m.heading_deg.is_finite() && m.speed_mph.is_finite());
        let mut answers_ms = drive.answers_ms.clone();
        answers_ms.sort_by(f64::total_cmp);
        let answer_ms = |q| (!answers_ms.is_empty()).then(|| quantile(&answers_ms, q));
        DonkeyDriveSummary {
            server: options.server.clone(),
            scene: drive.scene.clone(),
            runs: runs.len(),
            laps_completed: runs.iter().map(|run| run.laps_completed).sum(),
            laps_total: options.laps * runs.len(),
            completed_low,
            completed_high,
            autonomy_percent: autonomy_percent(interventions, time_s),
            interventions,
            interventions_per_km: interventions as f64 / (distance_m / 1000.0).max(1e-9),
            distance_m,
            time_s,
            cte_mean_m: line_errors.map(|errors| errors[0]),
            cte_rms_m: line_errors.map(|errors| errors[1]),
            cte_p95_m: line_errors.map(|errors| errors[2]),
            cte_max_m: line_errors.map(|_| runs.iter().map(|run| run.worst_cte_m).fold(0.0, f64::max)),
            crashes: failed(|failure| *failure == Failure::Crash),
            disqualified: failed(|failure| *failure == Failure::Disqualified),
            mean_speed_mph: speeds.iter().sum::<f64>() / speeds.len().max(1) as f64,
            whiteness_deg_s: (sum(|run| run.whiteness_sum) / time_s.max(1e-9)).sqrt(),
            calm: has_direction.then(|| Calm::of(runs.iter().map(Trial::calm_frames))),
            answered: drive.answered,
            superseded: drive.superseded,
            unreadable: drive.unreadable,
            answer_ms_p50: answer_ms(0.5),
            answer_ms_p99: answer_ms(0.99),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_cannot_be_driven_is_refused_with_what_can() {
        let with = |change: fn(&mut DonkeyDriveOptions)| {
            let mut options = DonkeyDriveOptions::default();
            change(&mut options);
            options.check().map_err(|error| error.to_string())
        };
        assert_eq!(with(|_| ()), Ok(()));
        for (change, named) in [
            ((|o| o.laps = 0) as fn(&mut DonkeyDriveOptions), "at least 1"),
            (|o| o.speed = Speed::Auto, "give a speed"),
            (|o| o.speed = Speed::Driver(0.0), "1 to 100"),
            (|o| o.time_limit_s = f64::NAN, "--time-limit"),
            (|o| o.scale = 0.0, "--scale"),
            (|o| o.max_cte = -1.0, "--max-cte"),
            (|o| o.camera = vec![("zoom".into(), 1.0)], "fish_eye_x"),
            (|o| o.camera = vec![("fov".into(), f64::NAN)], "fov=NaN"),
        ] {
            assert!(with(change).unwrap_err().contains(named), "{named}");
        }
    }

    #[test]
    fn a_failed_run_costs_six_seconds_and_what_the_simulator_does_not_tell_is_no_figure() {
        let options = DonkeyDriveOptions { laps: 2, ..DonkeyDriveOptions::default() };
        let good = Trial { laps_completed: 2, time_s: 80.0, distance_m: 900.0, ..Trial::default() };
        let bad = Trial { time_s: 20.0, distance_m: 100.0, failure: Some(Failure::Crash), ..Trial::default() };
        let drive = DonkeyDrive { runs: vec![good, bad], ..DonkeyDrive::default() };
        let summary = DonkeyDriveSummary::new(&options, &drive);
        assert_eq!((summary.laps_completed, summary.laps_total, summary.crashes), (2, 4, 1));
        assert_eq!((summary.autonomy_percent, summary.interventions_per_km), (94.0, 1.0));
        assert_eq!((summary.cte_mean_m, summary.calm, summary.answer_ms_p50), (None, None, None));
    }
}
