//! What a model is worth on recordings: its error on single rows, and how it drives there, on the side of a split that it was
//! trained on and on the other one.

use std::ops::Range;
use std::time::Instant;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::log::{Frames, ReplayLog};
use super::run::{ReplayOptions, ReplayRun, ReplaySummary, replay, summarise};
use crate::dataset::{DrivenSessions, Recording, View};
use crate::error::Result;
use crate::geometry::LookAhead;
use crate::metrics::{Metrics, Prediction};
use crate::observer::StopSignal;
use crate::picture::RgbImage;

/// Rows of a side whose error is measured, spread over the side.
const MAX_ROWS: usize = 2000;
/// Time that is driven on a side, s, spread over the side.
const MAX_DRIVEN_S: f64 = 300.0;
/// Longer stretches are driven in pieces, each from the path; so they can be driven at the same time.
const PIECE_S: f64 = 60.0;
/// Stretches that are named in a note.
const NAMED: usize = 4;

/// One side of a split.
#[derive(Clone, Debug)]
pub struct Side {
    /// `training` or `validation`.
    pub name: &'static str,
    /// Recording and row of each picture of the centre camera, sorted.
    pub rows: Vec<(usize, usize)>,
}

/// Consecutive rows that were driven on.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stretch {
    /// Number of the recording, from 0, in the order of the command line.
    pub recording: usize,
    /// Lines of its log, the first and the last.
    pub lines: [u32; 2],
}

/// What a model is worth on one side.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SideVerdict {
    /// `training` or `validation`.
    pub side: String,
    /// Rows whose error was measured.
    pub rows: usize,
    /// Mean absolute error against the recorded wheel, in degrees of the front wheels.
    pub wheel_mae_deg: Option<f64>,
    /// Squared error ÷ that of a wheel held straight.
    pub wheel_relative_to_zero: Option<f64>,
    /// Those of the rows that have a path label.
    pub path_rows: usize,
    /// Mean absolute error against the steering that follows the driven path.
    pub path_mae_deg: Option<f64>,
    /// Squared error against it ÷ that of a wheel held straight.
    pub path_relative_to_zero: Option<f64>,
    /// What was driven.
    pub stretches: Vec<Stretch>,
    /// How; absent if nothing could be driven.
    pub drive: Option<ReplaySummary>,
}

/// What a model is worth on recordings; `replay.json` of a run folder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordingVerdict {
    /// Training side, then validation side if there is one.
    pub sides: Vec<SideVerdict>,
    /// What the reader should know: why a figure is missing, what was assumed.
    pub notes: Vec<String>,
}

/// Judges a model on both `sides` of `recordings`. `new_driver` makes a driver as for
/// [`replay`](super::replay()), one for each thread; `full_lock_deg` turns errors into degrees.
///
/// Pictures that cannot be read cost their rows and stretches. Long sides are judged by a part of them.
///
/// # Errors
///
/// Those of `new_driver`; [`Error::Interrupted`](crate::Error::Interrupted) if `stop` is requested.
pub fn judge<D>(
    recordings: &[Recording],
    sides: &[Side],
    full_lock_deg: f64,
    new_driver: impl Fn() -> Result<D> + Sync,
    stop: &StopSignal,
) -> Result<RecordingVerdict>
where
    D: FnMut(&RgbImage) -> Result<f32>,
{
    let mut verdict = RecordingVerdict { sides: Vec::new(), notes: Vec::new() };
    let labels: Vec<Vec<Option<f32>>> = (recordings.iter())
        .map(|recording| {
            verdict.notes.extend(recording.camera_notice());
            let driven = DrivenSessions::of(recording, recording.geometry.clone());
            if let Some(mps) = driven.assumed_speed_mps {
                let path = recording.path.display();
                verdict
                    .notes
                    .push(format!("{path} says no speed; {mps:.1} m/s was assumed for the path and the drive"));
            }
            if !recording.times_plausible {
                let (path, hz) = (recording.path.display(), recording.rate_hz().unwrap_or(0.0));
                verdict.notes.push(format!("{path} has no plausible times; {hz:.0} rows/s were assumed"));
            }
            driven.path_labels(LookAhead::usual(&recording.geometry))
        })
        .collect();
    for (number, side) in sides.iter().enumerate() {
        let other: Vec<(usize, usize)> =
            sides.iter().enumerate().filter(|(i, _)| *i != number).flat_map(|(_, side)| side.rows.clone()).collect();
        let (wheel, path) = errors(recordings, side, &labels, full_lock_deg, &new_driver, stop)?;
        let (stretches, drive) = drive(recordings, side, &other, &new_driver, &mut verdict.notes, stop)?;
        let (wheel_relative_to_zero, path_relative_to_zero) =
            (wheel.and_then(|m| m.relative_to_zero), path.and_then(|m| m.relative_to_zero));
        if let (Some(_), None) = (wheel, wheel_relative_to_zero) {
            let note = "every recorded label is 0, so there is no error relative to a straight wheel";
            verdict.notes.push(format!("{}: {note}", side.name));
        }
        if path.is_none() {
            let note = "no row has a path ahead of it, so there is no error against the path: the car stands, or its sessions \
                        are too short";
            verdict.notes.push(format!("{}: {note}", side.name));
        }
        verdict.sides.push(SideVerdict {
            side: side.name.into(),
            rows: wheel.map_or(0, |m| m.rows),
            wheel_mae_deg: wheel.map(|m| m.mae_deg),
            wheel_relative_to_zero,
            path_rows: path.map_or(0, |m| m.rows),
            path_mae_deg: path.map(|m| m.mae_deg),
            path_relative_to_zero,
            stretches,
            drive,
        });
    }
    Ok(verdict)
}

