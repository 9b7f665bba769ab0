//! Counting what a recording holds.

use std::collections::BTreeMap;
use std::path::Path;

use super::frames::Frame;
use super::lag::Lag;
use super::report::{Gaps, Pictures, Report, Session, Size, Spread, Steering};
use super::suspicious::{self, STANDING_MPH};
use super::{FULL_LOCK, STRAIGHT, Treatment, advice};
use crate::dataset::recording::{Recording, Row, View};
use crate::dataset::unusable::{Reason, Unusable};
use crate::geometry::MPS_PER_MPH;
use crate::text::escaped;

/// Steering bins of width 0.1, centred at -1.0, -0.9, … 1.0.
const BINS: usize = 21;
/// A step between rows of a session that is this many times the usual one is a gap.
const GAP_STEPS: f64 = 3.0;

/// The findings about `recording` at `path`, whose centre pictures are `frames`; with advice for training that does what
/// `treatment` says.
pub(super) fn describe(path: &Path, recording: &Recording, frames: &[Option<Frame>], treatment: &Treatment) -> Report {
    let rows = &recording.rows;
    let lag = Lag::of(recording, frames);
    let times = || rows.iter().map(|row| row.time_ms);
    let span_ms = times().max().unwrap_or(0) - times().min().unwrap_or(0);
    let sessions = recording.sessions.iter().map(|session| Session {
        first_line: rows[session.start].line,
        rows: session.len(),
        length_s: recording.session_s(session),
    });
    let mut report = Report {
        path: path.display().to_string(),
        kind: recording.format.id,
        format: recording.format.name,
        format_cameras: recording.format.cameras,
        rows: recording.total_rows(),
        usable: rows.len() - frames.iter().filter(|frame| frame.is_none()).count(),
        unusable: without_damaged(recording, frames),
        sessions: sessions.collect(),
        driven_s: recording.driven_s(),
        span_s: span_ms as f64 / 1000.0,
        rate_hz: recording.rate_hz(),
        times_plausible: recording.times_plausible,
        cameras: View::ALL.into_iter().filter(|&camera| recording.has(camera)).collect(),
        image_size: recording.image_size,
        steering: describe_steering(rows),
        throttle: Spread::of(rows.iter().map(|row| row.throttle)),
        speed_mph: Spread::of(rows.iter().map(|row| row.speed_mph)),
        distance_m: distance_m(recording),
        standing_share: share_of(rows.iter().filter(|row| !row.speed_mph.is_nan()), |row| row.speed_mph < STANDING_MPH),
        gaps: gaps(recording),
        pictures: describe_pictures(recording, frames, lag),
        suspicious: suspicious::find(recording, frames, lag),
        notices: recording.unit_trouble().map(str::to_owned).into_iter().chain(recording.notices.clone()).collect(),
        labels_believed: recording.unit_trouble().is_none(),
        sizes: sizes(frames),
        advice: Vec::new(),
    };
    report.advice = advice::advice(&report, treatment);
    report
}

/// Share of `rows` that are `chosen`; `None` without rows.
fn share_of<'a>(rows: impl Iterator<Item = &'a Row>, chosen: impl Fn(&Row) -> bool) -> Option<f64> {
    let (count, all) = rows.fold((0, 0), |(count, all), row| (count + usize::from(chosen(row)), all + 1));
    (all > 0).then(|| count as f64 / all as f64)
}

/// Pairs of neighbouring rows of the same session.
fn neighbours(recording: &Recording) -> impl Iterator<Item = (&Row, &Row)> {
    let sessions = recording.sessions.iter().map(|session| &recording.rows[session.clone()]);
    sessions.flat_map(|rows| rows.windows(2).map(|pair| (&pair[0], &pair[1])))
}

