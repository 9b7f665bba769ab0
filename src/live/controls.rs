//! The wheel: which connection holds it, its input, and the controls that follow.

use std::time::{Duration, Instant};

use super::messages::{Input, Request};
use crate::simulator::car::dynamics::Controls;
use crate::simulator::car::keys;
use crate::simulator::car::speed::SpeedController;

/// A connection that sends nothing for so long loses the wheel. (A page that is hidden says that it leaves, and a browser that
/// ends closes its connection. This is for a browser that hangs.)
const SILENCE: Duration = Duration::from_millis(1500);

/// Largest number of actions that wait: a page that sends more is not a person's.
const MAX_ACTIONS: usize = 64;

/// Something that a page asks for and that happens once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Action {
    /// Begin to record, or pause.
    Record,
    /// Hold the accelerator, or release it.
    Cruise,
    /// Take the last seconds out of the recording.
    Erase,
    /// Put the car onto the middle of the road.
    PutBack,
    /// The same, facing the other way.
    TurnRound,
    /// End the drive.
    Finish,
}

/// A wheel that one connection at a time holds.
#[derive(Clone, Debug, Default)]
pub struct Wheel {
    holder: Option<u64>,
    input: Input,
    heard: Option<Instant>,
    actions: Vec<Action>,
}

impl Wheel {
    /// Handles a request of connection `id` at `now`. The first connection that steers gets the wheel. While it holds the
    /// wheel, this ignores the requests of others, except that they may take the wheel.
    pub fn take(&mut self, id: u64, request: Request, now: Instant) {
        let action = match request {
            Request::Next => return,
            Request::Leave => return self.leave(id),
            Request::Take => {
                if self.holder != Some(id) {
                    (self.holder, self.input) = (Some(id), Input::default());
                }
                None
            }
            Request::Controls(input) => {
                if self.holder(now).is_none() {
                    self.holder = Some(id);
                }
                if self.holder == Some(id) {
                    self.input = input;
                }
                None
            }
            Request::Record => Some(Action::Record),
            Request::Cruise => Some(Action::Cruise),
            Request::Erase => Some(Action::Erase),
            Request::PutBack => Some(Action::PutBack),
            Request::TurnRound => Some(Action::TurnRound),
            Request::Finish => Some(Action::Finish),
            // These are no one's alone.
            Request::Pause | Request::Rate { .. } | Request::NextRun => return,
        };
        if self.holder == Some(id) {
            self.heard = Some(now);
            let room = MAX_ACTIONS - self.actions.len();
            self.actions.extend(action.into_iter().take(room));
        }
    }

    /// Connection `id` releases the wheel or has ended.
    pub fn leave(&mut self, id: u64) {
        if self.holder == Some(id) {
            // Earlier requests still happen, above all the end of the drive.
            *self = Wheel { actions: std::mem::take(&mut self.actions), ..Wheel::default() };
        }
    }

    /// The connection that holds the wheel at `now`.
    pub fn holder(&mut self, now: Instant) -> Option<u64> {
        if self.heard.is_none_or(|heard| now.saturating_duration_since(heard) > SILENCE) {
            *self = Wheel::default();
        }
        self.holder
    }

    /// The input at `now`, if a connection holds the wheel.
    pub fn input(&mut self, now: Instant) -> Option<Input> {
        self.holder(now).map(|_| self.input)
    }

    /// The actions since the last call.
    pub fn take_actions(&mut self) -> Vec<Action> {
        std::mem::take(&mut self.actions)
    }
}

/// Turns keys, mouse and gamepad into controls, one step of 20 ms after another.
#[derive(Clone, Debug, Default)]
pub struct Cockpit {
    controls: Controls,
    /// Whether the accelerator is held.
    pub cruise: bool,
    limiter: SpeedController,
}

