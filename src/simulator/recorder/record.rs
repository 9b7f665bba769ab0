//! Records drives of the expert in the format of Udacity's simulator.

use std::fs;
use std::path::Path;

use rayon::prelude::*;
use serde::Serialize;

use crate::files::new_folder::NewFolder;
use crate::observer::{Observer, Progress, Tally};
use crate::simulator::camera::eye::Eye;
use crate::simulator::camera::pinhole::BodyPose;
use crate::simulator::car::dynamics::{Controls, MPS_PER_MPH, STEP_S, STEPS_PER_S};
use crate::simulator::car::expert::{Keyboard, Style, pursuit};
use crate::simulator::car::noise::SteeringNoise;
use crate::simulator::car::simulation::{Simulation, Start};
use crate::simulator::car::speed::SpeedController;
use crate::simulator::math::Rng;
pub use crate::simulator::recorder::writer::Sample;
use crate::simulator::recorder::writer::{LogLines, Photographer};
use crate::simulator::road::track::Track;
use crate::simulator::scenery::light::Variant;
use crate::simulator::trial::run::{DRIVE_HZ, DriveState, Driver};
use crate::{Error, Result};

/// Rows of the log for each second, unless told otherwise.
pub const RECORD_HZ: u64 = 10;

/// How the log is written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LogFormat {
    /// As Udacity's sample data: a header, `", "` between fields, paths relative to the log.
    #[default]
    Sample,
    /// As version 2 of the simulator: no header, `","` between fields, absolute paths.
    V2,
}

/// What to record.
#[derive(Clone, Debug)]
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
    /// Strength of a disturbance of the steering that the labels do not show: standard deviation of the steering.
    pub noise: f64,
    /// Rows of the log for each second: 1, 2, 5, 10, 25 or 50.
    pub hz: u64,
    /// How the log is written.
    pub format: LogFormat,
}

impl RecordOptions {
    /// Checks what any driver is bound to: speed and rows a second.
    ///
    /// # Errors
    /// [`Error::Usage`] with what would be possible.
    pub fn check(&self) -> Result<()> {
        if !(5.0..=30.0).contains(&self.speed_mph) {
            return Err(Error::Usage(format!("speed {} mph: 5 to 30 mph can be recorded", self.speed_mph)));
        }
        if self.hz == 0 || !STEPS_PER_S.is_multiple_of(self.hz) {
            return Err(Error::Usage(format!("{} rows a second: 1, 2, 5, 10, 25 or 50 can be recorded", self.hz)));
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
            noise: 0.0,
            hz: RECORD_HZ,
            format: LogFormat::Sample,
        }
    }
}

/// What a recording is, beside the log.
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
    /// Speed held, mph; the highest, if by hand.
    pub speed_mph: f64,
    /// Disturbance of the steering.
    pub noise: f64,
    /// Rows for each second.
    pub hz: u64,
    /// Rows of the log.
    pub rows: usize,
}

impl RecordingInfo {
    /// What is said of `rows` rows that were driven as `options` ask for.
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

/// The expert driving for a recording.
struct Session<'a> {
    simulation: Simulation<'a>,
    speed: SpeedController,
    keyboard: Option<Keyboard>,
    noise: SteeringNoise,
    target_mph: f64,
    steps_per_row: u64,
}

impl Session<'_> {
    /// Drives one step; returns the label and the throttle that were in force.
    fn step(&mut self) -> (f64, f64) {
        let steering = match &mut self.keyboard {
            Some(keyboard) => keyboard.steer(&self.simulation),
            None => pursuit(&self.simulation),
        };
        let throttle = self.speed.throttle(self.target_mph, self.simulation.car.speed_mps / MPS_PER_MPH, STEP_S);
        let disturbed = steering + self.noise.next(STEP_S);
        self.simulation.step(Controls { steering: disturbed, throttle });
        (steering, throttle)
    }

    fn sample(&self, time_s: f64, (steering, throttle): (f64, f64), body: BodyPose, speed_mps: f64) -> Sample {
        let speed_mph = speed_mps / MPS_PER_MPH;
        Sample { time_s, body, steering, throttle: throttle.max(0.0), brake: (-throttle).max(0.0), speed_mph }
    }

    /// Drives `steps` steps or until `done`, taking a sample whenever a row is due.
    fn drive(&mut self, steps: u64, samples: &mut Vec<Sample>, done: impl Fn(&Simulation) -> bool) {
        for step in 0..steps {
            if done(&self.simulation) {
                return;
            }
            let due = step % self.steps_per_row == 0;
            let before =
                due.then(|| (self.simulation.time_s(), self.simulation.body_pose(), self.simulation.car.speed_mps));
            let driven = self.step();
            if let Some((time_s, body, speed_mps)) = before {
                samples.push(self.sample(time_s, driven, body, speed_mps));
            }
        }
    }
}

