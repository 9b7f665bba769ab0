//! Drivers: anything that answers a frame with steering.

use crate::geometry::CarGeometry;
use crate::simulator::camera::foreign_car;
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
    /// The steering, [-1, 1], + = right, for what the camera shows after JPEG, as it would be served: 320x160, or
    /// the picture of [`car`](Driver::car).
    fn steer(&mut self, frame: &RgbFrame, state: &DriveState) -> f32;

    /// The same with the throttle or the speed that the driver wants, if it has a mind of its own about that.
    fn drive(&mut self, frame: &RgbFrame, state: &DriveState) -> DriverAnswer {
        DriverAnswer { steering: self.steer(frame, state), pace: None }
    }

    /// The car through whose camera it looks; the simulator's own if there is none.
    fn car(&self) -> Option<&CarGeometry> {
        None
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

/// A driver that looks through the camera of another car. Steering is that car's.
pub struct InCar<D> {
    /// The driver.
    pub driver: D,
    /// The car, which the simulator must be able to have.
    pub car: CarGeometry,
}

impl<D: Driver> Driver for InCar<D> {
    fn steer(&mut self, frame: &RgbFrame, state: &DriveState) -> f32 {
        self.drive(frame, state).steering
    }

    fn drive(&mut self, frame: &RgbFrame, state: &DriveState) -> DriverAnswer {
        let answer = self.driver.drive(frame, state);
        DriverAnswer { steering: foreign_car::steering_of(f64::from(answer.steering), &self.car) as f32, ..answer }
    }

    fn car(&self) -> Option<&CarGeometry> {
        Some(&self.car)
    }

    fn gives_up(&self) -> bool {
        self.driver.gives_up()
    }

    fn needs_frame(&self) -> bool {
        self.driver.needs_frame()
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
