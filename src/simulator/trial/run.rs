//! One trial: a driver steers by what the camera shows, free or assisted.

use std::time::Instant;

use crate::observer::Observer;
use crate::simulator::camera::front_camera::FrontCamera;
use crate::simulator::camera::pinhole::RgbFrame;
use crate::simulator::car::expert;
use crate::simulator::car::speed::{Speed, SpeedController, telemetry_mph};
use crate::simulator::track::Track;
use crate::simulator::trial::closed_loop::ClosedLoop;
use crate::simulator::trial::driver::{DriveState, Driver};
use crate::simulator::trial::event::{DriveEvent, DriveFrame};
use crate::simulator::trial::outcome::{Trial, TrialOptions};
use crate::{Error, Result};

/// Drives one trial whose start, light and noise `seed` draws.
///
/// # Errors
/// If a picture cannot be encoded; [`Error::Interrupted`] if the driver gives up.
pub fn run_trial(track: &Track, driver: &mut dyn Driver, options: &TrialOptions, seed: u64) -> Result<Trial> {
    drive_run(track, driver, options, seed, None)
}

/// As [`run_trial`], to the same bits; `observer` is told every frame. Frames are rendered even if the driver does not look at them.
///
/// # Errors
/// As [`run_trial`], and the observer's own.
pub fn run_trial_observed(
    track: &Track,
    driver: &mut dyn Driver,
    options: &TrialOptions,
    seed: u64,
    observer: &mut dyn for<'a> Observer<DriveEvent<'a>>,
) -> Result<Trial> {
    drive_run(track, driver, options, seed, Some(observer))
}

