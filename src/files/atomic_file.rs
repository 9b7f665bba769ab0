//! Files that appear whole or not at all.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use tempfile::NamedTempFile;

use crate::error::{Error, Result};
use crate::files::new_folder::{create_parent, denied, exists, explain_full_disk};
use crate::files::unfinished;

/// Writes `bytes` to a temporary file beside `path`, then renames it. A reader of `path` finds the old content or the new one,
/// never a part of it, even after a crash or on a full disk.
///
/// # Errors
///
/// [`Error::Io`]; `path` is then as it was.
pub fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    let folder = match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    let mut file = unfinished::new_file(folder, path).map_err(Error::io(folder))?;
    file.write_all(bytes).map_err(Error::io(path))?;
    file.as_file().sync_all().map_err(Error::io(path))?;
    file.persist(path).map_err(|e| Error::io(path)(e.error))?;
    Ok(())
}

/// A file that grows under a hidden name beside its place, and gets its own name when it is complete. Dropped before, it
/// leaves nothing behind.
#[derive(Debug)]
pub struct NewFile {
    path: PathBuf,
    unfinished: NamedTempFile,
}

impl NewFile {
    /// Prepares the file `path`; missing folders are created.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] if there is something at `path`, [`Error::CannotWrite`] if nothing can be created there.
    pub fn create(path: &Path) -> Result<NewFile> {
        if fs::symlink_metadata(path).is_ok() {
            return Err(exists(path, "file"));
        }
        let unfinished = unfinished::new_file(create_parent(path)?, path).map_err(|source| denied(path, &source))?;
        Ok(NewFile { path: path.to_path_buf(), unfinished })
    }

    /// Opens the file for writing.
    ///
    /// # Errors
    ///
    /// [`Error::Io`] if it cannot be opened.
    pub fn open(&self) -> Result<File> {
        self.unfinished.reopen().map_err(Error::io(&self.path))
    }

    /// Gives the file its name, and returns its size in bytes.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] if something has come to be at its place, [`Error::Io`] if it cannot be renamed. What was written is
    /// removed then.
    pub fn finish(self) -> Result<u64> {
        let file = self.unfinished.as_file();
        let size = file.sync_all().and_then(|()| file.metadata()).map_err(|source| self.explain(source))?.len();
        self.unfinished.persist_noclobber(&self.path).map_err(|e| match e.error.kind() {
            io::ErrorKind::AlreadyExists => exists(&self.path, "file"),
            _ => Error::io(&self.path)(e.error),
        })?;
        Ok(size)
    }

    /// An error of writing to the file, with a remedy where the disk is full.
    pub fn explain(&self, source: io::Error) -> Error {
        explain_full_disk(&self.path, &self.path, source, "file")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn replaces_a_file_and_leaves_nothing_else_behind() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.txt");
        write(&path, b"old").unwrap();
        write(&path, b"new").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"new");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_missing_folder_is_an_error_that_names_it() {
        let folder = tempfile::tempdir().unwrap().path().join("gone");
        let error = write(&folder.join("a.txt"), b"x").unwrap_err();
        assert!(error.to_string().starts_with(&folder.display().to_string()));
    }

    #[test]
    fn a_new_file_replaces_nothing_and_leaves_nothing_behind_when_it_is_dropped() {
        let scratch = tempfile::tempdir().unwrap();
        let path = scratch.path().join("deep/a.bin");
        let file = NewFile::create(&path).unwrap();
        file.open().unwrap().write_all(b"12345").unwrap();
        assert!(!path.exists());
        assert_eq!((file.finish().unwrap(), fs::read(&path).unwrap()), (5, b"12345".to_vec()));
        assert!(NewFile::create(&path).unwrap_err().to_string().contains("exists already"));

        let late = NewFile::create(&path.with_file_name("late")).unwrap();
        fs::write(path.with_file_name("late"), "mine").unwrap();
        assert!(late.finish().unwrap_err().to_string().contains("exists already"));
        assert_eq!(fs::read_to_string(path.with_file_name("late")).unwrap(), "mine");
        drop(NewFile::create(&path.with_file_name("b")).unwrap());
        assert_eq!(fs::read_dir(scratch.path().join("deep")).unwrap().count(), 2);
    }
}
