//! Makes a command from the model's answer: smoothing, and a speed to hold or to stay below.

use std::time::{Duration, Instant};

use super::co_driver::{HandWheel, Hands};
use crate::simulator::DriverAnswer;
use crate::simulator::car::dynamics::STEP_S;
use crate::simulator::car::keys;
use crate::simulator::car::speed::{MIN_BRAKE_MPH, Pace, SpeedController, slower_in_bends_mph};
use crate::udacity::Command;

/// How the car is driven.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HelmOptions {
    /// Speed to hold, mph; with `pace_of_model` the highest.
    pub speed_mph: f64,
    /// Whether throttle or speed are the model's, as far as it gives one.
    pub pace_of_model: bool,
    /// Whether to drive slower where the model steers much.
    pub slower_in_bends: bool,
    /// Time constant of the low-pass filter of the steering, s; 0 for none.
    pub smooth_s: f64,
}

impl Default for HelmOptions {
    fn default() -> Self {
        HelmOptions { speed_mph: 15.0, pace_of_model: false, slower_in_bends: false, smooth_s: 0.0 }
    }
}

/// Time after the last usable frame for which the helm holds the steering, without throttle. Then the car brakes.
pub const HOLD_TIME: Duration = Duration::from_millis(500);
/// Longest time of braking while the speed is unknown. A car that stands would drive backwards after that.
const MAX_BLIND_BRAKE_S: f64 = 3.0;
/// Largest number of the wheel's steps between two frames: after a longer gap, a key does not throw the wheel round.
const MAX_KEY_STEPS: f64 = 10.0;
/// Throttle of the brake.
const BRAKE: f32 = -1.0;

/// Steering that a car can follow, [-1, 1]: 0 for what is not finite.
pub fn usable(steering: f32) -> f32 {
    if steering.is_finite() { steering.clamp(-1.0, 1.0) } else { 0.0 }
}

/// The time of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FrameTime {
    /// The server's clock at its arrival.
    Arrival(Instant),
    /// Simulated time, s, from a client that waits for each answer.
    Simulated(f64),
}

/// Makes the commands of one drive of one client.
#[derive(Clone, Debug)]
pub struct Helm {
    options: HelmOptions,
    controller: SpeedController,
    began: Instant,
    last_s: Option<f64>,
    /// Time of the last usable frame, and when it was answered.
    last_frame: Option<(FrameTime, Instant)>,
    last: Command,
}

impl Helm {
    /// A helm for a drive that begins now.
    pub fn new(options: HelmOptions) -> Helm {
        Helm {
            options,
            controller: SpeedController::default(),
            began: Instant::now(),
            last_s: None,
            last_frame: None,
            last: Command::default(),
        }
    }

    /// The command for the frame of `time`: the model's outputs are `answer`, the car drives at `speed_mph`.
    ///
    /// Steering that is not finite becomes 0. `drive` computes its commands in the same way; without smoothing and slowing
    /// down, a client on simulated time gets the same bits.
    pub fn command_for(&mut self, answer: DriverAnswer, speed_mph: f64, time: FrameTime) -> Command {
        let time_s = self.seconds(time);
        let DriverAnswer { steering, pace } = answer;
        let mut steering = usable(steering);
        if let Some(last_s) = self.last_s.filter(|_| self.options.smooth_s > 0.0) {
            let share = 1.0 - (-(time_s - last_s).max(0.0) / self.options.smooth_s).exp();
            steering = self.last.steering + share as f32 * (steering - self.last.steering);
        }
        let throttle = self.throttle_of_model(pace, steering, speed_mph, time_s);
        self.remember(Command { steering, throttle }, time, time_s)
    }

    /// The throttle where the model drives, or a person steers and leaves the pedals alone.
    fn throttle_of_model(&mut self, pace: Option<Pace>, steering: f32, speed_mph: f64, time_s: f64) -> f32 {
        let mut target_mph = self.options.speed_mph;
        if self.options.slower_in_bends {
            target_mph = slower_in_bends_mph(target_mph, f64::from(steering));
        }
        match pace.filter(|_| self.options.pace_of_model) {
            Some(pace) => self.controller.throttle_for(pace, time_s, target_mph, speed_mph),
            None => self.controller.throttle_at(time_s, target_mph, speed_mph),
        }
    }

    /// Keeps the command for the frame of `time`, `time_s` after the drive began.
    fn remember(&mut self, command: Command, time: FrameTime, time_s: f64) -> Command {
        self.last_s = Some(time_s);
        self.last_frame = Some((time, Instant::now()));
        self.last = command;
        command
    }

