//! Rows that a person has left out of a recording, and where that is written.
//!
//! No picture and no row is touched. Beside a log they are the entry `exclude` of `steersman.toml`; of a donkeycar tub they are the
//! list that its own tools keep: `deleted_indexes` in `manifest.json`, or `exclude.json` in format 1.

use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;
use toml_edit::{Array, DocumentMut, Item, Value as TomlValue};

use super::description::{DESCRIPTION_FILE, Description};
use super::recording::Recording;
use super::rows::NO_NUMBER;
use crate::files::atomic_file;
use crate::{Error, Result};

/// End of the name of the copy that is made of a manifest before it is changed for the first time.
const BACKUP: &str = ".before-steersman";

/// Where the rows that a person has left out of a recording are written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Exclusions {
    place: Place,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum Place {
    Description(PathBuf),
    Manifest(PathBuf),
    List(PathBuf),
}

impl Exclusions {
    /// Of `recording`.
    ///
    /// # Errors
    ///
    /// [`Error::Data`] for an archive, and for recordings whose rows have no number that stays.
    pub fn of(recording: &Recording) -> Result<Exclusions> {
        if recording.store.is_archive() {
            return Err(Error::data(
                &recording.path,
                "rows are left out beside the log, not in an archive: unpack it first",
            ));
        }
        let in_folder = |name: &str| recording.folder.join(name);
        let place = match recording.format.id {
            "tub" => Place::Manifest(in_folder("manifest.json")),
            "tub-1" => Place::List(in_folder("exclude.json")),
            _ => Place::Description(in_folder(DESCRIPTION_FILE)),
        };
        if let Place::Manifest(path) = &place
            && !path.is_file()
        {
            return Err(Error::data(
                path,
                "is not there, and holds the list of deleted records: donkeycar can write it anew",
            ));
        }
        if recording.rows.iter().all(|row| row.number == NO_NUMBER) && !recording.rows.is_empty() {
            return Err(Error::data(
                &recording.path,
                "its rows are files without a log, so they cannot be named: move files away to leave them out",
            ));
        }
        Ok(Exclusions { place })
    }

    /// The file that is changed.
    pub fn path(&self) -> &Path {
        let (Place::Description(path) | Place::Manifest(path) | Place::List(path)) = &self.place;
        path
    }

    /// Of the rows `known`, leaves out those of these `numbers`, and no others: lines of a log, numbers of a tub's records. Both are
    /// sorted; of two numbers with none of `known` between them a log's file makes one range. Everything else in the file stays as
    /// it is, also what it says of rows that are not known, as those that another driver drove.
    ///
    /// # Errors
    ///
    /// [`Error::Data`] if the file is damaged, [`Error::CannotWrite`] and [`Error::Io`] if it cannot be written. It is then as it
    /// was.
    pub fn save(&self, numbers: &[u32], known: &[u32]) -> Result<()> {
        match &self.place {
            Place::Description(path) => {
                let text = read_or_empty(path)?;
                let Some(changed) =
                    with_ranges(&text, ranges(numbers, known), known).map_err(|e| Error::data(path, e))?
                else {
                    return Ok(());
                };
                // What is written must be read again.
                let read = toml::from_str::<Description>(&changed).map_err(|e| e.to_string());
                read.and_then(|said| said.validate()).map_err(|e| Error::data(path, e.trim_end()))?;
                atomic_file::write(path, changed.as_bytes())
            }
            Place::Manifest(path) => {
                let text = fs::read_to_string(path).map_err(Error::io(path))?;
                let changed = with_deleted(&text, numbers, known).map_err(|e| Error::data(path, e))?;
                back_up(path, &text)?;
                atomic_file::write(path, changed.as_bytes())
            }
            Place::List(path) => {
                let text = read_or_empty(path)?;
                let old = if text.trim().is_empty() {
                    Value::Null
                } else {
                    back_up(path, &text)?;
                    serde_json::from_str(&text).map_err(|e| Error::data(path, e.to_string()))?
                };
                let text = Value::from(with_unknown(numbers, known, &old)).to_string();
                atomic_file::write(path, text.as_bytes())
            }
        }
    }
}

/// Keeps `text`, what the file `path` says before it is changed for the first time.
fn back_up(path: &Path, text: &str) -> Result<()> {
    let mut backup = path.to_path_buf().into_os_string();
    backup.push(BACKUP);
    if Path::new(&backup).exists() { Ok(()) } else { atomic_file::write(Path::new(&backup), text.as_bytes()) }
}

/// `numbers`, and those of the list `old` that are not `known`.
fn with_unknown(numbers: &[u32], known: &[u32], old: &Value) -> Vec<u64> {
    let old = old.as_array().into_iter().flatten().filter_map(Value::as_u64);
    let unknown = old.filter(|number| u32::try_from(*number).is_ok_and(|number| known.binary_search(&number).is_err()));
    let mut all: Vec<u64> = numbers.iter().copied().map(u64::from).chain(unknown).collect();
    all.sort_unstable();
    all.dedup();
    all
}

