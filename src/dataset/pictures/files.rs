//! The image files of a recording: finding them, checking them, and remembering them in few bytes.

use crate::dataset::unusable::Reason;
use crate::picture::decode::{ends_complete, starts_as_image};
use std::collections::HashMap;
use std::ffi::OsString;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Names of image files. A name is a *place* (a folder, and for `left_2016….jpg` the part before the time) and the
/// rest; the places are few, and the three cameras of a row share the rest.
#[derive(Debug, Default)]
pub(crate) struct Files {
    places: Vec<OsString>,
    numbers: HashMap<OsString, u16>,
    names: String,
}

/// A file name in [`Files`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Name {
    place: u16,
    length: u16,
    start: u32,
}

impl Files {
    /// Remembers the images of a row: folder and file name for each camera.
    ///
    /// # Errors
    /// If there are more than 65,535 places, or names of more than 4 GB.
    pub fn add(&mut self, images: [Option<(&Path, &str)>; 3]) -> Result<[Option<Name>; 3], String> {
        let mut names = [None; 3];
        let mut shared: Option<(&str, u32)> = None;
        for (name, image) in names.iter_mut().zip(images) {
            let Some((folder, file)) = image else { continue };
            let (prefix, rest) = file.split_at(file.find('_').unwrap_or(0));
            let start = match shared {
                Some((held, start)) if held == rest => start,
                _ => u32::try_from(self.names.len()).map_err(|_| "more than 4 GB of image names")?,
            };
            if start as usize == self.names.len() {
                self.names.push_str(rest);
            }
            shared = Some((rest, start));
            let length = u16::try_from(rest.len()).map_err(|_| "an image name longer than 65,535 bytes")?;
            *name = Some(Name { place: self.place(folder, prefix)?, length, start });
        }
        Ok(names)
    }

    fn place(&mut self, folder: &Path, prefix: &str) -> Result<u16, String> {
        // Joining an empty string leaves a separator at the end.
        let mut place = folder.join("").into_os_string();
        place.push(prefix);
        if let Some(&number) = self.numbers.get(&place) {
            return Ok(number);
        }
        let number = u16::try_from(self.places.len())
            .map_err(|_| "the images lie in more than 65,535 folders, or their names begin in as many ways")?;
        self.places.push(place.clone());
        self.numbers.insert(place, number);
        Ok(number)
    }

    /// The path of an image.
    pub fn path(&self, name: Name) -> PathBuf {
        let mut path = self.places[usize::from(name.place)].clone();
        path.push(&self.names[name.start as usize..][..usize::from(name.length)]);
        path.into()
    }
}

/// Looks for the images a log names: logs move between folders, machines and systems.
#[derive(Debug, Clone)]
pub(crate) struct Locator {
    /// Folder of the log.
    base: PathBuf,
}

impl Locator {
    pub fn new(base: &Path) -> Self {
        Self { base: base.to_path_buf() }
    }

    /// Where an image named `written` may lie, most likely first: where the log says (a relative path starts at the
    /// log), in `IMG` beside the log, beside the log.
    pub fn folders<'a>(&self, written: &'a str) -> (Vec<PathBuf>, &'a str) {
        let (folder, file) = split_path(written);
        let mut folders = Vec::with_capacity(3);
        if Path::new(folder).is_absolute() {
            folders.push(PathBuf::from(folder));
        } else if !folder.is_empty() {
            folders.push(self.base.join(folder.replace('\\', "/")));
        }
        let here = [self.base.join("IMG"), self.base.clone()];
        folders.extend(here.into_iter().filter(|folder| folders.first() != Some(folder)).collect::<Vec<_>>());
        (folders, file)
    }

    /// The folder of an image that exists, after a look at its first and last bytes.
    ///
    /// # Errors
    /// What is wrong with it, and in words.
    pub fn check<'a>(&self, written: &'a str) -> Result<(PathBuf, &'a str), (Reason, String)> {
        let (folders, file) = self.folders(written);
        for folder in folders {
            match check_image(&folder.join(file)) {
                Err(Reason::ImageMissing) => {}
                Err(reason) => return Err((reason, format!("{}: {}", folder.join(file).display(), reason.text()))),
                Ok(()) => return Ok((folder, file)),
            }
        }
        Err((Reason::ImageMissing, format!("{written}: {}", Reason::ImageMissing.text())))
    }

    /// The likeliest folder, without looking at the image.
    pub fn assume<'a>(&self, written: &'a str) -> (PathBuf, &'a str) {
        let (folders, file) = self.folders(written);
        let likeliest = folders.iter().position(|folder| folder.is_dir()).unwrap_or(0);
        (folders.into_iter().nth(likeliest).unwrap_or_default(), file)
    }
}

/// Folder and file name of a path of any system.
pub(crate) fn split_path(path: &str) -> (&str, &str) {
    match path.rfind(['/', '\\']) {
        Some(at) => (&path[..at.max(1)], &path[at + 1..]),
        None => ("", path),
    }
}

/// A cheap look at an image file: it begins as one and ends as one.
fn check_image(path: &Path) -> Result<(), Reason> {
    let look = || -> io::Result<(Vec<u8>, Vec<u8>)> {
        let mut file = File::open(path)?;
        let mut head = Vec::with_capacity(8);
        file.by_ref().take(8).read_to_end(&mut head)?;
        let length = file.metadata()?.len();
        file.seek(SeekFrom::Start(length.saturating_sub(64)))?;
        let mut tail = Vec::with_capacity(64);
        file.take(64).read_to_end(&mut tail)?;
        Ok((head, tail))
    };
    match look() {
        Ok((head, _)) if head.is_empty() => Err(Reason::ImageTruncated),
        Ok((head, _)) if !starts_as_image(&head) => Err(Reason::NotAnImage),
        Ok((_, tail)) if !ends_complete(&tail) => Err(Reason::ImageTruncated),
        Ok(_) => Ok(()),
        Err(error) if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => {
            Err(Reason::ImageMissing)
        }
        // A path of another system can be no valid name at all here.
        Err(error) if matches!(error.kind(), io::ErrorKind::InvalidFilename | io::ErrorKind::InvalidInput) => {
            Err(Reason::ImageMissing)
        }
        Err(_) => Err(Reason::NotAnImage),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_come_back_and_share_what_they_can() {
        let mut files = Files::default();
        let folder = Path::new("drive").join("IMG");
        let rows = [
            ["center_1_2.jpg", "left_1_2.jpg", "right_1_2.jpg"],
            ["center_3.jpg", "odd.jpg", "right_4.jpg"],
            ["0_cam_.jpg", "_.png", "x"],
        ];
        for row in rows {
            let names = files.add(row.map(|name| Some((folder.as_path(), name)))).unwrap();
            for (written, name) in row.iter().zip(names) {
                assert_eq!(files.path(name.unwrap()), folder.join(written));
            }
        }
        assert_eq!(files.names.matches("_1_2.jpg").count(), 1);
        assert_eq!(files.add([None; 3]), Ok([None; 3]));
    }

    #[test]
    fn paths_of_every_system_are_split() {
        assert_eq!(split_path(r"C:\Users\me\IMG\a.jpg"), (r"C:\Users\me\IMG", "a.jpg"));
        assert_eq!(split_path("/home/me/a b/IMG/a.jpg"), ("/home/me/a b/IMG", "a.jpg"));
        assert_eq!(split_path("a.jpg"), ("", "a.jpg"));
        assert_eq!(split_path("/a.jpg"), ("/", "a.jpg"));
    }
}
