//! The Udacity simulator's `driving_log.csv`, in all its dialects.
//!
//! Fields: centre, left and right image, steering, throttle, brake, speed. There may be a header or none (a first line
//! that begins with `center_` is data), spaces after commas, paths of another machine or system, commas in paths, CRLF,
//! exponents, decimal commas, and sessions appended one after the other.

use super::decimal_comma;
use crate::dataset::unusable::Reason;
use std::io::{self, BufRead, Read};

/// A longer line is no line of a log.
const MAX_LINE_BYTES: u64 = 64 * 1024;
/// Steering may exceed full lock by this much, the rounding of the simulator.
const LABEL_SLACK: f64 = 1e-5;

/// A row as written, before its images are looked for.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Entry {
    pub line: u32,
    /// Paths as written.
    pub images: [Option<String>; 3],
    pub steering: f32,
    pub throttle: f32,
    pub brake: f32,
    pub speed_mph: f32,
}

/// What a line of a log holds.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Line {
    Row(Entry),
    Unusable { line: u32, reason: Reason, detail: String },
}

/// Which column holds what; `None` where there is no such column.
#[derive(Debug, Clone, PartialEq)]
struct Columns {
    images: [Option<usize>; 3],
    steering: usize,
    /// Throttle, brake, speed.
    numbers: [Option<usize>; 3],
}

/// Reads a log line by line.
pub(crate) struct Log<R> {
    input: R,
    line: u32,
    buffer: Vec<u8>,
    /// Set by a header that names another order than the usual one.
    columns: Option<Columns>,
    /// Header lines seen.
    pub headers: usize,
}

impl<R: BufRead> Log<R> {
    pub fn new(input: R) -> Self {
        Self { input, line: 0, buffer: Vec::new(), columns: None, headers: 0 }
    }

    /// The next line that is neither empty nor a header; `None` at the end.
    ///
    /// # Errors
    /// If reading fails or a line is longer than 64 KiB.
    pub fn next(&mut self) -> io::Result<Option<Line>> {
        loop {
            self.buffer.clear();
            if self.input.by_ref().take(MAX_LINE_BYTES + 1).read_until(b'\n', &mut self.buffer)? == 0 {
                return Ok(None);
            }
            self.line = self.line.saturating_add(1);
            if self.buffer.len() as u64 > MAX_LINE_BYTES {
                let message = format!("line {} is longer than 64 KiB: this is no driving log", self.line);
                return Err(io::Error::new(io::ErrorKind::InvalidData, message));
            }
            let text = String::from_utf8_lossy(&self.buffer);
            let text = text.trim_start_matches('\u{feff}').trim();
            if text.is_empty() {
                continue;
            }
            let fields = split_fields(text);
            if is_header(&fields) {
                self.headers += 1;
                self.columns = columns_of(&fields);
                continue;
            }
            let parsed = match &self.columns {
                Some(columns) => by_columns(&fields, columns, self.line),
                None => usual(&fields, self.line),
            };
            return Ok(Some(match parsed {
                Ok(entry) => Line::Row(entry),
                Err((reason, detail)) => Line::Unusable { line: self.line, reason, detail },
            }));
        }
    }
}

