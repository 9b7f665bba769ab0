//! What a recording holds, for `steersman inspect`.

use super::load::{ImageCheck, load_with};
use super::recording::{Camera, Kind, Recording, Row, Unusable};
use crate::Result;
use serde::Serialize;
use std::fmt::{self, Write};
use std::path::Path;

/// Steering bins of width 0.1, centred at -1.0, -0.9, … 1.0.
const BINS: usize = 21;
/// Steering from here on counts as full lock.
const FULL_LOCK: f32 = 0.999;
/// Characters of the longest bar of the histogram.
const BAR: usize = 50;
/// Sessions listed one by one.
const LISTED_SESSIONS: usize = 10;

/// The findings; serialises to JSON, and [`fmt::Display`] prints them for people.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// What was inspected.
    pub path: String,
    /// Who wrote it.
    pub kind: Kind,
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
    pub cameras: Vec<Camera>,
    /// Height and width of the first image.
    pub image_size: Option<[usize; 2]>,
    /// The labels; `None` without rows.
    pub steering: Option<Steering>,
    /// Smallest, mean and largest throttle, where it was recorded.
    pub throttle: Option<Spread>,
    /// Smallest, mean and largest speed in miles per hour, where it was recorded.
    pub speed_mph: Option<Spread>,
    /// What the reader should know.
    pub notices: Vec<String>,
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

/// Reads the recording at `path` and describes it. Where no image can be read, the log alone is described.
///
/// # Errors
/// As [`super::load`].
pub fn report(path: &Path) -> Result<Report> {
    let checked = load_with(path, ImageCheck::Verify)?;
    if checked.rows.is_empty() && checked.total_rows() > 0 {
        let log_alone = load_with(path, ImageCheck::Skip)?;
        if !log_alone.rows.is_empty() {
            let mut report = describe(path, &log_alone);
            report.notices.insert(0, "no row has its images; the figures are those of the log alone".into());
            report.cameras.clear();
            (report.usable, report.unusable) = (0, checked.unusable);
            return Ok(report);
        }
    }
    Ok(describe(path, &checked))
}

fn describe(path: &Path, recording: &Recording) -> Report {
    let rows = &recording.rows;
    let times = || rows.iter().map(|row| row.time_ms);
    let span_ms = times().max().unwrap_or(0) - times().min().unwrap_or(0);
    let sessions = recording.sessions.iter().map(|session| Session {
        first_line: rows[session.start].line,
        rows: session.len(),
        length_s: recording.session_s(session),
    });
    Report {
        path: path.display().to_string(),
        kind: recording.kind,
        rows: recording.total_rows(),
        usable: rows.len(),
        unusable: recording.unusable.clone(),
        sessions: sessions.collect(),
        driven_s: recording.driven_s(),
        span_s: span_ms as f64 / 1000.0,
        rate_hz: recording.rate_hz(),
        times_plausible: recording.times_plausible,
        cameras: Camera::ALL.into_iter().filter(|&camera| recording.has(camera)).collect(),
        image_size: recording.image_size,
        steering: describe_steering(rows),
        throttle: Spread::of(rows.iter().map(|row| row.throttle)),
        speed_mph: Spread::of(rows.iter().map(|row| row.speed_mph)),
        notices: recording.notices.clone(),
    }
}

