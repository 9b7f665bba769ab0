//! A deterministic driving simulator without a window: tracks, a car, cameras, an expert, a recorder, and the measures of
//! a drive. Camera, car and recordings match Udacity's simulator.
//!
//! World coordinates are metres: x east, y north, z up. Angles of direction run anticlockwise from east. `steering` is
//! normalised to [-1, 1], + = right; offsets from the reference line are + = right.

pub mod camera;
pub mod car;
pub mod math;
pub mod recorder;
pub mod road;
pub mod scenery;
pub mod trial;

pub use camera::contact_sheet::{contact_sheet, side_by_side};
pub use camera::pinhole::{BodyPose, Camera, HEIGHT, Mount, RgbFrame, WIDTH};
pub use camera::renderer::Renderer;
pub use car::simulation::{Simulation, Start};
pub use car::speed::Speed;
pub use recorder::record::{LogFormat, RecordOptions, record};
pub use road::track::{Location, Station, Track};
pub use scenery::light::Variant;
pub use scenery::world::World;
pub use trial::closed_loop::ClosedLoop;
pub use trial::drive::{DriveOptions, DriveResult, DriveSummary, compare, drive, drive_observed};
pub use trial::observer::{DriveEvent, DriveFrame};
pub use trial::run::{DriveState, Driver, Expert, Run, RunOptions, Zero, run_observed};

#[cfg(test)]
mod tests;
