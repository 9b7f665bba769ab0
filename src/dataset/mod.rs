//! Recordings: reading, splitting, preprocessing and loading them.
//!
//! The way of a frame to the network:
//! 1. [`load()`] reads a recording, finds its images and leaves out rows that cannot be used;
//! 2. [`split::split`] divides the rows into training and validation, before anything is augmented;
//! 3. [`loader::Loader`] decodes each image once, preprocesses it ([`preprocess`]), keeps it ([`cache`]), augments
//!    training images ([`augment`]) and hands out batches.
//!
//! Labels are steering in [-1, 1], + = right. Side cameras and shifts move them, mirrors negate them; they are never
//! clamped. [`leak`] measures what the training side gives away of the validation side, [`inspect`] describes a
//! recording for people.

pub mod augment;
pub mod cache;
pub mod colour;
mod decimal_comma;
mod driving_log;
mod files;
pub mod held_out;
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
pub(crate) mod testing;
