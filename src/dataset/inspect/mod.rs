//! What a recording holds, for `steersman inspect`.

pub(crate) mod advice;
mod frames;
mod lag;
mod suspicious;

use crate::Result;
use crate::dataset::description::Description;
use crate::dataset::load::load_with;
use crate::dataset::recording::{Recording, Row, View};
use crate::dataset::rows::ImageCheck;
use crate::dataset::unusable::{Reason, Unusable};
use crate::observer::{Observer, Progress};
use crate::text::escaped;
pub use frames::Frame;
pub use lag::Lag;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt::{self, Write};
use std::path::Path;
pub use suspicious::{STANDING_MPH, Stretch, Suspicion, contradiction, seen_steering};

/// Steering bins of width 0.1, centred at -1.0, -0.9, … 1.0.
const BINS: usize = 21;
/// Steering from here on counts as full lock.
pub const FULL_LOCK: f32 = 0.999;
/// Labels up to here, to either side, count as straight: 1 degree of the wheels at 25 degrees of full lock.
pub const STRAIGHT: f32 = 0.04;
/// A step between rows of a session that is this many times the usual one is a gap.
const GAP_STEPS: f64 = 3.0;
/// Metres per second in a mile per hour.
const MPS_PER_MPH: f64 = 0.44704;
/// Characters of the longest bar of the histogram.
const BAR: usize = 50;
/// Sessions, and suspicious stretches, listed one by one.
const LISTED: usize = 10;

/// The findings; serialises to JSON, and [`fmt::Display`] prints them for people.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// What was inspected.
    pub path: String,
    /// Name of its format in JSON, such as `udacity` or `tub`.
    pub kind: &'static str,
    /// Name of its format for people.
    #[serde(skip)]
    pub format: &'static str,
    /// Cameras that recordings of its format have.
    #[serde(skip)]
    pub format_cameras: usize,
    /// Rows of the log.
    pub rows: usize,
    /// Rows that can be used for training.
    pub usable: usize,
    /// The others, by reason.
    pub unusable: Unusable,
    /// Number of rows and length of each session.
    pub sessions: Vec<Session>,
    /// Seconds driven, the sum of the sessions.
    pub driven_s: f64,
    /// Seconds from the earliest to the latest row.
    pub span_s: f64,
    /// Rows per second within sessions.
    pub rate_hz: Option<f64>,
    /// Whether the times come from the recording; otherwise rows count as 20 Hz.
    pub times_plausible: bool,
    /// Cameras that have images.
    pub cameras: Vec<View>,
    /// Height and width of the first image.
    pub image_size: Option<[usize; 2]>,
    /// The sizes of the centre camera's pictures, the most frequent first.
    pub sizes: Vec<Size>,
    /// Whether the labels look like shares of full lock, or the user has said what they are.
    pub labels_believed: bool,
    /// The labels; `None` without rows.
    pub steering: Option<Steering>,
    /// Smallest, mean and largest throttle, where it was recorded.
    pub throttle: Option<Spread>,
    /// Smallest, mean and largest speed in miles per hour, where it was recorded.
    pub speed_mph: Option<Spread>,
    /// Distance driven in metres, from speed and time, where the speed was recorded.
    pub distance_m: Option<f64>,
    /// Share of the rows in which the car stands, where the speed was recorded.
    pub standing_share: Option<f64>,
    /// Missing rows within sessions.
    pub gaps: Gaps,
    /// What the pictures of the centre camera show; `None` without pictures.
    pub pictures: Option<Pictures>,
    /// Stretches to be looked at.
    pub suspicious: Vec<Stretch>,
    /// What the reader should know.
    pub notices: Vec<String>,
    /// What the reader should do.
    pub advice: Vec<String>,
}

/// Steps between rows of a session that are at least three times the usual one.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Gaps {
    /// Their number.
    pub count: usize,
    /// The longest, in seconds; 0 without one.
    pub longest_s: f64,
}

/// What the pictures of the centre camera show.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Pictures {
    /// Pictures that could be read.
    pub seen: usize,
    /// Rows whose picture cannot be decoded.
    pub undecodable: usize,
    /// Files that are the same as an earlier one, byte for byte.
    pub copies: usize,
    /// Pictures that show the same as the one before although the car moves, but for noise.
    pub frozen: usize,
    /// How labels and pictures fit together in time, where that can be told.
    pub lag: Option<Lag>,
}

