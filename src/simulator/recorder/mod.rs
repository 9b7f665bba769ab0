//! The expert drives, and its pictures and labels become a recording.

pub mod record;
pub mod writer;
