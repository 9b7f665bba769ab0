//! What lies on the coach's desk: the rows of a recording, which are left out, and what was found out about them.

use std::ops::Range;
use std::path::Path;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{SystemTime, UNIX_EPOCH};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::dataset::inspect::{FULL_LOCK, STANDING_MPH, Stretch, stretches};
use crate::dataset::{Exclusions, NO_NUMBER, Recording, View};
use crate::error::{Error, Result};
use crate::observer::{Progress, StopSignal};
use crate::pilot::Pilot;

/// Rows that a thread asks a model about in one go.
const CHUNK: usize = 64;

/// A recording and what a person does to it. All methods may be called from many threads.
#[derive(Debug)]
pub(super) struct Desk {
    recording: Recording,
    exclusions: Exclusions,
    /// The numbers of all rows, sorted.
    numbers: Vec<u32>,
    left_out: Mutex<LeftOutRows>,
    models: Vec<String>,
    /// Bits of what each model answers for each row; NaN where that is not known.
    answers: Vec<Vec<AtomicU32>>,
    suspicious: Mutex<Suspicious>,
    stop: StopSignal,
}

/// The rows that are left out.
#[derive(Debug)]
struct LeftOutRows {
    /// Counts the changes, so that two open pages do not overwrite each other's.
    revision: u64,
    rows: Vec<bool>,
}

/// What a page is told of the rows that are left out, and tells.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct LeftOut {
    /// Of the change that the page has seen last.
    pub revision: u64,
    /// First row, from 0, and the one after the last, of each stretch that is left out.
    pub stretches: Vec<[usize; 2]>,
}

/// Why a change is refused.
#[derive(Debug)]
pub(super) enum Refusal {
    /// Another page has changed the rows since.
    Stale,
    /// There are no such rows.
    Wrong,
    /// They could not be written.
    Failed(Error),
}

/// The first message to a page.
#[derive(Debug, Serialize)]
struct About<'a> {
    recording: String,
    format: &'static str,
    rows: usize,
    saves_to: String,
    cameras: Vec<View>,
    /// Rows at which sessions begin.
    sessions: Vec<usize>,
    rate_hz: Option<f64>,
    full_lock_deg: f64,
    /// Steering from here on counts as full lock.
    full_lock: f32,
    /// A slower car stands, mph.
    standing_mph: f32,
    models: &'a [String],
    notices: &'a [String],
}

/// What is suspicious in the recording.
#[derive(Debug, Default, Serialize)]
struct Suspicious {
    /// Share of the work that is done.
    done: f64,
    stretches: Vec<Named>,
}

#[derive(Debug, Serialize)]
struct Named {
    what: &'static str,
    rows: [usize; 2],
    length_s: f64,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // What is behind the locks is replaced as a whole.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Desk {
    pub fn new(recording: Recording, models: Vec<String>) -> Result<Desk> {
        if recording.rows.is_empty() {
            return Err(Error::data(&recording.path, "the recording has no rows to look through"));
        }
        let exclusions = Exclusions::of(&recording)?;
        let mut numbers: Vec<u32> = recording.rows.iter().map(|row| row.number).filter(|&n| n != NO_NUMBER).collect();
        numbers.sort_unstable();
        let rows = recording.rows.iter().map(|row| row.excluded).collect();
        let unknown = || (0..recording.rows.len()).map(|_| AtomicU32::new(f32::NAN.to_bits())).collect();
        Ok(Desk {
            answers: models.iter().map(|_| unknown()).collect(),
            recording,
            exclusions,
            numbers,
            left_out: Mutex::new(LeftOutRows { revision: first_revision(), rows }),
            models,
            suspicious: Mutex::default(),
            stop: StopSignal::default(),
        })
    }

    pub fn saves_to(&self) -> &Path {
        self.exclusions.path()
    }

    /// Number of rows that are left out.
    pub fn left_out(&self) -> usize {
        lock(&self.left_out).rows.iter().filter(|out| **out).count()
    }

    pub fn end(&self) {
        self.stop.request();
    }

    pub fn is_over(&self) -> bool {
        self.stop.requested()
    }

    /// What the recording is, as JSON.
    pub fn about(&self) -> String {
        let recording = &self.recording;
        json(&About {
            recording: recording.path.display().to_string(),
            format: recording.kind(),
            rows: recording.rows.len(),
            saves_to: self.saves_to().display().to_string(),
            cameras: View::ALL.into_iter().filter(|&view| recording.has(view)).collect(),
            sessions: recording.sessions.iter().map(|session| session.start).collect(),
            rate_hz: recording.rate_hz(),
            full_lock_deg: recording.geometry.full_lock_deg,
            full_lock: FULL_LOCK,
            standing_mph: STANDING_MPH,
            models: &self.models,
            notices: &recording.notices,
        })
    }

