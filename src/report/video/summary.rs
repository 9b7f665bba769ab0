//! What a video came to.

use serde::Serialize;

/// What a video came to.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct VideoSummary {
    /// Pictures.
    pub frames: u64,
    /// Pictures for each second.
    pub fps: f64,
    /// Length, s.
    pub seconds: f64,
    /// Size of the file.
    pub bytes: u64,
    /// Rows of a recording whose picture is missing or cannot be read; the picture before stays in view.
    pub unreadable: usize,
}
