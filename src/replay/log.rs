//! What is driven on: the sessions of a recording with their paths, and their pictures.

use std::ops::Range;

use crate::dataset::{DrivenSession, DrivenSessions, Recording, View};
use crate::error::{Error, Result};
use crate::geometry::CarGeometry;
use crate::picture::RgbImage;
use crate::picture::decode::decode_rgb;

/// Sessions with a shorter path cannot be driven, m.
const MIN_PATH_M: f64 = 20.0;

/// A recording that can be driven on.
#[derive(Debug)]
pub struct ReplayLog<'a> {
    /// The recording.
    pub recording: &'a Recording,
    /// Its camera and car.
    pub geometry: CarGeometry,
    /// The sessions that are long enough, in the order of the log.
    pub sessions: Vec<DrivenSession>,
    /// Speed that was assumed because the recording says none, m/s.
    pub assumed_speed_mps: Option<f64>,
}

impl<'a> ReplayLog<'a> {
    /// The sessions of `recording` that are long enough to be driven.
    ///
    /// # Errors
    ///
    /// [`Error::Data`] if no session is.
    pub fn new(recording: &'a Recording, geometry: CarGeometry) -> Result<ReplayLog<'a>> {
        let log = ReplayLog::of_stretches(recording, geometry, &recording.sessions);
        if log.sessions.is_empty() {
            return Err(Error::data(
                &recording.path,
                format!("no session has a path of {MIN_PATH_M} m or more, so nothing can be driven on this recording"),
            ));
        }
        Ok(log)
    }

    /// All sessions of `recording`, also those that are too short to be driven.
    pub fn of_any_length(recording: &'a Recording, geometry: CarGeometry) -> ReplayLog<'a> {
        let DrivenSessions { geometry, sessions, assumed_speed_mps } = DrivenSessions::of(recording, geometry);
        ReplayLog { recording, geometry, sessions, assumed_speed_mps }
    }

    /// Those of `stretches` of the rows of `recording`, each within a session, that are long enough to be driven, as sessions of
    /// their own.
    pub fn of_stretches(recording: &'a Recording, geometry: CarGeometry, stretches: &[Range<usize>]) -> ReplayLog<'a> {
        let driven = DrivenSessions::of_stretches(recording, geometry, stretches);
        let DrivenSessions { geometry, mut sessions, assumed_speed_mps } = driven;
        sessions.retain(|session| session.path.length_m() >= MIN_PATH_M);
        ReplayLog { recording, geometry, sessions, assumed_speed_mps }
    }
}

/// The pictures of recordings, decoded when they are needed; the last one is kept.
#[derive(Debug, Default)]
pub struct Frames<'a> {
    file: Vec<u8>,
    image: RgbImage,
    held: Option<(&'a Recording, usize, View)>,
}

impl<'a> Frames<'a> {
    /// The picture of `camera` at `row` of `recording`.
    ///
    /// # Errors
    ///
    /// [`Error::Io`] and [`Error::Data`] with its path if it cannot be read.
    pub fn get(&mut self, recording: &'a Recording, row: usize, camera: View) -> Result<&RgbImage> {
        let is_held =
            |(held, at, of): (&Recording, usize, View)| std::ptr::eq(held, recording) && (at, of) == (row, camera);
        if !self.held.is_some_and(is_held) {
            self.held = None;
            recording.read_picture(row, camera, &mut self.file)?;
            let place = || recording.image_path(row, camera).unwrap_or_else(|| recording.path.clone());
            decode_rgb(&self.file, &mut self.image).map_err(|message| Error::data(place(), message))?;
            self.held = Some((recording, row, camera));
        }
        Ok(&self.image)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset;
    use crate::dataset::testing::jpeg;

    #[test]
    fn the_picture_that_is_kept_is_not_taken_for_that_of_another_recording() {
        let scratch = tempfile::tempdir().unwrap();
        let recordings = [("a", [200, 30, 30]), ("b", [30, 30, 200])].map(|(name, colour)| {
            let folder = scratch.path().join(name);
            std::fs::create_dir_all(folder.join("IMG")).unwrap();
            std::fs::write(folder.join("IMG/center.jpg"), jpeg(16, 16, colour)).unwrap();
            std::fs::write(folder.join("driving_log.csv"), "IMG/center.jpg,,,0.1,1,0,20\n".repeat(2)).unwrap();
            dataset::load(&folder).unwrap()
        });
        let mut frames = Frames::default();
        let mut red_above_blue = |number: usize, row: usize| {
            let picture = frames.get(&recordings[number], row, View::Centre).unwrap();
            picture.pixels[0] > picture.pixels[2]
        };
        let seen = [(0, 0), (1, 0), (0, 0), (0, 1), (1, 1), (1, 1)].map(|(number, row)| red_above_blue(number, row));
        assert_eq!(seen, [true, false, true, true, false, false]);
    }
}
