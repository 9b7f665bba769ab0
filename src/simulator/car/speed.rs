//! Holding a speed: the controller of Udacity's `drive.py`, in elapsed time instead of frames.

use crate::simulator::car::dynamics::{MAX_STEER_DEG, MPS_PER_MPH, WHEELBASE_M};
use crate::simulator::car::simulation::Simulation;

/// Throttle for each mph of error.
const PROPORTIONAL: f64 = 0.1;
/// Throttle for each mph of error and second; `drive.py` adds 0.002 a frame, which is this at 20 frames a second.
const INTEGRAL_PER_S: f64 = 0.04;
/// Time step of the first frame, s.
const FIRST_FRAME_S: f64 = 0.05;
/// Maximum time step of a frame, s.
const MAX_FRAME_S: f64 = 0.5;
/// Maximum sideways acceleration of `Speed::Auto` in bends, m/s².
pub const COMFORT_MPS2: f64 = 2.5;
/// Maximum speed of `Speed::Auto`, mph.
const AUTO_TOP_MPH: f64 = 30.0;

/// Minimum speed in bends, mph.
const MIN_BEND_MPH: f64 = 9.0;

/// Speed below which neither a driver's own pace nor a driver without pictures brakes, mph: Udacity's simulator drives backwards when it brakes below 5 mph.
pub const MIN_BRAKE_MPH: f64 = 5.0;
/// Throttle that a driver may give for each mph below the limit of its speed.
const LIMIT_PER_MPH: f64 = 0.5;

/// What a driver asks of the pedals.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Pace {
    /// Throttle, [-1, 1], negative to brake.
    Throttle(f32),
    /// A speed to hold, mph.
    SpeedMph(f32),
}

/// The speed a drive aims at.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub enum Speed {
    /// The same everywhere, mph.
    Fixed(f64),
    /// 30 mph, less before and in bends.
    Auto,
    /// What the driver asks for, at most this, mph; a driver that asks for nothing holds it.
    Driver(f64),
}

impl Speed {
    /// The speed to aim at here, mph.
    pub fn target_mph(self, simulation: &Simulation) -> f64 {
        match self {
            Speed::Fixed(mph) | Speed::Driver(mph) => mph,
            Speed::Auto => before_bends_mph(simulation, AUTO_TOP_MPH, COMFORT_MPS2),
        }
    }

    /// The speed at which trials start, m/s.
    pub fn at_start_mps(self) -> f64 {
        match self {
            Speed::Fixed(mph) => mph * MPS_PER_MPH,
            Speed::Auto | Speed::Driver(_) => 12.0 * MPS_PER_MPH,
        }
    }
}

/// The speed of a driver who knows the way, mph: at most `top_mph`, and before and in bends so slow that the car is pushed sideways by at
/// most `sideways_mps2`.
pub fn before_bends_mph(simulation: &Simulation, top_mph: f64, sideways_mps2: f64) -> f64 {
    let sign = if simulation.reverse { -1.0 } else { 1.0 };
    let sharpest = (0..=12)
        .map(|k| simulation.track.at(simulation.location.s_m + sign * f64::from(k) * 2.5).curvature.abs())
        .fold(0.0, f64::max);
    bend_mph(sharpest, sideways_mps2).clamp(MIN_BEND_MPH.min(top_mph), top_mph)
}

/// The speed in a bend of `curvature`, 1/m and not negative, that pushes the car sideways by `sideways_mps2`, mph.
fn bend_mph(curvature: f64, sideways_mps2: f64) -> f64 {
    (sideways_mps2 / curvature.max(1e-6)).sqrt() / MPS_PER_MPH
}

/// The target speed, mph, where `steering`, [-1, 1], is needed: at most `target_mph`, less in bends. For drivers that know
/// a bend only from their own steering.
pub fn slower_in_bends_mph(target_mph: f64, steering: f64) -> f64 {
    let curvature = (steering * MAX_STEER_DEG).to_radians().tan().abs() / WHEELBASE_M;
    bend_mph(curvature, COMFORT_MPS2).clamp(MIN_BEND_MPH.min(target_mph), target_mph)
}

/// The speed as telemetry carries it: four decimals, mph.
pub fn telemetry_mph(speed_mps: f64) -> f64 {
    (speed_mps / MPS_PER_MPH * 1e4).round() / 1e4
}

