//! Cameras, and how they see the scenery.

mod bonnet;
pub mod contact_sheet;
pub mod foreign_car;
pub mod front_camera;
pub mod jpeg;
mod objects;
pub mod pinhole;
pub mod renderer;
mod view;
