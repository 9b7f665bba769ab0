//! Turns moments at uneven times into pictures at an even rate: each moment stays until the next one begins.

use std::path::Path;

use super::file::VideoFile;
use super::summary::VideoSummary;
use crate::error::Result;
use crate::picture::RgbImage;

/// A video that shows at each time the last moment before it, to half a frame.
pub(super) struct Timeline {
    file: VideoFile,
    /// The last picture, painted and not yet written: only the next moment says how long it stays.
    picture: RgbImage,
    first_s: Option<f64>,
}

impl Timeline {
    /// As [`VideoFile::create`].
    pub fn create(path: &Path, size: [usize; 2], fps: f64) -> Result<Timeline> {
        let picture = RgbImage::filled(size[0], size[1], [255; 3]);
        Ok(Timeline { file: VideoFile::create(path, size, fps)?, picture, first_s: None })
    }

    /// Whether nothing has been shown.
    pub fn is_empty(&self) -> bool {
        self.first_s.is_none()
    }

    /// From `time_s` on, what `paint` paints is to be seen.
    pub fn show(&mut self, time_s: f64, paint: impl FnOnce(&mut RgbImage)) -> Result<()> {
        let first_s = *self.first_s.get_or_insert(time_s);
        let begins_at = ((time_s - first_s) * self.file.fps()).round() as u64;
        while self.file.frames() < begins_at {
            self.file.write(&self.picture)?;
        }
        paint(&mut self.picture);
        Ok(())
    }

    /// Shows the last picture, with what `paint` adds, for `seconds`.
    pub fn hold(&mut self, seconds: f64, paint: impl FnOnce(&mut RgbImage)) -> Result<()> {
        paint(&mut self.picture);
        for _ in 0..(seconds * self.file.fps()).round().max(1.0) as u64 {
            self.file.write(&self.picture)?;
        }
        Ok(())
    }

    /// As [`VideoFile::finish`].
    pub fn finish(self) -> Result<VideoSummary> {
        self.file.finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Length in pictures of a video of 20 moments a second, written at `fps`, with a pause in it.
    fn pictures(fps: f64) -> u64 {
        let scratch = tempfile::tempdir().unwrap();
        let mut timeline = Timeline::create(&scratch.path().join("a.mp4"), [32, 32], fps).unwrap();
        assert!(timeline.is_empty());
        let mut painted = 0;
        for k in 0..40 {
            let pause_s = if k >= 20 { 0.65 } else { 0.0 };
            timeline
                .show(7.0 + f64::from(k) / 20.0 + pause_s, |picture| {
                    painted += 1;
                    *picture = RgbImage::filled(32, 32, [k as u8 * 6; 3]);
                })
                .unwrap();
        }
        assert_eq!(painted, 40);
        timeline.hold(1.0, |_| ()).unwrap();
        timeline.finish().unwrap().frames
    }

    #[test]
    fn moments_last_as_long_as_they_did_whatever_the_rate() {
        // 39 steps and a pause: 2.6 s until the last moment, which stays for 1 s.
        assert_eq!(pictures(20.0), 52 + 20);
        assert_eq!(pictures(10.0), 26 + 10);
        assert_eq!(pictures(60.0), 156 + 60);
        assert_eq!(pictures(7.0), 18 + 7);
    }
}