    /// The command of a person for the frame of `time`, to which the model would `answer`; the car drives at `speed_mph`. Keys move
    /// the wheel from where it is. Without a pedal the throttle is as if the model drove with this steering.
    /// The accelerator ends at the speed to hold, and the brake where a simulator would drive backwards.
    pub fn command_by_hand(&mut self, hands: Hands, answer: DriverAnswer, speed_mph: f64, time: FrameTime) -> Command {
        let time_s = self.seconds(time);
        let steering = match hands.wheel {
            HandWheel::At(steering) => steering.clamp(-1.0, 1.0),
            HandWheel::Keys(pressed) => {
                let steps = self.last_s.map_or(1.0, |last_s| ((time_s - last_s) / STEP_S).round());
                let steps = steps.clamp(1.0, MAX_KEY_STEPS) as usize;
                (0..steps).fold(f64::from(self.last.steering), |wheel, _| keys::wheel(wheel, pressed)) as f32
            }
        };
        let throttle = match hands.throttle {
            None => self.throttle_of_model(answer.pace, steering, speed_mph, time_s),
            Some(throttle) => {
                let pace = Pace::Throttle(throttle);
                self.controller.throttle_for(pace, time_s, self.options.speed_mph, speed_mph)
            }
        };
        self.remember(Command { steering, throttle }, time, time_s)
    }

    /// The command at `time` without a usable frame: the last steering without throttle for [`HOLD_TIME`], then the brake.
    /// `speed_mph` is the speed, if it is known.
    pub fn without_frame(&mut self, time: FrameTime, speed_mph: Option<f64>) -> Command {
        let blind_s = match (time, self.last_frame) {
            (_, None) => 0.0,
            (FrameTime::Simulated(time_s), Some((FrameTime::Simulated(last_s), _))) => time_s - last_s,
            (_, Some((_, answered))) => answered.elapsed().as_secs_f64(),
        };
        let hold_s = HOLD_TIME.as_secs_f64();
        let moves = match speed_mph {
            Some(mph) => mph >= MIN_BRAKE_MPH,
            None => blind_s < hold_s + MAX_BLIND_BRAKE_S,
        };
        self.last.throttle = if blind_s >= hold_s && moves { BRAKE } else { 0.0 };
        self.last
    }

    /// The command at the end of a drive: the last steering without throttle.
    pub fn cut_throttle(&mut self) -> Command {
        self.last.throttle = 0.0;
        self.last
    }

    /// Seconds of `time` since the drive began.
    pub fn seconds(&self, time: FrameTime) -> f64 {
        match time {
            FrameTime::Arrival(arrived) => arrived.saturating_duration_since(self.began).as_secs_f64(),
            FrameTime::Simulated(time_s) => time_s,
        }
    }

