//! Steering and pedals with keys, as version 2 of Udacity's simulator takes them.

use crate::simulator::car::dynamics::STEP_S;

/// How far a held key moves the wheel in a step: full lock is reached in 0.4 s.
const HELD: f64 = 0.05;
/// How fast a released wheel or pedal returns, 1/s: the gravity of Unity's input axes. A pedal comes as fast as it goes.
const RETURN_PER_S: f64 = 3.0;

/// The wheel, [-1, 1], one step of 20 ms later. `pressed` is -1 for the left key, +1 for the right one, 0 for none.
pub fn wheel(wheel: f64, pressed: f64) -> f64 {
    if pressed != 0.0 {
        return (wheel + HELD * pressed).clamp(-1.0, 1.0);
    }
    let back = RETURN_PER_S * STEP_S;
    if wheel.abs() <= back { 0.0 } else { wheel - back.copysign(wheel) }
}

/// The pedals, [-1, 1] from the brake to the accelerator, one step later. `pressed` is -1 for the brake's key, +1 for the
/// accelerator's. A change from one to the other starts at 0 (Unity: the axis snaps).
pub fn pedals(pedals: f64, pressed: f64) -> f64 {
    let from = if pedals * pressed < 0.0 { 0.0 } else { pedals };
    let step = RETURN_PER_S * STEP_S;
    from + (pressed - from).clamp(-step, step)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn after(steps: usize, from: f64, pressed: f64, axis: fn(f64, f64) -> f64) -> f64 {
        (0..steps).fold(from, |value, _| axis(value, pressed))
    }

    #[test]
    fn a_held_key_reaches_full_lock_in_20_steps_and_a_released_wheel_the_middle_in_17() {
        assert!((after(10, 0.0, 1.0, wheel) - 0.5).abs() < 1e-9);
        assert!(after(19, 0.0, -1.0, wheel) > -0.96 && (after(20, 0.0, -1.0, wheel) + 1.0).abs() < 1e-9);
        assert!(after(16, 1.0, 0.0, wheel) > 0.0 && after(17, 1.0, 0.0, wheel) == 0.0);
    }

    #[test]
    fn pedals_come_and_go_and_the_brake_does_not_wait_for_the_accelerator() {
        assert!(after(16, 0.0, 1.0, pedals) < 1.0 && after(17, 0.0, 1.0, pedals) == 1.0);
        assert!(after(17, 1.0, 0.0, pedals) == 0.0);
        assert!(after(1, 1.0, -1.0, pedals) < 0.0);
    }
}
