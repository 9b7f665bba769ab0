//! A deterministic driving simulator without a window: tracks, a car, cameras, an expert, a recorder, and the measures of
//! a drive. Camera, car and recordings match Udacity's simulator.
//!
//! World coordinates are metres: x east, y north, z up. Angles of direction run anticlockwise from east. `steering` is
//! normalised to [-1, 1], + = right; offsets from the reference line are + = right.

mod bonnet;
pub mod builtin;
pub mod camera;
pub mod car;
pub mod closed_loop;
pub mod contact_sheet;
pub mod drive;
pub mod expert;
pub mod eye;
pub mod jpeg;
pub mod keys;
pub mod light;
pub mod math;
pub mod noise;
mod objects;
pub mod observer;
mod pictures;
pub mod random_track;
pub mod recorder;
pub mod renderer;
mod road_texture;
pub mod run;
pub mod simulation;
mod sky;
pub mod spec;
pub mod speed;
pub mod statistics;
mod terrain;
pub mod track;
pub mod trajectory;
mod world;
pub mod writer;

pub use camera::{BodyPose, Camera, HEIGHT, Mount, RgbFrame, WIDTH};
pub use closed_loop::ClosedLoop;
pub use contact_sheet::{contact_sheet, side_by_side};
pub use drive::{DriveOptions, DriveResult, DriveSummary, compare, drive, drive_observed};
pub use light::Variant;
pub use observer::{DriveFrame, DriveObserver};
pub use recorder::{LogFormat, RecordOptions, record};
pub use renderer::Renderer;
pub use run::{DriveState, Driver, Expert, Run, RunOptions, Zero, run_observed};
pub use simulation::{Simulation, Start};
pub use speed::Speed;
pub use track::{Location, Station, Track};
pub use world::World;

#[cfg(test)]
mod tests;