    /// Begins anew after a person drove by hand: the integral of the speed controller has lost its meaning.
    pub fn release(&mut self) {
        *self = Helm::new(self.options);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    impl Helm {
        /// The command for a model that gives the steering alone.
        fn command(&mut self, steering: f32, speed_mph: f64, time: FrameTime) -> Command {
            self.command_for(DriverAnswer { steering, pace: None }, speed_mph, time)
        }
    }

    #[test]
    fn steering_is_clamped_and_not_finite_is_straight_ahead() {
        let mut helm = Helm::new(HelmOptions::default());
        for (model, command) in [(0.25, 0.25), (3.0, 1.0), (-3.0, -1.0), (f32::NAN, 0.0), (f32::INFINITY, 0.0)] {
            assert_eq!(helm.command(model, 15.0, FrameTime::Simulated(0.0)).steering, command);
        }
    }

    #[test]
    fn throttle_is_that_of_the_drives_controller_on_the_same_clock() {
        let mut helm = Helm::new(HelmOptions::default());
        let mut controller = SpeedController::default();
        for (time_s, mph) in [(0.0, 14.2), (0.06, 14.3), (0.1, 14.4)] {
            let expected = controller.throttle_at(time_s, 15.0, mph);
            assert_eq!(helm.command(0.0, mph, FrameTime::Simulated(time_s)).throttle, expected);
        }
        let mut by_arrival = Helm::new(HelmOptions::default());
        let (start, mut controller) = (by_arrival.began, SpeedController::default());
        for (ms, mph) in [(5, 14.2), (65, 14.3)] {
            let throttle = by_arrival.command(0.0, mph, FrameTime::Arrival(start + Duration::from_millis(ms))).throttle;
            assert!((throttle - controller.throttle_at(ms as f64 / 1e3, 15.0, mph)).abs() < 1e-6);
        }
    }

    #[test]
    fn the_models_pace_counts_only_if_wanted_and_up_to_the_limit() {
        let answer = |pace| DriverAnswer { steering: 0.0, pace: Some(pace) };
        let at = |pace_of_model, pace, mph| {
            let mut helm = Helm::new(HelmOptions { pace_of_model, ..Default::default() });
            helm.command_for(answer(pace), mph, FrameTime::Simulated(0.0)).throttle
        };
        let held = |target_mph: f64, mph: f64| SpeedController::default().throttle_at(0.0, target_mph, mph);
        assert_eq!(at(true, Pace::Throttle(0.3), 10.0), 0.3);
        assert_eq!(at(false, Pace::Throttle(0.3), 10.0), held(15.0, 10.0));
        assert_eq!(at(true, Pace::Throttle(0.9), 16.0), -0.5);
        assert_eq!(at(true, Pace::SpeedMph(12.0), 10.0), held(12.0, 10.0));
        assert_eq!(at(true, Pace::SpeedMph(25.0), 10.0), held(15.0, 10.0));
        let mut without = Helm::new(HelmOptions { pace_of_model: true, ..Default::default() });
        assert_eq!(without.command(0.0, 10.0, FrameTime::Simulated(0.0)).throttle, held(15.0, 10.0));
    }

    #[test]
    fn keys_move_the_wheel_from_where_the_model_left_it_and_the_speed_is_held() {
        let mut helm = Helm::new(HelmOptions::default());
        let left_at = helm.command(0.3, 14.0, FrameTime::Simulated(0.0)).steering;
        let answer = DriverAnswer { steering: 0.9, pace: Some(Pace::SpeedMph(12.0)) };
        let by_hand = |helm: &mut Helm, wheel, throttle, mph, time_s| {
            helm.command_by_hand(Hands { wheel, throttle }, answer, mph, FrameTime::Simulated(time_s))
        };
        // Three steps of 20 ms, 0.05 each.
        let command = by_hand(&mut helm, HandWheel::Keys(-1.0), None, 14.0, 0.06);
        assert!((command.steering - (left_at - 0.15)).abs() < 1e-6 && command.throttle > 0.0, "{command:?}");
        let command = by_hand(&mut helm, HandWheel::Keys(1.0), None, 14.0, 9.0);
        assert!((command.steering - (left_at - 0.15 + 0.5)).abs() < 1e-6, "ten steps at most: {command:?}");
        for (mph, throttle) in [(10.0, -0.7), (4.0, 0.0)] {
            let command = by_hand(&mut helm, HandWheel::At(2.0), Some(-0.7), mph, 9.05);
            assert_eq!(command, Command { steering: 1.0, throttle });
        }
        // A correction does not change the pace: at 14 mph a model that wants 12 brakes, and bends are still taken slower.
        let options = HelmOptions { speed_mph: 30.0, pace_of_model: true, ..HelmOptions::default() };
        assert!(by_hand(&mut Helm::new(options), HandWheel::At(0.5), None, 14.0, 0.0).throttle < 0.0);
        let options = HelmOptions { slower_in_bends: true, ..HelmOptions::default() };
        let straight = by_hand(&mut Helm::new(options), HandWheel::At(0.0), None, 14.0, 0.0).throttle;
        assert!(by_hand(&mut Helm::new(options), HandWheel::At(0.9), None, 14.0, 0.0).throttle < straight - 0.1);
    }

    #[test]
    fn smoothing_reaches_a_step_after_some_time_constants_whatever_the_rate() {
        for dt_s in [0.01, 0.05] {
            let mut helm = Helm::new(HelmOptions { smooth_s: 0.1, ..Default::default() });
            assert_eq!(helm.command(0.0, 15.0, FrameTime::Simulated(0.0)).steering, 0.0);
            let mut at = 0.0;
            let mut steering = 0.0;
            while at < 0.0999 {
                at += dt_s;
                steering = helm.command(1.0, 15.0, FrameTime::Simulated(at)).steering;
            }
            assert!((steering - (1.0 - (-1.0_f32).exp())).abs() < 1e-5, "{dt_s}: {steering}");
        }
    }

    #[test]
    fn without_frames_the_steering_is_held_and_then_the_car_brakes() {
        let mut helm = Helm::new(HelmOptions::default());
        let good = helm.command(0.3, 14.0, FrameTime::Simulated(10.0));
        assert!(good.throttle > 0.0);
        for (time_s, mph, throttle) in [
            (10.05, Some(14.0), 0.0),
            (10.45, None, 0.0),
            (10.5, Some(14.0), -1.0),
            (11.0, None, -1.0),
            (12.0, Some(4.0), 0.0),
            (13.4, None, -1.0),
            (13.6, None, 0.0),
            (20.0, Some(9.0), -1.0),
        ] {
            let command = helm.without_frame(FrameTime::Simulated(time_s), mph);
            assert_eq!(command, Command { steering: good.steering, throttle }, "{time_s} s, {mph:?} mph");
        }
        assert!(helm.command(0.1, 10.0, FrameTime::Simulated(21.0)).throttle > 0.0, "a good frame drives again");
    }

    #[test]
    fn bends_are_taken_slower_if_wanted_and_the_throttle_can_be_cut() {
        let plain = Helm::new(HelmOptions::default()).command(0.6, 15.0, FrameTime::Simulated(0.0));
        let mut slower = Helm::new(HelmOptions { slower_in_bends: true, ..Default::default() });
        let command = slower.command(0.6, 15.0, FrameTime::Simulated(0.0));
        assert!(command.throttle < plain.throttle - 0.1 && command.steering == plain.steering);
        assert_eq!(slower.cut_throttle(), Command { throttle: 0.0, ..command });
    }
}
