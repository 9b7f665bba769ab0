//! The video of a drive on a recording: the warped pictures that the model saw, and its steering beside the steering that leads back
//! to the driven path.

use std::path::Path;

use super::film::Video;
use super::onlooker::Onlooker;
use super::painter::{Captions, FilmFrame, FilmScales, Painter};
use super::summary::VideoSummary;
use crate::error::Result;
use crate::geometry::MPH_PER_MPS;
use crate::replay::{DRIVE_HZ, ReplayFrame, ReplayLog, ReplayRun};

/// The video of a drive along one session, begun.
pub struct ReplayVideo {
    video: Video,
    onlooker: Option<Onlooker>,
    frame: FilmFrame,
    full_lock_deg: f64,
}

impl ReplayVideo {
    /// Begins the video of `run`, a drive of `driver` on `log`, in the new file `path`: `fps` pictures a second, or as many as the
    /// driver saw. An `onlooker` colours the pictures.
    ///
    /// # Errors
    ///
    /// As [`Video::create`].
    pub fn create(
        path: &Path,
        log: &ReplayLog,
        run: &ReplayRun,
        driver: &str,
        fps: Option<f64>,
        onlooker: Option<Onlooker>,
    ) -> Result<ReplayVideo> {
        let full_lock_deg = log.geometry.full_lock_deg;
        let place = log.recording.path.file_name().unwrap_or(log.recording.path.as_os_str()).to_string_lossy();
        let names = Captions {
            title: format!("on {place}"),
            subtitle: driver.into(),
            model: Some(if driver == "zero" { "driver" } else { "model" }),
            reference: "path",
        };
        let angles = run.moments.iter().map(|m| m.steering * full_lock_deg);
        let scales = FilmScales::covering(angles, run.moments.iter().map(|m| m.offset_m));
        let painter = Painter::new(names, scales, None, onlooker.is_some());
        let video = Video::create(path, painter, fps.unwrap_or(DRIVE_HZ))?;
        Ok(ReplayVideo { video, onlooker, frame: FilmFrame::default(), full_lock_deg })
    }

    /// Adds a frame.
    ///
    /// # Errors
    ///
    /// If the file cannot be written.
    pub fn show(&mut self, seen: &ReplayFrame) -> Result<()> {
        let (frame, moment) = (&mut self.frame, &seen.moment);
        frame.picture.clone_from(seen.view);
        if let Some(onlooker) = &mut self.onlooker {
            onlooker.look(&mut frame.picture)?;
        }
        frame.time_s = moment.time_s;
        frame.model_deg = Some(moment.steering * self.full_lock_deg);
        frame.reference_deg = moment.pursuit.map(|steering| steering * self.full_lock_deg);
        frame.speed_mph = Some(moment.speed_mps * MPH_PER_MPS);
        frame.cte_m = Some(moment.offset_m);
        frame.put_back = moment.put_back;
        self.video.show(frame)
    }

    /// Ends the video with the words `text`.
    ///
    /// # Errors
    ///
    /// As [`Video::finish`].
    pub fn finish(self, text: &str) -> Result<VideoSummary> {
        self.video.finish(text)
    }
}
