//! The car: its motion, the expert, keys, and the speed controller.

pub mod dynamics;
pub mod expert;
pub mod keys;
pub mod noise;
pub mod pose;
pub mod simulation;
pub mod speed;
