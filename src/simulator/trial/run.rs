//! One closed-loop run: a driver steers by what the camera shows, free or assisted.

use std::time::Instant;

use crate::Result;
use crate::observer::Observer;
use crate::simulator::camera::eye::Eye;
use crate::simulator::camera::pinhole::RgbFrame;
use crate::simulator::car::dynamics::STEP_S;
use crate::simulator::car::expert;
use crate::simulator::car::simulation::Simulation;
use crate::simulator::car::speed::{Speed, SpeedController, telemetry_mph};
use crate::simulator::road::track::Track;
use crate::simulator::trial::closed_loop::ClosedLoop;
use crate::simulator::trial::observer::{DriveEvent, DriveFrame};
use crate::simulator::trial::statistics::quantile;

/// Frames that a driver sees in each second. At 50 steps a second they come after 3 and 2 steps in turn.
pub const DRIVE_HZ: u64 = 20;
/// Distance from the line at which an assisted run is interrupted, m (NVIDIA 2016).
pub const INTERVENTION_M: f64 = 1.0;
/// Time charged for an intervention, s (NVIDIA 2016).
pub const INTERVENTION_S: f64 = 6.0;

/// What a driver may know beside the picture.
pub struct DriveState<'a> {
    /// The car on its track. A driver that is to be judged looks only at the picture and at the speed.
    pub simulation: &'a Simulation<'a>,
    /// Speed as telemetry carries it, mph.
    pub speed_mph: f64,
}

/// Something that steers.
pub trait Driver {
    /// The steering, [-1, 1], + = right, for what the camera shows: 320x160, after JPEG, as it would be served.
    fn steer(&mut self, frame: &RgbFrame, state: &DriveState) -> f32;

    /// Whether `steer` looks at the picture; if not, none is taken.
    fn needs_frame(&self) -> bool {
        true
    }
}

/// The driver whose steering is the label of recordings.
pub struct Expert;

impl Driver for Expert {
    fn steer(&mut self, _: &RgbFrame, state: &DriveState) -> f32 {
        expert::pursuit(state.simulation) as f32
    }

    fn needs_frame(&self) -> bool {
        false
    }
}

/// The driver that never steers; what any other must beat.
pub struct Zero;

impl Driver for Zero {
    fn steer(&mut self, _: &RgbFrame, _: &DriveState) -> f32 {
        0.0
    }

    fn needs_frame(&self) -> bool {
        false
    }
}

/// Why a free run ended early.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Failure {
    /// Hit a wall.
    Crash,
    /// More than one pair of wheels off the road for more than 1 s.
    LeftRoad,
    /// Stood still for more than 10 s.
    StoodStill,
}

/// One moment of a run, taken when a frame is shown.
#[derive(Clone, Copy, Debug, PartialEq)]
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

/// What one run of a driver came to.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Run {
    /// Moments at 20 Hz.
    pub moments: Vec<Moment>,
    /// Whole laps driven.
    pub laps_completed: usize,
    /// Way made along the line, m.
    pub distance_m: f64,
    /// Simulated time, s.
    pub time_s: f64,
    /// Time with more than two wheels off the road, s.
    pub off_road_s: f64,
    /// Why the run ended early; never in an assisted run.
    pub failure: Option<Failure>,
    /// Times the car was put back; 0 in a free run.
    pub interventions: usize,
    /// Largest distance from the line at any step, m.
    pub worst_cte_m: f64,
    /// Sum of squared changes of the wheel's angle, deg²/s, to be divided by the time for the whiteness squared.
    pub whiteness_sum: f64,
}

impl Run {
    /// Share of the time in which nobody had to help, %: `(1 - 6 s * interventions / time) * 100`, not below 0.
    pub fn autonomy_percent(&self) -> f64 {
        (100.0 * (1.0 - INTERVENTION_S * self.interventions as f64 / self.time_s.max(STEP_S))).max(0.0)
    }

    /// Root mean square rate of the steering, deg/s.
    pub fn whiteness_deg_s(&self) -> f64 {
        (self.whiteness_sum / self.time_s.max(STEP_S)).sqrt()
    }

    /// Mean speed over the moments, mph.
    pub fn mean_speed_mph(&self) -> f64 {
        self.moments.iter().map(|m| m.speed_mph).sum::<f64>() / self.moments.len().max(1) as f64
    }
}

