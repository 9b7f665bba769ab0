//! steersman: a from-scratch CNN engine that learns to steer a car from its front camera.
#![forbid(unsafe_code)]

pub mod atomic_file;
pub mod cli;
pub mod dataset;
pub mod error;
pub mod layers;
pub mod main_job;
pub mod model_file;
pub mod network;
pub mod optimizer;
pub mod pilot;
pub mod random;
pub mod recipe;
pub mod report;
pub mod simulator;
pub mod tensor;
pub mod training;

pub use error::{Error, Result};
