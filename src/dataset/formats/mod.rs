//! Formats of recordings.

mod decimal_comma;
pub(crate) mod tub;
pub(crate) mod udacity;
pub mod udacity_writer;