/// A recording, read and looked at.
#[derive(Debug)]
pub struct Inspection {
    /// The rows.
    pub recording: Recording,
    /// The centre camera's frame of each row, where it could be read.
    pub frames: Vec<Option<Frame>>,
    /// The findings.
    pub report: Report,
}

/// A stretch driven without a break.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Session {
    /// Line of the log it begins at.
    pub first_line: u32,
    /// Its rows.
    pub rows: usize,
    /// Its length in seconds.
    pub length_s: f64,
}

/// Pictures of one size.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Size {
    /// Height in pixels.
    pub height: usize,
    /// Width in pixels.
    pub width: usize,
    /// Their number.
    pub pictures: usize,
}

/// What the labels look like.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Steering {
    /// Smallest, mean and largest label.
    #[serde(flatten)]
    pub spread: Spread,
    /// Standard deviation.
    pub deviation: f64,
    /// Share of labels that are exactly 0.
    pub zero_share: f64,
    /// Share of labels at full lock, to either side.
    pub full_lock_share: f64,
    /// Share of labels beyond 0.04 to the left.
    pub left_share: f64,
    /// Share of labels beyond 0.04 to the right.
    pub right_share: f64,
    /// How many different labels there are.
    pub distinct: usize,
    /// Labels in each bin of width 0.1, centred at -1.0, -0.9, … 1.0.
    pub histogram: Vec<usize>,
}

/// Smallest, mean and largest of some values.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Spread {
    /// Smallest.
    pub min: f64,
    /// Mean.
    pub mean: f64,
    /// Largest.
    pub max: f64,
}

impl Spread {
    fn of(values: impl Iterator<Item = f32>) -> Option<Self> {
        let (mut min, mut max, mut sum, mut count) = (f64::INFINITY, f64::NEG_INFINITY, 0.0, 0_usize);
        for value in values.map(f64::from).filter(|value| value.is_finite()) {
            (min, max, sum, count) = (min.min(value), max.max(value), sum + value, count + 1);
        }
        (count > 0).then(|| Self { min, mean: sum / count as f64, max })
    }
}

