//! What is known of a recording once it is read: rows, sessions, and what had to be left out.

use super::formats::Format;
use super::pictures::files::{Files, Name};
use super::pictures::preprocess::Preprocessing;
use super::store::Store;
use super::unusable::Unusable;
use crate::geometry::CarGeometry;
use crate::picture::RgbImage;
use crate::picture::decode::decode_rgb;
use crate::{Error, Result};
use rayon::prelude::*;
use serde::Serialize;
use sha2::{Digest, Sha256};
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Two rows further apart than this, in milliseconds, belong to different sessions.
pub const SESSION_GAP_MS: i64 = 1000;
/// Largest share of unusable rows that training accepts.
const MAX_UNUSABLE_SHARE: f64 = 0.2;
/// Which camera of the car a picture is from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum View {
    /// In the middle, the one that drives.
    Centre,
    /// About 0.8 m to the left.
    Left,
    /// About 0.8 m to the right.
    Right,
}

impl View {
    /// All cameras, in the order of the columns of a log.
    pub const ALL: [View; 3] = [View::Centre, View::Left, View::Right];

    /// Name in messages.
    pub fn name(self) -> &'static str {
        ["centre", "left", "right"][self as usize]
    }

    /// How many corrections are added to the steering for this camera: +1 left, −1 right, 0 centre.
    pub fn correction_sign(self) -> f32 {
        [0.0, 1.0, -1.0][self as usize]
    }
}

/// One usable instant of a recording. Kept small, so that long logs stay in memory: see `size_of_a_row` below.
#[derive(Debug, Clone)]
pub struct Row {
    /// Steering label in [-1, 1], + = right.
    pub steering: f32,
    /// Throttle, 0 to 1 (−1 to 1 in tubs). NaN where it was not recorded.
    pub throttle: f32,
    /// Brake, 0 to 1. NaN where it was not recorded.
    pub brake: f32,
    /// Speed in miles per hour. NaN where it was not recorded.
    pub speed_mph: f32,
    /// Whether a person took the wheel from a model that drove: the log has a column `mode` that says `user`, and
    /// something else in other rows.
    pub taken_over: bool,
    /// Whether a person has left it out; such rows are in a recording only if they were asked for.
    pub(crate) excluded: bool,
    /// What it is named by where a person leaves it out: the line of a log, the number of a tub's record.
    pub(crate) number: u32,
    /// Time in milliseconds; only differences within a recording mean something.
    pub time_ms: i64,
    /// Line of the log, from 1.
    pub line: u32,
    /// Rows written in another folder or session of the recorder, or behind rows that a person has left out, have another number.
    pub(super) source: u16,
    pub(super) images: [Option<Name>; 3],
}

/// A recording, ready to be split and loaded. Its files are only ever read.
#[derive(Debug)]
pub struct Recording {
    /// The folder or file it was read from.
    pub path: PathBuf,
    /// The folder of its log, where `steersman.toml` may lie.
    pub(crate) folder: PathBuf,
    /// How it is written.
    pub(crate) format: &'static Format,
    /// The usable rows, in the order of the log.
    pub rows: Vec<Row>,
    /// Ranges of `rows` that were driven without a break.
    pub sessions: Vec<Range<usize>>,
    /// What was left out.
    pub unusable: Unusable,
    /// What the reader should know: cameras that fall away, time stamps that cannot be true.
    pub notices: Vec<String>,
    /// Height and width of the first image, if it was looked at.
    pub image_size: Option<[usize; 2]>,
    /// Camera and car: as was said, or the preset for recordings of this kind.
    pub geometry: CarGeometry,
    /// Whether all of it was said.
    pub camera_named: bool,
    /// Whether `time_ms` comes from the recording or the user; otherwise a rate is assumed.
    pub times_plausible: bool,
    /// Why the labels cannot be believed: they look like another unit than shares of full lock.
    pub(super) unit_trouble: Option<String>,
    /// A hash of each row's centre picture, once [`Recording::hash_pictures`] has read them.
    pub(super) picture_hashes: Vec<u64>,
    pub(super) files: Files,
    pub(super) store: Store,
}

impl Recording {
    /// Number of rows in the log, usable or not.
    pub fn total_rows(&self) -> usize {
        self.rows.len() + self.unusable.rows()
    }

    /// Whether the recording has images of `camera`.
    pub fn has(&self, camera: View) -> bool {
        self.rows.iter().any(|row| row.images[camera as usize].is_some())
    }

    /// Path of the image of `camera` at `row`, if there is one.
    pub fn image_path(&self, row: usize, camera: View) -> Option<PathBuf> {
        let name = self.rows.get(row)?.images[camera as usize]?;
        Some(self.files.path(name))
    }

    /// Reads the file of the picture of `camera` at `row` into `bytes`.
    ///
    /// # Errors
    /// [`Error::Io`] if there is none, or it cannot be read.
    pub fn read_picture(&self, row: usize, camera: View, bytes: &mut Vec<u8>) -> Result<()> {
        match self.image_path(row, camera) {
            Some(path) => self.store.read(&path, bytes).map_err(Error::io(path)),
            None => Err(Error::io(&self.path)(std::io::ErrorKind::NotFound.into())),
        }
    }

