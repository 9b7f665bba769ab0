//! Finding out what a recording is, and reading it.

use super::formats::tub::Tub;
use super::formats::udacity::{Entry, Line, Log, time_of};
use super::pictures::files::{Files, Locator, split_path};
use super::recording::{Kind, Recording, Row, View, file_name};
use super::unusable::{Reason, Unusable};
use crate::{Error, Result};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::BufReader;
use std::path::{Path, PathBuf};

/// Rows whose images are looked at together; so much of a log is held as text.
const CHUNK: usize = 4096;

/// Whether the images of a recording are looked at while it is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ImageCheck {
    /// Each image must exist, begin as a JPEG or PNG and end as one. This costs some microseconds an image.
    Verify,
    /// Rows are believed; for logs whose images are elsewhere.
    Skip,
}

/// Reads the recording at `path`: a folder with a driving log or a tub, a log itself, or a tub's `manifest.json`.
///
/// # Errors
/// If nothing is found there or reading fails. Unusable rows are no error: see [`Recording::require_usable`].
pub fn load(path: &Path) -> Result<Recording> {
    load_with(path, ImageCheck::Verify)
}

/// As [`load`], with a choice about the images.
///
/// # Errors
/// As [`load`].
pub fn load_with(path: &Path, check: ImageCheck) -> Result<Recording> {
    let is_folder = fs::metadata(path).map_err(Error::io(path))?.is_dir();
    if is_folder && path.join("manifest.json").is_file() {
        read_tub(path, path, check)
    } else if is_folder {
        read_log(path, &find_log(path)?, check)
    } else if path.file_name().is_some_and(|name| name == "manifest.json") {
        read_tub(path, parent(path), check)
    } else {
        read_log(path, path, check)
    }
}

fn parent(path: &Path) -> &Path {
    match path.parent() {
        Some(parent) if parent != Path::new("") => parent,
        _ => Path::new("."),
    }
}

/// The log in `folder`: `driving_log.csv`, or else the only CSV file that reads as one.
fn find_log(folder: &Path) -> Result<PathBuf> {
    let usual = folder.join("driving_log.csv");
    if usual.is_file() {
        return Ok(usual);
    }
    let mut logs = Vec::new();
    for entry in fs::read_dir(folder).map_err(Error::io(folder))? {
        let path = entry.map_err(Error::io(folder))?.path();
        let is_csv = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("csv"));
        if is_csv && !file_name(&path).starts_with("._") && path.is_file() {
            let mut log = Log::new(BufReader::new(File::open(&path).map_err(Error::io(&path))?));
            if (0..5).any(|_| matches!(log.next(), Ok(Some(Line::Row(_))))) {
                logs.push(path);
            }
        }
    }
    logs.sort();
    match &logs[..] {
        [log] => Ok(log.clone()),
        [] => {
            Err(Error::data(folder, "no recording here: neither driving_log.csv nor manifest.json of a donkeycar tub"))
        }
        several => {
            let names: Vec<String> = several.iter().map(|path| file_name(path)).collect();
            Err(Error::data(folder, format!("several logs here ({}): name one of the files", names.join(", "))))
        }
    }
}

fn read_log(path: &Path, log_path: &Path, check: ImageCheck) -> Result<Recording> {
    let file = File::open(log_path).map_err(Error::io(log_path))?;
    let mut log = Log::new(BufReader::with_capacity(1 << 16, file));
    let place = file_name(log_path);
    let mut builder = Builder::new(path, Kind::Udacity, Locator::new(parent(log_path)), check);
    while let Some(line) = log.next().map_err(Error::io(log_path))? {
        match line {
            Line::Row(entry) => {
                let centre = entry.images[0].as_deref().unwrap_or("");
                let (folder, name) = split_path(centre);
                let (source, time_ms) = (folder.to_owned(), time_of(name));
                builder.push(Pending { entry, place: place.clone(), source, time_ms })?;
            }
            Line::Unusable { line, reason, detail } => {
                builder.unusable.add(reason, || format!("{place}:{line}: {detail}"));
            }
        }
    }
    let headers = log.headers;
    let mut recording = builder.finish(&place)?;
    if headers > 1 {
        recording.notices.push(format!("the log has {headers} header lines: several logs were put together"));
    }
    Ok(recording)
}

