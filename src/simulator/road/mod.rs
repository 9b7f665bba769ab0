//! Tracks: the line of a road, the file that describes it, the built-in ones and random ones.

pub mod builtin;
pub mod line;
pub mod random_track;
pub mod spec;