    /// Columns of the rows, little endian, one after the other: steering, throttle, speed (mph) and time (s) as f32, and the line
    /// of the log as u32. NaN stands where something was not recorded.
    pub fn columns(&self) -> Vec<u8> {
        let rows = &self.recording.rows;
        let first_ms = rows[0].time_ms;
        let mut bytes = Vec::with_capacity(20 * rows.len());
        let mut column =
            |of: &dyn Fn(&crate::dataset::Row) -> [u8; 4]| rows.iter().for_each(|row| bytes.extend(of(row)));
        column(&|row| row.steering.to_le_bytes());
        column(&|row| row.throttle.to_le_bytes());
        column(&|row| row.speed_mph.to_le_bytes());
        column(&|row| (row.time_ms.saturating_sub(first_ms) as f32 / 1000.0).to_le_bytes());
        column(&|row| row.line.to_le_bytes());
        bytes
    }

    /// What the models answer, as f32 of all rows of one model after the other; NaN where that is not known yet, or never.
    pub fn answers(&self) -> Vec<u8> {
        self.answers.iter().flatten().flat_map(|bits| bits.load(Ordering::Relaxed).to_le_bytes()).collect()
    }

    /// What is suspicious, as JSON.
    pub fn suspicious(&self) -> String {
        json(&*lock(&self.suspicious))
    }

    /// The file of the picture of `view` at `row`; `None` if there is none that can be read.
    pub fn picture(&self, row: usize, view: View) -> Option<Vec<u8>> {
        let mut bytes = Vec::new();
        self.recording.read_picture(row, view, &mut bytes).ok()?;
        Some(bytes)
    }

    /// The rows that are left out, as JSON.
    pub fn left_out_rows(&self) -> String {
        json(&lock(&self.left_out).as_told())
    }

    /// Leaves out what `wanted` says, and no other rows, and writes it.
    ///
    /// # Errors
    ///
    /// [`Refusal`]; nothing is changed then.
    pub fn leave_out(&self, wanted: &LeftOut) -> Result<String, Refusal> {
        let count = self.recording.rows.len();
        if wanted.stretches.iter().any(|[first, end]| first >= end || *end > count) {
            return Err(Refusal::Wrong);
        }
        let mut left_out = lock(&self.left_out);
        if wanted.revision != left_out.revision {
            return Err(Refusal::Stale);
        }
        let mut rows = vec![false; count];
        wanted.stretches.iter().for_each(|&[first, end]| rows[first..end].fill(true));
        let out = self.recording.rows.iter().zip(&rows).filter(|(_, out)| **out).map(|(row, _)| row);
        if let Some(row) = out.clone().find(|row| row.number == NO_NUMBER) {
            let message = "the record has no _index, so nothing can say that it is left out";
            return Err(Refusal::Failed(Error::data_at(&self.recording.path, u64::from(row.line), message)));
        }
        let mut out: Vec<u32> = out.map(|row| row.number).collect();
        out.sort_unstable();
        self.exclusions.save(&out, &self.numbers).map_err(Refusal::Failed)?;
        *left_out = LeftOutRows { revision: left_out.revision + 1, rows };
        Ok(json(&left_out.as_told()))
    }

    /// Asks `pilots`, those of the models, about every row, and looks for what is suspicious.
    pub fn look(&self, pilots: Vec<Pilot>) {
        for (pilot, answers) in pilots.into_iter().zip(&self.answers) {
            let chunks: Vec<usize> = (0..answers.len()).step_by(CHUNK).collect();
            chunks.into_par_iter().for_each_init(
                || (pilot.clone(), Vec::new()),
                |(pilot, bytes), first| {
                    for (row, answer) in answers.iter().enumerate().skip(first).take(CHUNK) {
                        if self.is_over() {
                            return;
                        }
                        let read = self.recording.read_picture(row, View::Centre, bytes);
                        // A picture that cannot be used has no answer.
                        if let Ok(steering) = read.and_then(|()| pilot.steer_encoded(bytes)) {
                            answer.store(steering.to_bits(), Ordering::Relaxed);
                        }
                    }
                },
            );
        }
        let mut observer = |Progress(share): Progress| {
            lock(&self.suspicious).done = share.min(0.999);
            self.stop.check()
        };
        if let Ok(found) = stretches(&self.recording, &mut observer) {
            let named = |stretch: Stretch| {
                let Range { start, end } = stretch.rows;
                Named { what: stretch.what.text(), rows: [start, end], length_s: stretch.length_s }
            };
            *lock(&self.suspicious) = Suspicious { done: 1.0, stretches: found.into_iter().map(named).collect() };
        }
    }
}

impl LeftOutRows {
    fn as_told(&self) -> LeftOut {
        let mut stretches: Vec<[usize; 2]> = Vec::new();
        for row in (0..self.rows.len()).filter(|&row| self.rows[row]) {
            match stretches.last_mut() {
                Some([_, end]) if *end == row => *end += 1,
                _ => stretches.push([row, row + 1]),
            }
        }
        LeftOut { revision: self.revision, stretches }
    }
}

/// A number that no earlier program at this port began with, so that a page of another recording does not change this one. It fits a
/// number of JavaScript.
fn first_revision() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_millis() as u64)
}

fn json(value: &impl Serialize) -> String {
    serde_json::to_string(value).expect("numbers, words and lists can be written as JSON")
}
