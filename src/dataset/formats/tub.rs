//! donkeycar tubs of format 2: `manifest.json`, catalogs of one JSON record a line, and a folder `images`.

use std::collections::BTreeSet;
use std::io::BufRead;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde_json::Value;

use super::{Format, parent};
use crate::dataset::description::{DESCRIPTION_FILE, Labels, Unit};
use crate::dataset::recording::file_name;
use crate::dataset::rows::{Entry, NO_NUMBER, Rows};
use crate::dataset::store::Store;
use crate::dataset::unusable::Reason;
use crate::{Error, Result};

/// Tubs of format 2.
pub(super) const FORMAT: Format = Format {
    id: "tub",
    name: "donkeycar tub, format 2",
    marks: "`manifest.json` or `catalog_N.catalog` files, and `images/`",
    labels: "`user/angle` in [-1, 1], or `pilot/angle` with `labels = \"pilot\"`; `_timestamp_ms`",
    unit: Unit::Lock,
    hz: 20.0,
    cameras: 1,
    find,
    base: |store, folder| {
        if store.is_folder(&folder.join("images")) { folder.join("images") } else { folder.to_path_buf() }
    },
    read,
};

/// A longer manifest, or line of a catalog, is none.
const MAX_MANIFEST_BYTES: u64 = 64 << 20;
const MAX_LINE_BYTES: u64 = 1 << 20;

/// The line of the manifest that lists the catalogs.
#[derive(Debug, Default, Deserialize)]
struct Contents {
    paths: Vec<String>,
    #[serde(default)]
    deleted_indexes: Option<BTreeSet<u64>>,
}

/// A record of a tub of either format. Other fields are ignored.
#[derive(Debug, Deserialize)]
pub(super) struct Record {
    #[serde(rename = "_index")]
    index: Option<u64>,
    #[serde(rename = "_timestamp_ms", alias = "milliseconds")]
    pub time_ms: Option<Value>,
    #[serde(rename = "_session_id")]
    session: Option<String>,
    #[serde(rename = "cam/image_array")]
    pub image: Option<String>,
    #[serde(rename = "user/angle")]
    angle: Option<f64>,
    #[serde(rename = "user/steering")]
    steering: Option<f64>,
    #[serde(rename = "user/throttle")]
    throttle: Option<f64>,
    #[serde(rename = "user/mode")]
    mode: Option<String>,
    #[serde(rename = "pilot/angle")]
    pilot_angle: Option<f64>,
    #[serde(rename = "pilot/throttle")]
    pilot_throttle: Option<f64>,
    #[serde(rename = "__empty__", default)]
    empty: Option<bool>,
}

/// What becomes of the records of a tub, counted.
#[derive(Debug, Default)]
pub(super) struct Counts {
    pub deleted: usize,
    /// Records of another driver than the labels are asked for.
    other_driver: usize,
}

impl Counts {
    /// Whether the next record is read; one that is marked as deleted is counted instead, unless such rows are asked for.
    pub fn keep(&mut self, deleted: bool, rows: &mut Rows) -> bool {
        let keep = !deleted || rows.keeps_excluded();
        self.deleted += usize::from(!keep);
        keep
    }

    /// Says what was left out.
    pub fn report(&self, labels: Labels, rows: &mut Rows) {
        if self.deleted > 0 {
            rows.notice(format!("{} records marked as deleted are left out", self.deleted));
        }
        if self.other_driver > 0 {
            rows.notice(match labels {
                Labels::User => format!(
                    "{} records that a pilot drove (user/mode is not user) are left out; --labels pilot takes the pilot's commands",
                    self.other_driver
                ),
                Labels::Pilot => format!("{} records without a pilot's command are left out", self.other_driver),
            });
        }
    }
}

/// Hands the row of `record` to `rows`. `place` says its line, its number and whether it is marked as deleted.
pub(super) fn push(record: Record, place: Entry, labels: Labels, counts: &mut Counts, rows: &mut Rows) -> Result<()> {
    let line = place.line;
    if record.empty == Some(true) {
        counts.deleted += 1;
        return Ok(());
    }
    let driven_by_user =
        record.mode.as_deref().is_none_or(|mode| mode.trim().is_empty() || mode.trim().eq_ignore_ascii_case("user"));
    let (angle, throttle) = match labels {
        Labels::User if driven_by_user => (record.angle.or(record.steering), record.throttle),
        Labels::Pilot if record.pilot_angle.is_some() => {
            (record.pilot_angle, record.pilot_throttle.or(record.throttle))
        }
        _ => {
            counts.other_driver += 1;
            return Ok(());
        }
    };
    let Some(steering) = angle else {
        rows.unusable(line, Reason::NotANumber, "the record has neither user/angle nor user/steering");
        return Ok(());
    };
    let Some(image) = record.image else {
        rows.unusable(line, Reason::TooFewFields, "the record has no cam/image_array");
        return Ok(());
    };
    // Times beyond the year 9999 are no times.
    let time_ms = record.time_ms.as_ref().and_then(|time| time.as_i64().or(time.as_f64().map(|time| time as i64)));
    rows.push(Entry {
        images: [Some(image), None, None],
        steering,
        throttle: throttle.map_or(f32::NAN, |x| x as f32),
        time_ms: time_ms.filter(|ms| (0..=253_402_300_799_999).contains(ms)),
        source: record.session.unwrap_or_default(),
        ..place
    })
}