fn distance_m(recording: &Recording) -> Option<f64> {
    let known = recording.rows.iter().any(|row| row.speed_mph.is_finite());
    let parts = neighbours(recording).map(|(row, next)| {
        let speed_mps = f64::from(row.speed_mph) * MPS_PER_MPH;
        if speed_mps.is_finite() { speed_mps * (next.time_ms - row.time_ms) as f64 / 1000.0 } else { 0.0 }
    });
    // The sum of nothing is -0.0.
    known.then(|| parts.sum::<f64>() + 0.0)
}

pub(super) fn gaps(recording: &Recording) -> Gaps {
    let usual_s = recording.rate_hz().map_or(f64::INFINITY, |hz| 1.0 / hz);
    let steps_s = neighbours(recording).map(|(row, next)| (next.time_ms - row.time_ms) as f64 / 1000.0);
    steps_s.filter(|step_s| *step_s >= GAP_STEPS * usual_s).fold(Gaps { count: 0, longest_s: 0.0 }, |gaps, step_s| {
        Gaps { count: gaps.count + 1, longest_s: gaps.longest_s.max(step_s) }
    })
}

fn describe_pictures(recording: &Recording, frames: &[Option<Frame>], lag: Option<Lag>) -> Option<Pictures> {
    let seen = frames.iter().flatten().count();
    let moves = |row: &Row| row.speed_mph.is_nan() || row.speed_mph >= STANDING_MPH;
    let frozen = recording.rows.iter().zip(frames).filter(|(row, frame)| moves(row) && frame.is_some_and(|f| f.frozen));
    (!frames.is_empty()).then(|| Pictures {
        seen,
        undecodable: frames.len() - seen,
        copies: frames.iter().flatten().filter(|frame| frame.copy_of.is_some()).count(),
        frozen: frozen.count(),
        lag,
    })
}

fn describe_steering(rows: &[Row]) -> Option<Steering> {
    let spread = Spread::of(rows.iter().map(|row| row.steering))?;
    let n = rows.len() as f64;
    let square = |row: &Row| (f64::from(row.steering) - spread.mean).powi(2);
    let share = |chosen: fn(&Row) -> bool| share_of(rows.iter(), chosen).unwrap_or(0.0);
    let mut distinct: Vec<u32> = rows.iter().map(|row| row.steering.to_bits()).collect();
    distinct.sort_unstable();
    distinct.dedup();
    let mut histogram = vec![0; BINS];
    for row in rows {
        histogram[((row.steering + 1.0) * 10.0).round() as usize] += 1;
    }
    Some(Steering {
        spread,
        deviation: (rows.iter().map(square).sum::<f64>() / n).sqrt(),
        zero_share: share(|row| row.steering == 0.0),
        full_lock_share: share(|row| row.steering.abs() >= FULL_LOCK),
        left_share: share(|row| row.steering < -STRAIGHT),
        right_share: share(|row| row.steering > STRAIGHT),
        distinct: distinct.len(),
        histogram,
    })
}

/// Counts rows whose centre picture cannot be decoded as unusable.
fn without_damaged(recording: &Recording, frames: &[Option<Frame>]) -> Unusable {
    let mut unusable = recording.unusable.clone();
    for (row, _) in frames.iter().enumerate().filter(|(_, frame)| frame.is_none()) {
        let name = recording.image_path(row, View::Centre).unwrap_or_default();
        unusable.add(Reason::ImageTruncated, || {
            format!("line {}: {} cannot be decoded", recording.rows[row].line, escaped(&name.display().to_string()))
        });
    }
    unusable
}

/// The sizes of the pictures, the most frequent first.
fn sizes(frames: &[Option<Frame>]) -> Vec<Size> {
    let mut counts = BTreeMap::new();
    frames.iter().flatten().for_each(|frame| *counts.entry(frame.size).or_insert(0) += 1);
    let mut sizes: Vec<Size> =
        counts.into_iter().map(|([height, width], pictures)| Size { height, width, pictures }).collect();
    sizes.sort_by_key(|size| std::cmp::Reverse(size.pictures));
    sizes
}
