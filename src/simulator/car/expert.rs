//! The expert: pure pursuit of the reference line, and the same driver with a keyboard.

use crate::simulator::car::dynamics::{MAX_STEER_DEG, REAR_AXLE_M, STEP_S, WHEELBASE_M};
use crate::simulator::car::keys;
use crate::simulator::car::simulation::Simulation;
use crate::simulator::math::atan;

/// Look-ahead distance of a standing car, from the rear axle, m.
const LOOK_AHEAD_M: f64 = 3.0;
/// Additional look-ahead distance for each m/s of speed, s.
const LOOK_AHEAD_S: f64 = 0.35;

/// The steering, [-1, 1], that leads the rear axle onto the reference line a little way ahead.
///
/// Pure pursuit (Coulter 1992): the circle through the rear axle, tangent to the car, that meets the point of the line at
/// distance `l` under the angle `a` has curvature `2 sin(a) / l`; the front wheels that follow it stand at
/// `atan(wheelbase * 2 sin(a) / l)`.
pub fn pursuit(simulation: &Simulation) -> f64 {
    pursue(simulation, LOOK_AHEAD_M + LOOK_AHEAD_S * simulation.car.speed_mps)
}

/// The steering, [-1, 1], towards the point of the reference line `ahead` m from the rear axle, as [`pursuit`].
pub fn pursue(simulation: &Simulation, ahead: f64) -> f64 {
    let (track, car) = (simulation.track, &simulation.car);
    let sign = if simulation.reverse { -1.0 } else { 1.0 };
    let target = track.at(simulation.location.s_m + sign * (ahead - REAR_AXLE_M));
    let (dx, dy) = (target.x - (car.x - REAR_AXLE_M * car.hx), target.y - (car.y - REAR_AXLE_M * car.hy));
    let square = (dx * dx + dy * dy).max(1.0);
    // To the right of the car, m; over the squared distance it is half the curvature.
    let right = dx * car.hy - dy * car.hx;
    let wheels = atan(WHEELBASE_M * 2.0 * right / square);
    (wheels.to_degrees() / MAX_STEER_DEG).clamp(-1.0, 1.0)
}

/// Deadband: smaller steering presses no key.
const TOLERATED: f64 = 0.05;
/// Look-ahead distance of the driver with keys, m.
const KEYBOARD_LOOK_AHEAD_M: f64 = 11.0;

/// How the expert moves the wheel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub enum Style {
    /// The pursuit's own steering.
    #[default]
    Smooth,
    /// Through the keys of Udacity's simulator: labels are often zero, with spikes between.
    Keyboard,
}

/// Turns wanted steering into that of a driver with two keys.
///
/// The wheel moves by [`keys::wheel`]. The driver presses a key when the integral of
/// the missing steering is large enough, and releases it when the integral is nearly zero.
#[derive(Clone, Debug, Default)]
pub struct Keyboard {
    wheel: f64,
    missing: f64,
    pressed: f64,
}

impl Keyboard {
    /// The wheel after one more step of 20 ms on the way of `simulation`.
    pub fn steer(&mut self, simulation: &Simulation) -> f64 {
        // Coarse steering needs a longer look-ahead.
        self.step(pursue(simulation, KEYBOARD_LOOK_AHEAD_M))
    }

    /// The wheel after one step in which `wanted` steering was called for.
    fn step(&mut self, wanted: f64) -> f64 {
        let wanted = if wanted.abs() < TOLERATED { 0.0 } else { wanted };
        self.missing = (self.missing + (wanted - self.wheel) * STEP_S).clamp(-0.2, 0.2);
        if self.pressed == 0.0 && self.missing.abs() > 0.022 {
            self.pressed = self.missing.signum();
        } else if self.missing * self.pressed < 0.006 {
            self.pressed = 0.0;
        }
        self.wheel = keys::wheel(self.wheel, self.pressed);
        self.wheel
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulator::car::dynamics::{Controls, MPS_PER_MPH};
    use crate::simulator::car::simulation::Start;
    use crate::simulator::track::Track;

    #[test]
    fn a_car_left_of_the_line_is_steered_right() {
        let track = Track::load("lake").unwrap();
        for reverse in [false, true] {
            for (offset_m, expected) in [(-1.0, 1.0), (1.0, -1.0)] {
                let start = Start { s_m: 60.0, reverse, offset_m, heading_deg: 0.0 };
                let steering = pursuit(&Simulation::new(&track, start, 9.0));
                assert!(steering * expected > 0.05, "{reverse} {offset_m} {steering}");
            }
        }
    }

    #[test]
    fn cross_track_error_stays_small_on_every_track_in_both_directions() {
        let random = (0..24).chain(1_000_000..1_000_024).map(|seed| format!("random:{seed}"));
        let (mut worst_p95, mut worst) = (0.0, 0.0);
        for name in ["lake", "mountain", "coast", "forest"].map(String::from).into_iter().chain(random) {
            let track = Track::load(&name).unwrap();
            for reverse in [false, true] {
                let start = Start { s_m: 0.0, reverse, offset_m: 0.0, heading_deg: 0.0 };
                let speed = 20.0 * MPS_PER_MPH;
                let mut simulation = Simulation::new(&track, start, speed);
                let mut errors = Vec::new();
                while simulation.progress_m < track.length_m && simulation.time_s() < 300.0 {
                    let throttle = (speed - simulation.car.speed_mps).clamp(-0.05, 1.0);
                    simulation.step(Controls { steering: pursuit(&simulation), throttle });
                    errors.push(simulation.cte_m().abs());
                }
                assert!(simulation.progress_m >= track.length_m, "{name} {reverse}");
                errors.sort_by(f64::total_cmp);
                let (p95, max) = (errors[errors.len() * 95 / 100], errors[errors.len() - 1]);
                assert!(p95 <= 0.3 && max <= 0.8, "{name} reverse {reverse}: p95 {p95} max {max}");
                (worst_p95, worst) = (f64::max(worst_p95, p95), f64::max(worst, max));
            }
        }
        eprintln!(
            "expert on 52 tracks, both directions: cross-track error p95 at most {worst_p95:.3} m, max {worst:.3} m"
        );
    }

    #[test]
    fn the_keyboard_follows_on_average_with_many_zeros() {
        let mut keyboard = Keyboard::default();
        let wheel: Vec<f64> = (0..5000).map(|_| keyboard.step(0.08)).collect();
        let mean = wheel.iter().sum::<f64>() / wheel.len() as f64;
        let zeros = wheel.iter().filter(|w| **w == 0.0).count() as f64 / wheel.len() as f64;
        assert!((mean - 0.08).abs() < 0.02, "{mean}");
        assert!(zeros > 0.4, "{zeros}");
        assert!(wheel.iter().any(|w| *w > 0.2));
    }
}
