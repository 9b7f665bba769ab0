//! The visible world: land, road surface, sky, objects beside the road, and the light on them.

pub mod light;
pub(crate) mod pictures;
pub(crate) mod road_texture;
pub(crate) mod sky;
pub(crate) mod terrain;
pub(crate) mod texel;
pub(crate) mod world;
