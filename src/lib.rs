//! steersman: a from-scratch CNN engine that learns to steer a car from its front camera.
#![forbid(unsafe_code)]

pub mod error;
pub mod simulator;

pub use error::{Error, Result};
