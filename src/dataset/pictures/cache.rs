//! Preprocessed images, kept in memory up to a budget and beyond it in a temporary file.
//!
//! The first images of the list are kept in memory, the rest in the file, so what lies where depends on nothing but the
//! budget. Every image takes the same number of bytes. Each image is made once; what is read back is what was made.

use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU8, AtomicU32, Ordering};
use std::sync::{Mutex, OnceLock, PoisonError};

/// Locks that guard the making of file slots; several, so that threads seldom wait for each other.
const STRIPES: usize = 64;

/// What happens to images beyond the memory budget.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Overflow {
    /// They go to a temporary file that vanishes with the run.
    #[default]
    File,
    /// They are decoded anew every time.
    Decode,
}

/// How much is kept, and where.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CacheSpec {
    /// Bytes of images kept in memory.
    pub memory_bytes: usize,
    /// What happens to the rest.
    pub overflow: Overflow,
    /// Folder of the temporary file; the system's folder for such files by default.
    pub folder: Option<PathBuf>,
}

impl Default for CacheSpec {
    /// 512 MiB, then a file in the system's temporary folder.
    fn default() -> Self {
        Self { memory_bytes: 512 << 20, overflow: Overflow::File, folder: None }
    }
}

/// State of an image that is not kept in memory.
const EMPTY: u8 = 0;
const IN_FILE: u8 = 1;
const BROKEN: u8 = 2;

/// A fixed number of images of one size.
#[derive(Debug)]
pub struct ImageCache {
    bytes_per_image: usize,
    /// `None` inside for an image that cannot be made.
    memory: Vec<OnceLock<Option<Box<[u8]>>>>,
    states: Vec<AtomicU8>,
    /// CRC-32 of each image in the file.
    checksums: Vec<AtomicU32>,
    file: Option<Store>,
    stripes: [Mutex<()>; STRIPES],
}

impl ImageCache {
    /// An empty cache for `images` images of `bytes_per_image` bytes.
    ///
    /// # Errors
    /// If the temporary file is needed and cannot be created.
    pub fn new(images: usize, bytes_per_image: usize, spec: &CacheSpec) -> Result<Self> {
        let in_memory = images.min(spec.memory_bytes / bytes_per_image.max(1));
        let overflows = in_memory < images && spec.overflow == Overflow::File;
        Ok(Self {
            bytes_per_image,
            memory: (0..in_memory).map(|_| OnceLock::new()).collect(),
            states: (in_memory..images).map(|_| AtomicU8::new(EMPTY)).collect(),
            checksums: (in_memory..images).map(|_| AtomicU32::new(0)).collect(),
            file: overflows.then(|| Store::new(spec)).transpose()?,
            stripes: [const { Mutex::new(()) }; STRIPES],
        })
    }

    /// Number of images kept in memory once they are made.
    pub fn in_memory(&self) -> usize {
        self.memory.len()
    }

