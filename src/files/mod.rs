//! Files and folders that appear whole or not at all.

pub mod atomic_file;
pub mod new_folder;
pub mod tar_archive;
pub mod zip_archive;
