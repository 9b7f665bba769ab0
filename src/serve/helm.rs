//! From the model's steering to a command: smoothing, and a speed to hold.

use std::time::Instant;

use super::protocol::Command;
use crate::simulator::run::FIRST_DT_S;
use crate::simulator::speed::{SpeedController, slower_in_bends_mph};

/// Longest time between two frames that counts, s: after a pause the car is somewhere else.
const MAX_DT_S: f64 = 0.5;

/// How the car is driven.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HelmOptions {
    /// Speed to hold, mph.
    pub speed_mph: f64,
    /// Drive slower where much steering is needed.
    pub slower_in_bends: bool,
    /// Time constant of the low-pass filter of the steering, s; 0 for none.
    pub smooth_s: f64,
}

impl Default for HelmOptions {
    fn default() -> Self {
        HelmOptions { speed_mph: 15.0, slower_in_bends: false, smooth_s: 0.0 }
    }
}

/// When a frame was taken.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Clock {
    /// When it came.
    Arrival(Instant),
    /// Simulated seconds, from a client that waits for each answer.
    Simulated(f64),
}

impl Clock {
    fn seconds_since(self, earlier: Clock) -> Option<f64> {
        match (self, earlier) {
            (Clock::Arrival(now), Clock::Arrival(then)) => Some(now.saturating_duration_since(then).as_secs_f64()),
            (Clock::Simulated(now), Clock::Simulated(then)) => Some(now - then),
            _ => None,
        }
    }
}

/// One drive of one client.
#[derive(Clone, Debug)]
pub struct Helm {
    options: HelmOptions,
    controller: SpeedController,
    before: Option<Clock>,
    last: Command,
}

impl Helm {
    /// For a drive that begins.
    pub fn new(options: HelmOptions) -> Helm {
        Helm { options, controller: SpeedController::default(), before: None, last: Command::default() }
    }

    /// The command for a frame taken at `clock`, for which the model said `steering`, at `speed_mph`.
    ///
    /// A model that answers nonsense steers straight ahead. `drive` computes its commands alike, so without smoothing and
    /// slowing down a client on simulated time is driven to the same bits.
    pub fn command(&mut self, steering: f32, speed_mph: f64, clock: Clock) -> Command {
        let dt_s = match self.before.and_then(|before| clock.seconds_since(before)) {
            Some(dt_s) => dt_s.clamp(0.0, MAX_DT_S),
            None => FIRST_DT_S,
        };
        let mut steering = f64::from(steering);
        steering = if steering.is_finite() { steering.clamp(-1.0, 1.0) } else { 0.0 };
        if self.options.smooth_s > 0.0 && self.before.is_some() {
            let share = 1.0 - (-dt_s / self.options.smooth_s).exp();
            steering = self.last.steering + share * (steering - self.last.steering);
        }
        let mut target_mph = self.options.speed_mph;
        if self.options.slower_in_bends {
            target_mph = slower_in_bends_mph(target_mph, steering);
        }
        let throttle = self.controller.throttle(target_mph, speed_mph, dt_s);
        self.before = Some(clock);
        self.last = Command { steering, throttle };
        self.last
    }

    /// The last command.
    pub fn last(&self) -> Command {
        self.last
    }

    /// The command when nothing is known any more: the wheel stays, the throttle is cut.
    pub fn cut_throttle(&mut self) -> Command {
        self.last.throttle = 0.0;
        self.last
    }

    /// A person drives: what the speed controller has summed up no longer means anything.
    pub fn release(&mut self) {
        self.controller = SpeedController::default();
        self.before = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    fn helm(options: HelmOptions) -> Helm {
        Helm::new(options)
    }

    #[test]
    fn steering_is_clamped_and_nonsense_is_straight_ahead() {
        let mut helm = helm(HelmOptions::default());
        for (model, command) in [(0.25, 0.25), (3.0, 1.0), (-3.0, -1.0), (f32::NAN, 0.0), (f32::INFINITY, 0.0)] {
            assert_eq!(helm.command(model, 15.0, Clock::Simulated(0.0)).steering, command);
        }
    }

    #[test]
    fn throttle_is_that_of_the_drives_controller_on_the_same_clock() {
        let mut helm = helm(HelmOptions::default());
        let mut controller = SpeedController::default();
        let mut expected = controller.throttle(15.0, 14.2, FIRST_DT_S);
        assert_eq!(helm.command(0.0, 14.2, Clock::Simulated(0.0)).throttle, expected);
        expected = controller.throttle(15.0, 14.3, 0.06);
        assert_eq!(helm.command(0.0, 14.3, Clock::Simulated(0.06)).throttle, expected);
        let start = Instant::now();
        let mut by_arrival = Helm::new(HelmOptions::default());
        by_arrival.command(0.0, 14.2, Clock::Arrival(start));
        let second = by_arrival.command(0.0, 14.3, Clock::Arrival(start + Duration::from_millis(60)));
        assert!((second.throttle - expected).abs() < 1e-12);
    }

    #[test]
    fn smoothing_reaches_a_step_after_some_time_constants_whatever_the_rate() {
        for dt_s in [0.01, 0.05] {
            let mut helm = helm(HelmOptions { smooth_s: 0.1, ..Default::default() });
            assert_eq!(helm.command(0.0, 15.0, Clock::Simulated(0.0)).steering, 0.0);
            let mut at = 0.0;
            let mut steering = 0.0;
            while at < 0.0999 {
                at += dt_s;
                steering = helm.command(1.0, 15.0, Clock::Simulated(at)).steering;
            }
            assert!((steering - (1.0 - (-1.0_f64).exp())).abs() < 1e-6, "{dt_s}: {steering}");
        }
    }

    #[test]
    fn bends_are_taken_slower_if_wanted_and_the_throttle_can_be_cut() {
        let plain = helm(HelmOptions::default()).command(0.6, 15.0, Clock::Simulated(0.0));
        let mut slower = helm(HelmOptions { slower_in_bends: true, ..Default::default() });
        let command = slower.command(0.6, 15.0, Clock::Simulated(0.0));
        assert!(command.throttle < plain.throttle - 0.1 && command.steering == plain.steering);
        assert_eq!(slower.cut_throttle(), Command { throttle: 0.0, ..command });
    }
}