    /// Name of the format.
    pub fn kind(&self) -> &'static str {
        self.format.id
    }

    /// What is to be said where the geometry of the recording matters: the preset that was assumed, if none was named.
    pub fn camera_notice(&self) -> Option<String> {
        (!self.camera_named).then(|| {
            format!(
                "{}: no preset for camera and car is named, `{}` is assumed: say preset = … under [camera] in steersman.toml \
                 beside the log",
                self.path.display(),
                usual_preset(self.format.id)
            )
        })
    }

    /// Reads the centre picture of every row and keeps a hash of it, so that [`split`](super::split::split) knows copies.
    pub fn hash_pictures(&mut self) {
        let hash = |bytes: &mut Vec<u8>, row: usize| match self.read_picture(row, View::Centre, bytes) {
            Ok(()) => fingerprint(bytes),
            // Pictures that cannot be read are no copies of each other.
            Err(_) => self.row_id(row),
        };
        self.picture_hashes = (0..self.rows.len()).into_par_iter().map_init(Vec::new, hash).collect();
    }

    /// The hash of the centre picture of `row`, where it is known.
    pub fn picture_hash(&self, row: usize) -> Option<u64> {
        self.picture_hashes.get(row).copied()
    }

    /// Length of the file of the picture of `camera` at `row`; 0 without one.
    pub fn picture_len(&self, row: usize, camera: View) -> u64 {
        self.image_path(row, camera).map_or(0, |path| self.store.len(&path))
    }

    /// The picture of `camera` at `row`, if there is one that can be read and decoded.
    pub fn picture(&self, row: usize, camera: View) -> Option<RgbImage> {
        let mut bytes = Vec::new();
        self.read_picture(row, camera, &mut bytes).ok()?;
        let mut image = RgbImage::default();
        decode_rgb(&bytes, &mut image).ok()?;
        Some(image)
    }

    /// A number that stands for `row` wherever the recording lies: from the name of its centre image and its steering. Model
    /// files keep those of their training rows.
    ///
    /// # Panics
    /// If there is no such row.
    pub fn row_id(&self, row: usize) -> u64 {
        let path = self.image_path(row, View::Centre);
        let name = path.as_ref().and_then(|path| path.file_name()).unwrap_or_default();
        let mut hash = Sha256::new();
        hash.update(name.as_encoded_bytes());
        hash.update(self.rows[row].steering.to_le_bytes());
        let digest: [u8; 32] = hash.finalize().into();
        u64::from_le_bytes(std::array::from_fn(|i| digest[i]))
    }

    /// Whether `row` has an image of `camera`.
    pub fn row_has(&self, row: usize, camera: View) -> bool {
        self.rows.get(row).is_some_and(|row| row.images[camera as usize].is_some())
    }

    /// Median number of rows per second within sessions; `None` for less than two rows in a session.
    pub fn rate_hz(&self) -> Option<f64> {
        let steps = self.sessions.iter().flat_map(|session| {
            self.rows[session.clone()].windows(2).map(|pair| pair[1].time_ms - pair[0].time_ms).filter(|&ms| ms > 0)
        });
        median(steps.collect()).map(|ms| 1000.0 / ms as f64)
    }

    /// Which session `row` belongs to.
    ///
    /// # Panics
    /// If there is no such row.
    pub fn session_of(&self, row: usize) -> usize {
        let session = self.sessions.partition_point(|session| session.end <= row);
        assert!(session < self.sessions.len(), "row {row} of {}", self.rows.len());
        session
    }

    /// Seconds driven: the sum over the sessions.
    pub fn driven_s(&self) -> f64 {
        // The sum of nothing is -0.0.
        self.sessions.iter().map(|session| self.session_s(session)).sum::<f64>() + 0.0
    }

    /// Length of a session in seconds, from its first to its last row.
    pub fn session_s(&self, session: &Range<usize>) -> f64 {
        match &self.rows[session.clone()] {
            [first, .., last] => (last.time_ms - first.time_ms) as f64 / 1000.0,
            _ => 0.0,
        }
    }

    /// Checks that enough of the recording can be used to train on it or to judge a network by it.
    ///
    /// # Errors
    /// [`Error::Data`] if no row or less than 80 % of the rows can be used, with the reasons.
    pub fn require_usable(&self) -> Result<()> {
        self.require_unit()?;
        let (total, unusable) = (self.total_rows(), self.unusable.rows());
        if total == 0 {
            return Err(Error::data(&self.path, "the recording has no rows"));
        }
        if self.rows.is_empty() || unusable as f64 > MAX_UNUSABLE_SHARE * total as f64 {
            let reasons: Vec<String> = (self.unusable.0.iter())
                .map(|(reason, tally)| {
                    format!("{} in {} rows ({})", reason.text(), tally.rows, tally.examples.join("; "))
                })
                .collect();
            let message = format!(
                "{unusable} of {total} rows cannot be used, more than a fifth is too much: {}. \
                 `steersman inspect` shows more",
                reasons.join(", ")
            );
            return Err(Error::data(&self.path, message));
        }
        Ok(())
    }

    /// What the user should know before the recording goes through `preprocessing`, each line with its place.
    pub fn notices_for(&self, preprocessing: &Preprocessing) -> Vec<String> {
        let unusable = self.unusable.rows();
        let left_out =
            (unusable > 0).then(|| format!("{unusable} of {} rows cannot be used and are left out", self.total_rows()));
        let scaled = self.image_size.and_then(|size| preprocessing.size_notice(size));
        let all = self.notices.iter().cloned().chain(left_out).chain(scaled);
        all.map(|text| format!("{}: {text}", self.path.display())).collect()
    }

    /// Checks that the labels are shares of full lock, or that the user has said what they are.
    ///
    /// # Errors
    /// [`Error::Data`] with the likely unit.
    pub fn require_unit(&self) -> Result<()> {
        match &self.unit_trouble {
            Some(trouble) => Err(Error::data(&self.path, trouble.as_str())),
            None => Ok(()),
        }
    }

    /// Why the labels of the recording cannot be used as they are, if so.
    pub fn unit_trouble(&self) -> Option<&str> {
        self.unit_trouble.as_deref()
    }

    /// Times are believed if nine rows of ten have one and the rate is 1 to 100 Hz; unless the user says the rate.
    pub(super) fn settle_times(&mut self, said_hz: Option<f64>, assumed_hz: f64) {
        let timed = self.rows.iter().filter(|row| row.time_ms != i64::MIN).count();
        let mut last = None;
        let mut steps = Vec::new();
        for row in self.rows.iter().filter(|row| row.time_ms != i64::MIN) {
            steps.extend(last.map(|last| row.time_ms - last).filter(|&ms| ms > 0));
            last = Some(row.time_ms);
        }
        let step_ms = median(steps);
        let plausible = self.rows.len() < 2
            || (timed * 10 >= self.rows.len() * 9 && step_ms.is_some_and(|ms| (10..=1000).contains(&ms)));
        self.times_plausible = plausible || said_hz.is_some();
        if let Some(hz) = said_hz {
            self.notices.push(format!("the rows count as {hz} Hz, as was said"));
        } else if !plausible {
            let found = match step_ms {
                Some(ms) if timed > 1 => format!("{ms} ms between rows"),
                _ => "none".to_string(),
            };
            self.notices.push(format!(
                "time stamps are implausible ({found}); the rows are assumed to count as {assumed_hz} Hz: say --hz, or hz = … in \
                 steersman.toml, if it was another rate"
            ));
        }
        let hz = said_hz.or((!plausible).then_some(assumed_hz));
        let mut time_ms = 0;
        for (i, row) in self.rows.iter_mut().enumerate() {
            if let Some(hz) = hz {
                row.time_ms = (i as f64 * 1000.0 / hz).round() as i64;
            } else if row.time_ms == i64::MIN {
                row.time_ms = time_ms;
            }
            time_ms = row.time_ms;
        }
    }

    pub(super) fn settle_sessions(&mut self) {
        let mut start = 0;
        for end in 1..=self.rows.len() {
            let breaks = self.rows.get(end).is_none_or(|next| {
                let last = &self.rows[end - 1];
                let step_ms = next.time_ms - last.time_ms;
                next.source != last.source || !(0..=SESSION_GAP_MS).contains(&step_ms)
            });
            if breaks {
                self.sessions.push(start..end);
                start = end;
            }
        }
    }
}