fn read_or_empty(path: &Path) -> Result<String> {
    match fs::read_to_string(path) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(String::new()),
        result => result.map_err(Error::io(path)),
    }
}

/// `numbers` as ranges; between two numbers of a range lies none of `known` that is not among them.
fn ranges(numbers: &[u32], known: &[u32]) -> Vec<[u32; 2]> {
    let mut ranges: Vec<[u32; 2]> = Vec::new();
    for &number in numbers {
        let joins = |[_, last]: &[u32; 2]| {
            let after = known.partition_point(|known| known <= last);
            known.get(after).is_none_or(|&next| next >= number)
        };
        match ranges.last_mut().filter(|range| joins(range)) {
            Some([_, last]) => *last = number,
            None => ranges.push([number, number]),
        }
    }
    ranges
}

/// The description `text` with these `exclude`, and those of its ranges that hold none of the lines `known`; `None` if there is
/// nothing to say and nothing was said.
fn with_ranges(text: &str, mut ranges: Vec<[u32; 2]>, known: &[u32]) -> Result<Option<String>, String> {
    let mut document: DocumentMut =
        text.parse().map_err(|e: toml_edit::TomlError| e.to_string().trim_end().to_string())?;
    let old = toml::from_str::<Description>(text).map(|said| said.exclude).unwrap_or_default();
    let holds_known = |[first, last]: &[u32; 2]| {
        known[known.partition_point(|line| line < first)..].first().is_some_and(|line| line <= last)
    };
    ranges.extend(old.into_iter().filter(|range| !holds_known(range)));
    ranges.sort_unstable();
    if ranges.is_empty() {
        return Ok(document.remove("exclude").map(|_| document.to_string()));
    }
    let pair = |range: &[u32; 2]| TomlValue::from(range.iter().map(|&line| i64::from(line)).collect::<Array>());
    let value: Array = ranges.iter().map(pair).collect();
    match document.get_mut("exclude") {
        // Comments around it stay.
        Some(Item::Value(old)) => {
            let decor = old.decor().clone();
            *old = TomlValue::Array(value);
            *old.decor_mut() = decor;
        }
        _ => {
            document.insert("exclude", Item::Value(TomlValue::Array(value)));
        }
    }
    Ok(Some(document.to_string()))
}

