//! The one error type of the library.

use std::path::{Path, PathBuf};

/// Result of every fallible function of this crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// What went wrong, where, and what to do about it.
///
/// Every message stands alone: it names the place (file, line, layer, recipe key) and, where there is one, the remedy.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A file or folder could not be read or written.
    #[error("{path}: {source}", path = path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// Something in a file is not as it must be. `place` is `file`, or `file:line`.
    #[error("{place}: {message}")]
    Data {
        /// File, or file and line.
        place: String,
        /// What is wrong and what would be right.
        message: String,
    },
    /// A recipe has a wrong entry.
    #[error("recipe {recipe}: {message}")]
    Recipe {
        /// Name or path of the recipe.
        recipe: String,
        /// What is wrong, naming the key.
        message: String,
    },
    /// A network cannot be built: the shapes or numbers of a layer do not fit.
    #[error("layer `{layer}`: {message}")]
    Network {
        /// Name of the layer.
        layer: String,
        /// What was expected and what was found.
        message: String,
    },
    /// The request itself cannot be carried out as asked.
    #[error("{0}")]
    Usage(String),
    /// The person at the keyboard pressed Ctrl-C.
    #[error("interrupted")]
    Interrupted,
}

impl Error {
    /// An [`Error::Io`] at `path`; meant for `map_err`.
    pub fn io(path: impl AsRef<Path>) -> impl FnOnce(std::io::Error) -> Error {
        let path = path.as_ref().to_path_buf();
        move |source| Error::Io { path, source }
    }

    /// An [`Error::Data`] in the file `path`.
    pub fn data(path: impl AsRef<Path>, message: impl Into<String>) -> Error {
        Error::Data { place: path.as_ref().display().to_string(), message: message.into() }
    }

    /// An [`Error::Data`] at `line` (from 1) of the file `path`.
    pub fn data_at(path: impl AsRef<Path>, line: u64, message: impl Into<String>) -> Error {
        Error::Data { place: format!("{}:{line}", path.as_ref().display()), message: message.into() }
    }
}
