//! donkeycar tubs of format 1: one `record_N.json` a row, with pictures beside it.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use super::tub::{Counts, Record, push, require_own_list};
use super::{Format, parent};
use crate::dataset::description::Unit;
use crate::dataset::recording::file_name;
use crate::dataset::rows::{Entry, Rows};
use crate::dataset::store::Store;
use crate::dataset::unusable::Reason;
use crate::{Error, Result};

/// Tubs of format 1.
pub(super) const FORMAT: Format = Format {
    id: "tub-1",
    name: "donkeycar tub, format 1",
    marks: "`record_N.json` files, with `meta.json` and pictures beside them",
    labels: "`user/angle` in [-1, 1], or `pilot/angle` with `labels = \"pilot\"`; `milliseconds`",
    unit: Unit::Lock,
    hz: 20.0,
    cameras: 1,
    find,
    base: |_, folder| folder.to_path_buf(),
    read,
};

/// A longer record is none.
const MAX_RECORD_BYTES: u64 = 1 << 20;

fn number(name: &str) -> Option<u32> {
    name.strip_prefix("record_")?.strip_suffix(".json")?.parse().ok()
}

fn find(store: &Store, path: &Path) -> Result<Option<PathBuf>> {
    if store.is_file(path) {
        let name = file_name(path);
        return Ok((name == "meta.json" || number(&name).is_some()).then(|| parent(path)));
    }
    Ok(store.list(path)?.iter().any(|path| number(&file_name(path)).is_some()).then(|| path.to_path_buf()))
}

fn read(store: &Store, folder: &Path, rows: &mut Rows) -> Result<()> {
    require_own_list(rows, folder, "exclude.json")?;
    let labels = rows.said().labels.unwrap_or_default();
    let mut numbers: Vec<u32> = store.list(folder)?.iter().filter_map(|path| number(&file_name(path))).collect();
    numbers.sort_unstable();
    let excluded = folder.join("exclude.json");
    let mut excluded_numbers = BTreeSet::<u32>::new();
    if store.is_file(&excluded) {
        let text = store.read_text(&excluded, MAX_RECORD_BYTES).map_err(Error::io(&excluded))?;
        match serde_json::from_str(&text) {
            Ok(list) => excluded_numbers = list,
            Err(error) => rows.notice(format!("exclude.json cannot be read ({error}): nothing is excluded")),
        }
    }
    let mut counts = Counts::default();
    rows.read_from("record_N.json");
    for number in numbers {
        let excluded = excluded_numbers.contains(&number);
        if !counts.keep(excluded, rows) {
            continue;
        }
        let path = folder.join(format!("record_{number}.json"));
        let text = store.read_text(&path, MAX_RECORD_BYTES);
        let record = text.map_err(|e| e.to_string()).and_then(|text| {
            serde_json::from_str::<Record>(&text).map_err(|error| format!("the record cannot be read: {error}"))
        });
        match record {
            Ok(record) => push(record, Entry { excluded, ..Entry::at(number) }, labels, &mut counts, rows)?,
            Err(detail) => rows.unusable(number, Reason::NotANumber, &detail),
        }
    }
    rows.notice("a tub has one camera: side cameras of a recipe fall away".into());
    counts.report(labels, rows);
    Ok(())
}
