//! What people look at: charts, pages, explanations of a model, and videos.
//!
//! [`charts`] draws, [`explain`] asks a model what it looks at, [`pages`] writes HTML pages that open from disk and load
//! nothing, [`video`] films drives and recordings.

pub mod charts;
pub mod explain;
pub mod pages;
pub mod tone;
#[cfg(feature = "video")]
pub mod video;
