//! Models that other programs wrote or can read.

pub mod fit;
pub mod keras;
pub mod presets;
