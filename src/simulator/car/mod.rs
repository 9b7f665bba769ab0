//! The car, and who moves its pedals and its wheel.

pub mod dynamics;
pub mod expert;
pub mod keys;
pub mod noise;
pub mod pose;
pub mod simulation;
pub mod speed;
