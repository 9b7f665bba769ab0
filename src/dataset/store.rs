//! Where the files of a recording lie: in a folder, or in a `.zip` or `.tar.gz` that is read in place.
//!
//! Files in an archive have paths like `drive.zip/IMG/a.jpg`. Only regular files are ever opened: opening a FIFO would wait
//! for ever, and a device has no end.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::{self, BufRead, BufReader, Cursor, Read, Seek, SeekFrom};
use std::path::{Component, Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use flate2::read::MultiGzDecoder;

use crate::files::tar_archive;
use crate::files::zip_archive::{self, ZipArchive, ZipEntry};
use crate::{Error, Result};

/// The largest log that is read, and the largest picture.
const MAX_LOG_BYTES: u64 = 1 << 30;
const MAX_PICTURE_BYTES: u64 = 64 << 20;
/// A `.tar.gz` that unpacks to more is refused.
const MAX_UNPACKED_BYTES: u64 = 64 << 30;

/// What stands at a path.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    /// A regular file.
    File,
    /// A folder.
    Folder,
    /// A FIFO, a device or a socket.
    Special,
    /// Nothing.
    Nothing,
}

/// Gives access to the files of a recording.
#[derive(Debug)]
pub(crate) enum Store {
    /// Files on disk.
    Disk,
    /// Files in an archive.
    Archive(Archive),
}

/// An open archive.
#[derive(Debug)]
pub(crate) struct Archive {
    path: PathBuf,
    file: Mutex<File>,
    files: BTreeMap<PathBuf, Place>,
    folders: BTreeSet<PathBuf>,
    /// Whether the archive ends early.
    cut: bool,
}

/// Where a file stands in an archive.
#[derive(Debug)]
enum Place {
    /// An entry of a zip archive.
    Zip(ZipEntry),
    /// Bytes of a tar archive: begin and length.
    Tar(u64, u64),
}

impl Store {
    /// The store that holds `path`: a folder, a file, an archive, or a path into an archive.
    ///
    /// # Errors
    /// If there is nothing, or an archive cannot be read.
    pub fn of(path: &Path) -> Result<Store> {
        match fs::metadata(path) {
            Ok(found) if found.is_file() => Ok(Archive::open(path)?.map_or(Store::Disk, Store::Archive)),
            Ok(found) if found.is_dir() => Ok(Store::Disk),
            Ok(_) => Err(Error::data(path, "is a FIFO, a device or a socket: a recording is a folder or a file")),
            Err(error) => {
                // The path may go on inside an archive.
                let archive = path.ancestors().skip(1).find(|above| above.is_file());
                match archive.map(Archive::open).transpose()?.flatten() {
                    Some(archive) => Ok(Store::Archive(archive)),
                    None => Err(Error::io(path)(error)),
                }
            }
        }
    }

    /// Whether the files lie in an archive.
    pub fn is_archive(&self) -> bool {
        matches!(self, Store::Archive(_))
    }

    /// What the user should know of the store.
    pub fn notice(&self) -> Option<String> {
        match self {
            Store::Archive(Archive { cut: true, .. }) => Some("the archive ends early; what it holds is read".into()),
            _ => None,
        }
    }

    /// What stands at `path`.
    pub fn kind(&self, path: &Path) -> Kind {
        match self {
            Store::Disk => match fs::metadata(path) {
                Ok(found) if found.is_file() => Kind::File,
                Ok(found) if found.is_dir() => Kind::Folder,
                Ok(_) => Kind::Special,
                Err(_) => Kind::Nothing,
            },
            Store::Archive(archive) => match archive.inside(path) {
                Some(inside) if archive.files.contains_key(&inside) => Kind::File,
                Some(inside) if archive.folders.contains(&inside) => Kind::Folder,
                _ => Kind::Nothing,
            },
        }
    }

    /// Whether a regular file stands at `path`.
    pub fn is_file(&self, path: &Path) -> bool {
        self.kind(path) == Kind::File
    }

    /// Whether a folder stands at `path`.
    pub fn is_folder(&self, path: &Path) -> bool {
        self.kind(path) == Kind::Folder
    }

