//! A deterministic driving simulator without a window: tracks, a car, cameras, an expert, a recorder, and the measures of
//! a drive. Camera, car and recordings match Udacity's simulator.
//!
//! World coordinates are metres: x east, y north, z up. Angles of direction run anticlockwise from east. `steering` is
//! normalised to [-1, 1], + = right; offsets from the reference line are + = right.
//!
//! Each room uses only those before it: `math`, `road` (the line, the track file, random tracks), `scenery` (the visible
//! world), `track` (a road with its world), `car` (its motion, the expert), `camera` (its frames), `trial` (a measured drive),
//! `recorder` (a drive as a recording), `drives` (many drives, which several processes share).

pub(crate) mod camera;
pub(crate) mod car;
pub(crate) mod drives;
pub(crate) mod math;
pub(crate) mod recorder;
pub(crate) mod road;
pub(crate) mod scenery;
pub(crate) mod track;
pub(crate) mod trial;

pub use camera::contact_sheet::{contact_sheet, side_by_side};
pub use camera::foreign_car::trouble as camera_trouble;
pub use camera::jpeg;
pub use camera::pinhole::{Camera, HEIGHT, Mount, RgbFrame, WIDTH};
pub use camera::renderer::Renderer;
pub use car::pose::BodyPose;
pub use car::simulation::{Simulation, Start};
pub use car::speed::{Pace, Speed, SpeedController};
#[cfg(feature = "mpi")]
pub(crate) use drives::Drives;
pub use drives::{Leg, LegResult, drive_legs, offline_mae_deg};
pub use recorder::options::{LogFormat, RecordOptions};
#[cfg(feature = "mpi")]
pub(crate) use recorder::photograph::Photographs;
pub use recorder::record::{RecordRequest, record, record_all, record_driven};
pub use road::line::{Location, Road, Station};
pub use scenery::light::Variant;
pub use scenery::world::World;
pub use track::Track;
pub use trial::closed_loop::ClosedLoop;
pub use trial::drive::{compare, drive, drive_observed, drive_observed_as_far};
pub use trial::driver::{DriveState, Driver, DriverAnswer, Expert, InCar, Zero};
pub use trial::event::{DriveEvent, DriveFrame};
pub use trial::outcome::{Failure, Trial, TrialOptions};
pub use trial::run::{run_trial, run_trial_observed};
pub use trial::summary::{DriveOptions, DriveResult, DriveSummary};
pub use trial::wheel::Wheel;

#[cfg(test)]
mod tests;
