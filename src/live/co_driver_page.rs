//! The page of a server that drives: it shows what the car sees, and a person takes the wheel there when the model errs.

use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use super::messages::{Hello, Input, State, Takeover};
use super::server::Live;
use crate::error::Result;
use crate::serve::{AnsweredFrame, CoDriver, HandWheel, Hands};

/// Time after the last key, or movement of mouse or gamepad, for which the wheel stays with the person: between two taps of a
/// correction the model must not interfere.
const GIVE_BACK: Duration = Duration::from_millis(700);
/// Smallest deflection of mouse or gamepad that takes the wheel.
const MIN_DEFLECTION: f64 = 0.02;

/// A page that watches a [`Server`](crate::serve::Server) and may take its wheel.
#[derive(Debug)]
pub struct CoDriverPage {
    live: Live,
    /// When the person last steered or braked.
    last_touch: Mutex<Option<Instant>>,
}

impl CoDriverPage {
    /// Serves the page at `port` of the loopback address; 0 takes any free port. `driver` is the name of the model.
    ///
    /// # Errors
    ///
    /// [`Error::System`](crate::Error::System) with the remedy if the port cannot be had.
    pub fn start(port: u16, driver: String) -> Result<CoDriverPage> {
        Ok(CoDriverPage { live: Live::start(port, Hello::beside(driver), true)?, last_touch: Mutex::default() })
    }

    /// The address to open in a browser.
    pub fn url(&self) -> String {
        self.live.url()
    }

    /// Tells every page how the drive ended, and closes the connections.
    pub fn finish(self, words: &str) {
        self.live.finish(words);
    }
}

/// What the hands do, if they do anything.
fn hands(input: &Input) -> Option<Hands> {
    let deflected = |value: Option<f64>| value.filter(|value| value.abs() > MIN_DEFLECTION);
    let pressed = |value: f64| (value != 0.0).then(|| value.clamp(-1.0, 1.0));
    let throttle = deflected(input.pedals).or(pressed(input.pedal)).map(|throttle| throttle as f32);
    let touched = throttle.is_some() || deflected(input.wheel).is_some() || pressed(input.steer).is_some();
    touched.then(|| Hands { wheel: wheel(input), throttle })
}

fn wheel(input: &Input) -> HandWheel {
    match input.wheel {
        Some(wheel) => HandWheel::At(wheel as f32),
        None => HandWheel::Keys(input.steer.clamp(-1.0, 1.0)),
    }
}

impl CoDriver for CoDriverPage {
    fn hands(&self, now: Instant) -> Option<Hands> {
        let input = self.live.with_wheel(|wheel| wheel.input(now)).flatten();
        let mut last_touch = self.last_touch.lock().unwrap_or_else(PoisonError::into_inner);
        // Without a page, or with one that has fallen silent, the model drives at once.
        let Some(input) = input else {
            *last_touch = None;
            return None;
        };
        if let Some(hands) = hands(&input) {
            *last_touch = Some(now);
            return Some(hands);
        }
        let holds = last_touch.is_some_and(|last| now.saturating_duration_since(last) < GIVE_BACK);
        holds.then(|| Hands { wheel: wheel(&input), throttle: None })
    }

    fn see(&self, frame: &AnsweredFrame, rows_by_user: Option<u64>) {
        if self.live.viewers() == 0 {
            return;
        }
        let driver = self.live.with_wheel(|wheel| wheel.holder(Instant::now())).flatten();
        let state = State {
            time_s: frame.time_s,
            steering: f64::from(frame.steering),
            throttle: f64::from(frame.throttle),
            expert: f64::from(frame.steering_of_model),
            speed_mph: frame.speed_mph,
            takeover: Some(Takeover { driver, by_user: frame.by_user, rows: rows_by_user }),
            ..State::default()
        };
        self.live.publish(&state, frame.image, &[]);
    }
}

#[cfg(test)]
mod tests {
    use super::super::messages::Request;
    use super::*;

    #[test]
    fn hands_that_rest_leave_the_wheel_to_the_model_after_a_while() {
        let page = CoDriverPage::start(0, "a model".into()).unwrap();
        let start = Instant::now();
        let at = |ms: u64| start + Duration::from_millis(ms);
        let send = |input: Input, now: Instant| {
            page.live.with_wheel(|wheel| wheel.take(1, Request::Controls(input), now));
        };
        assert_eq!(page.hands(at(0)), None, "no page");
        send(Input::default(), at(0));
        assert_eq!(page.hands(at(1)), None, "a page that is only looked at");
        send(Input { steer: -1.0, ..Input::default() }, at(10));
        let keys = |pressed, throttle| Some(Hands { wheel: HandWheel::Keys(pressed), throttle });
        assert_eq!(page.hands(at(11)), keys(-1.0, None));
        send(Input::default(), at(20));
        assert_eq!(page.hands(at(700)), keys(0.0, None), "the wheel returns to the middle");
        send(Input::default(), at(711));
        assert_eq!(page.hands(at(712)), None);
        send(Input { pedal: -1.0, ..Input::default() }, at(800));
        assert_eq!(page.hands(at(801)), keys(0.0, Some(-1.0)));
        send(Input { wheel: Some(0.4), ..Input::default() }, at(900));
        assert_eq!(page.hands(at(901)), Some(Hands { wheel: HandWheel::At(0.4), throttle: None }));
        send(Input { wheel: Some(0.0), pedals: Some(0.0), ..Input::default() }, at(1000));
        assert!(page.hands(at(1001)).is_some(), "a mouse that rests is held for a while");
        send(Input { wheel: Some(0.0), pedals: Some(0.0), ..Input::default() }, at(1900));
        assert_eq!(page.hands(at(1901)), None, "a gamepad on the table does not drive");
        send(Input { steer: 1.0, ..Input::default() }, at(2000));
        assert!(page.hands(at(2001)).is_some());
        assert_eq!(page.hands(at(9000)), None, "a page that hangs does not drive");
    }
}