/// A proportional-integral controller from speed to throttle.
#[derive(Clone, Debug, Default)]
pub struct SpeedController {
    /// Sum of error times time, mph s.
    integral: f64,
    /// Time of the last frame, s.
    last_s: Option<f64>,
}

impl SpeedController {
    /// The throttle, [-1, 1], for the frame of time `time_s`, in the 32 bits that the car takes.
    ///
    /// The first frame counts for 0.05 s; a gap longer than 0.5 s for no more than that, and a
    /// clock that ran backwards for nothing.
    pub fn throttle_at(&mut self, time_s: f64, target_mph: f64, speed_mph: f64) -> f32 {
        let dt_s = self.last_s.map_or(FIRST_FRAME_S, |last| (time_s - last).clamp(0.0, MAX_FRAME_S));
        self.last_s = Some(time_s);
        self.throttle(target_mph, speed_mph, dt_s) as f32
    }

    /// As [`throttle_at`](Self::throttle_at), for the pace that a driver asks for, at most `limit_mph`.
    ///
    /// A speed is held by this controller. A throttle is passed on, but the nearer the speed is to the limit, the less of it: none at the
    /// limit, the brake above. Neither brakes a car that hardly moves, which would drive backwards. What is not finite asks for
    /// nothing: no throttle, no speed.
    pub fn throttle_for(&mut self, pace: Pace, time_s: f64, limit_mph: f64, speed_mph: f64) -> f32 {
        let asked = |value: f32| if value.is_finite() { f64::from(value) } else { 0.0 };
        let throttle = match pace {
            Pace::SpeedMph(mph) => self.throttle_at(time_s, asked(mph).clamp(0.0, limit_mph), speed_mph),
            Pace::Throttle(throttle) => {
                self.last_s = Some(time_s);
                asked(throttle).min(LIMIT_PER_MPH * (limit_mph - speed_mph)).clamp(-1.0, 1.0) as f32
            }
        };
        if speed_mph < MIN_BRAKE_MPH { throttle.max(0.0) } else { throttle }
    }

