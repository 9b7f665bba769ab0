//! Videos of drives: the camera's picture, who steers how, and the way on the map, as H.264 in an MP4 file.
//!
//! [`mod@file`] writes the file picture by picture, [`pace`] shows each moment as long as it lasted, [`panel`] paints, and
//! [`drive`], [`replay`] and [`recording`] say what there is to see: a run as it is driven, one that was saved, and a
//! recording.

pub mod drive;
pub mod file;
mod mp4;
pub mod pace;
pub mod panel;
pub mod recording;
pub mod replay;

use std::path::Path;
use std::time::{Duration, Instant};

use serde::Serialize;

use crate::dataset::decode::RgbImage;
use crate::error::{Error, Result};
use crate::pilot::Pilot;
use crate::report::saliency::Saliency;
use pace::Pace;
use panel::{Panel, Scene};

/// Seconds for which the last picture stays.
const FAREWELL_S: f64 = 2.0;

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

/// A video that grows scene by scene.
pub struct Video {
    panel: Panel,
    pace: Pace,
}

impl Video {
    /// A video of `fps` pictures a second in the new file `path`.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] for a name that does not end in `.mp4`, a file that exists or cannot be created, or an impossible rate.
    pub fn create(path: &Path, panel: Panel, fps: f64) -> Result<Video> {
        Ok(Video { pace: Pace::create(path, panel.size(), fps)?, panel })
    }

    /// Adds what is to be seen at `scene.time_s`; times must not fall.
    ///
    /// # Errors
    ///
    /// If the file cannot be written.
    pub fn show(&mut self, scene: &Scene) -> Result<()> {
        let Video { panel, pace } = self;
        // The panel remembers where the car was, so that it must see scenes which are not shown too.
        panel.notice(scene);
        pace.show(scene.time_s, |picture| panel.paint(scene, picture))
    }

    /// Writes `text` over the last picture, lets it stay for a while, and gives the file its name. Without a scene there is no
    /// file.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] if nothing was shown; if the file cannot be written.
    pub fn finish(mut self, text: &str) -> Result<VideoSummary> {
        if self.pace.is_empty() {
            return Err(Error::Usage("there is nothing to show, so no video was written".into()));
        }
        self.pace.hold(FAREWELL_S, |picture| Panel::farewell(text, picture))?;
        self.pace.finish()
    }
}

/// A model that looks at the pictures of a video.
pub struct Onlooker {
    pilot: Pilot,
    saliency: Option<Saliency>,
}

impl Onlooker {
    /// Steers beside the driver; with `saliency` it also colours what excites it.
    ///
    /// # Errors
    ///
    /// As [`Saliency::new`].
    pub fn new(pilot: Pilot, saliency: bool) -> Result<Onlooker> {
        let saliency = saliency.then(|| Saliency::new(pilot.network())).transpose()?;
        Ok(Onlooker { pilot, saliency })
    }

    /// Angle of the front wheels at steering 1, degrees, of the car that the model was made for.
    pub fn full_lock_deg(&self) -> f64 {
        self.pilot.recipe().full_lock_deg
    }

    /// What the model steers, in degrees of the front wheels, + = right, and how long it took. The picture is coloured if that
    /// was asked for.
    ///
    /// # Errors
    ///
    /// As [`Pilot::steer`].
    pub fn look(&mut self, picture: &mut RgbImage) -> Result<(f64, Duration)> {
        let Onlooker { pilot, saliency } = self;
        let asked = Instant::now();
        let steering = pilot.steer(picture.height, picture.width, &picture.pixels)?;
        let answered_in = asked.elapsed();
        if let Some(saliency) = saliency {
            saliency.steer(pilot, picture.height, picture.width, &picture.pixels)?;
            saliency.overlay(&pilot.recipe().preprocessing, picture);
        }
        Ok((f64::from(steering) * pilot.recipe().full_lock_deg, answered_in))
    }
}