    /// Image `i`, which `make` makes if it is asked for the first time. `buffer` may be used to hold it.
    /// `None` if it cannot be made; `make` has then said so and is not called again.
    ///
    /// # Errors
    /// If the temporary file cannot be written or read.
    ///
    /// # Panics
    /// If there is no image `i`, or `buffer` does not have the size of an image.
    pub fn get<'a>(
        &'a self,
        i: usize,
        buffer: &'a mut [u8],
        make: impl FnOnce(&mut [u8]) -> bool,
    ) -> Result<Option<&'a [u8]>> {
        assert_eq!(buffer.len(), self.bytes_per_image, "buffer for an image of the cache");
        if let Some(slot) = self.memory.get(i) {
            return Ok(slot.get_or_init(|| make(buffer).then(|| Box::from(&*buffer))).as_deref());
        }
        let i = i - self.memory.len();
        let state = &self.states[i];
        let offset = (i * self.bytes_per_image) as u64;
        if state.load(Ordering::Acquire) == EMPTY {
            let guard = self.file.is_some().then(|| {
                // The lock guards no data, so a thread that died with it leaves nothing broken.
                self.stripes[i % STRIPES].lock().unwrap_or_else(PoisonError::into_inner)
            });
            if state.load(Ordering::Acquire) == EMPTY {
                if !make(buffer) {
                    state.store(BROKEN, Ordering::Release);
                    return Ok(None);
                }
                if let Some(file) = &self.file {
                    file.write(buffer, offset)?;
                    self.checksums[i].store(checksum(buffer), Ordering::Relaxed);
                    state.store(IN_FILE, Ordering::Release);
                }
                return Ok(Some(buffer));
            }
            drop(guard);
        }
        match (&self.file, state.load(Ordering::Acquire)) {
            (Some(file), IN_FILE) => {
                file.read(buffer, offset)?;
                // What the disk has damaged is made again.
                if checksum(buffer) != self.checksums[i].load(Ordering::Relaxed) && !make(buffer) {
                    return Ok(None);
                }
                Ok(Some(buffer))
            }
            _ => Ok(None),
        }
    }
}

/// CRC-32 of an image.
fn checksum(image: &[u8]) -> u32 {
    let mut crc = flate2::Crc::new();
    crc.update(image);
    crc.sum()
}

/// The temporary file. It has no name (or is deleted when it is closed), so a run that is killed leaves nothing behind.
#[derive(Debug)]
struct Store {
    file: File,
    folder: PathBuf,
    /// Where the system cannot read at an offset, seeking and reading must not be interrupted by another thread.
    #[cfg(not(any(unix, windows)))]
    seeking: Mutex<()>,
}

impl Store {
    fn new(spec: &CacheSpec) -> Result<Self> {
        let folder = spec.folder.clone().unwrap_or_else(std::env::temp_dir);
        let file = tempfile::tempfile_in(&folder).map_err(Self::failed(&folder))?;
        Ok(Self {
            file,
            folder,
            #[cfg(not(any(unix, windows)))]
            seeking: Mutex::new(()),
        })
    }

    fn failed(folder: &std::path::Path) -> impl FnOnce(std::io::Error) -> Error {
        move |error| {
            let remedy = "choose another folder for the image cache, or allow it more memory";
            Error::data(folder, format!("temporary file of the image cache: {error}; {remedy}"))
        }
    }

    fn write(&self, bytes: &[u8], offset: u64) -> Result<()> {
        self.write_at(bytes, offset).map_err(Self::failed(&self.folder))
    }

    fn read(&self, bytes: &mut [u8], offset: u64) -> Result<()> {
        self.read_at(bytes, offset).map_err(Self::failed(&self.folder))
    }

    #[cfg(unix)]
    fn write_at(&self, bytes: &[u8], offset: u64) -> std::io::Result<()> {
        std::os::unix::fs::FileExt::write_all_at(&self.file, bytes, offset)
    }

    #[cfg(unix)]
    fn read_at(&self, bytes: &mut [u8], offset: u64) -> std::io::Result<()> {
        std::os::unix::fs::FileExt::read_exact_at(&self.file, bytes, offset)
    }

    #[cfg(windows)]
    fn write_at(&self, mut bytes: &[u8], mut offset: u64) -> std::io::Result<()> {
        while !bytes.is_empty() {
            let written = std::os::windows::fs::FileExt::seek_write(&self.file, bytes, offset)?;
            if written == 0 {
                return Err(std::io::ErrorKind::WriteZero.into());
            }
            bytes = &bytes[written..];
            offset += written as u64;
        }
        Ok(())
    }

    #[cfg(windows)]
    fn read_at(&self, mut bytes: &mut [u8], mut offset: u64) -> std::io::Result<()> {
        while !bytes.is_empty() {
            let read = std::os::windows::fs::FileExt::seek_read(&self.file, bytes, offset)?;
            if read == 0 {
                return Err(std::io::ErrorKind::UnexpectedEof.into());
            }
            bytes = &mut bytes[read..];
            offset += read as u64;
        }
        Ok(())
    }

