//! Driving sets of text lines: `FILE ANGLE[,DATE]`, as in the widespread `data.txt` with 45,000 to 63,000 frames.

use std::path::{Path, PathBuf};

use super::text::Lines;
use super::udacity::{days_of, number_of};
use super::{Format, files_ending, only, parent};
use crate::dataset::description::Unit;
use crate::dataset::pictures::files::{is_picture_name, split_path};
use crate::dataset::recording::file_name;
use crate::dataset::rows::{Entry, Rows};
use crate::dataset::store::Store;
use crate::dataset::unusable::Reason;
use crate::{Error, Result};

/// Driving sets of text lines.
pub(super) const FORMAT: Format = Format {
    id: "text-lines",
    name: "driving set of text lines",
    marks: "`data.txt`, or one other `.txt`: lines `FILE ANGLE` or `FILE ANGLE,DATE`, pictures beside it or in a folder there",
    labels: "degrees of the steering wheel, 400 are full lock; all within [-1, 1]: shares of full lock; the date, where there is one",
    unit: Unit::WheelDegrees,
    hz: 30.0,
    cameras: 1,
    find,
    base: |_, log| parent(log),
    read,
};

/// Lines that are looked at to tell the format.
const LOOKED_AT: usize = 5;

/// A line, taken apart.
struct Parsed {
    file: String,
    angle: f64,
    time_ms: Option<i64>,
}

/// `FILE ANGLE[,DATE]`; a name may hold spaces.
fn parse(line: &str) -> Option<Parsed> {
    let lower = line.to_lowercase();
    let end = [".jpg", ".jpeg", ".png"].iter().filter_map(|e| Some(lower.find(e)? + e.len())).min()?;
    // Letters may take another length in small letters.
    let (file, rest) = line.split_at_checked(end)?;
    let rest = rest.strip_prefix([' ', '\t'])?.trim_start();
    let (angle, date) = match rest.split_once([',', ' ', '\t']) {
        Some((angle, date)) => (angle, Some(date)),
        None => (rest, None),
    };
    let angle = angle.trim().parse().ok()?;
    Some(Parsed { file: file.trim().to_owned(), angle, time_ms: date.and_then(time_of_date) })
}

/// `2018-07-01 17:09:44:912`, or with a point before the milliseconds.
fn time_of_date(date: &str) -> Option<i64> {
    let (day, time) = date.trim().split_once([' ', 'T'])?;
    let mut parts = day.split('-').map(|part| part.parse::<i64>().ok());
    let mut next = || parts.next().flatten();
    let (year, month, day) = (next()?, next()?, next()?);
    let mut parts = time.split([':', '.']);
    let mut next = || parts.next().and_then(|part| part.trim().parse::<i64>().ok());
    let (hour, minute, second) = (next()?, next()?, next()?);
    let ms = parts.next().map_or(Some(0.0), |part| format!("0.{}", part.trim()).parse::<f64>().ok())?;
    let days = days_of(year, month, day)?;
    let fits = (0..24).contains(&hour) && (0..60).contains(&minute) && (0..=60).contains(&second);
    fits.then(|| (((days * 24 + hour) * 60 + minute) * 60 + second) * 1000 + (ms * 1000.0).round() as i64)
}

fn find(store: &Store, path: &Path) -> Result<Option<PathBuf>> {
    let usual = path.join("data.txt");
    let logs = if store.is_file(&usual) { vec![usual] } else { files_ending(store, path, &["txt"])? };
    let is_log = |log: &PathBuf| {
        let Ok(mut lines) = Lines::open(store, log) else { return false };
        (0..LOOKED_AT).any(|_| matches!(lines.next(), Ok(Some((_, line))) if parse(&line).is_some()))
    };
    only(path, logs.into_iter().filter(is_log).collect())
}

fn read(store: &Store, path: &Path, rows: &mut Rows) -> Result<()> {
    rows.read_from(&file_name(path));
    let mut lines = Lines::open(store, path).map_err(Error::io(path))?;
    let mut parsed = Vec::new();
    while let Some((number, text)) = lines.next().map_err(Error::io(path))? {
        if text.trim().is_empty() || text.starts_with('#') {
            continue;
        }
        match parse(&text) {
            Some(line) => parsed.push((number, line)),
            None => {
                let picture = text.split_whitespace().next().is_some_and(|word| is_picture_name(&word.to_lowercase()));
                let angle = text.split_whitespace().nth(1).is_some_and(|word| number_of(word).is_some());
                let reason = if picture || angle { Reason::NotANumber } else { Reason::TooFewFields };
                rows.unusable(number, reason, "no line `FILE ANGLE`");
            }
        }
    }
    // No drive on a road turns the steering wheel by less than a degree all the time.
    if parsed.iter().all(|(_, line)| line.angle.abs() <= 1.0) {
        rows.set_unit(Unit::Lock);
        rows.notice(
            "all angles are within [-1, 1]: they are taken for shares of full lock; say --unit if they are not".into(),
        );
    } else if rows.said().unit.is_none() {
        rows.notice(
            "angles are taken for degrees of the steering wheel, 400 are full lock; say --unit or full_lock_deg if not"
                .into(),
        );
    }
    for (line, Parsed { file, angle, time_ms }) in parsed {
        let source = split_path(&file).0.to_owned();
        rows.push(Entry { images: [Some(file), None, None], steering: angle, time_ms, source, ..Entry::at(line) })?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_with_and_without_a_date() {
        let line = parse("12.jpg -13.610000,2018-07-01 17:09:44:912").unwrap();
        assert_eq!((line.file.as_str(), line.angle), ("12.jpg", -13.61));
        assert_eq!(line.time_ms, Some(1_530_464_984_912));
        let line = parse("my drive/a.PNG\t2.5").unwrap();
        assert_eq!((line.file.as_str(), line.angle, line.time_ms), ("my drive/a.PNG", 2.5, None));
        for text in ["a.jpg", "a.jpg,1", "x 3", "a.jpg left", ""] {
            assert!(parse(text).is_none(), "{text}");
        }
    }
}