    /// The throttle, [-1, 1], after `dt_s` more seconds at `speed_mph` where `target_mph` is wanted.
    pub fn throttle(&mut self, target_mph: f64, speed_mph: f64, dt_s: f64) -> f64 {
        let error = target_mph - speed_mph;
        let integral = self.integral + error * dt_s;
        let throttle = PROPORTIONAL * error + INTEGRAL_PER_S * integral;
        // At full throttle or brake the sum must not grow further: it would only make the car overshoot.
        if throttle.abs() <= 1.0 || throttle.signum() != error.signum() {
            self.integral = integral;
        }
        throttle.clamp(-1.0, 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulator::car::dynamics::{Car, Controls, STEP_S};

    #[test]
    fn in_bends_the_speed_falls_to_a_comfortable_one_and_straight_ahead_it_does_not() {
        assert_eq!(slower_in_bends_mph(20.0, 0.0), 20.0);
        assert_eq!(slower_in_bends_mph(5.0, 1.0), 5.0);
        assert_eq!(slower_in_bends_mph(30.0, -1.0), MIN_BEND_MPH);
        let mph = slower_in_bends_mph(30.0, 0.2);
        let radius_m = WHEELBASE_M / 5_f64.to_radians().tan();
        assert!(((mph * MPS_PER_MPH).powi(2) / radius_m - COMFORT_MPS2).abs() < 1e-9, "{mph}");
    }

    #[test]
    fn a_drivers_pace_is_followed_up_to_the_limit_and_never_backwards() {
        let throttle = |pace, limit_mph, mph| SpeedController::default().throttle_for(pace, 1.0, limit_mph, mph);
        for (asked, limit_mph, mph, expected) in [
            (0.4, 20.0, 12.0, 0.4),
            (2.0, 20.0, 12.0, 1.0),
            (0.9, 20.0, 19.0, 0.5),
            (0.9, 20.0, 20.0, 0.0),
            (0.9, 20.0, 21.0, -0.5),
            (-0.3, 20.0, 12.0, -0.3),
            (-0.3, 20.0, 4.0, 0.0),
            (f32::NAN, 20.0, 12.0, 0.0),
        ] {
            assert_eq!(throttle(Pace::Throttle(asked), limit_mph, mph), expected, "{asked} at {mph} mph");
        }
        let held = |target_mph: f64, mph: f64| SpeedController::default().throttle_at(1.0, target_mph, mph);
        assert_eq!(throttle(Pace::SpeedMph(17.0), 20.0, 12.0), held(17.0, 12.0));
        assert_eq!(throttle(Pace::SpeedMph(40.0), 20.0, 12.0), held(20.0, 12.0));
        assert_eq!(throttle(Pace::SpeedMph(f32::INFINITY), 20.0, 12.0), held(0.0, 12.0));
        assert_eq!(throttle(Pace::SpeedMph(0.0), 20.0, 3.0), 0.0);
        // At full throttle a car settles a little below the limit.
        let (mut car, mut controller) = (Car::new(0.0, 0.0, 1.0, 0.0, 0.0), SpeedController::default());
        for step in 0..2000 {
            let (time_s, mph) = (f64::from(step) * STEP_S, car.speed_mps / MPS_PER_MPH);
            let throttle = f64::from(controller.throttle_for(Pace::Throttle(1.0), time_s, 20.0, mph));
            car.step(Controls { steering: 0.0, throttle }, 0.0, 0.0);
            assert!(car.speed_mps / MPS_PER_MPH < 20.0);
        }
        assert!(car.speed_mps / MPS_PER_MPH > 18.5, "{}", car.speed_mps / MPS_PER_MPH);
    }

    #[test]
    fn a_long_start_at_full_throttle_does_not_make_the_car_overshoot() {
        let mut car = Car::new(0.0, 0.0, 1.0, 0.0, 0.0);
        let (mut controller, mut fastest_mph) = (SpeedController::default(), 0.0_f64);
        for _ in 0..60 {
            controller.throttle(20.0, 0.0, 1.0);
        }
        for _ in 0..1000 {
            let speed_mph = car.speed_mps / MPS_PER_MPH;
            let throttle = controller.throttle(20.0, speed_mph, STEP_S);
            car.step(Controls { steering: 0.0, throttle }, 0.0, 0.0);
            fastest_mph = fastest_mph.max(speed_mph);
        }
        assert!(fastest_mph < 22.0, "{fastest_mph}");
    }

    #[test]
    fn the_speed_settles_at_the_target_from_rest_and_from_above_whatever_the_frame_rate() {
        for (from_mph, every) in [(0.0, 1), (0.0, 5), (30.0, 2)] {
            let mut car = Car::new(0.0, 0.0, 1.0, 0.0, from_mph * MPS_PER_MPH);
            let (mut controller, mut throttle) = (SpeedController::default(), 0.0);
            for step in 0..2000 {
                if step % every == 0 {
                    throttle = controller.throttle(20.0, car.speed_mps / MPS_PER_MPH, every as f64 * STEP_S);
                }
                car.step(Controls { steering: 0.0, throttle }, 0.0, 0.0);
            }
            assert!((car.speed_mps / MPS_PER_MPH - 20.0).abs() < 0.3, "{}", car.speed_mps / MPS_PER_MPH);
        }
    }

    #[test]
    fn time_stamps_count_as_elapsed_time_but_gaps_and_steps_back_are_limited() {
        let throttle = |times: &[f64]| {
            let mut controller = SpeedController::default();
            times.iter().fold(0.0, |_, time_s| controller.throttle_at(*time_s, 20.0, 18.0))
        };
        let elapsed = |total_s: f64| SpeedController::default().throttle(20.0, 18.0, total_s) as f32;
        assert!((throttle(&[7.0, 7.03, 7.1]) - elapsed(0.05 + 0.1)).abs() < 1e-6);
        assert!((throttle(&[7.0, 90.0]) - elapsed(0.05 + 0.5)).abs() < 1e-6);
        assert!((throttle(&[7.0, 3.0]) - elapsed(0.05)).abs() < 1e-6);
    }

    #[test]
    fn telemetry_has_four_decimals_and_survives_printing() {
        for mph in [0.0, 0.00004, 0.00005, 12.34565, 29.99999] {
            let rounded = telemetry_mph(mph * MPS_PER_MPH);
            assert!((rounded - mph).abs() <= 0.5001e-4);
            assert_eq!(format!("{rounded:.4}").parse(), Ok(rounded));
        }
    }
}