    #[cfg(not(any(unix, windows)))]
    fn write_at(&self, bytes: &[u8], offset: u64) -> std::io::Result<()> {
        use std::io::{Seek, SeekFrom, Write};
        let _seeking = self.seeking.lock().unwrap_or_else(PoisonError::into_inner);
        (&self.file).seek(SeekFrom::Start(offset))?;
        (&self.file).write_all(bytes)
    }

    #[cfg(not(any(unix, windows)))]
    fn read_at(&self, bytes: &mut [u8], offset: u64) -> std::io::Result<()> {
        use std::io::{Read, Seek, SeekFrom};
        let _seeking = self.seeking.lock().unwrap_or_else(PoisonError::into_inner);
        (&self.file).seek(SeekFrom::Start(offset))?;
        (&self.file).read_exact(bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rayon::prelude::*;
    use std::sync::atomic::AtomicUsize;

    #[test]
    fn an_image_that_the_disk_damaged_is_made_again() {
        let spec = CacheSpec { memory_bytes: 0, ..CacheSpec::default() };
        let cache = ImageCache::new(3, 10, &spec).unwrap();
        let makes = AtomicUsize::new(0);
        let get = |i: usize| {
            let mut buffer = [0; 10];
            let made = |image: &mut [u8]| {
                image.fill(i as u8 + 1);
                makes.fetch_add(1, Ordering::Relaxed);
                true
            };
            cache.get(i, &mut buffer, made).unwrap().map(<[u8]>::to_vec)
        };
        (0..3).for_each(|i| drop(get(i)));
        cache.file.as_ref().unwrap().write(&[2, 2, 2, 2, 2, 2, 2, 2, 2, 3], 10).unwrap();
        assert_eq!((get(1), get(2), makes.into_inner()), (Some(vec![2; 10]), Some(vec![3; 10]), 4));
    }

    fn check(spec: &CacheSpec, in_memory: usize, makes_per_image: usize) {
        let cache = ImageCache::new(100, 10, spec).unwrap();
        assert_eq!(cache.in_memory(), in_memory);
        let made = AtomicUsize::new(0);
        for _ in 0..3 {
            (0..100).into_par_iter().for_each(|i| {
                let mut buffer = [0; 10];
                let image = cache
                    .get(i, &mut buffer, |bytes| {
                        made.fetch_add(1, Ordering::Relaxed);
                        bytes.fill(i as u8);
                        i != 5 && i != 95
                    })
                    .unwrap();
                assert_eq!(image, (i != 5 && i != 95).then_some(&[i as u8; 10][..]));
            });
        }
        let beyond = 100 - in_memory;
        let broken_beyond = if in_memory > 95 {
            0
        } else if in_memory > 5 {
            1
        } else {
            2
        };
        let expected = in_memory + broken_beyond + (beyond - broken_beyond) * makes_per_image;
        assert_eq!(made.into_inner(), expected);
    }

    #[test]
    fn images_come_back_from_memory_file_and_anew() {
        let folder = tempfile::tempdir().unwrap();
        for (memory_bytes, in_memory) in [(0, 0), (9, 0), (405, 40), (1 << 20, 100)] {
            for (overflow, makes) in [(Overflow::File, 1), (Overflow::Decode, 3)] {
                let spec = CacheSpec { memory_bytes, overflow, folder: Some(folder.path().into()) };
                check(&spec, in_memory, makes);
            }
        }
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    #[test]
    fn a_folder_that_cannot_be_used_is_an_error_with_a_remedy() {
        let spec = CacheSpec { memory_bytes: 0, folder: Some("/no/such/folder".into()), ..Default::default() };
        let message = ImageCache::new(1, 1, &spec).unwrap_err().to_string();
        assert!(message.contains("another folder"), "{message}");
    }
}
