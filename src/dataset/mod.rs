//! Recordings: reading, splitting, preprocessing and loading them.

pub mod augment;
pub mod cache;
pub mod colour;
mod decimal_comma;
pub mod decode;
mod driving_log;
mod files;
pub mod inspect;
pub mod leak;
mod load;
pub mod loader;
pub mod preprocess;
mod recording;
pub mod resize;
mod samples;
pub mod split;
mod tub;

pub use load::{ImageCheck, load, load_with};
pub use recording::{ASSUMED_STEP_MS, Camera, Kind, Reason, Recording, Row, SESSION_GAP_MS, Tally, Unusable};
pub use samples::{Balance, Flip, Group, Item, SampleSpec};

#[cfg(test)]
mod testing;
