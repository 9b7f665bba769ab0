//! Formats of recordings, told by what they are.
//!
//! A format is one entry of [`FORMATS`]: what marks it, how it is read, and what must be assumed where it says nothing. To add
//! one, write its file here with a `FORMAT`, and name it in the list. The table in `data/README.md` is printed from the list;
//! a test compares the two.

mod challenge;
mod columns;
mod decimal_comma;
mod file_names;
mod foreign;
mod text;
mod text_lines;
mod tub;
mod tub1;
mod udacity;
pub mod udacity_writer;

use std::path::{Path, PathBuf};

use super::description::Unit;
use super::rows::Rows;
use super::store::Store;
use crate::{Error, Result};
pub(crate) use foreign::name_of_foreign;

/// A format of recordings that can be read.
#[derive(Debug)]
pub(crate) struct Format {
    /// Name in JSON.
    pub id: &'static str,
    /// Name for people.
    pub name: &'static str,
    /// What marks it, for people.
    pub marks: &'static str,
    /// Where labels and times come from, for people.
    pub labels: &'static str,
    /// Unit of the labels, unless the reader finds another one.
    pub unit: Unit,
    /// Rows a second where there are no times.
    pub hz: f64,
    /// Cameras it can have.
    pub cameras: usize,
    /// The file or folder to be read, if there is such a recording at a path: a folder, or a file that was named.
    pub find: fn(&Store, &Path) -> Result<Option<PathBuf>>,
    /// The folder from which pictures are looked for, given what `find` found.
    pub base: fn(&Store, &Path) -> PathBuf,
    /// Reads what `find` found.
    pub read: fn(&Store, &Path, &mut Rows) -> Result<()>,
}

/// All formats. The first one that finds something reads it.
pub(crate) static FORMATS: [&Format; 7] = [
    &tub::FORMAT,
    &tub1::FORMAT,
    &challenge::FORMAT,
    &udacity::FORMAT,
    &text_lines::FORMAT,
    &challenge::FRAMES,
    &file_names::FORMAT,
];

/// Folder of the file `path`.
pub(crate) fn parent(path: &Path) -> PathBuf {
    match path.parent() {
        Some(parent) if parent != Path::new("") => parent.to_path_buf(),
        _ => PathBuf::from("."),
    }
}

/// The files in `folder` whose names end in one of `extensions`; the file itself if `folder` is one.
fn files_ending(store: &Store, folder: &Path, extensions: &[&str]) -> Result<Vec<PathBuf>> {
    let fits = |path: &PathBuf| {
        let extension = path.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase();
        extensions.contains(&extension.as_str()) && store.is_file(path)
    };
    if store.is_file(folder) {
        return Ok(vec![folder.to_path_buf()]);
    }
    Ok(store.list(folder)?.into_iter().filter(fits).collect())
}

/// The only one of `logs`.
fn only(folder: &Path, logs: Vec<PathBuf>) -> Result<Option<PathBuf>> {
    if logs.len() > 1 {
        let names: Vec<String> = logs.iter().map(|path| super::recording::file_name(path)).collect();
        return Err(Error::data(folder, format!("several logs here ({}): name one of the files", names.join(", "))));
    }
    Ok(logs.into_iter().next())
}

/// The table of formats in Markdown.
pub fn table() -> String {
    let mut text = String::from(
        "| format | what marks it | labels and times | without times | cameras |\n|---|---|---|---|---|\n",
    );
    for format in FORMATS {
        let Format { name, marks, labels, hz, cameras, .. } = format;
        text += &format!("| {name} | {marks} | {labels} | {hz} Hz | {cameras} |\n");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_documentation_has_the_table() {
        let readme = include_str!("../../../data/README.md");
        assert!(readme.contains(&table()), "data/README.md should have this table:\n{}", table());
        let mut ids: Vec<&str> = FORMATS.iter().map(|format| format.id).collect();
        ids.sort_unstable();
        ids.dedup();
        assert_eq!(ids.len(), FORMATS.len());
    }
}
