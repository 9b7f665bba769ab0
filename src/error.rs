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
    #[error("{path}: {source}{}", reading_remedy(path, source), path = path.display())]
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
    /// The user typed something that cannot be carried out: an argument, a name, or a key of a recipe.
    #[error("{0}")]
    Usage(String),
    /// A function of the library was given a value that it does not take, such as an image of another shape.
    #[error("{0}")]
    Input(String),
    /// A picture or a video could not be encoded or decoded.
    #[error("{0}")]
    Codec(String),
    /// Training diverged: a loss or a weight is not finite any more.
    #[error("{0}")]
    Diverged(String),
    /// Nothing can be written at this place: the disk is full, or the folder is read-only.
    #[error("{path}: {source}; {remedy}", path = path.display())]
    CannotWrite {
        /// The file or folder.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
        /// What the user can do.
        remedy: String,
    },
    /// The server that this program connects to is gone, or does not reply.
    #[error("{0}")]
    Connection(String),
    /// Another process that works together with this one could not go on.
    #[error("{0}")]
    Rank(String),
    /// The operating system refused a port, a thread or a signal handler. The message has the remedy.
    #[error("{0}")]
    System(String),
    /// This program is at fault.
    #[error("{0}; this is a fault of steersman, please report it")]
    Fault(String),
    /// The work ended early, and part of its result is kept.
    #[error("{cause}; {kept}")]
    EndedEarly {
        /// Why it ended.
        cause: Box<Error>,
        /// What is kept, where it is, and how to go on.
        kept: String,
    },
    /// The person at the keyboard pressed Ctrl-C.
    #[error("interrupted")]
    Interrupted,
}

/// What can be done where `path` cannot be read for the reason of `source`, to be put behind it; may be empty.
fn reading_remedy(path: &Path, source: &std::io::Error) -> String {
    use std::io::ErrorKind::{NotFound, PermissionDenied};
    match source.kind() {
        NotFound if path.is_relative() => match std::env::current_dir() {
            Ok(here) => format!("; check the name, it is looked for in {}", here.display()),
            Err(_) => "; check the name".into(),
        },
        NotFound => "; check the name".into(),
        PermissionDenied => "; its owner can permit it".into(),
        _ => String::new(),
    }
}

impl Error {
    /// An [`Error::Io`] at `path`, or an [`Error::CannotWrite`] with the remedy where the disk is full or read-only; meant for
    /// `map_err`.
    pub fn io(path: impl AsRef<Path>) -> impl FnOnce(std::io::Error) -> Error {
        use std::io::ErrorKind::{FileTooLarge, QuotaExceeded, ReadOnlyFilesystem, StorageFull};
        let path = path.as_ref().to_path_buf();
        move |source| {
            let remedy = match source.kind() {
                StorageFull | QuotaExceeded | FileTooLarge => "make room on that disk, or name a place on another",
                ReadOnlyFilesystem => "name a folder where you may write",
                _ => return Error::Io { path, source },
            };
            Error::CannotWrite { path, source, remedy: remedy.into() }
        }
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
