//! donkeycar tubs of format 2: `manifest.json`, catalogs of one JSON record a line, and a folder `images`.

use super::udacity::{Entry, Line};
use crate::dataset::unusable::Reason;
use crate::{Error, Result};
use serde::Deserialize;
use std::collections::BTreeSet;
use std::fs;
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};

/// The line of the manifest that lists the catalogs.
#[derive(Debug, Deserialize)]
struct Contents {
    paths: Vec<String>,
    #[serde(default)]
    deleted_indexes: BTreeSet<u64>,
}

/// One line of a catalog. Other fields are ignored.
#[derive(Debug, Deserialize)]
struct Record {
    #[serde(rename = "_index")]
    index: u64,
    #[serde(rename = "_timestamp_ms")]
    time_ms: Option<i64>,
    #[serde(rename = "_session_id")]
    session: Option<String>,
    #[serde(rename = "cam/image_array")]
    image: String,
    #[serde(rename = "user/angle")]
    angle: f64,
    #[serde(rename = "user/throttle")]
    throttle: Option<f64>,
}

/// A record with what a log of the simulator would not hold.
pub(crate) struct TubLine {
    pub line: Line,
    pub catalog: String,
    pub time_ms: Option<i64>,
    pub session: Option<String>,
}

/// Reads the records of a tub one after the other.
pub(crate) struct Tub {
    folder: PathBuf,
    catalogs: std::vec::IntoIter<String>,
    open: Option<(String, BufReader<File>, u32)>,
    deleted_indexes: BTreeSet<u64>,
    /// Records left out because the driver deleted them.
    pub deleted: usize,
}

impl Tub {
    /// Opens the tub in `folder`.
    ///
    /// # Errors
    /// If the manifest cannot be read or lists no catalogs.
    pub fn open(folder: &Path) -> Result<Self> {
        let path = folder.join("manifest.json");
        let text = fs::read_to_string(&path).map_err(Error::io(&path))?;
        let contents = text.lines().find_map(|line| serde_json::from_str::<Contents>(line).ok());
        let Some(Contents { mut paths, deleted_indexes }) = contents else {
            return Err(Error::data(&path, "no line lists the catalogs (`paths`): not a donkeycar tub of format 2"));
        };
        // macOS leaves `._` files beside the real ones on foreign disks.
        paths.retain(|path| !path.starts_with("._"));
        if paths.iter().any(|path| Path::new(path).components().count() != 1 || path.contains('\\') || path == "..") {
            return Err(Error::data(&path, "catalogs must lie beside the manifest"));
        }
        Ok(Self { folder: folder.into(), catalogs: paths.into_iter(), open: None, deleted_indexes, deleted: 0 })
    }

    /// The next record that was not deleted; `None` at the end.
    ///
    /// # Errors
    /// If a catalog cannot be read.
    pub fn next(&mut self) -> Result<Option<TubLine>> {
        loop {
            let Some((catalog, input, line)) = &mut self.open else {
                let Some(catalog) = self.catalogs.next() else { return Ok(None) };
                let path = self.folder.join(&catalog);
                let file = File::open(&path).map_err(Error::io(&path))?;
                self.open = Some((catalog, BufReader::new(file), 0));
                continue;
            };
            let mut text = Vec::new();
            if input.read_until(b'\n', &mut text).map_err(Error::io(self.folder.join(&*catalog)))? == 0 {
                self.open = None;
                continue;
            }
            *line += 1;
            if text.trim_ascii().is_empty() {
                continue;
            }
            let (catalog, line) = (catalog.clone(), *line);
            let record = match serde_json::from_slice::<Record>(&text) {
                Ok(record) => record,
                Err(error) => {
                    let detail = format!("the record cannot be read: {error}");
                    let line = Line::Unusable { line, reason: Reason::NotANumber, detail };
                    return Ok(Some(TubLine { line, catalog, time_ms: None, session: None }));
                }
            };
            if self.deleted_indexes.contains(&record.index) {
                self.deleted += 1;
                continue;
            }
            // Times beyond the year 9999 are no times.
            let time_ms = record.time_ms.filter(|ms| (0..=253_402_300_799_999).contains(ms));
            let session = record.session.clone();
            return Ok(Some(TubLine { line: row(record, line), catalog, time_ms, session }));
        }
    }
}

fn row(record: Record, line: u32) -> Line {
    if !(-1.0..=1.0).contains(&record.angle) {
        let detail = format!("user/angle {} is not in [-1, 1]", record.angle);
        return Line::Unusable { line, reason: Reason::LabelOutOfRange, detail };
    }
    Line::Row(Entry {
        line,
        images: [Some(record.image), None, None],
        steering: record.angle as f32,
        throttle: record.throttle.map_or(f32::NAN, |x| x as f32),
        brake: f32::NAN,
        speed_mph: f32::NAN,
    })
}
