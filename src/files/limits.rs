//! Limits on files of others, and a place for results that cannot be written where they were meant to be.

use std::fs::File;
use std::io::Read as _;
use std::path::Path;

use crate::error::{Error, Result};

/// Reads the file `path`, which is `what`, if it has at most `max_len` bytes.
///
/// # Errors
///
/// [`Error::Io`] if it cannot be read, [`Error::Data`] with the limit if it is longer.
pub(crate) fn read_up_to(path: &Path, max_len: u64, what: &str) -> Result<Vec<u8>> {
    let file = File::open(path).map_err(Error::io(path))?;
    let mut bytes = Vec::new();
    // The size that the system tells may be wrong, as for a pipe; one byte more shows that a file is longer.
    let read = file.take(max_len + 1).read_to_end(&mut bytes).map_err(Error::io(path))?;
    if read as u64 > max_len {
        let mib = max_len.div_ceil(1 << 20);
        return Err(Error::data(path, format!("is longer than {mib} MiB, the most that {what} may have")));
    }
    Ok(bytes)
}

/// Writes results, which could not be written because of `cause`, into a new folder among the temporary files, and returns
/// the error that names it; `cause` alone if that fails, too. `go_on` says what to do with the folder.
pub(crate) fn keep_elsewhere(
    cause: Error,
    write: impl FnOnce(&Path) -> Result<()>,
    go_on: impl FnOnce(&Path) -> String,
) -> Error {
    if !matches!(cause, Error::CannotWrite { .. } | Error::Io { .. }) {
        return cause;
    }
    let Ok(folder) = tempfile::Builder::new().prefix("steersman-kept-").tempdir() else { return cause };
    match write(folder.path()) {
        Ok(()) => {
            let kept = go_on(&folder.keep());
            Error::EndedEarly { cause: Box::new(cause), kept }
        }
        Err(_) => cause,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn a_file_that_is_too_long_is_refused_with_the_limit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        fs::write(&path, [7; 100]).unwrap();
        assert_eq!(read_up_to(&path, 100, "a picture").unwrap().len(), 100);
        let error = read_up_to(&path, 99, "a picture").unwrap_err().to_string();
        assert!(error.ends_with("is longer than 1 MiB, the most that a picture may have"), "{error}");
    }

    #[test]
    fn results_are_kept_elsewhere_and_named() {
        let cause = || Error::io("out")(std::io::ErrorKind::StorageFull.into());
        let write = |folder: &Path| fs::write(folder.join("a"), "1").map_err(Error::io(folder));
        let error = keep_elsewhere(cause(), write, |folder| format!("kept in {}", folder.display()));
        let Error::EndedEarly { kept, .. } = &error else { panic!("{error}") };
        let folder = Path::new(kept.strip_prefix("kept in ").unwrap());
        assert_eq!(fs::read_to_string(folder.join("a")).unwrap(), "1");
        fs::remove_dir_all(folder).unwrap();
        let failing = |_: &Path| Err(Error::Interrupted);
        assert!(matches!(keep_elsewhere(cause(), failing, |_| String::new()), Error::CannotWrite { .. }));
    }
}
