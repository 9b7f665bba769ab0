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

/// A driver that looks through the camera of another car. Steering is that car's, and so is a speed that the driver wants: a small car
/// drives it on a model of the track, as recordings of it hold it.
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
        let pace = answer.pace.map(|pace| match pace {
            Pace::SpeedMph(speed_mph) => Pace::SpeedMph(speed_mph * foreign_car::scale(&self.car) as f32),
            Pace::Throttle(throttle) => Pace::Throttle(throttle),
        });
        DriverAnswer { steering: foreign_car::steering_of(f64::from(answer.steering), &self.car) as f32, pace }
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulator::Track;
    use crate::simulator::car::simulation::Start;

    /// Answers with the steering and the pace of a log's row.
    struct Row(DriverAnswer);

    impl Driver for Row {
        fn steer(&mut self, _: &RgbFrame, _: &DriveState) -> f32 {
            self.0.steering
        }

        fn drive(&mut self, _: &RgbFrame, _: &DriveState) -> DriverAnswer {
            self.0
        }
    }

    #[test]
    fn what_a_recording_of_another_car_holds_drives_the_own_car_as_it_was_driven() {
        let track = Track::load("lake").unwrap();
        let start = Start { s_m: 0.0, reverse: false, offset_m: 0.0, heading_deg: 0.0 };
        let simulation = Simulation::new(&track, start, 0.0);
        let state = DriveState { simulation: &simulation, speed_mph: 0.0 };
        for name in ["donkeycar", "steersman"] {
            let car = CarGeometry::preset(name).unwrap();
            // As the recorder writes it of 20 mph.
            let row = Row(DriverAnswer {
                steering: foreign_car::steering(0.3, &car) as f32,
                pace: Some(Pace::SpeedMph((20.0 / foreign_car::scale(&car)) as f32)),
            });
            let answer = InCar { driver: row, car: car.clone() }.drive(&RgbFrame::default(), &state);
            let Some(Pace::SpeedMph(speed_mph)) = answer.pace else { panic!("{answer:?}") };
            assert!((speed_mph - 20.0).abs() < 1e-4 && (answer.steering - 0.3).abs() < 1e-6, "{name}: {answer:?}");
            let throttle = Row(DriverAnswer { steering: 0.0, pace: Some(Pace::Throttle(0.4)) });
            let answer = InCar { driver: throttle, car }.drive(&RgbFrame::default(), &state);
            assert_eq!(answer.pace, Some(Pace::Throttle(0.4)), "{name}");
        }
    }
}