/// Reads the recording at `path`, of which the user says `said`, looks at its pictures and describes it. Where no image can be
/// read, the log alone is described. `observer` is told the share of the pictures that is done.
///
/// # Errors
/// As [`load_with`]; the observer's own.
pub fn inspect(path: &Path, said: &Description, observer: &mut (dyn Observer<Progress> + Send)) -> Result<Inspection> {
    let checked = load_with(path, said, ImageCheck::Verify)?;
    if checked.rows.is_empty() && checked.total_rows() > 0 {
        let log_alone = load_with(path, said, ImageCheck::Skip)?;
        if !log_alone.rows.is_empty() {
            let mut report = describe(path, &log_alone, &[]);
            report.notices.insert(0, "no row has its images; the figures are those of the log alone".into());
            report.cameras.clear();
            (report.usable, report.unusable) = (0, checked.unusable);
            report.advice = advice::advice(&report);
            return Ok(Inspection { recording: log_alone, frames: Vec::new(), report });
        }
    }
    let frames = frames::look(&checked, observer)?;
    let report = describe(path, &checked, &frames);
    Ok(Inspection { recording: checked, frames, report })
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

/// `value` with `decimals`, and no sign before zero.
fn fixed(value: f64, decimals: usize) -> String {
    let text = format!("{value:.decimals$}");
    match text.strip_prefix('-') {
        Some(zero) if zero.bytes().all(|byte| matches!(byte, b'0' | b'.')) => zero.to_owned(),
        _ => text,
    }
}

fn describe(path: &Path, recording: &Recording, frames: &[Option<Frame>]) -> Report {
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
    report.advice = advice::advice(&report);
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
    known.then(|| parts.sum())
}

fn gaps(recording: &Recording) -> Gaps {
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

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}: {}", self.path, self.format)?;
        writeln!(f, "rows      {} of {} usable", self.usable, self.rows)?;
        for (reason, tally) in &self.unusable.0 {
            writeln!(f, "          {} left out: {}", tally.rows, reason.text())?;
            for example in &tally.examples {
                writeln!(f, "            {}", escaped(example))?;
            }
        }
        let rate = self.rate_hz.map_or(String::new(), |hz| format!(", {hz:.1} rows/s"));
        let count = self.sessions.len();
        writeln!(f, "sessions  {count}, {:.1} s driven within {:.1} s{rate}", self.driven_s, self.span_s)?;
        for session in self.sessions.iter().take(LISTED) {
            let Session { first_line, rows, length_s } = session;
            writeln!(f, "          from line {first_line}: {rows} rows, {length_s:.1} s")?;
        }
        if count > LISTED {
            writeln!(f, "          and {} more", count - LISTED)?;
        }
        if self.gaps.count > 0 {
            writeln!(f, "gaps      {} within sessions, the longest {:.2} s", self.gaps.count, self.gaps.longest_s)?;
        }
        if let Some(distance_m) = self.distance_m {
            writeln!(f, "distance  {distance_m:.0} m")?;
        }
        let cameras: Vec<&str> = self.cameras.iter().map(|camera| camera.name()).collect();
        let cameras = if cameras.is_empty() { "no images".to_owned() } else { cameras.join(", ") };
        let size = match &self.sizes[..] {
            [] | [_] => self.image_size.map_or(String::new(), |[h, w]| format!("; {w}x{h} pixels")),
            sizes => {
                let of = |Size { height, width, pictures }: &Size| format!("{pictures} of {width}x{height}");
                format!("; pictures of {} sizes: {}", sizes.len(), sizes.iter().map(of).collect::<Vec<_>>().join(", "))
            }
        };
        writeln!(f, "cameras   {cameras}{size}")?;
        for (name, spread, unit) in [("throttle", self.throttle, ""), ("speed", self.speed_mph, " mph")] {
            if let Some(Spread { min, mean, max }) = spread {
                let [min, mean, max] = [min, mean, max].map(|value| fixed(value, 2));
                writeln!(f, "{name:<9} {min} to {max}{unit}, mean {mean}")?;
            }
        }
        if let Some(steering) = &self.steering {
            let Steering { spread: Spread { min, mean, max }, deviation, zero_share, full_lock_share, .. } = steering;
            let (min, mean, max) = (fixed(*min, 3), fixed(*mean, 4), fixed(*max, 3));
            writeln!(f, "steering  {min} to {max}, mean {mean}, standard deviation {deviation:.4}")?;
            let (zero, lock) = (100.0 * zero_share, 100.0 * full_lock_share);
            writeln!(
                f,
                "          {zero:.1} % exactly 0, {lock:.1} % at full lock, {} different labels",
                steering.distinct
            )?;
            let (left, right) = (100.0 * steering.left_share, 100.0 * steering.right_share);
            let straight = (100.0 - left - right).max(0.0);
            writeln!(
                f,
                "          {left:.1} % to the left, {straight:.1} % straight (within {STRAIGHT}), {right:.1} % to the right"
            )?;
            f.write_str(&bars(&steering.histogram))?;
        }
        if let Some(Pictures { seen, undecodable, copies, frozen, lag }) = &self.pictures {
            let and = |count: &usize, what: &str| if *count > 0 { format!(", {count} {what}") } else { String::new() };
            let (bad, copies) = (and(undecodable, "cannot be decoded"), and(copies, "copies of earlier files"));
            let frozen = and(frozen, "frozen while the car moves");
            writeln!(f, "pictures  {seen} looked at{bad}{copies}{frozen}")?;
            match lag {
                Some(Lag { ms, correlation, .. }) => writeln!(
                    f,
                    "          they follow the labels by {} ms (correlation of steering and movement {})",
                    fixed(*ms, 0),
                    fixed(*correlation, 2)
                )?,
                None => writeln!(
                    f,
                    "          how well labels and pictures fit in time cannot be told from this recording"
                )?,
            }
        }
        if let Some(share) = self.standing_share.filter(|share| *share > 0.0) {
            writeln!(f, "standing  {:.1} % of the rows", 100.0 * share)?;
        }
        for Stretch { what, lines: [first, last], length_s, .. } in self.suspicious.iter().take(LISTED) {
            writeln!(f, "look at   lines {first} to {last}: {} ({length_s:.1} s)", what.text())?;
        }
        if self.suspicious.len() > LISTED {
            writeln!(f, "          and {} more stretches", self.suspicious.len() - LISTED)?;
        }
        self.notices.iter().try_for_each(|notice| writeln!(f, "note      {notice}"))?;
        self.advice.iter().try_for_each(|advice| writeln!(f, "advice    {advice}"))
    }
}