fn read_tub(path: &Path, folder: &Path, check: ImageCheck) -> Result<Recording> {
    let mut tub = Tub::open(folder)?;
    let mut builder = Builder::new(path, Kind::Tub, Locator::new(&folder.join("images")), check);
    while let Some(record) = tub.next()? {
        match record.line {
            Line::Row(entry) => {
                let source = record.session.unwrap_or_default();
                builder.push(Pending { entry, place: record.catalog, source, time_ms: record.time_ms })?;
            }
            Line::Unusable { line, reason, detail } => {
                builder.unusable.add(reason, || format!("{}:{line}: {detail}", record.catalog));
            }
        }
    }
    let deleted = tub.deleted;
    let mut recording = builder.finish("catalogs")?;
    recording.notices.push("a tub has one camera: side cameras of a recipe fall away".into());
    if deleted > 0 {
        recording.notices.push(format!("{deleted} records marked as deleted are left out"));
    }
    Ok(recording)
}

/// A row that waits for its images to be looked at.
struct Pending {
    entry: Entry,
    place: String,
    /// Folder or session it was written in.
    source: String,
    time_ms: Option<i64>,
}

/// Where each camera's image is, or what is wrong with it.
type Found = [Option<Result<(PathBuf, String), (Reason, String)>>; 3];

struct Builder {
    path: PathBuf,
    kind: Kind,
    locator: Locator,
    check: ImageCheck,
    pending: Vec<Pending>,
    sources: BTreeMap<String, u16>,
    rows: Vec<Row>,
    files: Files,
    unusable: Unusable,
}

impl Builder {
    fn new(path: &Path, kind: Kind, locator: Locator, check: ImageCheck) -> Self {
        Self {
            path: path.into(),
            kind,
            locator,
            check,
            pending: Vec::new(),
            sources: BTreeMap::new(),
            rows: Vec::new(),
            files: Files::default(),
            unusable: Unusable::default(),
        }
    }

    fn push(&mut self, row: Pending) -> Result<()> {
        self.pending.push(row);
        if self.pending.len() >= CHUNK { self.look_at_images() } else { Ok(()) }
    }

    /// Finds the images of the pending rows, on all threads, and keeps the rows that can be used.
    fn look_at_images(&mut self) -> Result<()> {
        let (locator, check) = (&self.locator, self.check);
        let find = |written: &String| match check {
            ImageCheck::Verify => locator.check(written).map(|(folder, file)| (folder, file.to_owned())),
            ImageCheck::Skip => {
                let (folder, file) = locator.assume(written);
                Ok((folder, file.to_owned()))
            }
        };
        let found: Vec<Found> =
            self.pending.par_iter().map(|row| row.entry.images.each_ref().map(|i| i.as_ref().map(find))).collect();
        for (row, found) in std::mem::take(&mut self.pending).into_iter().zip(found) {
            self.keep(row, found)?;
        }
        Ok(())
    }

    fn keep(&mut self, row: Pending, found: Found) -> Result<()> {
        let Pending { entry, place, source, time_ms } = row;
        let fault = match &found[0] {
            Some(Ok(_)) => None,
            Some(Err((reason, detail))) => Some((*reason, detail.clone())),
            None => Some((Reason::TooFewFields, "no image of the centre camera".to_owned())),
        };
        if let Some((reason, detail)) = fault {
            self.unusable.add(reason, || format!("{place}:{}: {detail}", entry.line));
            return Ok(());
        }
        let side_faults = [1, 2].map(|i| found[i].as_ref()?.as_ref().err().map(|(reason, _)| *reason));
        let images = found.each_ref().map(|image| match image {
            Some(Ok((folder, file))) => Some((folder.as_path(), file.as_str())),
            _ => None,
        });
        let images = self.files.add(images).map_err(|message| Error::data(&self.path, message))?;
        let next = self.sources.len();
        let source = match self.sources.get(&source) {
            Some(&number) => number,
            None => {
                let number = u16::try_from(next)
                    .map_err(|_| Error::data(&self.path, "the images lie in more than 65,535 folders"))?;
                self.sources.insert(source, number);
                number
            }
        };
        let Entry { line, steering, throttle, brake, speed_mph, .. } = entry;
        let time_ms = time_ms.unwrap_or(i64::MIN);
        self.rows.push(Row { steering, throttle, brake, speed_mph, time_ms, line, source, images, side_faults });
        Ok(())
    }

    fn finish(mut self, log: &str) -> Result<Recording> {
        self.look_at_images()?;
        let mut recording = Recording {
            path: self.path,
            kind: self.kind,
            rows: self.rows,
            sessions: Vec::new(),
            unusable: self.unusable,
            notices: Vec::new(),
            image_size: None,
            times_plausible: true,
            files: self.files,
        };
        recording.settle(log);
        recording.image_size = recording
            .image_path(0, View::Centre)
            .and_then(|path| fs::read(path).ok())
            .and_then(|bytes| crate::picture::decode::image_size(&bytes).ok());
        Ok(recording)
    }
}

#[cfg(test)]
#[path = "load_tests.rs"]
mod tests;