/// The errors against the wheel and against the path, on up to [`MAX_ROWS`] of the rows.
fn errors<'a, D>(
    recordings: &'a [Recording],
    side: &Side,
    labels: &[Vec<Option<f32>>],
    full_lock_deg: f64,
    new_driver: &(impl Fn() -> Result<D> + Sync),
    stop: &StopSignal,
) -> Result<(Option<Metrics>, Option<Metrics>)>
where
    D: FnMut(&RgbImage) -> Result<f32>,
{
    new_driver()?;
    let n = side.rows.len().min(MAX_ROWS);
    let answer = |(driver, frames): &mut (Result<D>, Frames<'a>), k: usize| -> Option<[Option<Prediction>; 2]> {
        stop.check().ok()?;
        let (number, row) = side.rows[k * side.rows.len() / n];
        let recording = &recordings[number];
        let picture = frames.get(recording, row, View::Centre).ok()?;
        let steering = driver.as_mut().ok()?(picture).ok()?;
        let of = |label| Prediction { steering, label, session: 0, time_s: 0.0 };
        Some([Some(of(recording.rows[row].steering)), labels[number][row].map(of)])
    };
    let answers: Vec<[Option<Prediction>; 2]> =
        (0..n).into_par_iter().map_init(|| (new_driver(), Frames::default()), answer).flatten().collect();
    stop.check()?;
    let metrics = |kind: usize| {
        let predictions: Vec<Prediction> = answers.iter().filter_map(|answer| answer[kind]).collect();
        Metrics::of(&predictions, full_lock_deg)
    };
    Ok((metrics(0), metrics(1)))
}

/// Drives on the stretches of `side`: rows between which there is none of `other`.
fn drive<D>(
    recordings: &[Recording],
    side: &Side,
    other: &[(usize, usize)],
    new_driver: &(impl Fn() -> Result<D> + Sync),
    notes: &mut Vec<String>,
    stop: &StopSignal,
) -> Result<(Vec<Stretch>, Option<ReplaySummary>)>
where
    D: FnMut(&RgbImage) -> Result<f32>,
{
    let mut pieces = pieces(recordings, side, other);
    let (mut parts, mut any) = (Vec::new(), false);
    for (number, recording) in recordings.iter().enumerate() {
        let theirs = rows_of(other, number);
        let own = stretches(recording, &rows_of(&side.rows, number), &theirs);
        any |= !own.is_empty();
        // A session that is whole on one side needs no word.
        let shared = |rows: &Range<usize>| {
            let session = &recording.sessions[recording.session_of(rows.start)];
            theirs.iter().any(|row| session.contains(row))
        };
        let long = ReplayLog::of_stretches(recording, recording.geometry.clone(), &own);
        let lines = |rows: &Range<usize>| [rows.start, rows.end - 1].map(|row| recording.rows[row].line);
        let named = long.sessions.iter().map(|session| &session.rows).filter(|rows| shared(rows));
        parts.extend(named.map(lines).map(|[first, last]| format!("{first}–{last}{}", of_log(recordings, number))));
    }
    if pieces.is_empty() {
        let note = if any {
            "its rows lie in no stretch of 20 m or more, so nothing can be driven"
        } else {
            "its rows stand between those of the other side, so nothing can be driven"
        };
        notes.push(format!("{}: {note}", side.name));
        return Ok((Vec::new(), None));
    }
    if !parts.is_empty() {
        let more = if parts.len() > NAMED { format!(" and {} more", parts.len() - NAMED) } else { String::new() };
        let first = parts[..parts.len().min(NAMED)].join(", ");
        let log = if recordings.len() == 1 { " of the log" } else { "" };
        notes.push(format!("{}: driven are its parts of the sessions, lines {first}{log}{more}", side.name));
    }
    let length_s = |log: &ReplayLog| log.recording.session_s(&log.sessions[0].rows);
    let all_s: f64 = pieces.iter().map(length_s).sum();
    if all_s > MAX_DRIVEN_S {
        let wanted = ((pieces.len() as f64 * MAX_DRIVEN_S / all_s).round() as usize).max(1);
        let n = pieces.len();
        let mut chosen: Vec<usize> = (0..wanted).map(|k| k * n / wanted).collect();
        chosen.dedup();
        let mut place = 0..n;
        pieces.retain(|_| place.next().is_some_and(|k| chosen.binary_search(&k).is_ok()));
        let driven_s: f64 = pieces.iter().map(length_s).sum();
        notes.push(format!("{}: {driven_s:.0} of {all_s:.0} s are driven, spread over all of it", side.name));
    }
    let began = Instant::now();
    let driven: Vec<(Stretch, Result<ReplayRun>)> = pieces
        .par_iter()
        .map(|log| {
            let run = replay(log, &ReplayOptions::usual(&log.geometry), new_driver, &|_, _| stop.check());
            let rows = &log.sessions[0].rows;
            let lines = [rows.start, rows.end - 1].map(|row| log.recording.rows[row].line);
            let number = recordings.iter().position(|recording| std::ptr::eq(recording, log.recording));
            let stretch = Stretch { recording: number.unwrap_or_default(), lines };
            (stretch, run.map(|mut runs| runs.pop().unwrap_or_default()))
        })
        .collect();
    stop.check()?;
    let seconds = began.elapsed().as_secs_f64();
    let (mut stretches, mut runs) = (Vec::new(), Vec::new());
    for (stretch, run) in driven {
        match run {
            Ok(run) => {
                runs.push(run);
                stretches.push(stretch);
            }
            Err(error) => {
                let [first, last] = stretch.lines;
                let of_log = of_log(recordings, stretch.recording);
                notes.push(format!("{}: lines {first}–{last}{of_log} are not driven: {error}", side.name));
            }
        }
    }
    let summary = (!runs.is_empty()).then(|| summarise(&runs, seconds));
    Ok((stretches, summary))
}

