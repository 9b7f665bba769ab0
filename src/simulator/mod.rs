//! A deterministic driving simulator without a window: tracks, a car, cameras, an expert, a recorder, and the measures of
//! a drive. Camera, car and recordings match Udacity's simulator.
//!
//! World coordinates are metres: x east, y north, z up. Angles of direction run anticlockwise from east. `steering` is
//! normalised to [-1, 1], + = right; offsets from the reference line are + = right.

pub mod builtin;
mod bonnet;
pub mod camera;
pub mod car;
pub mod contact_sheet;
pub mod expert;
pub mod light;
pub mod math;
pub mod jpeg;
pub mod noise;
mod objects;
mod pictures;
pub mod random_track;
pub mod recorder;
pub mod renderer;
mod road_texture;
mod sky;
pub mod simulation;
pub mod speed;
pub mod spec;
mod terrain;
pub mod track;
mod world;

pub use camera::{BodyPose, Camera, HEIGHT, Mount, RgbFrame, WIDTH};
pub use light::Variant;
pub use renderer::Renderer;
pub use track::{Location, Station, Track};
pub use world::World;