    /// What lies in `folder`, sorted by name; what macOS leaves on foreign disks (`._*`, `__MACOSX`) is left out.
    ///
    /// # Errors
    /// If the folder cannot be read.
    pub fn list(&self, folder: &Path) -> Result<Vec<PathBuf>> {
        let mut paths: Vec<PathBuf> = match self {
            Store::Disk => {
                let entries = fs::read_dir(folder).map_err(Error::io(folder))?;
                entries.map(|entry| Ok(entry.map_err(Error::io(folder))?.path())).collect::<Result<_>>()?
            }
            Store::Archive(archive) => {
                let inside = archive.inside(folder).unwrap_or_default();
                let all = archive.files.keys().chain(&archive.folders);
                all.filter(|path| path.parent() == Some(&inside)).map(|path| archive.path.join(path)).collect()
            }
        };
        paths.retain(|path| {
            let name = path.file_name().unwrap_or_default().as_encoded_bytes();
            !name.starts_with(b"._") && name != b"__MACOSX"
        });
        paths.sort();
        Ok(paths)
    }

    /// Reads the picture at `path` into `bytes`.
    ///
    /// # Errors
    /// If it is no regular file, cannot be read, or is larger than 64 MiB.
    pub fn read(&self, path: &Path, bytes: &mut Vec<u8>) -> io::Result<()> {
        bytes.clear();
        match self {
            Store::Disk => {
                let file = regular(path)?;
                let read = file.take(MAX_PICTURE_BYTES + 1).read_to_end(bytes)?;
                if read as u64 > MAX_PICTURE_BYTES { Err(too_large(MAX_PICTURE_BYTES)) } else { Ok(()) }
            }
            Store::Archive(archive) => {
                *bytes = archive.read(path, MAX_PICTURE_BYTES)?;
                Ok(())
            }
        }
    }

    /// Opens the text file at `path`.
    ///
    /// # Errors
    /// If it is no regular file, or cannot be read.
    pub fn open(&self, path: &Path) -> io::Result<Box<dyn BufRead>> {
        match self {
            Store::Disk => Ok(Box::new(BufReader::with_capacity(1 << 16, regular(path)?))),
            Store::Archive(archive) => Ok(Box::new(Cursor::new(archive.read(path, MAX_LOG_BYTES)?))),
        }
    }

    /// All of the text file at `path`, of at most `max_bytes`; bytes that are no UTF-8 are replaced.
    ///
    /// # Errors
    /// As [`Store::open`]; and if it is larger.
    pub fn read_text(&self, path: &Path, max_bytes: u64) -> io::Result<String> {
        let mut bytes = Vec::new();
        self.open(path)?.take(max_bytes + 1).read_to_end(&mut bytes)?;
        if bytes.len() as u64 > max_bytes {
            return Err(too_large(max_bytes));
        }
        Ok(String::from_utf8_lossy(&bytes).into_owned())
    }

    /// The first 8 and the last 64 bytes of a file.
    ///
    /// # Errors
    /// As [`Store::open`].
    pub fn ends(&self, path: &Path) -> io::Result<([u8; 8], usize, Vec<u8>)> {
        let mut head = [0; 8];
        match self {
            Store::Disk => {
                let mut file = regular(path)?;
                let mut filled = 0;
                while filled < 8 {
                    match file.read(&mut head[filled..])? {
                        0 => break,
                        n => filled += n,
                    }
                }
                let len = file.seek(SeekFrom::End(0))?;
                file.seek(SeekFrom::Start(len.saturating_sub(64)))?;
                let mut tail = Vec::with_capacity(64);
                file.take(64).read_to_end(&mut tail)?;
                Ok((head, filled, tail))
            }
            Store::Archive(archive) => {
                let bytes = archive.read(path, MAX_PICTURE_BYTES)?;
                let filled = bytes.len().min(8);
                head[..filled].copy_from_slice(&bytes[..filled]);
                Ok((head, filled, bytes[bytes.len().saturating_sub(64)..].to_vec()))
            }
        }
    }

    /// Length of the file at `path`; 0 where there is none.
    pub fn len(&self, path: &Path) -> u64 {
        match self {
            Store::Disk => fs::metadata(path).map_or(0, |found| found.len()),
            Store::Archive(archive) => match archive.inside(path).and_then(|inside| archive.files.get(&inside)) {
                Some(Place::Zip(entry)) => entry.len,
                Some(Place::Tar(_, len)) => *len,
                None => 0,
            },
        }
    }
}

/// Opens a regular file, and nothing else.
fn regular(path: &Path) -> io::Result<File> {
    if !fs::metadata(path)?.is_file() {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "is no regular file"));
    }
    File::open(path)
}

fn too_large(max_bytes: u64) -> io::Error {
    io::Error::new(io::ErrorKind::FileTooLarge, format!("has more than {max_bytes} bytes"))
}

