//! The Udacity simulator's `driving_log.csv`, in all its dialects.
//!
//! Fields: centre, left and right image, steering, throttle, brake, speed. There may be a header or none (a first line
//! that begins with `center_` is data), commas, semicolons or tabs, spaces after them, paths of another machine or system,
//! commas in paths, exponents, decimal commas, more columns, and sessions appended one after the other.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::columns::{self, Columns};
use super::text::Lines;
use super::{Format, decimal_comma, files_ending, only, parent};
use crate::dataset::description::{Column, ColumnRef, Unit};
use crate::dataset::pictures::files::{is_picture_name, split_path};
use crate::dataset::recording::file_name;
use crate::dataset::rows::{Entry, Rows};
use crate::dataset::store::Store;
use crate::dataset::unusable::Reason;
use crate::{Error, Result};

/// Udacity's logs.
pub(super) const FORMAT: Format = Format {
    id: "udacity",
    name: "Udacity driving log",
    marks: "`driving_log.csv`, or one other `.csv` or `.txt` of such rows, and `IMG/`: picture names and numbers between commas, \
            semicolons or tabs, with or without a header",
    labels: "steering in [-1, 1], or what `unit` says; times in the names of pictures",
    unit: Unit::Lock,
    hz: 20.0,
    cameras: 3,
    find,
    base: |_, log| parent(log),
    read,
};

/// Lines of a file that are looked at to tell whether it is a log.
const LOOKED_AT: usize = 5;

/// What a line of a log holds.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Line {
    Row(Entry),
    Unusable { line: u32, reason: Reason, detail: String },
}

/// Reads a log line by line.
pub(crate) struct Log<'a> {
    lines: Lines,
    said: &'a BTreeMap<Column, ColumnRef>,
    /// The character between fields, once a line has shown it.
    separator: Option<char>,
    /// Set by a header, or by the user.
    columns: Option<Columns>,
    /// Header lines seen.
    pub headers: usize,
}

impl<'a> Log<'a> {
    /// Reads `lines`; `said` chooses columns.
    ///
    /// # Errors
    /// If `said` names columns of a header.
    pub fn new(lines: Lines, said: &'a BTreeMap<Column, ColumnRef>) -> Self {
        Self { lines, said, separator: None, columns: None, headers: 0 }
    }

    /// The next line that is neither empty nor a header; `None` at the end.
    ///
    /// # Errors
    /// What is wrong with the whole log: it cannot be read, a line is longer than 64 KiB, its columns cannot be told apart.
    pub fn next(&mut self) -> Result<Option<Line>, String> {
        loop {
            let Some((line, text)) = self.lines.next().map_err(|e| e.to_string())? else { return Ok(None) };
            let text = text.trim_matches(['\u{feff}', ' ', '\0']);
            if text.trim().is_empty() {
                continue;
            }
            let separator = *self.separator.get_or_insert_with(|| separator_of(text));
            let text = if separator == '\t' { text } else { text.trim() };
            let fields = split_fields(text, separator);
            // Excel writes the separator it used.
            if text.len() == 5 && text.to_ascii_lowercase().starts_with("sep=") {
                self.separator = text.chars().last();
                continue;
            }
            let first = self.headers == 0 && self.columns.is_none();
            if is_header(&fields) {
                self.headers += 1;
                self.columns = columns::find(&fields, self.said)?;
                continue;
            }
            if first && !self.said.is_empty() {
                self.columns = columns::without_header(self.said)?;
            }
            let decimal_commas = separator != ',';
            let parsed = match &self.columns {
                Some(columns) if !columns.are_usual() || (columns.count > 7 && fields.len() == columns.count) => {
                    by_columns(&fields, columns, decimal_commas, line)
                }
                _ => usual(&fields, separator, decimal_commas, line),
            };
            return Ok(Some(match parsed {
                Ok(entry) => Line::Row(entry),
                Err((reason, detail)) => Line::Unusable { line, reason, detail },
            }));
        }
    }
}