fn find(store: &Store, path: &Path) -> Result<Option<PathBuf>> {
    if store.is_file(path) {
        return Ok(path.file_name().is_some_and(|name| name == "manifest.json").then(|| parent(path)));
    }
    let catalogs = || Ok::<bool, Error>(!catalogs(store, path)?.is_empty());
    Ok((store.is_file(&path.join("manifest.json")) || catalogs()?).then(|| path.to_path_buf()))
}

/// Checks that nothing but the tub itself leaves records out.
pub(super) fn require_own_list(rows: &Rows, folder: &Path, list: &str) -> Result<()> {
    if rows.said().exclude.is_empty() {
        return Ok(());
    }
    Err(Error::data(folder.join(DESCRIPTION_FILE), format!("exclude: a tub has a list of its own for that, {list}")))
}

/// The catalogs that lie in `folder`, by their numbers.
fn catalogs(store: &Store, folder: &Path) -> Result<Vec<String>> {
    let number = |name: &str| name.strip_prefix("catalog_")?.strip_suffix(".catalog")?.parse::<u64>().ok();
    let mut names: Vec<String> = store.list(folder)?.iter().map(|path| file_name(path)).collect();
    names.retain(|name| number(name).is_some());
    names.sort_by_key(|name| number(name));
    Ok(names)
}

/// The catalogs of the tub in `folder`, and the indexes that were deleted.
fn contents(store: &Store, folder: &Path, rows: &mut Rows) -> Result<(Vec<String>, BTreeSet<u64>)> {
    let path = folder.join("manifest.json");
    let there = catalogs(store, folder)?;
    let text = if store.is_file(&path) {
        store.read_text(&path, MAX_MANIFEST_BYTES).map_err(Error::io(&path))?
    } else {
        String::new()
    };
    let contents = text.lines().find_map(|line| serde_json::from_str::<Contents>(line).ok());
    let Some(Contents { mut paths, deleted_indexes }) = contents else {
        if there.is_empty() {
            return Err(Error::data(
                &path,
                "no line lists the catalogs (`paths`), and there are none: not a donkeycar tub of format 2",
            ));
        }
        let what = if text.is_empty() { "there is no manifest.json" } else { "manifest.json is damaged" };
        rows.notice(format!(
            "{what}: the {} catalogs beside it are read; which records were deleted is not known",
            there.len()
        ));
        return Ok((there, BTreeSet::new()));
    };
    // macOS leaves `._` files beside the real ones on foreign disks.
    paths.retain(|path| !path.starts_with("._"));
    if paths.iter().any(|path| Path::new(path).components().count() != 1 || path.contains('\\') || path == "..") {
        return Err(Error::data(&path, "catalogs must lie beside the manifest"));
    }
    let unlisted: Vec<String> = there.into_iter().filter(|name| !paths.contains(name)).collect();
    if !unlisted.is_empty() {
        rows.notice(format!(
            "manifest.json does not list {}, which {} read all the same",
            unlisted.join(", "),
            if unlisted.len() == 1 { "is" } else { "are" }
        ));
        paths.extend(unlisted);
    }
    Ok((paths, deleted_indexes.unwrap_or_default()))
}

fn read(store: &Store, folder: &Path, rows: &mut Rows) -> Result<()> {
    require_own_list(rows, folder, "the deleted_indexes of its manifest.json")?;
    let labels = rows.said().labels.unwrap_or_default();
    let (paths, deleted) = contents(store, folder, rows)?;
    let mut counts = Counts::default();
    for name in paths {
        let path = folder.join(&name);
        let mut input = match store.open(&path) {
            Ok(input) => input,
            Err(error) => {
                rows.notice(format!("{name} cannot be read ({error}): its records are missing"));
                continue;
            }
        };
        rows.read_from(&name);
        let (mut text, mut line) = (Vec::new(), 0);
        loop {
            text.clear();
            let read = std::io::Read::take(&mut input, MAX_LINE_BYTES + 1)
                .read_until(b'\n', &mut text)
                .map_err(Error::io(&path))?;
            if read == 0 {
                break;
            }
            line += 1;
            if text.len() as u64 > MAX_LINE_BYTES {
                return Err(Error::data_at(
                    &path,
                    u64::from(line),
                    "the record is longer than 1 MiB: no catalog of a tub",
                ));
            }
            if text.trim_ascii().is_empty() {
                continue;
            }
            match serde_json::from_slice::<Record>(&text) {
                Ok(record) => {
                    let excluded = record.index.is_some_and(|index| deleted.contains(&index));
                    let number = record.index.and_then(|index| u32::try_from(index).ok()).unwrap_or(NO_NUMBER);
                    if counts.keep(excluded, rows) {
                        push(record, Entry { number, excluded, ..Entry::at(line) }, labels, &mut counts, rows)?;
                    }
                }
                Err(error) => rows.unusable(line, Reason::NotANumber, &format!("the record cannot be read: {error}")),
            }
        }
    }
    rows.notice("a tub has one camera: side cameras of a recipe fall away".into());
    counts.report(labels, rows);
    Ok(())
}
