//! Recordings: reading, splitting, preprocessing and loading them.

pub mod colour;
pub mod decode;
pub mod preprocess;
pub mod resize;
mod spec_tmp;
pub use spec_tmp::*;
pub use preprocess::Preprocessing;