fn find(store: &Store, path: &Path) -> Result<Option<PathBuf>> {
    let usual = path.join("driving_log.csv");
    if store.is_file(&usual) {
        return Ok(Some(usual));
    }
    let mut logs = files_ending(store, path, &["csv", "tsv", "txt"])?;
    let named = store.is_file(path);
    logs.retain(|log| {
        let Ok(lines) = Lines::open(store, log) else { return false };
        let columns = BTreeMap::new();
        let mut log = Log::new(lines, &columns);
        (0..LOOKED_AT).any(|_| match log.next() {
            Ok(Some(Line::Row(entry))) => {
                entry.images[0].as_deref().is_some_and(|image| is_picture_name(&image.to_lowercase()))
            }
            // A log all of whose rows are wrong is a log, if it was named; so is one whose columns cannot be told apart.
            Ok(Some(Line::Unusable { reason, .. })) => named && reason != Reason::TooFewFields,
            Err(message) => named || !message.starts_with("no column is known to hold picture"),
            Ok(None) => false,
        })
    });
    if named && logs.is_empty() && path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("csv")) {
        return Ok(Some(path.to_path_buf()));
    }
    only(path, logs)
}

fn read(store: &Store, path: &Path, rows: &mut Rows) -> Result<()> {
    rows.read_from(&file_name(path));
    let said = rows.said();
    let mut log = Log::new(Lines::open(store, path).map_err(Error::io(path))?, &said.columns);
    while let Some(line) = log.next().map_err(|message| Error::data(path, message))? {
        match line {
            Line::Row(mut entry) => {
                let (folder, name) = split_path(entry.images[0].as_deref().unwrap_or(""));
                (entry.time_ms, entry.source) = (time_of(name), folder.to_owned());
                rows.push(entry)?;
            }
            Line::Unusable { line, reason, detail } => rows.unusable(line, reason, &detail),
        }
    }
    if log.headers > 1 {
        rows.notice(format!("the log has {} header lines: several logs were put together", log.headers));
    }
    Ok(())
}

/// The character between the fields of `line`: a tab or a semicolon where there are three or more, or else a comma.
fn separator_of(line: &str) -> char {
    let commas = line.matches(',').count();
    ['\t', ';'].into_iter().find(|&c| line.matches(c).count() >= 3.min(commas.max(1))).unwrap_or(',')
}

/// Splits at `separator`, but not inside quotes that a field begins with. Spaces stay: they tell separators apart.
pub(super) fn split_fields(text: &str, separator: char) -> Vec<&str> {
    let mut fields = Vec::with_capacity(8);
    let mut rest = text;
    loop {
        let quoted = rest.trim_start().strip_prefix('"').and_then(|inner| Some((inner, inner.find('"')?)));
        if let Some((inner, end)) = quoted {
            let after = &inner[end + 1..];
            if after.trim().is_empty() || after.trim_start().starts_with(separator) {
                fields.push(&inner[..end]);
                match after.split_once(separator) {
                    Some((_, next)) => rest = next,
                    None => return fields,
                }
                continue;
            }
        }
        match rest.split_once(separator) {
            Some((field, next)) => {
                fields.push(field);
                rest = next;
            }
            None => {
                fields.push(rest);
                return fields;
            }
        }
    }
}

fn is_image(field: &str) -> bool {
    let field = field.trim().trim_matches('"');
    field.len() >= 4
        && field
            .get(field.len().saturating_sub(5)..)
            .or(Some(field))
            .is_some_and(|end| is_picture_name(&end.to_ascii_lowercase()))
}

/// A header has words where rows have images and numbers.
pub(super) fn is_header(fields: &[&str]) -> bool {
    let word = |field: &&str| {
        let field = field.trim();
        let path = field.contains('\\') || field.starts_with('/') || field.matches('/').count() > 1;
        !field.is_empty() && number_of(field).is_none() && !is_image(field) && !path
    };
    fields.len() > 1 && fields.iter().all(word)
}

/// A number, with a decimal point or a decimal comma.
pub(super) fn number_of(field: &str) -> Option<f64> {
    let field = field.trim().trim_matches('"');
    field.parse().ok().or_else(|| field.contains(',').then(|| field.replacen(',', ".", 1).parse().ok())?)
}

type Fault = (Reason, String);

