//! Measures of how well a model predicts.

mod metrics;

pub use metrics::{Metrics, Prediction, correlation};