/// Drives what `options` ask for and returns the rows, without pictures.
pub fn drive_expert(track: &Track, options: &RecordOptions) -> Vec<Sample> {
    let mut rng = Rng::new(options.seed, "recording");
    let start = Start { reverse: options.reverse, ..Start::draw(track, options.seed) };
    let speed_mps = options.speed_mph * MPS_PER_MPH;
    let mut session = Session {
        simulation: Simulation::new(track, start, speed_mps),
        speed: SpeedController::default(),
        keyboard: (options.style == Style::Keyboard).then(Keyboard::default),
        noise: SteeringNoise::new(options.seed, options.noise),
        target_mph: options.speed_mph,
        steps_per_row: STEPS_PER_S / options.hz,
    };
    let way_m = options.laps * track.length_m;
    let most_steps = (way_m / speed_mps.max(1.0) * 3.0) as u64 * STEPS_PER_S + 500;
    let mut samples = Vec::new();
    if !options.recovery {
        session.drive(most_steps, &mut samples, |s| s.progress_m >= way_m);
        return samples;
    }
    // Every 22 m or so the car is put off its line, on alternating sides, and the way back is recorded.
    let mut s_m = start.s_m;
    let mut gone_m = 0.0;
    let mut side = if rng.unit() < 0.5 { 1.0 } else { -1.0 };
    while gone_m < way_m {
        let room = track.at(s_m).width_m / 2.0 - 1.2;
        let offset_m = side * rng.between(0.7, 2.2).min(room);
        let heading_deg = rng.between(-4.0, 12.0) * side;
        session.simulation.put(Start { s_m, reverse: options.reverse, offset_m, heading_deg }, speed_mps);
        session.keyboard = session.keyboard.map(|_| Keyboard::default());
        session.drive(3 * STEPS_PER_S, &mut samples, |s| s.cte_m().abs() < 0.1 && s.heading_error().abs() < 0.03);
        // A pause in the names of the pictures, so that a reader sees where one stretch ends and the next begins.
        session.simulation.steps += 2 * STEPS_PER_S;
        let step_m = rng.between(16.0, 28.0);
        gone_m += step_m;
        s_m += if options.reverse { -step_m } else { step_m };
        side = -side;
    }
    samples
}

/// Distance from the line at which a driver who learns is put back, m: what lies beyond no longer teaches how to stay.
const LOST_M: f64 = 2.2;

/// Lets `driver` drive what `options` ask for and returns the rows, labelled with the expert's steering at every moment.
/// In a share of the seconds, `expert_share`, the expert itself is at the wheel.
///
/// # Errors
/// If a picture cannot be encoded.
pub fn drive_and_label(
    track: &Track,
    options: &RecordOptions,
    driver: &mut dyn Driver,
    expert_share: f64,
) -> Result<Vec<Sample>> {
    let mut rng = Rng::new(options.seed, "who drives");
    let start = Start { reverse: options.reverse, ..Start::draw(track, options.seed) };
    let speed_mps = options.speed_mph * MPS_PER_MPH;
    let mut simulation = Simulation::new(track, start, speed_mps);
    let mut eye = Eye::new(track, options.seed);
    let mut controller = SpeedController::default();
    let way_m = options.laps * track.length_m;
    let most_steps = (way_m / speed_mps.max(1.0) * 3.0) as u64 * STEPS_PER_S + 500;
    let (mut samples, mut answer, mut frames, mut by_expert) = (Vec::new(), 0.0, 0, true);
    for step in 0..most_steps {
        if simulation.progress_m >= way_m {
            break;
        }
        if step % STEPS_PER_S == 0 {
            by_expert = rng.unit() < expert_share;
        }
        let label = pursuit(&simulation);
        let speed_mph = simulation.car.speed_mps / MPS_PER_MPH;
        let throttle = controller.throttle(options.speed_mph, speed_mph, STEP_S);
        if step * DRIVE_HZ >= frames * STEPS_PER_S {
            frames += 1;
            let state = DriveState { simulation: &simulation, speed_mph };
            answer = f64::from(driver.steer(eye.look(&simulation)?, &state));
            answer = if answer.is_finite() { answer.clamp(-1.0, 1.0) } else { 0.0 };
        }
        if step % (STEPS_PER_S / options.hz) == 0 {
            samples.push(Sample {
                time_s: simulation.time_s(),
                body: simulation.body_pose(),
                steering: label,
                throttle: throttle.max(0.0),
                brake: (-throttle).max(0.0),
                speed_mph,
            });
        }
        simulation.step(Controls { steering: if by_expert { label } else { answer }, throttle });
        if simulation.cte_m().abs() > LOST_M || simulation.at_wall {
            simulation.put_back();
        }
    }
    Ok(samples)
}

/// Records a drive of the expert into the new folder `out`: `driving_log.csv`, `IMG/` and `recording.toml`.
///
/// Pictures are taken on all threads; the files do not depend on their number.
///
/// # Errors
/// If `out` exists, if something cannot be written, or if the observer returns an error. Nothing is left behind then: the folder
/// gets its name when it is whole.
pub fn record(
    track: &Track,
    options: &RecordOptions,
    out: &Path,
    observer: &mut (dyn Observer<Progress> + Send),
) -> Result<RecordingInfo> {
    if !(options.laps > 0.0 && options.laps <= 1000.0) {
        return Err(Error::Usage(format!("laps {}: more than 0 and at most 1000 can be recorded", options.laps)));
    }
    options.check()?;
    let samples = drive_expert(track, options);
    write_recording(track, options, &samples, out, observer)
}