/// Distance from the line over the moments of runs: mean, root mean square and 95th percentile, m.
pub fn line_errors_m<'a>(moments: impl Iterator<Item = &'a Moment>) -> [f64; 3] {
    let mut errors: Vec<f64> = moments.map(|m| m.cte_m.abs()).collect();
    errors.sort_by(f64::total_cmp);
    let n = errors.len().max(1) as f64;
    let rms = (errors.iter().map(|e| e * e).sum::<f64>() / n).sqrt();
    [errors.iter().sum::<f64>() / n, rms, quantile(&errors, 0.95)]
}

/// How a run is driven.
#[derive(Clone, Copy, Debug)]
pub struct RunOptions {
    /// Laps to drive.
    pub laps: usize,
    /// Speed to hold.
    pub speed: Speed,
    /// Time from a picture to the wheels, ms, in steps of 20.
    pub latency_ms: f64,
    /// Standard deviation of a disturbance of the steering, [-1, 1].
    pub noise: f64,
    /// Put the car back when it is too far from the line, instead of ending the run when it fails.
    pub assisted: bool,
}

/// Drives one run whose start, light and noise `seed` draws.
///
/// # Errors
/// If a picture cannot be encoded.
pub fn run(track: &Track, driver: &mut dyn Driver, options: &RunOptions, seed: u64) -> Result<Run> {
    drive_run(track, driver, options, seed, None)
}

/// As [`run`], to the same bits, telling `observer` every frame. Pictures are taken even if the driver does not look.
///
/// # Errors
/// If a picture cannot be encoded, or the observer's own.
pub fn run_observed(
    track: &Track,
    driver: &mut dyn Driver,
    options: &RunOptions,
    seed: u64,
    observer: &mut dyn for<'a> Observer<DriveEvent<'a>>,
) -> Result<Run> {
    drive_run(track, driver, options, seed, Some(observer))
}

