//! Recordings: reading, splitting, preprocessing and loading them.

pub mod colour;
mod decimal_comma;
pub mod decode;
mod driving_log;
mod files;
mod load;
pub mod preprocess;
mod recording;
pub mod resize;
mod tub;

pub use load::{ImageCheck, load, load_with};
pub use recording::{ASSUMED_STEP_MS, Camera, Kind, Reason, Recording, Row, SESSION_GAP_MS, Tally, Unusable};

#[cfg(test)]
mod testing;
