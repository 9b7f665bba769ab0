//! Drivers: anything that answers a frame with steering.

use crate::simulator::camera::pinhole::RgbFrame;
use crate::simulator::car::expert;
use crate::simulator::car::simulation::Simulation;
use crate::simulator::car::speed::{Pace, Speed};

/// What a driver may know beside the picture.
pub struct DriveState<'a> {
    /// The car on its track. A driver that is to be judged looks only at the picture and at the speed.
    pub simulation: &'a Simulation<'a>,
    /// Speed as telemetry carries it, mph.
    pub speed_mph: f64,
}

/// What a driver answers a frame with.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DriverAnswer {
    /// Steering, [-1, 1], + = right.
    pub steering: f32,
    /// Throttle or speed, of drivers that decide it; others leave it to whoever lets them drive.
    pub pace: Option<Pace>,
}

/// Something that steers.
pub trait Driver {
    /// The steering, [-1, 1], + = right, for what the camera shows: 320x160, after JPEG, as it would be served.
    fn steer(&mut self, frame: &RgbFrame, state: &DriveState) -> f32;

    /// The same with the throttle or the speed that the driver wants, if it has a mind of its own about that.
    fn drive(&mut self, frame: &RgbFrame, state: &DriveState) -> DriverAnswer {
        DriverAnswer { steering: self.steer(frame, state), pace: None }
    }

    /// Whether the driver wants the trial to end at once, without a result.
    fn gives_up(&self) -> bool {
        false
    }

    /// Whether `steer` looks at the picture; if not, none is taken.
    fn needs_frame(&self) -> bool {
        true
    }
}

/// The driver whose steering is the label of recordings.
pub struct Expert;

impl Driver for Expert {
    fn steer(&mut self, _: &RgbFrame, state: &DriveState) -> f32 {
        expert::pursuit(state.simulation) as f32
    }

    fn drive(&mut self, frame: &RgbFrame, state: &DriveState) -> DriverAnswer {
        let speed_mph = Speed::Auto.target_mph(state.simulation) as f32;
        DriverAnswer { steering: self.steer(frame, state), pace: Some(Pace::SpeedMph(speed_mph)) }
    }

    fn needs_frame(&self) -> bool {
        false
    }
}

/// The driver that never steers; what any other must beat.
pub struct Zero;

impl Driver for Zero {
    fn steer(&mut self, _: &RgbFrame, _: &DriveState) -> f32 {
        0.0
    }

    fn needs_frame(&self) -> bool {
        false
    }
}