/// The manifest `text` with these `deleted_indexes`, and those of its own that are not `known`.
fn with_deleted(text: &str, numbers: &[u32], known: &[u32]) -> Result<String, String> {
    let mut changed = String::with_capacity(text.len());
    let mut found = false;
    for line in text.split_inclusive('\n') {
        let value = serde_json::from_str::<Value>(line).ok().filter(|value| !found && value.get("paths").is_some());
        let Some(mut value) = value else {
            changed += line;
            continue;
        };
        found = true;
        value["deleted_indexes"] = with_unknown(numbers, known, &value["deleted_indexes"]).into();
        changed += &value.to_string();
        changed += &line[line.trim_end().len()..];
    }
    if found { Ok(changed) } else { Err("no line lists the catalogs (`paths`)".into()) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::load::{load, load_rows};
    use crate::dataset::rows::{ImageCheck, LeftOut};
    use crate::dataset::testing::recordings_folder;

    #[test]
    fn neighbours_make_a_range_whatever_lines_hold_no_row() {
        assert_eq!(ranges(&[2, 3, 4, 9], &[2, 3, 4, 5, 9, 10]), [[2, 4], [9, 9]]);
        // Lines 3 and 4 hold no row.
        assert_eq!(ranges(&[2, 5], &[1, 2, 5, 6]), [[2, 5]]);
        assert!(ranges(&[], &[1]).is_empty());
    }

    #[test]
    fn comments_and_other_entries_stay() {
        let lines: Vec<u32> = (1..=20).collect();
        let text = "# my drive\nhz = 30.0 # slow\n\n[camera]\npreset = \"udacity\"\n";
        let changed = with_ranges(text, vec![[4, 9], [12, 12]], &lines).unwrap().unwrap();
        assert_eq!(
            changed,
            "# my drive\nhz = 30.0 # slow\nexclude = [[4, 9], [12, 12]]\n\n[camera]\npreset = \"udacity\"\n"
        );
        let again = with_ranges(&changed.replace("12]]", "12]] # dusk"), vec![[5, 5]], &lines).unwrap().unwrap();
        assert!(again.contains("exclude = [[5, 5]] # dusk\n"), "{again}");
        assert_eq!(with_ranges(&changed, vec![], &lines).unwrap().unwrap(), text);
        assert_eq!(with_ranges(text, vec![], &lines).unwrap(), None);
        assert!(with_ranges("hz = ", vec![[1, 1]], &lines).is_err());
        // Lines 30 to 40 hold no row that can be used today.
        let with_unknown = with_ranges("exclude = [[2, 3], [30, 40]]\n", vec![[5, 5]], &lines).unwrap().unwrap();
        assert_eq!(with_unknown, "exclude = [[5, 5], [30, 40]]\n");
    }

    #[test]
    fn only_the_deleted_indexes_of_a_manifest_change() {
        let text = "[\"cam/image_array\"]\n{\"created_at\": 1602421393.7723908}\n{\"paths\": [\"catalog_0.catalog\"], \
            \"current_index\": 9, \"deleted_indexes\": [7]}\n";
        let changed = with_deleted(text, &[1, 2], &[0, 1, 2, 7]).unwrap();
        let [before, after] = [text, &changed].map(|text| text.lines().map(str::to_owned).collect::<Vec<_>>());
        assert_eq!((&before[..2], before.len()), (&after[..2], after.len()));
        let value: Value = serde_json::from_str(&after[2]).unwrap();
        assert_eq!(
            value,
            serde_json::json!({"paths": ["catalog_0.catalog"], "current_index": 9, "deleted_indexes": [1, 2]})
        );
        // Record 7 is not among those that were shown: another driver's, as it may be.
        assert!(with_deleted(text, &[1, 2], &[0, 1, 2]).unwrap().contains("\"deleted_indexes\":[1,2,7]"));
        assert!(with_deleted("{}\n", &[1], &[]).is_err());
    }

    #[test]
    fn what_is_left_out_is_not_read_and_cuts_the_session() {
        let folder = tempfile::tempdir().unwrap();
        let log: String = (0..10).map(|i| format!("{i}.jpg,,,0.{i},1,0,9\n")).collect();
        fs::write(folder.path().join("driving_log.csv"), log).unwrap();
        let read = |left_out| load_rows(folder.path(), &Description::default(), ImageCheck::Skip, left_out).unwrap();
        let all = read(LeftOut::Keep);
        let numbers: Vec<u32> = all.rows.iter().map(|row| row.number).collect();
        Exclusions::of(&all).unwrap().save(&[4, 5, 10], &numbers).unwrap();
        let written = fs::read_to_string(folder.path().join(DESCRIPTION_FILE)).unwrap();
        assert_eq!(written, "exclude = [[4, 5], [10, 10]]\n");
        let left = read(LeftOut::Drop);
        assert_eq!(left.rows.iter().map(|row| row.line).collect::<Vec<_>>(), [1, 2, 3, 6, 7, 8, 9]);
        assert_eq!(left.sessions, [0..3, 3..7]);
        assert!(left.notices.iter().any(|notice| notice.starts_with("3 rows are left out")), "{:?}", left.notices);
        let shown = read(LeftOut::Keep);
        let marked: Vec<u32> = shown.rows.iter().filter(|row| row.excluded).map(|row| row.line).collect();
        assert_eq!((shown.rows.len(), marked), (10, vec![4, 5, 10]));
        assert_eq!(shown.sessions.len(), 1);
        Exclusions::of(&shown).unwrap().save(&[], &numbers).unwrap();
        assert_eq!((read(LeftOut::Drop).rows.len(), read(LeftOut::Drop).sessions.len()), (10, 1));
    }

    #[test]
    fn a_tub_keeps_its_own_list_and_a_copy_of_the_manifest() {
        let Some(root) = recordings_folder() else { return };
        let folder = tempfile::tempdir().unwrap();
        let tub = folder.path().join("tub");
        fs::create_dir_all(tub.join("images")).unwrap();
        for name in ["manifest.json", "catalog_0.catalog"] {
            fs::copy(root.join("donkey-tub").join(name), tub.join(name)).unwrap();
        }
        let before = fs::read_to_string(tub.join("manifest.json")).unwrap();
        let read = |left_out| load_rows(&tub, &Description::default(), ImageCheck::Skip, left_out).unwrap();
        let all = read(LeftOut::Keep);
        let exclusions = Exclusions::of(&all).unwrap();
        let numbers: Vec<u32> = all.rows.iter().map(|row| row.number).collect();
        exclusions.save(&numbers[10..20], &numbers).unwrap();
        assert_eq!(read(LeftOut::Drop).rows.len(), all.rows.len() - 10);
        assert_eq!(fs::read_to_string(tub.join("manifest.json.before-steersman")).unwrap(), before);
        exclusions.save(&[], &numbers).unwrap();
        assert_eq!(read(LeftOut::Drop).rows.len(), all.rows.len());
        fs::write(tub.join(DESCRIPTION_FILE), "exclude = [[1, 2]]").unwrap();
        assert!(load(&tub).unwrap_err().to_string().contains("a list of its own"));
    }
}