fn describe_steering(rows: &[Row]) -> Option<Steering> {
    let spread = Spread::of(rows.iter().map(|row| row.steering))?;
    let n = rows.len() as f64;
    let square = |row: &Row| (f64::from(row.steering) - spread.mean).powi(2);
    let share = |chosen: fn(&&Row) -> bool| rows.iter().filter(chosen).count() as f64 / n;
    let mut histogram = vec![0; BINS];
    for row in rows {
        histogram[((row.steering + 1.0) * 10.0).round() as usize] += 1;
    }
    Some(Steering {
        spread,
        deviation: (rows.iter().map(square).sum::<f64>() / n).sqrt(),
        zero_share: share(|row| row.steering == 0.0),
        full_lock_share: share(|row| row.steering.abs() >= FULL_LOCK),
        histogram,
    })
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let kind = match self.kind {
            Kind::Udacity => "Udacity driving log",
            Kind::Tub => "donkeycar tub",
        };
        writeln!(f, "{}: {kind}", self.path)?;
        writeln!(f, "rows      {} of {} usable", self.usable, self.rows)?;
        for (reason, tally) in &self.unusable.0 {
            writeln!(f, "          {} left out: {}", tally.rows, reason.text())?;
            for example in &tally.examples {
                writeln!(f, "            {example}")?;
            }
        }
        let rate = self.rate_hz.map_or(String::new(), |hz| format!(", {hz:.1} rows/s"));
        let count = self.sessions.len();
        writeln!(f, "sessions  {count}, {:.1} s driven within {:.1} s{rate}", self.driven_s, self.span_s)?;
        for session in self.sessions.iter().take(LISTED_SESSIONS) {
            let Session { first_line, rows, length_s } = session;
            writeln!(f, "          from line {first_line}: {rows} rows, {length_s:.1} s")?;
        }
        if count > LISTED_SESSIONS {
            writeln!(f, "          and {} more", count - LISTED_SESSIONS)?;
        }
        let cameras: Vec<&str> = self.cameras.iter().map(|camera| camera.name()).collect();
        let cameras = if cameras.is_empty() { "no images".to_owned() } else { cameras.join(", ") };
        let size = self.image_size.map_or(String::new(), |[h, w]| format!("; {w}x{h} pixels"));
        writeln!(f, "cameras   {cameras}{size}")?;
        for (name, spread, unit) in [("throttle", self.throttle, ""), ("speed", self.speed_mph, " mph")] {
            if let Some(Spread { min, mean, max }) = spread {
                writeln!(f, "{name:<9} {min:.2} to {max:.2}{unit}, mean {mean:.2}")?;
            }
        }
        if let Some(steering) = &self.steering {
            let Steering { spread: Spread { min, mean, max }, deviation, zero_share, full_lock_share, .. } = steering;
            writeln!(f, "steering  {min:.3} to {max:.3}, mean {mean:.4}, standard deviation {deviation:.4}")?;
            let (zero, lock) = (100.0 * zero_share, 100.0 * full_lock_share);
            writeln!(f, "          {zero:.1} % exactly 0, {lock:.1} % at full lock")?;
            f.write_str(&bars(&steering.histogram))?;
        }
        self.notices.iter().try_for_each(|notice| writeln!(f, "note      {notice}"))
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
        let centre = i as f64 / 10.0 - 1.0;
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

    #[test]
    fn labels_are_described() {
        let report = describe(Path::new("drive"), &recording_of(&[0.0, 0.0, 1.0, -1.0, 0.5, -0.06], 100));
        let steering = report.steering.clone().unwrap();
        assert_eq!((steering.spread.min, steering.spread.max), (-1.0, 1.0));
        assert!(
            (steering.zero_share - 1.0 / 3.0).abs() < 1e-12 && (steering.full_lock_share - 1.0 / 3.0).abs() < 1e-12
        );
        let filled: Vec<_> = steering.histogram.iter().enumerate().filter(|(_, n)| **n > 0).collect();
        assert_eq!(filled, [(0, &1), (9, &1), (10, &2), (15, &1), (20, &1)]);
        assert_eq!((report.driven_s, report.rate_hz), (0.5, Some(10.0)));
        let text = report.to_string();
        for part in ["6 of 6 usable", "33.3 % exactly 0", "centre, left, right", "+0.0       2 ####", "10.0 rows/s"] {
            assert!(text.contains(part), "{part} in\n{text}");
        }
    }

    #[test]
    fn an_empty_recording_has_a_report() {
        let text = describe(Path::new("x"), &recording_of(&[], 100)).to_string();
        assert!(text.contains("0 of 0 usable"), "{text}");
    }

    #[test]
    fn reports_turn_into_json() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log.csv");
        std::fs::write(&path, "c.jpg,l.jpg,r.jpg,0.5,1,0,9\nc.jpg,l.jpg,r.jpg,x,1,0,9\n").unwrap();
        let report = report(&path).unwrap();
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
            let report = report(&root.join("csv-variants").join(format!("{name}.csv"))).unwrap();
            assert_eq!((report.rows, report.usable), (rows, 0), "{name}");
            assert!(report.steering.is_some());
        }
        let lake = report(&root.join("lake-sample")).unwrap();
        assert!((lake.steering.unwrap().zero_share - 0.56).abs() < 0.01);
        assert_eq!(lake.image_size, Some([160, 320]));
    }
}