fn drive_run(
    track: &Track,
    driver: &mut dyn Driver,
    options: &RunOptions,
    seed: u64,
    mut observer: Option<&mut dyn for<'a> Observer<DriveEvent<'a>>>,
) -> Result<Run> {
    let mut closed_loop = ClosedLoop::new(track, options, seed);
    let mut eye = (driver.needs_frame() || observer.is_some()).then(|| Eye::new(track, seed));
    let blank = RgbFrame::default();
    let mut controller = SpeedController::default();
    if let Some(observer) = &mut observer {
        observer.observe(DriveEvent::Begin { seed, options })?;
    }
    while closed_loop.goes_on() {
        if closed_loop.frame_is_due() {
            let simulation = closed_loop.simulation();
            let speed_mph = telemetry_mph(simulation.car.speed_mps);
            let picture = match &mut eye {
                Some(eye) => eye.look(simulation)?,
                None => &blank,
            };
            let asked = Instant::now();
            let steering = driver.steer(picture, &DriveState { simulation, speed_mph });
            let answered_in = asked.elapsed();
            let target_mph = options.speed.target_mph(simulation);
            let throttle = controller.throttle_at(simulation.time_s(), target_mph, speed_mph);
            closed_loop.answer(steering, throttle);
            if let (Some(observer), Some(moment)) = (&mut observer, closed_loop.last_moment()) {
                let simulation = closed_loop.simulation();
                let frame = DriveFrame {
                    picture,
                    simulation,
                    options,
                    steering: moment.steering,
                    expert_steering: expert::pursuit(simulation),
                    throttle: moment.throttle,
                    speed_mph,
                    put_back: moment.intervention,
                    interventions: closed_loop.interventions(),
                    answered_in,
                };
                observer.observe(DriveEvent::Frame(&frame))?;
            }
        }
        closed_loop.step();
    }
    Ok(closed_loop.finish())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options(assisted: bool) -> RunOptions {
        RunOptions { laps: 1, speed: Speed::Fixed(20.0), latency_ms: 0.0, noise: 0.0, assisted }
    }

    #[test]
    fn the_expert_completes_a_lap_of_every_track_without_help() {
        for name in ["lake", "mountain", "coast", "forest", "random:3"] {
            let track = Track::load(name).unwrap();
            for seed in 1..4 {
                for assisted in [false, true] {
                    let run = run(&track, &mut Expert, &options(assisted), seed).unwrap();
                    assert_eq!((run.laps_completed, run.failure, run.interventions), (1, None, 0), "{name} {seed}");
                    assert_eq!(run.autonomy_percent(), 100.0);
                    assert!(run.moments.len() as f64 >= run.time_s * 20.0 - 1.0);
                }
            }
        }
    }

    #[test]
    fn without_steering_no_lap_is_completed_and_help_is_charged() {
        for name in ["lake", "mountain", "coast", "forest"] {
            let track = Track::load(name).unwrap();
            for seed in 1..5 {
                let free = run(&track, &mut Zero, &options(false), seed).unwrap();
                assert!(free.laps_completed == 0 && free.failure.is_some(), "{name} {seed}");
                let assisted = run(&track, &mut Zero, &options(true), seed).unwrap();
                assert!(assisted.interventions > 5 && assisted.laps_completed == 1, "{name} {seed}");
                let expected = 100.0 * (1.0 - 6.0 * assisted.interventions as f64 / assisted.time_s);
                assert_eq!(assisted.autonomy_percent(), expected.max(0.0));
                assert!(assisted.moments.iter().filter(|m| m.intervention).count() >= assisted.interventions - 1);
            }
        }
    }

    #[test]
    fn a_driver_that_looks_sees_the_road_and_late_steering_is_worse() {
        struct Looking(usize);
        impl Driver for Looking {
            fn steer(&mut self, frame: &RgbFrame, state: &DriveState) -> f32 {
                self.0 += usize::from(frame.pixels.iter().any(|p| *p > 0));
                Expert.steer(frame, state)
            }
        }
        let track = Track::load("lake").unwrap();
        let mut looking = Looking(0);
        let seen = run(&track, &mut looking, &options(false), 2).unwrap();
        assert_eq!(looking.0, seen.moments.len());
        assert_eq!(seen, run(&track, &mut Expert, &options(false), 2).unwrap());
        let spread = |options: RunOptions| {
            let run = run(&track, &mut Expert, &options, 2).unwrap();
            run.moments[100..].iter().map(|m| m.cte_m * m.cte_m).sum::<f64>() / (run.moments.len() - 100) as f64
        };
        let plain = spread(options(false));
        assert!(spread(RunOptions { latency_ms: 700.0, ..options(false) }) > 1.1 * plain);
        assert!(spread(RunOptions { noise: 0.1, ..options(false) }) > 1.1 * plain);
    }

    #[test]
    fn an_observer_sees_every_frame_and_changes_nothing() {
        struct Watching(Vec<(f64, f64, bool)>, usize);
        impl<'a> Observer<DriveEvent<'a>> for Watching {
            fn observe(&mut self, event: DriveEvent) -> Result<()> {
                let DriveEvent::Frame(frame) = event else { return Ok(()) };
                assert!(frame.picture.pixels.iter().any(|p| *p > 0));
                assert_eq!((frame.lap(), frame.expert_steering), (1, expert::pursuit(frame.simulation)));
                self.0.push((frame.simulation.time_s(), frame.steering, frame.put_back));
                self.1 = frame.interventions;
                if self.0.len() == 300 { Err(crate::Error::Interrupted) } else { Ok(()) }
            }
        }
        let track = Track::load("lake").unwrap();
        let mut watching = Watching(Vec::new(), 0);
        let stopped = run_observed(&track, &mut Zero, &options(true), 2, &mut watching);
        assert!(matches!(stopped, Err(crate::Error::Interrupted)));
        let unseen = run(&track, &mut Zero, &options(true), 2).unwrap();
        let seen: Vec<_> = unseen.moments[..300].iter().map(|m| (m.time_s, m.steering, m.intervention)).collect();
        assert_eq!(watching.0, seen);
        assert!(watching.1 > 0 && watching.1 == seen.iter().filter(|m| m.2).count());

        let mut watching = Watching(Vec::new(), 0);
        let free = run_observed(&track, &mut Zero, &options(false), 2, &mut watching).unwrap();
        assert_eq!(free, run(&track, &mut Zero, &options(false), 2).unwrap());
        assert_eq!(watching.0.len(), free.moments.len());
    }
}
