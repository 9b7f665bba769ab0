//! Measures of how well a model predicts, and pictures of data, networks and runs.
//!
//! [`svg`], [`chart`], [`html`] and [`picture`] draw; the other modules say what there is to see. Pages stand alone: they open
//! from disk and load nothing.

pub mod chart;
pub mod comparison;
pub mod counterfactual;
pub mod explanation;
pub mod footage;
pub mod html;
pub mod inspection;
mod lettering;
pub mod map;
mod metrics;
pub mod network_diagram;
pub mod palette;
pub mod picture;
pub mod run;
pub mod saliency;
pub mod sparkline;
pub mod split_view;
pub mod steering;
pub mod svg;
pub mod video;

pub use metrics::{Metrics, Prediction, correlation};