impl Archive {
    /// The archive at `path`; `None` if the file is none. An Excel workbook and a Keras model are zip archives too, and are
    /// no archives here.
    fn open(path: &Path) -> Result<Option<Archive>> {
        let mut file = File::open(path).map_err(Error::io(path))?;
        let mut head = Vec::new();
        file.by_ref().take(512).read_to_end(&mut head).map_err(Error::io(path))?;
        let damaged = |message: String| Error::data(path, format!("the archive {message}"));
        let (mut files, mut cut) = (BTreeMap::new(), false);
        if head.starts_with(zip_archive::SIGNATURE) {
            let archive = ZipArchive::open(&mut file).map_err(damaged)?;
            let names: Vec<&str> = archive.entries().iter().map(|entry| entry.name.as_str()).collect();
            if names.iter().any(|name| matches!(*name, "[Content_Types].xml" | "model.weights.h5")) {
                return Ok(None);
            }
            for entry in archive.entries().iter().filter(|entry| !entry.name.ends_with('/')) {
                files.extend(safe(&entry.name).map(|inside| (inside, Place::Zip(entry.clone()))));
            }
        } else if head.starts_with(&[0x1f, 0x8b]) || tar_archive::begins_tar(&head) {
            file.seek(SeekFrom::Start(0)).map_err(Error::io(path))?;
            if head.starts_with(&[0x1f, 0x8b]) {
                (file, cut) = unpacked(path, file)?;
            }
            for entry in tar_archive::entries(&mut file).map_err(damaged)? {
                files.extend(safe(&entry.name).map(|inside| (inside, Place::Tar(entry.at, entry.len))));
            }
        } else {
            return Ok(None);
        }
        let folders = files.keys().flat_map(|path| path.ancestors().skip(1)).map(Path::to_path_buf).collect();
        Ok(Some(Archive { path: path.to_path_buf(), file: Mutex::new(file), files, folders, cut }))
    }

    /// The path within the archive.
    fn inside(&self, path: &Path) -> Option<PathBuf> {
        Some(path.strip_prefix(&self.path).ok()?.components().collect())
    }

    fn read(&self, path: &Path, max_len: u64) -> io::Result<Vec<u8>> {
        let invalid = |message: String| io::Error::new(io::ErrorKind::InvalidData, message);
        let place = self.inside(path).and_then(|inside| self.files.get(&inside));
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        match place {
            None => Err(io::ErrorKind::NotFound.into()),
            Some(Place::Zip(entry)) => ZipArchive::read(&mut *file, entry, max_len).map_err(invalid),
            Some(Place::Tar(_, len)) if *len > max_len => Err(too_large(max_len)),
            Some(Place::Tar(at, len)) => {
                file.seek(SeekFrom::Start(*at))?;
                let mut bytes = vec![0; *len as usize];
                file.read_exact(&mut bytes)?;
                Ok(bytes)
            }
        }
    }
}

/// The path that an entry's name means, unless it leads out of the archive.
fn safe(name: &str) -> Option<PathBuf> {
    let name = name.replace('\\', "/");
    let mut path = PathBuf::new();
    for part in Path::new(&name).components() {
        match part {
            Component::Normal(part) => path.push(part),
            Component::CurDir => {}
            _ => return None,
        }
    }
    (path != Path::new("")).then_some(path)
}

/// What is packed in the gzip file `packed`, in a file without a name that vanishes with the process; and whether it ends early.
fn unpacked(path: &Path, packed: File) -> Result<(File, bool)> {
    let mut content = MultiGzDecoder::new(BufReader::new(packed)).take(MAX_UNPACKED_BYTES + 1);
    let folder = std::env::temp_dir();
    let mut file = tempfile::tempfile_in(&folder).map_err(Error::io(&folder))?;
    let mut buffer = vec![0; 1 << 18];
    let mut first = true;
    loop {
        let read = match content.read(&mut buffer) {
            Ok(0) => break,
            Ok(read) => read,
            // What came before the damage can be read.
            Err(_) if !first => return Ok((file, true)),
            Err(e) => return Err(Error::data(path, format!("the archive is damaged: {e}"))),
        };
        // What is no archive inside is not unpacked to its end.
        if std::mem::take(&mut first) && read >= 512 && !tar_archive::begins_tar(&buffer[..512]) {
            return Err(Error::data(path, "is a gzip file without a tar archive in it: unpack it first"));
        }
        io::Write::write_all(&mut file, &buffer[..read]).map_err(Error::io(&folder))?;
    }
    if content.limit() == 0 {
        return Err(Error::data(path, "the archive unpacks to more than 64 GiB: unpack it first"));
    }
    Ok((file, false))
}
