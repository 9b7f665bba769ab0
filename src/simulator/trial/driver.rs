//! Who steers in a trial: anything that answers a picture.

use crate::simulator::camera::pinhole::RgbFrame;
use crate::simulator::car::expert;
use crate::simulator::car::simulation::Simulation;

/// What a driver may know beside the picture.
pub struct DriveState<'a> {
    /// The car on its track. A driver that is to be judged looks only at the picture and at the speed.
    pub simulation: &'a Simulation<'a>,
    /// Speed as telemetry carries it, mph.
    pub speed_mph: f64,
}

/// Something that steers.
pub trait Driver {
    /// The steering, [-1, 1], + = right, for what the camera shows: 320x160, after JPEG, as it would be served.
    fn steer(&mut self, frame: &RgbFrame, state: &DriveState) -> f32;

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
