//! A trained pilot at the wheel of the simulated car.

use crate::pilot::Pilot;
use crate::simulator::{DriveState, Driver, RgbFrame};

impl Driver for Pilot {
    fn steer(&mut self, frame: &RgbFrame, _: &DriveState) -> f32 {
        // A frame always has the size it says, so this cannot fail; the simulator takes what is no number as straight ahead.
        Pilot::steer(self, frame.view()).unwrap_or(f32::NAN)
    }
}
