//! The expert drives, and its pictures and labels become a recording.

pub mod expert_drive;
pub mod options;
pub(crate) mod photograph;
pub mod record;
pub mod sample;
pub mod writer;