/// Takes the pictures of `samples` and writes a recording, as [`record`] does.
///
/// # Errors
/// As [`record`].
pub fn write_recording(
    track: &Track,
    options: &RecordOptions,
    samples: &[Sample],
    out: &Path,
    observer: &mut (dyn Observer<Progress> + Send),
) -> Result<RecordingInfo> {
    let folder = NewFolder::create(out)?;
    let info = fill(track, options, samples, &folder, out, observer).map_err(|error| folder.explain(error))?;
    folder.finish()?;
    Ok(info)
}

/// Writes the files of a recording into `folder`, which will be called `out`.
fn fill(
    track: &Track,
    options: &RecordOptions,
    samples: &[Sample],
    folder: &NewFolder,
    out: &Path,
    observer: &mut (dyn Observer<Progress> + Send),
) -> Result<RecordingInfo> {
    let images = folder.unfinished().join("IMG");
    fs::create_dir(&images).map_err(Error::io(&images))?;
    let world = track.world();
    let variant = Variant::new(world, options.seed);
    let tally = Tally::new(samples.len(), observer);
    samples.par_iter().try_for_each_init(Photographer::default, |photographer, sample| {
        photographer.take(world, &variant, sample, &images)?;
        tally.add(1)
    })?;
    let log = folder.unfinished().join("driving_log.csv");
    let lines = LogLines::new(options.format, out)?;
    let mut text = lines.header().as_bytes().to_vec();
    let rows = samples.iter().try_for_each(|sample| lines.row(sample, &mut text));
    rows.and_then(|()| fs::write(&log, text)).map_err(Error::io(&log))?;
    let info = RecordingInfo::new(track, options, samples.len());
    info.write(folder.unfinished())?;
    Ok(info)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lap_is_sampled_at_ten_hertz_and_holds_the_speed() {
        let track = Track::load("forest").unwrap();
        let samples = drive_expert(&track, &RecordOptions::default());
        let expected = track.length_m / (20.0 * MPS_PER_MPH) * 10.0;
        assert!((samples.len() as f64 - expected).abs() < 0.08 * expected, "{} of {expected}", samples.len());
        assert!(samples.windows(2).all(|w| (w[1].time_s - w[0].time_s - 0.1).abs() < 1e-6));
        let settled = &samples[100..];
        assert!(settled.iter().all(|s| (s.speed_mph - 20.0).abs() < 2.5));
    }

    #[test]
    fn whoever_drives_the_labels_are_the_experts() {
        use crate::simulator::trial::run::{Expert, Zero};
        let track = Track::load("lake").unwrap();
        let options = RecordOptions { laps: 0.3, ..Default::default() };
        let recorded = drive_and_label(&track, &options, &mut Expert, 0.0).unwrap();
        let plain = drive_expert(&track, &options);
        assert!(
            recorded.len() > 100 && recorded.len().abs_diff(plain.len()) < 10,
            "{} {}",
            recorded.len(),
            plain.len()
        );
        assert!(recorded.iter().zip(&plain).all(|(a, b)| (a.steering - b.steering).abs() < 0.1));
        // Who never steers drifts off the line, and the labels say how to get back.
        let strength =
            |samples: &[Sample]| samples.iter().map(|s| s.steering.abs()).sum::<f64>() / samples.len() as f64;
        let zero = drive_and_label(&track, &options, &mut Zero, 0.0).unwrap();
        let helped = drive_and_label(&track, &options, &mut Zero, 0.5).unwrap();
        assert!(strength(&zero) > 2.0 * strength(&plain), "{} {}", strength(&zero), strength(&plain));
        assert!(strength(&helped) < strength(&zero));
    }

    #[test]
    fn recovery_steers_back_and_keyboard_labels_are_often_zero() {
        let track = Track::load("lake").unwrap();
        let recovery = drive_expert(&track, &RecordOptions { recovery: true, ..Default::default() });
        let spread = |samples: &[Sample]| samples.iter().map(|s| s.steering.abs()).sum::<f64>() / samples.len() as f64;
        let smooth = drive_expert(&track, &RecordOptions::default());
        assert!(recovery.len() > 300 && spread(&recovery) > 1.5 * spread(&smooth));
        let keys = drive_expert(&track, &RecordOptions { style: Style::Keyboard, ..Default::default() });
        let zero =
            |samples: &[Sample]| samples.iter().filter(|s| s.steering == 0.0).count() as f64 / samples.len() as f64;
        assert!(zero(&keys) > 0.4 && zero(&smooth) < 0.05, "{} {}", zero(&keys), zero(&smooth));
    }
}