impl Cockpit {
    /// The controls of the next step at `speed_mph`, with `max_mph` as the speed limit. Without input the car brakes.
    pub fn step(&mut self, input: Option<Input>, speed_mph: f64, max_mph: f64, step_s: f64) -> Controls {
        let Some(input) = input else {
            *self =
                Cockpit { controls: Controls { steering: self.controls.steering, throttle: -1.0 }, ..Self::default() };
            self.controls.steering = keys::wheel(self.controls.steering, 0.0);
            return self.controls;
        };
        let key = |value: f64| value.clamp(-1.0, 1.0).round();
        self.controls.steering = match input.wheel {
            Some(wheel) => wheel.clamp(-1.0, 1.0),
            None => keys::wheel(self.controls.steering, key(input.steer)),
        };
        let braked = input.pedal < 0.0 || input.pedals.is_some_and(|pedals| pedals < 0.0);
        self.cruise &= !braked;
        let wanted = match input.pedals {
            _ if self.cruise => 1.0,
            Some(pedals) => pedals.clamp(-1.0, 1.0),
            None => keys::pedals(self.controls.throttle, key(input.pedal)),
        };
        if wanted <= 0.0 {
            self.limiter = SpeedController::default();
        }
        // The speed limit holds for the accelerator; the brake is always the driver's.
        let max = if wanted > 0.0 { self.limiter.throttle(max_mph, speed_mph, step_s).max(0.0) } else { 0.0 };
        self.controls.throttle = wanted.min(max);
        self.controls
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulator::car::dynamics::{Car, MPS_PER_MPH, STEP_S};

    fn pressed(steer: f64, pedal: f64) -> Input {
        Input { steer, pedal, ..Input::default() }
    }

    #[test]
    fn the_first_has_the_wheel_until_it_leaves_falls_silent_or_another_takes_it() {
        let (mut wheel, start) = (Wheel::default(), Instant::now());
        let at = |ms: u64| start + Duration::from_millis(ms);
        wheel.take(1, Request::Controls(pressed(1.0, 0.0)), at(0));
        wheel.take(2, Request::Controls(pressed(-1.0, 0.0)), at(10));
        wheel.take(2, Request::Finish, at(11));
        assert_eq!((wheel.holder(at(20)), wheel.input(at(20))), (Some(1), Some(pressed(1.0, 0.0))));
        assert!(wheel.take_actions().is_empty(), "who only looks on cannot end the drive");
        wheel.take(2, Request::Take, at(30));
        assert_eq!(wheel.input(at(31)), Some(Input::default()), "keys of another are not pressed any more");
        wheel.take(2, Request::Record, at(40));
        assert_eq!(wheel.take_actions(), [Action::Record]);
        wheel.leave(1);
        assert_eq!(wheel.holder(at(50)), Some(2));
        assert_eq!(wheel.holder(at(2000)), None, "silence");
        wheel.take(1, Request::Controls(pressed(0.0, 1.0)), at(2010));
        wheel.leave(1);
        assert_eq!(wheel.input(at(2011)), None);
    }

    #[test]
    fn keys_ramp_and_mouse_and_gamepad_act_at_once() {
        let mut cockpit = Cockpit::default();
        let ramped: Vec<f64> =
            (0..3).map(|_| cockpit.step(Some(pressed(-1.0, 0.0)), 0.0, 20.0, STEP_S).steering).collect();
        assert!((ramped[0] + 0.05).abs() < 1e-9 && (ramped[2] + 0.15).abs() < 1e-9, "{ramped:?}");
        let analog = Input { wheel: Some(7.0), pedals: Some(-0.4), ..pressed(-1.0, 1.0) };
        let controls = cockpit.step(Some(analog), 10.0, 20.0, STEP_S);
        assert_eq!((controls.steering, controls.throttle), (1.0, -0.4));
    }

    #[test]
    fn the_accelerator_stops_at_the_limit_and_cruising_ends_with_the_brake() {
        let (mut cockpit, mut car) = (Cockpit::default(), Car::new(0.0, 0.0, 1.0, 0.0, 0.0));
        cockpit.cruise = true;
        let mut highest = 0.0f64;
        for _ in 0..1500 {
            let mph = car.speed_mps / MPS_PER_MPH;
            let controls = cockpit.step(Some(Input::default()), mph, 20.0, STEP_S);
            car.step(controls, 0.0, 0.0);
            highest = highest.max(mph);
        }
        let mph = car.speed_mps / MPS_PER_MPH;
        assert!((mph - 20.0).abs() < 0.5 && highest < 22.5, "{mph} {highest}");
        cockpit.step(Some(pressed(0.0, -1.0)), mph, 20.0, STEP_S);
        assert!(!cockpit.cruise);
    }

    #[test]
    fn with_nobody_at_the_wheel_the_car_brakes_to_a_stop() {
        let (mut cockpit, mut car) = (Cockpit::default(), Car::new(0.0, 0.0, 1.0, 0.0, 9.0));
        cockpit.cruise = true;
        for _ in 0..400 {
            let controls = cockpit.step(None, car.speed_mps / MPS_PER_MPH, 20.0, STEP_S);
            assert_eq!(controls.throttle, -1.0);
            car.step(controls, 0.0, 0.0);
        }
        assert!(car.speed_mps == 0.0 && car.x < 30.0 && !cockpit.cruise, "{car:?}");
    }
}