/// The histogram in characters; bins between the outermost filled ones that are empty are shown as well.
fn bars(histogram: &[usize]) -> String {
    let most = histogram.iter().copied().max().unwrap_or(0).max(1);
    let filled = |i: &usize| histogram[*i] > 0;
    let first = (0..histogram.len()).find(filled).unwrap_or(0);
    let last = (0..histogram.len()).rfind(filled).unwrap_or(0);
    let mut text = String::new();
    for (i, &count) in histogram.iter().enumerate().take(last + 1).skip(first) {
        let centre = (i as f64 - 10.0) / 10.0;
        let bar = "#".repeat((count * BAR).div_ceil(most));
        // Writing to a string cannot fail.
        let _ = writeln!(text, "{}", format!("          {centre:+.1} {count:>7} {bar}").trim_end());
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::testing::{recording_of, recordings_folder};
    use crate::observer::Unobserved;

    #[test]
    fn labels_are_described() {
        let report = describe(Path::new("drive"), &recording_of(&[0.0, 0.0, 1.0, -1.0, 0.5, -0.06], 100), &[]);
        let steering = report.steering.clone().unwrap();
        assert_eq!((steering.spread.min, steering.spread.max), (-1.0, 1.0));
        assert!(
            (steering.zero_share - 1.0 / 3.0).abs() < 1e-12 && (steering.full_lock_share - 1.0 / 3.0).abs() < 1e-12
        );
        let filled: Vec<_> = steering.histogram.iter().enumerate().filter(|(_, n)| **n > 0).collect();
        assert_eq!(filled, [(0, &1), (9, &1), (10, &2), (15, &1), (20, &1)]);
        assert_eq!((report.driven_s, report.rate_hz), (0.5, Some(10.0)));
        assert_eq!((steering.left_share, steering.right_share, steering.distinct), (1.0 / 3.0, 1.0 / 3.0, 5));
        // 20 mph are 8.94 m/s, for half a second.
        assert!((report.distance_m.unwrap() - 4.4704).abs() < 1e-6 && report.standing_share == Some(0.0));
        let text = report.to_string();
        for part in ["6 of 6 usable", "33.3 % exactly 0", "centre, left, right", "+0.0       2 ####", "10.0 rows/s"] {
            assert!(text.contains(part), "{part} in\n{text}");
        }
    }

    #[test]
    fn missing_rows_are_gaps() {
        let mut recording = recording_of(&[0.1; 40], 100);
        recording.rows[20..].iter_mut().for_each(|row| row.time_ms += 300);
        assert_eq!(gaps(&recording), Gaps { count: 1, longest_s: 0.4 });
        assert_eq!(gaps(&recording_of(&[0.1; 40], 100)).count, 0);
    }

    #[test]
    fn an_empty_recording_has_a_report() {
        let text = describe(Path::new("x"), &recording_of(&[], 100), &[]).to_string();
        assert!(text.contains("0 of 0 usable"), "{text}");
    }

    #[test]
    fn reports_turn_into_json() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log.csv");
        std::fs::write(&path, "c.jpg,l.jpg,r.jpg,0.5,1,0,9\nc.jpg,l.jpg,r.jpg,x,1,0,9\n").unwrap();
        let report = inspect(&path, &Description::default(), &mut Unobserved).unwrap().report;
        let json = serde_json::to_value(&report).unwrap();
        assert_eq!((json["rows"].as_u64(), json["usable"].as_u64()), (Some(2), Some(0)));
        assert_eq!(json["unusable"]["not-a-number"]["rows"], 1);
        assert_eq!(json["unusable"]["image-missing"]["rows"], 1);
        assert_eq!(json["steering"]["max"], 0.5);
        assert!(report.to_string().contains("log alone"));
    }

    #[test]
    fn the_log_variants_are_described() {
        let Some(root) = recordings_folder() else { return };
        for (name, rows) in [("bydavy-mixed", 150), ("jwasham12-track2-mac", 150), ("spgitmonish-own-header", 149)] {
            let path = root.join("csv-variants").join(format!("{name}.csv"));
            let report = inspect(&path, &Description::default(), &mut Unobserved).unwrap().report;
            assert_eq!((report.rows, report.usable), (rows, 0), "{name}");
            assert!(report.steering.is_some());
        }
        let lake = inspect(&root.join("lake-sample"), &Description::default(), &mut Unobserved).unwrap().report;
        assert!((lake.steering.unwrap().zero_share - 0.56).abs() < 0.01);
        assert_eq!(lake.image_size, Some([160, 320]));
        let pictures = lake.pictures.unwrap();
        assert_eq!((pictures.seen, pictures.undecodable), (3000, 0));
        assert!(lake.advice.iter().any(|advice| advice.contains("balance.keep_zero=0.4")), "{:?}", lake.advice);
    }
}