fn by_columns(fields: &[&str], columns: &Columns, decimal_commas: bool, line: u32) -> Result<Entry, Fault> {
    let field = |column: usize| {
        let found = format!("{} fields, the header names {}", fields.len(), columns.count);
        fields.get(column).copied().ok_or((Reason::TooFewFields, found))
    };
    if fields.len() > columns.count && fields[columns.count..].iter().any(|field| !field.trim().is_empty()) {
        return Err((Reason::TooManyFields, format!("{} fields, the header names {}", fields.len(), columns.count)));
    }
    let number = |column: Option<usize>, name| match column {
        Some(column) => number(field(column)?, decimal_commas, name),
        None => Ok(f64::NAN),
    };
    let mut images = [None, None, None];
    for (image, column) in images.iter_mut().zip(columns.images) {
        let written = column.map(field).transpose()?.map(|path| path.trim().trim_matches('"').to_owned());
        *image = written.filter(|path| !path.is_empty());
    }
    let [throttle, brake, speed] = columns.numbers;
    let values = [
        number(Some(columns.steering), "steering")?,
        number(throttle, "throttle")?,
        number(brake, "brake")?,
        number(speed, "speed")?,
    ];
    let by_user = columns.mode.map(field).transpose()?.is_some_and(|mode| mode.trim().eq_ignore_ascii_case("user"));
    Ok(Entry { taken_over: by_user, ..entry(line, images, values) })
}

/// A row in the usual order: three images, then steering, throttle, brake and speed.
fn usual(fields: &[&str], separator: char, decimal_commas: bool, line: u32) -> Result<Entry, Fault> {
    let mut fields = fields;
    let all = fields;
    let mut images = [None, None, None];
    for image in &mut images {
        // A path may hold commas: it goes on to the field that ends as an image file does.
        let length = fields.iter().position(|field| is_image(field)).map_or(1, |last| last + 1);
        let (path, rest) = fields.split_at(length.min(fields.len()));
        let path = if let [path] = path { Cow::Borrowed(*path) } else { Cow::Owned(path.join(&separator.to_string())) };
        // Logs of cars with one camera leave the sides empty.
        *image = Some(path.trim().to_owned()).filter(|path| !path.is_empty());
        fields = rest;
    }
    // A comma at the end of the line makes an empty field.
    while fields.len() > 4 && fields.last().is_some_and(|field| field.trim().is_empty()) {
        fields = &fields[..fields.len() - 1];
    }
    Ok(entry(line, images, values(fields, all, decimal_commas)?))
}

/// Steering, throttle, brake and speed from the fields after the images; `all` are those of the row.
fn values(fields: &[&str], all: &[&str], decimal_commas: bool) -> Result<[f64; 4], Fault> {
    const NAMES: [&str; 4] = ["steering", "throttle", "brake", "speed"];
    let wanted = || {
        let pictures = all.iter().filter(|field| is_image(field)).count();
        format!("{pictures} pictures among {} fields; a row is 3 pictures and 4 numbers", all.len())
    };
    if fields.len() < 4 {
        return Err((Reason::TooFewFields, wanted()));
    }
    let mut values = [0.0; 4];
    if fields.len() == 4 {
        for ((value, field), name) in values.iter_mut().zip(fields).zip(NAMES) {
            *value = number(field, decimal_commas, name)?;
        }
        return Ok(values);
    }
    if decimal_commas {
        return Err((Reason::TooManyFields, wanted()));
    }
    // The old simulator separates with comma and space: a comma without a space is then a decimal mark.
    let starts = fields.iter().filter(|field| field.starts_with(' ')).count();
    if starts == 4 && fields[0].starts_with(' ') && fields.len() <= 8 {
        let mut rest = fields;
        for (value, name) in values.iter_mut().zip(NAMES) {
            let length = 1 + rest[1..].iter().take_while(|field| !field.starts_with(' ')).count();
            *value = number(&rest[..length].join("."), false, name)?;
            rest = &rest[length..];
        }
        return Ok(values);
    }
    match decimal_comma::readings(fields)[..] {
        [reading] => Ok(reading),
        [] => Err((Reason::TooManyFields, wanted())),
        [a, b, ..] => {
            let text = fields.join(",");
            Err((Reason::Ambiguous, format!("`{text}` can be read as {a:?} or as {b:?}; record with a decimal point")))
        }
    }
}