/// Whose lines are meant: ` of PATH` where there are several recordings.
fn of_log(recordings: &[Recording], number: usize) -> String {
    match recordings {
        [_] => String::new(),
        _ => format!(" of {}", recordings[number].path.display()),
    }
}

/// What can be driven of `side`: stretches of its rows between which there is none of `other`, in pieces of at most a minute, each a
/// log of its own.
pub fn pieces<'a>(recordings: &'a [Recording], side: &Side, other: &[(usize, usize)]) -> Vec<ReplayLog<'a>> {
    let of_recording = |(number, recording): (usize, &'a Recording)| {
        let own = stretches(recording, &rows_of(&side.rows, number), &rows_of(other, number));
        let cut: Vec<Range<usize>> = own.iter().flat_map(|stretch| cut(recording, stretch)).collect();
        let log = ReplayLog::of_stretches(recording, recording.geometry.clone(), &cut);
        log.sessions.into_iter().map(move |session| ReplayLog {
            recording,
            geometry: recording.geometry.clone(),
            sessions: vec![session],
            assumed_speed_mps: log.assumed_speed_mps,
        })
    };
    recordings.iter().enumerate().flat_map(of_recording).collect()
}

/// The rows of recording `number` among `rows`.
fn rows_of(rows: &[(usize, usize)], number: usize) -> Vec<usize> {
    rows.iter().filter(|(of, _)| *of == number).map(|(_, row)| *row).collect()
}

/// The longest runs of rows within a session that begin and end with one of `own` and have none of `other`, both sorted.
/// Rows of neither side do not end a run.
fn stretches(recording: &Recording, own: &[usize], other: &[usize]) -> Vec<Range<usize>> {
    let mut found: Vec<Range<usize>> = Vec::new();
    for session in &recording.sessions {
        let mut open: Option<Range<usize>> = None;
        for row in session.clone() {
            if other.binary_search(&row).is_ok() {
                found.extend(open.take());
            } else if own.binary_search(&row).is_ok() {
                open = Some(open.map_or(row, |range| range.start)..row + 1);
            }
        }
        found.extend(open);
    }
    found
}

/// `stretch` in equal pieces of at most [`PIECE_S`].
fn cut(recording: &Recording, stretch: &Range<usize>) -> Vec<Range<usize>> {
    let n = (recording.session_s(stretch) / PIECE_S).ceil().max(1.0) as usize;
    let bound = |k: usize| stretch.start + k * stretch.len() / n;
    (0..n).map(|k| bound(k)..bound(k + 1)).filter(|piece| !piece.is_empty()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::testing::recording_of;

    #[test]
    fn lines_are_those_of_a_named_log_where_there_are_several() {
        let one = [recording_of(&[0.1; 4], 100)];
        assert_eq!(of_log(&one, 0), "");
        let mut two = [recording_of(&[0.1; 4], 100), recording_of(&[0.1; 4], 100)];
        two[1].path = "b".into();
        assert_eq!([0, 1].map(|number| of_log(&two, number)), [" of memory", " of b"]);
    }

    #[test]
    fn judging_ends_on_request() {
        let recordings = [recording_of(&[0.1; 40], 100)];
        let side = Side { name: "training", rows: (0..40).map(|row| (0, row)).collect() };
        let judged = |stop: &StopSignal| {
            judge(&recordings, std::slice::from_ref(&side), 25.0, || Ok(|_: &RgbImage| Ok(0.0)), stop)
        };
        let stop = StopSignal::default();
        assert!(judged(&stop).is_ok());
        stop.request();
        assert!(matches!(judged(&stop), Err(crate::Error::Interrupted)));
    }
}