fn drive_run(
    track: &Track,
    driver: &mut dyn Driver,
    options: &TrialOptions,
    seed: u64,
    mut observer: Option<&mut dyn for<'a> Observer<DriveEvent<'a>>>,
) -> Result<Trial> {
    let mut closed_loop = ClosedLoop::new(track, options, seed);
    let mut eye = (driver.needs_frame() || observer.is_some()).then(|| FrontCamera::of_car(track, seed, driver.car()));
    let blank = RgbFrame::default();
    let mut controller = SpeedController::default();
    if let Some(observer) = &mut observer {
        observer.observe(DriveEvent::Begin { seed, options })?;
    }
    while closed_loop.goes_on() {
        if closed_loop.frame_is_due() {
            if driver.gives_up() {
                return Err(Error::Interrupted);
            }
            let simulation = closed_loop.simulation();
            let speed_mph = telemetry_mph(simulation.car.speed_mps);
            let picture = match &mut eye {
                Some(eye) => eye.look(simulation)?,
                None => &blank,
            };
            let asked = Instant::now();
            let answer = driver.drive(picture, &DriveState { simulation, speed_mph });
            let answered_in = asked.elapsed();
            let (time_s, target_mph) = (simulation.time_s(), options.speed.target_mph(simulation));
            let throttle = match (options.speed, answer.pace) {
                (Speed::Driver(_), Some(pace)) => controller.throttle_for(pace, time_s, target_mph, speed_mph),
                _ => controller.throttle_at(time_s, target_mph, speed_mph),
            };
            closed_loop.answer(answer.steering, throttle);
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
    let trial = closed_loop.finish();
    if let Some(observer) = &mut observer {
        observer.observe(DriveEvent::End(&trial))?;
    }
    Ok(trial)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::CarGeometry;
    use crate::simulator::trial::driver::{Expert, InCar, Zero};

    fn options(assisted: bool) -> TrialOptions {
        TrialOptions { laps: 1, speed: Speed::Fixed(20.0), latency_ms: 0.0, noise: 0.0, assisted }
    }

    #[test]
    fn the_expert_completes_a_lap_of_every_track_without_help() {
        for name in ["lake", "mountain", "coast", "forest", "random:3"] {
            let track = Track::load(name).unwrap();
            for seed in 1..4 {
                for assisted in [false, true] {
                    let run = run_trial(&track, &mut Expert, &options(assisted), seed).unwrap();
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
                let free = run_trial(&track, &mut Zero, &options(false), seed).unwrap();
                assert!(free.laps_completed == 0 && free.failure.is_some(), "{name} {seed}");
                let assisted = run_trial(&track, &mut Zero, &options(true), seed).unwrap();
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
        let seen = run_trial(&track, &mut looking, &options(false), 2).unwrap();
        assert_eq!(looking.0, seen.moments.len());
        assert_eq!(seen, run_trial(&track, &mut Expert, &options(false), 2).unwrap());
        let spread = |options: TrialOptions| {
            let run = run_trial(&track, &mut Expert, &options, 2).unwrap();
            run.moments[100..].iter().map(|m| m.cte_m * m.cte_m).sum::<f64>() / (run.moments.len() - 100) as f64
        };
        let plain = spread(options(false));
        assert!(spread(TrialOptions { latency_ms: 700.0, ..options(false) }) > 1.1 * plain);
        assert!(spread(TrialOptions { noise: 0.1, ..options(false) }) > 1.1 * plain);
    }

    #[test]
    fn a_driver_in_another_car_sees_what_its_camera_sees_and_steers_its_wheels() {
        struct Looking([usize; 2]);
        impl Driver for Looking {
            fn steer(&mut self, frame: &RgbFrame, state: &DriveState) -> f32 {
                assert_eq!((frame.size, frame.pixels.len()), (self.0, 3 * self.0[0] * self.0[1]));
                0.5 * expert::pursuit(state.simulation) as f32
            }
        }
        let track = Track::load("lake").unwrap();
        let drive = |driver: &mut dyn Driver| {
            let mut closed = Vec::new();
            let mut watch = |event: DriveEvent| {
                if let DriveEvent::Frame(frame) = event {
                    closed.push((frame.simulation.cte_m(), frame.steering));
                }
                if closed.len() == 200 { Err(crate::Error::Interrupted) } else { Ok(()) }
            };
            let ended = run_trial_observed(&track, driver, &options(false), 2, &mut watch);
            assert!(matches!(ended, Err(crate::Error::Interrupted)));
            closed
        };
        let donkey = CarGeometry::preset("donkeycar").unwrap();
        let plain = drive(&mut Looking([160, 320]));
        assert_eq!(drive(&mut InCar { driver: Looking([120, 160]), car: donkey }), plain);
        // Wheels that turn twice as far bring half the steering to the expert's.
        let wide = CarGeometry { full_lock_deg: 50.0, ..CarGeometry::simulator() };
        let turned = drive(&mut InCar { driver: Looking([160, 320]), car: wide });
        assert!(
            turned.iter().zip(&plain).take(1).all(|(a, b)| (a.1 / b.1 - 2.0).abs() < 0.1),
            "{:?} {:?}",
            turned[0],
            plain[0]
        );
    }

    #[test]
    fn a_driver_that_gives_up_ends_the_trial_at_once() {
        struct Tired(usize);
        impl Driver for Tired {
            fn steer(&mut self, _: &RgbFrame, state: &DriveState) -> f32 {
                self.0 += 1;
                expert::pursuit(state.simulation) as f32
            }

            fn gives_up(&self) -> bool {
                self.0 == 7
            }
        }
        let mut tired = Tired(0);
        let ended = run_trial(&Track::load("lake").unwrap(), &mut tired, &options(false), 1);
        assert!(matches!(ended, Err(crate::Error::Interrupted)) && tired.0 == 7);
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
        let stopped = run_trial_observed(&track, &mut Zero, &options(true), 2, &mut watching);
        assert!(matches!(stopped, Err(crate::Error::Interrupted)));
        let unseen = run_trial(&track, &mut Zero, &options(true), 2).unwrap();
        let seen: Vec<_> = unseen.moments[..300].iter().map(|m| (m.time_s, m.steering, m.intervention)).collect();
        assert_eq!(watching.0, seen);
        assert!(watching.1 > 0 && watching.1 == seen.iter().filter(|m| m.2).count());

        let mut watching = Watching(Vec::new(), 0);
        let free = run_trial_observed(&track, &mut Zero, &options(false), 2, &mut watching).unwrap();
        assert_eq!(free, run_trial(&track, &mut Zero, &options(false), 2).unwrap());
        assert_eq!(watching.0.len(), free.moments.len());
    }
}