fn number(field: &str, decimal_comma: bool, name: &str) -> Result<f64, Fault> {
    let field = field.trim();
    let value = if decimal_comma || field.starts_with('"') { number_of(field) } else { field.parse().ok() };
    value.ok_or_else(|| (Reason::NotANumber, format!("{name} \"{field}\" is not a number")))
}

fn entry(line: u32, images: [Option<String>; 3], values: [f64; 4]) -> Entry {
    let [steering, throttle, brake, speed_mph] = values;
    Entry {
        images,
        steering,
        throttle: throttle as f32,
        brake: brake as f32,
        speed_mph: speed_mph as f32,
        ..Entry::at(line)
    }
}

/// Milliseconds from 1970 of a file name that ends in `YYYY_MM_DD_HH_mm_ss_fff.jpg`; `None` if it does not.
pub(crate) fn time_of(file: &str) -> Option<i64> {
    let stem = file.rsplit_once('.').map_or(file, |(stem, _)| stem);
    let mut parts = stem.rsplit('_').map(|part| part.parse::<i64>().ok());
    let mut next = || parts.next().flatten();
    let [ms, second, minute, hour, day, month, year] = [next()?, next()?, next()?, next()?, next()?, next()?, next()?];
    let fits =
        (0..1000).contains(&ms) && (0..=60).contains(&second) && (0..60).contains(&minute) && (0..24).contains(&hour);
    let days = days_of(year, month, day)?;
    fits.then_some((((days * 24 + hour) * 60 + minute) * 60 + second) * 1000 + ms)
}

