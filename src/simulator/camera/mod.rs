//! Cameras, and how they see the scenery.

pub(crate) mod bonnet;
pub mod contact_sheet;
pub mod eye;
pub mod jpeg;
pub(crate) mod objects;
pub mod pinhole;
pub mod renderer;