/// The preset for recordings in the format `id` that say nothing of their camera.
pub(super) fn usual_preset(id: &str) -> &'static str {
    if id.contains("tub") { CarGeometry::USUAL_SMALL } else { CarGeometry::USUAL }
}

/// A hash of `bytes` that is the same in every version of this program.
fn fingerprint(bytes: &[u8]) -> u64 {
    let mut hash = bytes.len() as u64;
    let mut mix = |word: u64| {
        hash = (hash ^ word).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        hash ^= hash >> 32;
    };
    let (words, rest) = bytes.as_chunks::<8>();
    words.iter().for_each(|word| mix(u64::from_le_bytes(*word)));
    rest.iter().for_each(|&byte| mix(u64::from(byte)));
    hash
}

/// Last part of a path, for messages.
pub(super) fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

fn median(mut values: Vec<i64>) -> Option<i64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable(middle).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn size_of_a_row() {
        // With a name of some 30 bytes a row takes less than 100.
        assert!(size_of::<Row>() <= 72, "{}", size_of::<Row>());
    }

    #[test]
    fn side_cameras_correct_towards_the_middle() {
        // The left camera sees what a car too far left would see: it has to steer right, which is positive.
        assert_eq!(View::ALL.map(View::correction_sign), [0.0, 1.0, -1.0]);
    }
}
