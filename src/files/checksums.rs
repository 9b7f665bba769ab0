//! Digests of the files in a folder, as `sha256sum` writes and checks them.
//!
//! Each file has at most two lines, the digest of its newest content and the one before: a process can be killed between
//! the two writes, and both contents are whole.

use std::fs;
use std::io::ErrorKind;
use std::path::Path;

use sha2::{Digest, Sha256};

use super::atomic_file;
use crate::error::{Error, Result};

/// Name of the file with the digests.
pub(crate) const FILE_NAME: &str = "checksums.txt";

/// SHA-256 of `bytes` as lower-case hexadecimal digits.
pub(crate) fn digest(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Writes `bytes` to the file `name` in `folder`, and its digest beside it.
///
/// # Errors
///
/// As [`atomic_file::write`].
pub(crate) fn write(folder: &Path, name: &str, bytes: &[u8]) -> Result<()> {
    let (path, new) = (folder.join(name), digest(bytes));
    let present = fs::read(&path).ok().map(|bytes| digest(&bytes)).filter(|present| *present != new);
    let mut lines: Vec<String> = text_of(folder)?.unwrap_or_default().lines().map(String::from).collect();
    let is_of_file = |line: &String| line.split_once("  ").is_some_and(|(_, of)| of == name);
    // A content that had no digest gets none: it may be damaged.
    let known = present.filter(|present| lines.iter().any(|line| is_of_file(line) && line.starts_with(present)));
    lines.retain(|line| !is_of_file(line));
    lines.extend(known.into_iter().chain([new]).map(|digest| format!("{digest}  {name}")));
    atomic_file::write(&folder.join(FILE_NAME), (lines.join("\n") + "\n").as_bytes())?;
    atomic_file::write(&path, bytes)
}

/// Reads the file `name` in `folder` and checks its digest. A file without one, of an earlier version, is read as it is.
///
/// # Errors
///
/// [`Error::Io`] if it cannot be read, [`Error::Data`] if it is damaged.
pub(crate) fn read(folder: &Path, name: &str) -> Result<Vec<u8>> {
    let path = folder.join(name);
    let bytes = fs::read(&path).map_err(Error::io(&path))?;
    let found = digest(&bytes);
    let text = text_of(folder)?.unwrap_or_default();
    let mut digests = text.lines().filter_map(|line| line.split_once("  ")).filter(|(_, of)| *of == name).peekable();
    if digests.peek().is_none() || digests.any(|(digest, _)| digest == found) {
        return Ok(bytes);
    }
    let message = format!(
        "is damaged or was changed: its content does not fit its digest in {FILE_NAME}; restore it from a copy, or, if you \
         changed it yourself, remove its lines there"
    );
    Err(Error::data(path, message))
}

/// Whether `folder` has digests.
pub(crate) fn exist(folder: &Path) -> bool {
    folder.join(FILE_NAME).is_file()
}

fn text_of(folder: &Path) -> Result<Option<String>> {
    let path = folder.join(FILE_NAME);
    match fs::read_to_string(&path) {
        Ok(text) => Ok(Some(text)),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        Err(error) => Err(Error::io(&path)(error)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_flipped_bit_is_found_and_a_kill_between_the_writes_is_no_damage() {
        let scratch = tempfile::tempdir().unwrap();
        let folder = scratch.path();
        write(folder, "a.json", b"{\"epoch\": 1}").unwrap();
        write(folder, "b.json", b"{}").unwrap();
        assert_eq!(read(folder, "a.json").unwrap(), b"{\"epoch\": 1}");
        let before = fs::read(folder.join("a.json")).unwrap();
        for bit in 0..before.len() * 8 {
            let mut damaged = before.clone();
            damaged[bit / 8] ^= 1 << (bit % 8);
            fs::write(folder.join("a.json"), damaged).unwrap();
            assert!(read(folder, "a.json").unwrap_err().to_string().contains("a.json: is damaged"), "bit {bit}");
        }
        fs::write(folder.join("a.json"), &before).unwrap();
        write(folder, "a.json", b"{\"epoch\": 2}").unwrap();
        assert!(read(folder, "a.json").is_ok());
        // Killed after the digest was written and before the file was.
        fs::write(folder.join("a.json"), &before).unwrap();
        assert!(read(folder, "a.json").is_ok());
        write(folder, "a.json", b"{\"epoch\": 3}").unwrap();
        assert_eq!(fs::read_to_string(folder.join(FILE_NAME)).unwrap().lines().count(), 3);
        fs::write(folder.join("old.json"), "{}").unwrap();
        assert!(read(folder, "old.json").is_ok(), "files of earlier versions have no digest");
    }
}
