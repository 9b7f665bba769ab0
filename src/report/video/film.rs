//! A video that grows frame by frame.

use std::path::Path;

use super::painter::{FilmFrame, Painter};
use super::summary::VideoSummary;
use super::timeline::Timeline;
use crate::error::{Error, Result};

/// Seconds for which the last picture stays.
const FAREWELL_S: f64 = 2.0;

/// A video that grows frame by frame.
pub struct Video {
    painter: Painter,
    timeline: Timeline,
}

impl Video {
    /// A video of `fps` pictures a second in the new file `path`.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] for a name that does not end in `.mp4`, a file that exists or cannot be created, or an impossible rate.
    pub fn create(path: &Path, painter: Painter, fps: f64) -> Result<Video> {
        Ok(Video { timeline: Timeline::create(path, painter.size(), fps)?, painter })
    }

    /// Adds what is to be seen at `frame.time_s`; times must not fall.
    ///
    /// # Errors
    ///
    /// If the file cannot be written.
    pub fn show(&mut self, frame: &FilmFrame) -> Result<()> {
        let Video { painter, timeline } = self;
        // The painter remembers where the car was, so that it must see scenes which are not shown too.
        painter.notice(frame);
        timeline.show(frame.time_s, |picture| painter.paint(frame, picture))
    }

    /// Writes `text` over the last picture, lets it stay for a while, and gives the file its name. Without a frame there is no
    /// file.
    ///
    /// # Errors
    ///
    /// [`Error::Input`] if nothing was shown; if the file cannot be written.
    pub fn finish(mut self, text: &str) -> Result<VideoSummary> {
        if self.timeline.is_empty() {
            return Err(Error::Input("there is nothing to show, so no video was written".into()));
        }
        self.timeline.hold(FAREWELL_S, |picture| Painter::farewell(text, picture))?;
        self.timeline.finish()
    }
}

/// Whether an observer wants no more of a video.
pub(super) fn ended_early(observed: Result<()>) -> Result<bool> {
    match observed {
        Ok(()) => Ok(false),
        Err(Error::Interrupted) => Ok(true),
        Err(error) => Err(error),
    }
}
