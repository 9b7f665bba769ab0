//! What people look at: charts, pages, explanations of a model, and videos.
//!
//! [`charts`] draws, [`explain`] asks a model what it looks at, [`pages`] writes HTML pages that open from disk and load
//! nothing, [`video`] films drives and recordings.
//!
//! To add a chart: draw it in `charts/` (a `Chart` of `Axis` and `Mark`s in `charts/chart.rs`, or an `Svg` of your own), and give it to
//! the `Page` that shows it as a `Figure`: `pages/run.rs`, `pages/inspection.rs` or `pages/comparison.rs`.

pub mod charts;
pub mod explain;
pub mod on_recording;
pub mod pages;
pub mod tone;
#[cfg(feature = "video")]
pub mod video;
