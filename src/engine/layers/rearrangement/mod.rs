//! Layers that move values and compute nothing.

mod crop;
mod flatten;
mod zero_pad;

pub use crop::{Crop, CropSpec};
pub use flatten::{Flatten, FlattenSpec};
pub use zero_pad::{ZeroPad, ZeroPadSpec};
