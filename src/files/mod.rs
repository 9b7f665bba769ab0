//! Files and folders that appear whole or not at all, locks, and limits on what is read.

pub mod atomic_file;
pub(crate) mod checksums;
pub(crate) mod limits;
pub(crate) mod lock;
pub mod new_folder;
pub mod tar_archive;
pub(crate) mod unfinished;
pub mod zip_archive;
