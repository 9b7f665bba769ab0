//! Where a command writes: what exists is never overwritten.

use std::path::Path;

use crate::error::{Error, Result};

/// Refuses an output that exists already.
pub(crate) fn refuse_existing(path: &Path) -> Result<()> {
    match path.exists() {
        true => Err(Error::Usage(format!("{}: exists already and is not overwritten; name a new one", path.display()))),
        false => Ok(()),
    }
}

/// Makes the new folder `path`, and those it lies in.
pub(crate) fn new_folder(path: &Path) -> Result<()> {
    refuse_existing(path)?;
    std::fs::create_dir_all(path).map_err(Error::io(path))
}
