//! From picture files to the network's input: where they are, size, colour, rows, and what is kept of them.

pub(crate) mod blur;
pub mod cache;
pub mod colour;
pub(crate) mod files;
pub mod preprocess;
pub mod resize;