/// Splits at commas, but not inside quotes that a field begins with. Spaces stay: they tell separators apart.
fn split_fields(text: &str) -> Vec<&str> {
    let mut fields = Vec::with_capacity(8);
    let mut rest = text;
    loop {
        let quoted = rest.trim_start().strip_prefix('"').and_then(|inner| Some((inner, inner.find('"')?)));
        if let Some((inner, end)) = quoted {
            let after = &inner[end + 1..];
            if after.trim().is_empty() || after.trim_start().starts_with(',') {
                fields.push(&inner[..end]);
                match after.split_once(',') {
                    Some((_, next)) => rest = next,
                    None => return fields,
                }
                continue;
            }
        }
        match rest.split_once(',') {
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
    let field = field.trim().to_ascii_lowercase();
    [".jpg", ".jpeg", ".png"].iter().any(|extension| field.ends_with(extension))
}

/// A header has words where rows have images and numbers.
fn is_header(fields: &[&str]) -> bool {
    let word = |field: &&str| {
        let field = field.trim();
        !field.is_empty() && field.parse::<f64>().is_err() && !is_image(field) && !field.contains(['/', '\\'])
    };
    fields.len() > 1 && fields.iter().all(word)
}

/// The columns a header names, unless it names the usual ones or none that are known.
fn columns_of(header: &[&str]) -> Option<Columns> {
    let names: Vec<String> = header.iter().map(|name| name.trim().to_ascii_lowercase()).collect();
    let find = |words: &[&str]| names.iter().position(|name| words.iter().any(|word| name.contains(word)));
    let columns = Columns {
        images: [find(&["center", "centre"]), find(&["left"]), find(&["right"])],
        steering: find(&["steer", "angle"])?,
        numbers: [find(&["throttle"]), find(&["brake", "reverse"]), find(&["speed"])],
    };
    let usual = Columns { images: [Some(0), Some(1), Some(2)], steering: 3, numbers: [Some(4), Some(5), Some(6)] };
    (columns.images[0].is_some() && columns != usual).then_some(columns)
}

type Fault = (Reason, String);

fn by_columns(fields: &[&str], columns: &Columns, line: u32) -> Result<Entry, Fault> {
    let field = |column: usize| {
        let found = format!("{} fields, column {} is needed", fields.len(), column + 1);
        fields.get(column).copied().ok_or((Reason::TooFewFields, found))
    };
    let number = |column: Option<usize>, name| match column {
        Some(column) => number(field(column)?, name),
        None => Ok(f64::NAN),
    };
    let mut images = [None, None, None];
    for (image, column) in images.iter_mut().zip(columns.images) {
        *image = column.map(|column| field(column).map(|path| path.trim().to_owned())).transpose()?;
    }
    let [throttle, brake, speed] = columns.numbers;
    let values = [
        number(Some(columns.steering), "steering")?,
        number(throttle, "throttle")?,
        number(brake, "brake")?,
        number(speed, "speed")?,
    ];
    entry(line, images, values)
}

/// A row in the usual order: three images, then steering, throttle, brake and speed.
fn usual(fields: &[&str], line: u32) -> Result<Entry, Fault> {
    let mut fields = fields;
    let count = fields.len();
    let mut images = [None, None, None];
    for image in &mut images {
        // A path may hold commas: it goes on to the field that ends as an image file does.
        let length = fields.iter().position(|field| is_image(field)).map_or(1, |last| last + 1);
        let (path, rest) = fields.split_at(length.min(fields.len()));
        // Logs of cars with one camera leave the sides empty.
        *image = Some(path.join(",").trim().to_owned()).filter(|path| !path.is_empty());
        fields = rest;
    }
    // A comma at the end of the line makes an empty field.
    while fields.len() > 4 && fields.last().is_some_and(|field| field.trim().is_empty()) {
        fields = &fields[..fields.len() - 1];
    }
    entry(line, images, values(fields, count)?)
}

/// Steering, throttle, brake and speed from the fields after the images.
fn values(fields: &[&str], count: usize) -> Result<[f64; 4], Fault> {
    const NAMES: [&str; 4] = ["steering", "throttle", "brake", "speed"];
    if fields.len() < 4 {
        return Err((Reason::TooFewFields, format!("{count} fields, a row has 7")));
    }
    let mut values = [0.0; 4];
    if fields.len() == 4 {
        for ((value, field), name) in values.iter_mut().zip(fields).zip(NAMES) {
            *value = number(field, name)?;
        }
        return Ok(values);
    }
    // The old simulator separates with comma and space: a comma without a space is then a decimal mark.
    let starts = fields.iter().filter(|field| field.starts_with(' ')).count();
    if starts == 4 && fields[0].starts_with(' ') && fields.len() <= 8 {
        let mut rest = fields;
        for (value, name) in values.iter_mut().zip(NAMES) {
            let length = 1 + rest[1..].iter().take_while(|field| !field.starts_with(' ')).count();
            *value = number(&rest[..length].join("."), name)?;
            rest = &rest[length..];
        }
        return Ok(values);
    }
    match decimal_comma::readings(fields)[..] {
        [reading] => Ok(reading),
        [] => Err((Reason::TooManyFields, format!("{count} fields, a row has 7"))),
        [a, b, ..] => {
            let text = fields.join(",");
            Err((Reason::Ambiguous, format!("`{text}` can be read as {a:?} or as {b:?}; record with a decimal point")))
        }
    }
}

fn number(field: &str, name: &str) -> Result<f64, Fault> {
    let field = field.trim();
    field.parse().map_err(|_| (Reason::NotANumber, format!("{name} \"{field}\" is not a number")))
}

fn entry(line: u32, images: [Option<String>; 3], values: [f64; 4]) -> Result<Entry, Fault> {
    let [steering, throttle, brake, speed_mph] = values;
    if !(-1.0 - LABEL_SLACK..=1.0 + LABEL_SLACK).contains(&steering) {
        return Err((Reason::LabelOutOfRange, format!("steering {steering} is not in [-1, 1]")));
    }
    Ok(Entry {
        line,
        images,
        steering: steering.clamp(-1.0, 1.0) as f32,
        throttle: throttle as f32,
        brake: brake as f32,
        speed_mph: speed_mph as f32,
    })
}

/// Milliseconds from 1970 of a file name that ends in `YYYY_MM_DD_HH_mm_ss_fff.jpg`; `None` if it does not.
pub(crate) fn time_of(file: &str) -> Option<i64> {
    let stem = file.rsplit_once('.').map_or(file, |(stem, _)| stem);
    let mut parts = stem.rsplit('_').map(|part| part.parse::<i64>().ok());
    let mut next = || parts.next().flatten();
    let [ms, second, minute, hour, day, month, year] = [next()?, next()?, next()?, next()?, next()?, next()?, next()?];
    let fits = (0..1000).contains(&ms)
        && (0..=60).contains(&second)
        && (0..60).contains(&minute)
        && (0..24).contains(&hour)
        && (1..=31).contains(&day)
        && (1..=12).contains(&month)
        && (1970..10_000).contains(&year);
    // Days from the civil calendar, counting years from March so that the leap day comes last (H. Hinnant).
    let (y, m) = if month > 2 { (year, month - 3) } else { (year - 1, month + 9) };
    let days = 365 * y + y / 4 - y / 100 + y / 400 + (153 * m + 2) / 5 + day - 719_469;
    fits.then_some((((days * 24 + hour) * 60 + minute) * 60 + second) * 1000 + ms)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lines(text: &str) -> Vec<Line> {
        let mut log = Log::new(text.as_bytes());
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
        for label in ["nan", "inf", "1.2", "-17"] {
            assert_eq!(fault(&format!("c.jpg,l.jpg,r.jpg,{label},0,0,1")), Reason::LabelOutOfRange);
        }
        assert_eq!(row("c.jpg,l.jpg,r.jpg,1.000001,0,0,1").steering, 1.0);
    }

    #[test]
    fn endless_lines_are_refused() {
        let text = "x".repeat(70_000);
        assert!(Log::new(text.as_bytes()).next().is_err());
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
