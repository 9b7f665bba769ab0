//! Finding out what a recording is, and reading it.

use std::path::{Path, PathBuf};

use super::description::Description;
use super::formats::{FORMATS, Format, name_of_foreign, parent};
use super::recording::{Recording, file_name};
use super::rows::{ImageCheck, LeftOut, Rows};
use super::store::Store;
use crate::{Error, Result};

/// Folders within folders in which recordings are looked for.
const MAX_DEPTH: usize = 4;
/// Folders that are looked into, and recordings that a message lists.
const MAX_FOLDERS: usize = 2000;
const MAX_LISTED: usize = 10;

/// Reads the recording at `path`: a folder, a log, a tub's `manifest.json`, or a `.zip` or `.tar.gz` of one. What stands in
/// `steersman.toml` beside it is heeded.
///
/// # Errors
/// If nothing is found there or reading fails. Unusable rows are no error: see [`Recording::require_usable`].
pub fn load(path: &Path) -> Result<Recording> {
    load_with(path, &Description::default(), ImageCheck::Verify)
}

/// As [`load`], with what the user says about the recording, which goes before what stands beside it; and a choice about the
/// pictures.
///
/// # Errors
/// As [`load`]; [`Error::Usage`] for a number in `said` that cannot be.
pub fn load_with(path: &Path, said: &Description, check: ImageCheck) -> Result<Recording> {
    load_rows(path, said, check, LeftOut::Drop)
}

/// As [`load_with`], with a choice about the rows that a person has left out.
///
/// # Errors
/// As [`load_with`].
pub(crate) fn load_rows(path: &Path, said: &Description, check: ImageCheck, left_out: LeftOut) -> Result<Recording> {
    said.validate().map_err(Error::Usage)?;
    let store = Store::of(path)?;
    let (format, found) = match find(&store, path)? {
        Some(found) => found,
        None => find_deeper(&store, path)?,
    };
    let base = (format.base)(&store, &found);
    let folder = if store.is_folder(&found) { found.clone() } else { parent(&found) };
    let said = said.clone().or(Description::beside(&store, &folder)?);
    // A log that was named alone is a recording with the folder it lies in.
    let top = if store.is_folder(path) || store.is_archive() { path.to_path_buf() } else { parent(path) };
    let top = if base.starts_with(&top) { top } else { folder.clone() };
    let mut rows = Rows::new(&store, &top, &base, format, &said, (check, left_out))?;
    (format.read)(&store, &found, &mut rows)?;
    let collected = rows.collect()?;
    collected.into_recording(path, folder, store, format)
}

/// The format that finds something at `path`, and what it found.
fn find(store: &Store, path: &Path) -> Result<Option<(&'static Format, PathBuf)>> {
    for format in FORMATS {
        if let Some(found) = (format.find)(store, path)? {
            return Ok(Some((format, found)));
        }
    }
    Ok(None)
}

/// The recording in the only sub-folder of an archive that has one; an error that says what is there instead.
fn find_deeper(store: &Store, path: &Path) -> Result<(&'static Format, PathBuf)> {
    if store.is_file(path) && !store.is_archive() {
        let what = name_of_foreign(store, path).unwrap_or_else(|| "is no recording in a known format".into());
        return Err(Error::data(path, what));
    }
    let below = below(store, path)?;
    if let ([only], true) = (&below[..], store.is_archive())
        && let Some(found) = find(store, only)?
    {
        return Ok(found);
    }
    if !below.is_empty() {
        let listed: Vec<String> = below.iter().take(MAX_LISTED).map(|path| path.display().to_string()).collect();
        let more = below.len().saturating_sub(MAX_LISTED);
        let more = if more > 0 { format!(" and {more} more") } else { String::new() };
        let message = format!(
            "holds {} recordings and is none itself: {}{more}; name them, or take all with --recursive",
            below.len(),
            listed.join(", ")
        );
        return Err(Error::data(path, message));
    }
    if store.is_file(&path.join("run.json")) || store.is_file(&path.join("model.safetensors")) {
        return Err(Error::data(
            path,
            "is the folder of a run, no recording: name the model first, then the recordings",
        ));
    }
    for file in store.list(path)?.iter().filter(|path| store.is_file(path)) {
        if let Some(what) = name_of_foreign(store, file).filter(|what| !what.starts_with("is a picture")) {
            return Err(Error::data(path, format!("no recording here; {} {what}", file_name(file))));
        }
    }
    Err(Error::data(
        path,
        "no recording here: neither driving_log.csv nor another log, no manifest.json or record_N.json of a donkeycar tub, no \
         data.txt, no pictures with labels in their names",
    ))
}

/// The recordings at `path` and below it, sorted by path; a folder that is a recording is not looked into.
///
/// # Errors
/// If `path` cannot be read, or there is none.
pub fn recordings_below(path: &Path) -> Result<Vec<PathBuf>> {
    let store = Store::of(path)?;
    if find(&store, path)?.is_some() {
        return Ok(vec![path.to_path_buf()]);
    }
    let found = if store.is_folder(path) || store.is_archive() { below(&store, path)? } else { Vec::new() };
    if found.is_empty() { find_deeper(&store, path).map(|_| Vec::new()) } else { Ok(found) }
}

fn below(store: &Store, path: &Path) -> Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    let mut count = 0;
    look_below(store, path, 0, &mut count, &mut found)?;
    Ok(found)
}

fn look_below(store: &Store, path: &Path, depth: usize, count: &mut usize, found: &mut Vec<PathBuf>) -> Result<()> {
    for entry in store.list(path)? {
        let archive = !store.is_archive() && is_archive_name(&entry) && store.is_file(&entry);
        if !archive && !store.is_folder(&entry) || *count >= MAX_FOLDERS {
            continue;
        }
        *count += 1;
        // A folder that cannot be read, or holds several logs, is for whoever names it.
        let here = if archive {
            Store::of(&entry)
                .and_then(|store| find(&store, &entry)?.map_or_else(|| find_deeper(&store, &entry), Ok).map(Some))
        } else {
            find(store, &entry)
        };
        match here {
            Ok(Some(_)) => found.push(entry),
            Ok(None) if depth < MAX_DEPTH && !archive => look_below(store, &entry, depth + 1, count, found)?,
            _ => {}
        }
    }
    Ok(())
}

fn is_archive_name(path: &Path) -> bool {
    let name = file_name(path).to_lowercase();
    [".zip", ".tar.gz", ".tgz", ".tar"].iter().any(|ending| name.ends_with(ending))
}

#[cfg(test)]
#[path = "load_tests.rs"]
mod tests;
