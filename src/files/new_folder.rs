//! Folders that appear whole or not at all.

use std::fs;
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};

use tempfile::TempDir;

use super::lock::Lock;
use super::unfinished;
use crate::error::{Error, Result};

/// A folder that fills under a hidden name beside its place, and gets its own name when it is complete. Dropped before, it
/// leaves nothing behind.
#[derive(Debug)]
pub struct NewFolder {
    path: PathBuf,
    unfinished: TempDir,
    /// Tells other processes that this one still writes.
    lock: Lock,
}

impl NewFolder {
    /// Prepares the folder `path`; missing parents are created.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] if there is something at `path`, [`Error::CannotWrite`] if nothing can be created there.
    pub fn create(path: &Path) -> Result<NewFolder> {
        if fs::symlink_metadata(path).is_ok() {
            return Err(exists(path, "folder"));
        }
        let parent = create_parent(path)?;
        let (unfinished, lock) = unfinished::new_folder(parent, path).map_err(|source| denied(path, &source))?;
        Ok(NewFolder { path: path.to_path_buf(), unfinished, lock })
    }

    /// Where to write.
    pub fn unfinished(&self) -> &Path {
        self.unfinished.path()
    }

    /// Gives the folder its name.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] if something has come to be at its place, [`Error::Io`] if it cannot be renamed. What was written is
    /// removed then.
    pub fn finish(self) -> Result<()> {
        let NewFolder { path, unfinished, lock } = self;
        if fs::symlink_metadata(&path).is_ok() {
            return Err(exists(&path, "folder"));
        }
        drop(lock);
        fs::rename(unfinished.path(), &path).map_err(Error::io(&path))?;
        // The folder has moved; there is nothing left to remove.
        let _moved = unfinished.keep();
        Ok(())
    }

    /// Gives the folder its name, for what cannot be done again: if something has come to be at its place, a number is added,
    /// as in `DIR-2`, and if it cannot be renamed it stays under its hidden name. The name that it got.
    pub fn finish_anyhow(self) -> PathBuf {
        let NewFolder { path, unfinished, lock } = self;
        drop(lock);
        let numbered = |n: usize| {
            let mut name = path.clone().into_os_string();
            name.push(format!("-{n}"));
            PathBuf::from(name)
        };
        let names = std::iter::once(path.clone()).chain((2..100).map(numbered));
        let free = names.into_iter().find(|name| fs::symlink_metadata(name).is_err());
        let renamed = free.filter(|name| fs::rename(unfinished.path(), name).is_ok());
        let hidden = unfinished.keep();
        renamed.unwrap_or(hidden)
    }

    /// An error of writing to the folder, as its user should read it: with the place that was meant, and a remedy where the
    /// disk is full.
    pub fn explain(&self, error: Error) -> Error {
        let (Error::Io { path, source } | Error::CannotWrite { path, source, .. }) = error else { return error };
        let path = path.strip_prefix(self.unfinished()).map_or(path.clone(), |inside| self.path.join(inside));
        explain_full_disk(&path, &self.path, source, "folder")
    }
}

/// The error `source` at `path`, which was to be in the new file or folder `out`: where the disk is full, with a remedy.
pub(crate) fn explain_full_disk(path: &Path, out: &Path, source: io::Error, kind: &str) -> Error {
    let full = [ErrorKind::StorageFull, ErrorKind::QuotaExceeded, ErrorKind::FileTooLarge];
    if full.contains(&source.kind()) {
        let remedy = format!("{} was not created; make room on that disk, or name a {kind} on another", out.display());
        return Error::CannotWrite { path: path.into(), source, remedy };
    }
    Error::io(path)(source)
}

/// Creates the folder `path` at once, for what is to be seen while it grows; missing parents are created.
///
/// # Errors
///
/// As [`NewFolder::create`].
pub fn create_now(path: &Path) -> Result<()> {
    create_parent(path)?;
    fs::create_dir(path).map_err(|source| match source.kind() {
        ErrorKind::AlreadyExists => exists(path, "folder"),
        _ => denied(path, &source),
    })
}

/// Creates what is missing above `path` and returns the folder it will be in.
pub(crate) fn create_parent(path: &Path) -> Result<&Path> {
    let parent = match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    fs::create_dir_all(parent).map_err(|source| denied(path, &source))?;
    Ok(parent)
}

pub(crate) fn denied(path: &Path, source: &io::Error) -> Error {
    let remedy = "name a folder where you may write".into();
    let source = io::Error::new(source.kind(), format!("cannot be created: {source}"));
    Error::CannotWrite { path: path.into(), source, remedy }
}

/// The error of a `kind` ("file" or "folder") that would have to replace something.
pub(crate) fn exists(path: &Path, kind: &str) -> Error {
    let remedy = format!("exists already and is not overwritten; name a new {kind} or remove it");
    Error::Usage(format!("{}: {remedy}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_appears_when_it_is_whole_and_leaves_nothing_behind_when_it_is_dropped() {
        let scratch = tempfile::tempdir().unwrap();
        let out = scratch.path().join("deep/out");
        let folder = NewFolder::create(&out).unwrap();
        fs::write(folder.unfinished().join("a"), "1").unwrap();
        assert!(!out.exists());
        folder.finish().unwrap();
        assert_eq!(fs::read_to_string(out.join("a")).unwrap(), "1");

        let other = out.with_file_name("other");
        let dropped = NewFolder::create(&other).unwrap();
        fs::write(dropped.unfinished().join("a"), "1").unwrap();
        drop(dropped);
        assert_eq!(fs::read_dir(scratch.path().join("deep")).unwrap().count(), 1);
    }

    #[test]
    fn what_is_there_is_never_replaced() {
        let scratch = tempfile::tempdir().unwrap();
        let out = scratch.path().join("out");
        let late = NewFolder::create(&out).unwrap();
        fs::write(&out, "mine").unwrap();
        assert!(NewFolder::create(&out).unwrap_err().to_string().contains("exists already"));
        assert!(late.finish().unwrap_err().to_string().contains("exists already"));
        assert_eq!(fs::read_to_string(&out).unwrap(), "mine");
        assert_eq!(fs::read_dir(scratch.path()).unwrap().count(), 1);
    }

    #[test]
    fn what_cannot_be_done_again_is_kept_under_another_name() {
        let scratch = tempfile::tempdir().unwrap();
        let out = scratch.path().join("out");
        let folder = || {
            let folder = NewFolder::create(&out).unwrap();
            fs::write(folder.unfinished().join("a"), "1").unwrap();
            folder
        };
        let (first, second) = (folder(), folder());
        assert_eq!(first.finish_anyhow(), out);
        let kept = second.finish_anyhow();
        assert_eq!(kept, scratch.path().join("out-2"));
        assert_eq!(fs::read_to_string(kept.join("a")).unwrap(), "1");
        assert_eq!(fs::read_dir(scratch.path()).unwrap().count(), 2);
    }

    #[test]
    fn a_full_disk_is_told_with_the_place_that_was_meant_and_a_remedy() {
        let scratch = tempfile::tempdir().unwrap();
        let folder = NewFolder::create(&scratch.path().join("out")).unwrap();
        let source = io::Error::from(ErrorKind::StorageFull);
        let error = Error::Io { path: folder.unfinished().join("IMG/a.jpg"), source };
        let message = folder.explain(error).to_string();
        assert!(message.contains("out/IMG/a.jpg: ") && message.contains("make room"), "{message}");
    }
}
