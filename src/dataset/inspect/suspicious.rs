//! Stretches of a recording that are better looked at before they are trained on.

use std::ops::Range;

use serde::Serialize;

use super::FULL_LOCK;
use super::frames::Frame;
use super::lag::Lag;
use crate::dataset::recording::Recording;

/// A car slower than this stands, mph.
pub const STANDING_MPH: f32 = 1.0;
/// Shortest stretch that is named, in seconds.
const MIN_S: f64 = 1.0;
/// A label is said to contradict the picture if they are on different sides of straight by at least this steering each.
const CONTRADICTION: f64 = 0.08;

/// What is suspicious.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Suspicion {
    /// The car stands: its labels mean nothing.
    Standing,
    /// The same picture again and again.
    Frozen,
    /// The wheel at full lock.
    FullLock,
    /// The same label, not zero, row after row.
    StuckLabel,
    /// The label points to the other side than the car turns.
    Contradiction,
}

impl Suspicion {
    /// The suspicion in words.
    pub fn text(self) -> &'static str {
        match self {
            Suspicion::Standing => "the car stands",
            Suspicion::Frozen => "the picture is frozen",
            Suspicion::FullLock => "at full lock",
            Suspicion::StuckLabel => "the label is stuck",
            Suspicion::Contradiction => "the label contradicts the picture",
        }
    }
}

/// A suspicious stretch.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Stretch {
    /// What is suspicious.
    pub what: Suspicion,
    /// First and last line of the log.
    pub lines: [u32; 2],
    /// Its length in seconds.
    pub length_s: f64,
    /// Its rows.
    #[serde(skip)]
    pub rows: Range<usize>,
}

/// The suspicious stretches of at least a second, in the order of the log.
pub fn find(recording: &Recording, frames: &[Option<Frame>], lag: Option<Lag>) -> Vec<Stretch> {
    let rows = &recording.rows;
    let frame = |row: usize| frames.get(row).copied().flatten();
    let contradicts = |row: usize| contradiction(recording, frames, lag, row).is_some_and(|size| size >= CONTRADICTION);
    let same_label = |row: usize| row > 0 && rows[row].steering == rows[row - 1].steering;
    let checks: [(Suspicion, &dyn Fn(usize) -> bool); 5] = [
        (Suspicion::Standing, &|row| rows[row].speed_mph < STANDING_MPH),
        (Suspicion::Frozen, &|row| {
            frame(row).is_some_and(|frame| frame.frozen)
                && rows[row].speed_mph.is_nan() | (rows[row].speed_mph >= STANDING_MPH)
        }),
        (Suspicion::FullLock, &|row| rows[row].steering.abs() >= FULL_LOCK),
        (Suspicion::StuckLabel, &|row| {
            let steering = rows[row].steering;
            steering != 0.0 && steering.abs() < FULL_LOCK && same_label(row)
        }),
        (Suspicion::Contradiction, &contradicts),
    ];
    let mut found = Vec::new();
    for (what, holds) in checks {
        for session in &recording.sessions {
            let mut row = session.start;
            while row < session.end {
                let end = (row..session.end).find(|&row| !holds(row)).unwrap_or(session.end);
                let length_s = recording.session_s(&(row..end));
                if length_s >= MIN_S {
                    let lines = [rows[row].line, rows[end - 1].line];
                    found.push(Stretch { what, lines, length_s, rows: row..end });
                }
                row = end.max(row + 1);
            }
        }
    }
    found.sort_by_key(|stretch| (stretch.lines, stretch.what as u8));
    found
}

/// How far label and picture of `row` are apart if they are on different sides of straight: the smaller of the two, in
/// steering. The picture is that of the lag later.
pub fn contradiction(recording: &Recording, frames: &[Option<Frame>], lag: Option<Lag>, row: usize) -> Option<f64> {
    let seen = seen_steering(recording, frames, lag?, row)?;
    let label = f64::from(recording.rows[row].steering);
    (seen * label < 0.0).then(|| seen.abs().min(label.abs()))
}

/// The steering that the movement of the picture goes with, the lag later, as a mean over five frames.
pub fn seen_steering(recording: &Recording, frames: &[Option<Frame>], lag: Lag, row: usize) -> Option<f64> {
    let session = &recording.sessions[recording.session_of(row)];
    let step_s = 1.0 / recording.rate_hz()?;
    let later = row.checked_add_signed((lag.ms / 1000.0 / step_s - 0.5).round() as isize)?;
    let around = later.saturating_sub(2).max(session.start)..(later + 3).min(session.end);
    let turns: Vec<f64> = around.filter_map(|row| frames.get(row).copied().flatten()?.turn).map(f64::from).collect();
    let speed_known = lag.turn_at_full_lock > 0.0 && turns.len() >= 3;
    speed_known.then(|| turns.iter().sum::<f64>() / turns.len() as f64 / lag.turn_at_full_lock)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::testing::recording_of;

    fn frame(turn: f32) -> Option<Frame> {
        Some(Frame { size: [160, 320], brightness: 90.0, turn: Some(turn), frozen: false, copy_of: None })
    }

    #[test]
    fn each_kind_of_stretch_is_found_with_its_lines() {
        let mut labels: Vec<f32> = (0..100).map(|i| 0.3 + 0.001 * i as f32).collect();
        labels[10..25].fill(1.0);
        labels[30..45].fill(0.2);
        let mut recording = recording_of(&labels, 100);
        recording.rows[50..65].iter_mut().for_each(|row| row.speed_mph = 0.0);
        let mut frames: Vec<_> = labels.iter().map(|label| frame(0.5 * label)).collect();
        frames[70..85].iter_mut().for_each(|frame| frame.as_mut().unwrap().frozen = true);
        let found = find(&recording, &frames, None);
        let as_words: Vec<_> = found.iter().map(|s| (s.what, s.lines)).collect();
        assert_eq!(
            as_words,
            [
                (Suspicion::FullLock, [11, 25]),
                (Suspicion::StuckLabel, [32, 45]),
                (Suspicion::Standing, [51, 65]),
                (Suspicion::Frozen, [71, 85]),
            ]
        );
        assert!((found[0].length_s - 1.4).abs() < 1e-9);
    }

    #[test]
    fn a_label_against_the_turn_of_the_car_is_a_contradiction() {
        let labels: Vec<f32> = (0..60).map(|i| 0.3 + 0.001 * i as f32).collect();
        let recording = recording_of(&labels, 100);
        let frames: Vec<_> = (0..60).map(|i| frame(if (20..40).contains(&i) { -0.2 } else { 0.15 })).collect();
        let lag = Lag { ms: 50.0, correlation: 0.9, turn_at_full_lock: 0.5 };
        let found = find(&recording, &frames, Some(lag));
        assert!(found.len() == 1 && found[0].what == Suspicion::Contradiction, "{found:?}");
        // The mean over five frames smooths the edges.
        assert!(found[0].rows.start.abs_diff(20) <= 2 && found[0].rows.end.abs_diff(40) <= 2, "{found:?}");
        assert!(find(&recording, &frames, None).is_empty());
    }
}
