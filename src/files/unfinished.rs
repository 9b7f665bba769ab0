//! Hidden names of files and folders that are not finished yet, and what killed processes leave of them.

use std::fs::{self, File};
use std::io::{self, ErrorKind};
use std::path::Path;

use tempfile::{NamedTempFile, TempDir};

use super::lock::Lock;

/// In the hidden name of everything unfinished.
const MARK: &str = "-unfinished-";
/// How often a name is chosen, in case a cleaner takes the first one away before it is locked.
const MAX_ATTEMPTS: usize = 16;

/// Start of the hidden names for `path`.
fn prefix(path: &Path) -> String {
    format!(".{}{MARK}", path.file_name().unwrap_or_default().to_string_lossy())
}

/// A new file beside `path` under a hidden name, which is removed if it is dropped. It is locked as long as it is open.
pub(super) fn new_file(parent: &Path, path: &Path) -> io::Result<NamedTempFile> {
    until_locked(parent, path, "file", 0o666, |builder| {
        let file = builder.tempfile_in(parent)?;
        let taken = matches!(file.as_file().try_lock(), Err(fs::TryLockError::WouldBlock));
        Ok((!taken).then_some(file))
    })
}

/// A new folder beside `path` under a hidden name, and its lock. It is removed if it is dropped.
pub(super) fn new_folder(parent: &Path, path: &Path) -> io::Result<(TempDir, Lock)> {
    until_locked(parent, path, "folder", 0o777, |builder| {
        let folder = builder.tempdir_in(parent)?;
        match Lock::try_take(folder.path()) {
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
            lock => Ok(lock?.map(|lock| (folder, lock))),
        }
    })
}

/// What `make` makes beside `path`, once it is locked: `make` answers `None` if a cleaner has taken it away before. `mode` are its
/// permissions: temporary files and folders are for their owner alone, but a model or a video is as readable as any other file.
fn until_locked<T>(
    parent: &Path,
    path: &Path,
    what: &str,
    mode: u32,
    make: impl Fn(&tempfile::Builder) -> io::Result<Option<T>>,
) -> io::Result<T> {
    let prefix = prefix(path);
    remove_left_over(parent, &prefix);
    let mut builder = tempfile::Builder::new();
    builder.prefix(&prefix);
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(mode));
    #[cfg(not(unix))]
    let _ = mode;
    for _ in 0..MAX_ATTEMPTS {
        if let Some(made) = make(&builder)? {
            return Ok(made);
        }
    }
    Err(io::Error::new(ErrorKind::AlreadyExists, format!("another process takes every temporary {what} away")))
}

/// Removes the unfinished files and folders in `folder` whose process has ended.
pub(crate) fn clean(folder: &Path) {
    remove_left_over(folder, ".");
}

/// Whether the name of `entry` is that of something unfinished.
pub(crate) fn is_left_over(entry: &fs::DirEntry) -> bool {
    let name = entry.file_name();
    let name = name.to_string_lossy();
    name.starts_with('.') && name.contains(MARK)
}

/// As [`clean`], for names that begin with `prefix`. What cannot be removed stays: it does no harm.
fn remove_left_over(folder: &Path, prefix: &str) {
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        if !(entry.file_name().to_string_lossy().starts_with(prefix) && is_left_over(&entry)) {
            continue;
        }
        let path = entry.path();
        if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            if let Ok(Some(lock)) = Lock::try_take(&path) {
                let _ = fs::remove_dir_all(&path);
                drop(lock);
            }
        } else if File::options().write(true).open(&path).is_ok_and(|file| file.try_lock().is_ok()) {
            let _ = fs::remove_file(&path);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_killed_process_left_is_removed_and_what_a_living_one_writes_stays() {
        let scratch = tempfile::tempdir().unwrap();
        let here = scratch.path();
        fs::create_dir(here.join(".run-unfinished-abc")).unwrap();
        fs::write(here.join(".run-unfinished-abc/IMG"), "x").unwrap();
        fs::write(here.join(".m.bin-unfinished-xyz"), "x").unwrap();
        fs::write(here.join(".mine"), "x").unwrap();
        let (folder, lock) = new_folder(here, &here.join("run")).unwrap();
        let file = new_file(here, &here.join("m.bin")).unwrap();
        assert!(!here.join(".run-unfinished-abc").exists() && !here.join(".m.bin-unfinished-xyz").exists());
        clean(here);
        assert!(folder.path().exists() && file.path().exists() && here.join(".mine").exists());
        drop((lock, folder, file));
        assert_eq!(fs::read_dir(here).unwrap().count(), 1);
    }
}