/// Days from 1970-01-01 to a date of the civil calendar, if it is one; the 31st of a shorter month is the 1st of the next.
pub(super) fn days_of(year: i64, month: i64, day: i64) -> Option<i64> {
    let fits = (1..=31).contains(&day) && (1..=12).contains(&month) && (1970..10_000).contains(&year);
    // Counting years from March, so that the leap day comes last (H. Hinnant).
    let (y, m) = if month > 2 { (year, month - 3) } else { (year - 1, month + 9) };
    fits.then(|| 365 * y + y / 4 - y / 100 + y / 400 + (153 * m + 2) / 5 + day - 719_469)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Cursor;

    fn lines(text: &str) -> Vec<Line> {
        let columns = BTreeMap::new();
        let mut log = Log::new(Lines::new(Box::new(Cursor::new(text.as_bytes().to_vec()))).unwrap(), &columns);
        std::iter::from_fn(|| log.next().unwrap()).collect()
    }

    fn row(text: &str) -> Entry {
        match &lines(text)[..] {
            [Line::Row(entry)] => entry.clone(),
            other => panic!("{other:?}"),
        }
    }

    fn fault(text: &str) -> Reason {
        match &lines(text)[..] {
            [Line::Unusable { reason, .. }] => *reason,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn a_plain_row() {
        let row = row("/a/IMG/center_1.jpg,/a/IMG/left_1.jpg,/a/IMG/right_1.jpg,-0.25,0.5,0,7.5E-05");
        assert_eq!(row.images[1].as_deref(), Some("/a/IMG/left_1.jpg"));
        assert_eq!((row.line, row.steering, row.throttle, row.brake, row.speed_mph), (1, -0.25, 0.5, 0.0, 7.5e-5));
    }

    #[test]
    fn headers_are_skipped_and_a_first_line_of_bare_names_is_none() {
        let data = "center_1.jpg,left_1.jpg,right_1.jpg,0,0,0,1\n";
        for header in
            ["center,left,right,steering,throttle,brake,speed", "Center,Left,Right,SteeringAngle,Throttle,Brake,Speed"]
        {
            assert_eq!(lines(&format!("{header}\n{data}")).len(), 1);
        }
        assert_eq!(lines(data).len(), 1);
        // A log that was put together from two has its header twice.
        assert_eq!(lines(&format!("center,left\n{data}center,left\n{data}")).len(), 2);
    }

    #[test]
    fn a_header_may_name_another_order() {
        let row = row("speed,steering,center\n12.5,-0.5,a.jpg");
        assert_eq!((row.steering, row.speed_mph, row.images[0].as_deref()), (-0.5, 12.5, Some("a.jpg")));
        assert!(row.throttle.is_nan() && row.images[1].is_none());
    }

    #[test]
    fn spaces_line_ends_and_empty_lines() {
        let text = "\u{feff}IMG/c.jpg, IMG/l.jpg, IMG/r.jpg, -0, 1, 0, 22.14829\r\n\r\n  \nIMG/c.jpg, IMG/l.jpg , IMG/r.jpg,.5,1,0,2";
        let rows = lines(text);
        assert_eq!(rows.len(), 2);
        let Line::Row(second) = &rows[1] else { panic!("{rows:?}") };
        assert_eq!((second.line, second.images[1].as_deref(), second.steering), (4, Some("IMG/l.jpg"), 0.5));
    }

    #[test]
    fn commas_and_quotes_in_paths() {
        let plain = row("/a, b/c.jpg,/a, b/l.jpg,/a, b/r.jpg,0.5,0,0,1");
        assert_eq!((plain.images[2].as_deref(), plain.steering), (Some("/a, b/r.jpg"), 0.5));
        assert_eq!(row("\"/a, b/c.jpg\",\"/a, b/l.jpg\",\"/a, b/r.jpg\",0.5,0,0,1"), plain);
        let odd = row("\"c.jpg,l.jpg,r.jpg,0,0,0,1");
        assert_eq!(odd.images[0].as_deref(), Some("\"c.jpg"));
    }

    #[test]
    fn decimal_commas_with_both_separators() {
        let old = row("c.jpg, l.jpg, r.jpg, -0,08581576, 0,1286689, 0, 12,1822");
        let new = row("c.jpg,l.jpg,r.jpg,-0,08581576,0,1286689,0,12,1822");
        assert_eq!((old.steering, old.throttle, old.brake, old.speed_mph), (-0.08581576, 0.1286689, 0.0, 12.1822));
        assert_eq!(old, new);
        let rolling = row("c.jpg, l.jpg, r.jpg, 0, 0, 0, 12,5");
        assert_eq!((rolling.steering, rolling.speed_mph), (0.0, 12.5));
        assert_eq!(fault("c.jpg,l.jpg,r.jpg,-0,0858,0,0,12,18"), Reason::Ambiguous);
    }

    #[test]
    fn rows_that_cannot_be_used() {
        assert_eq!(fault("c.jpg,l.jpg,r.jpg,0.5"), Reason::TooFewFields);
        assert_eq!(fault("c.jpg"), Reason::TooFewFields);
        assert_eq!(fault("c.jpg,l.jpg,r.jpg,0,0,0,1,2,3,4,5,6"), Reason::TooManyFields);
        assert_eq!(fault("c.jpg,l.jpg,r.jpg,abc,0,0,1"), Reason::NotANumber);
        assert_eq!(fault("c.jpg,l.jpg,r.jpg,0,0,,1"), Reason::NotANumber);
    }

    #[test]
    fn semicolons_tabs_and_more_columns() {
        let plain = row("c.jpg,l.jpg,r.jpg,-0.25,0.5,0,9.5");
        assert_eq!(row("c.jpg;l.jpg;r.jpg;-0,25;0,5;0;9,5"), plain);
        assert_eq!(row("c.jpg\tl.jpg\tr.jpg\t-0.25\t0.5\t0\t9.5"), plain);
        let header = "center,left,right,steering,throttle,brake,speed,lap,position";
        let Line::Row(entry) = &lines(&format!("{header}\nc.jpg,l.jpg,r.jpg,-0.25,0.5,0,9.5,3,12.5"))[0] else {
            panic!()
        };
        assert_eq!(Entry { line: 1, number: 1, ..entry.clone() }, plain);
    }

    #[test]
    fn times_come_from_file_names() {
        assert_eq!(time_of("center_1970_01_02_00_00_01_007.jpg"), Some(86_401_007));
        assert_eq!(time_of("center_2016_12_01_13_30_48_287.jpg"), Some(1_480_599_048_287));
        let step = |a, b| time_of(b).unwrap() - time_of(a).unwrap();
        assert_eq!(step("x_2020_02_28_23_59_59_999.jpg", "2020_02_29_00_00_00_000.jpg"), 1);
        for name in ["center.jpg", "12_cam_image_array_.jpg", "center_2016_13_01_13_30_48_287.jpg", ""] {
            assert_eq!(time_of(name), None, "{name}");
        }
    }
}
