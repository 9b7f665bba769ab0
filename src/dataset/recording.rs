//! What is known of a recording once it is read: rows, sessions, and what had to be left out.

use super::pictures::files::{Files, Name};
use super::pictures::preprocess::Preprocessing;
use super::unusable::{Reason, Unusable};
use crate::files::limits::read_up_to;
use crate::picture::RgbImage;
use crate::picture::decode::{MAX_FILE_LEN, decode_rgb};
use crate::{Error, Result};
use serde::Serialize;
use sha2::{Digest, Sha256};
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Two rows further apart than this, in milliseconds, belong to different sessions.
pub const SESSION_GAP_MS: i64 = 1000;
/// Time between rows, in milliseconds, where a recording has no plausible time stamps (20 Hz).
pub const ASSUMED_STEP_MS: i64 = 50;
/// Largest share of unusable rows that training accepts.
const MAX_UNUSABLE_SHARE: f64 = 0.2;
/// Who wrote a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Kind {
    /// The Udacity simulator: a CSV file and a folder `IMG`.
    Udacity,
    /// donkeycar: a tub of format 2, `manifest.json` and catalogs.
    Tub,
}

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
    /// Time in milliseconds; only differences within a recording mean something.
    pub time_ms: i64,
    /// Line of the log, from 1.
    pub line: u32,
    /// Rows written in another folder or session of the recorder have another number.
    pub(super) source: u16,
    pub(super) images: [Option<Name>; 3],
    /// What is wrong with the left and the right image.
    pub(super) side_faults: [Option<Reason>; 2],
}

/// A recording, ready to be split and loaded. Its files are only ever read.
#[derive(Debug)]
pub struct Recording {
    /// The folder or file it was read from.
    pub path: PathBuf,
    /// Who wrote it.
    pub kind: Kind,
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
    /// Whether `time_ms` comes from the recording; otherwise rows count as 20 Hz.
    pub times_plausible: bool,
    pub(super) files: Files,
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

    /// The picture of `camera` at `row`, if there is one that can be read and decoded.
    pub fn picture(&self, row: usize, camera: View) -> Option<RgbImage> {
        let bytes = read_up_to(&self.image_path(row, camera)?, MAX_FILE_LEN, "a picture").ok()?;
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
        self.sessions.iter().map(|session| self.session_s(session)).sum()
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

    /// Decides what the whole recording tells: cameras, times, sessions. Called once, when all rows are read;
    /// `log` names the file in examples.
    pub(super) fn settle(&mut self, log: &str) {
        self.settle_side_cameras(log);
        self.settle_times();
        self.settle_sessions();
    }

    /// A side camera without a single good image falls away; otherwise rows whose side image is bad are left out.
    fn settle_side_cameras(&mut self, log: &str) {
        let mut fallen = [false; 2];
        for (side, fallen) in fallen.iter_mut().enumerate() {
            let named = self.rows.iter().any(|row| row.side_faults[side].is_some());
            *fallen = named && !self.rows.iter().any(|row| row.images[side + 1].is_some());
            if *fallen {
                let camera = View::ALL[side + 1].name();
                self.notices.push(format!("no image of the {camera} camera can be read; the camera falls away"));
            }
        }
        let Self { rows, unusable, .. } = self;
        rows.retain(|row| {
            let fault = (0..2).filter(|&side| !fallen[side]).find_map(|side| Some((side, row.side_faults[side]?)));
            if let Some((side, reason)) = fault {
                let camera = View::ALL[side + 1].name();
                unusable.add(reason, || format!("{log}:{}: {camera} image", row.line));
            }
            fault.is_none()
        });
    }

    /// Times are believed if nine rows of ten have one and the rate is 1 to 100 Hz.
    fn settle_times(&mut self) {
        let timed = self.rows.iter().filter(|row| row.time_ms != i64::MIN).count();
        let mut last = None;
        let mut steps = Vec::new();
        for row in self.rows.iter().filter(|row| row.time_ms != i64::MIN) {
            steps.extend(last.map(|last| row.time_ms - last).filter(|&ms| ms > 0));
            last = Some(row.time_ms);
        }
        let step_ms = median(steps);
        self.times_plausible = self.rows.len() < 2
            || (timed * 10 >= self.rows.len() * 9 && step_ms.is_some_and(|ms| (10..=1000).contains(&ms)));
        if !self.times_plausible {
            let found = match step_ms {
                Some(ms) if timed > 1 => format!("{ms} ms between rows"),
                _ => "none".to_string(),
            };
            self.notices.push(format!("time stamps are implausible ({found}); the rows count as 20 Hz"));
        }
        let mut time_ms = 0;
        for (i, row) in self.rows.iter_mut().enumerate() {
            if !self.times_plausible {
                row.time_ms = i as i64 * ASSUMED_STEP_MS;
            } else if row.time_ms == i64::MIN {
                row.time_ms = time_ms;
            }
            time_ms = row.time_ms;
        }
    }

    fn settle_sessions(&mut self) {
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
