//! steersman: a from-scratch CNN engine that learns to steer a car from its front camera.
#![forbid(unsafe_code)]

pub mod dataset;
pub mod error;
pub mod random;

pub use error::{Error, Result};
