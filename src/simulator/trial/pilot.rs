//! A trained pilot at the wheel of the simulated car.

use crate::pilot::{Answer, Pilot};
use crate::simulator::car::speed::Pace;
use crate::simulator::{DriveState, Driver, DriverAnswer, RgbFrame};

impl Driver for Pilot {
    fn steer(&mut self, frame: &RgbFrame, state: &DriveState) -> f32 {
        self.drive(frame, state).steering
    }

    fn drive(&mut self, frame: &RgbFrame, _: &DriveState) -> DriverAnswer {
        // A frame always has the size it says, so this cannot fail; the simulator takes what is no number as straight ahead.
        match self.answer(frame.view()) {
            Ok(answer) => DriverAnswer { steering: answer.steering, pace: self.pace(&answer) },
            Err(_) => DriverAnswer { steering: f32::NAN, pace: None },
        }
    }
}

impl Pilot {
    /// The throttle or the speed of an answer, of models that give one.
    pub fn pace(&self, answer: &Answer) -> Option<Pace> {
        let top_mph = self.recipe().outputs.top_speed_mph().unwrap_or_default() as f32;
        let speed = answer.speed.map(|share| Pace::SpeedMph(share * top_mph));
        speed.or(answer.throttle.map(Pace::Throttle))
    }

    /// Whether the model gives a throttle or a speed.
    pub fn has_pace(&self) -> bool {
        self.recipe().outputs.count() > 1
    }
}
