//! The image files of a recording: finding them, checking them, and remembering them in few bytes.

use crate::Result as Outcome;
use crate::dataset::store::{Kind, Store};
use crate::dataset::unusable::Reason;
use crate::picture::RgbImage;
use crate::picture::decode::{decode_rgb, ends_complete, starts_as_image};
use std::collections::HashMap;
use std::ffi::OsString;
use std::io;
use std::path::{Component, Path, PathBuf};
use std::sync::OnceLock;

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

/// Names of folders that pictures usually lie in, beside the log; in any case.
const FOLDERS: [&str; 9] = ["img", "images", "image", "imgs", "pictures", "frames", "center", "centre", "data"];
/// Folders within folders that are looked through for pictures, and files in them.
const MAX_DEPTH: usize = 4;
const MAX_INDEXED: usize = 4 << 20;

/// Looks for the pictures a log names: logs move between folders, machines and systems.
///
/// Nothing outside the recording is ever opened: a path that leads there stands for the name at its end.
#[derive(Debug)]
pub(crate) struct Locator<'a> {
    store: &'a Store,
    /// The top folder of the recording, as it was named and as absolute paths would name it.
    top: PathBuf,
    tops: Vec<PathBuf>,
    /// Folder of the log.
    base: PathBuf,
    /// Folders in which pictures are looked for by name, the likeliest first.
    usual: Vec<PathBuf>,
    /// All pictures in the recording by their names in small letters, once they are asked for.
    index: OnceLock<HashMap<String, Vec<PathBuf>>>,
}

impl<'a> Locator<'a> {
    /// For a log in the folder `base` of the recording `top`.
    ///
    /// # Errors
    /// If `base` cannot be read.
    pub fn new(store: &'a Store, top: &Path, base: &Path) -> Outcome<Self> {
        let mut tops: Vec<PathBuf> = std::path::absolute(top).iter().map(|top| plain(top)).collect();
        tops.extend(std::fs::canonicalize(top));
        let mut usual = Vec::new();
        if store.is_folder(base) {
            let below: Vec<PathBuf> = store.list(base)?.into_iter().filter(|path| store.is_folder(path)).collect();
            for name in FOLDERS {
                let is_it = |path: &&PathBuf| path.file_name().is_some_and(|found| found.eq_ignore_ascii_case(name));
                usual.extend(below.iter().filter(is_it).cloned());
            }
        }
        usual.push(base.to_path_buf());
        Ok(Self { store, top: top.into(), tops, base: base.into(), usual, index: OnceLock::new() })
    }

    /// The top folder of the recording.
    pub fn top(&self) -> &Path {
        &self.top
    }

    /// Where a picture named `written` may lie, most likely first: where the log says (a relative path starts at the log), in
    /// `IMG` beside the log, beside the log.
    fn folders<'t>(&self, written: &'t str) -> (Vec<PathBuf>, &'t str) {
        let (folder, file) = split_path(written);
        let mut folders = Vec::with_capacity(1 + self.usual.len());
        folders.extend(self.inside(folder));
        for usual in &self.usual {
            if folders.first() != Some(usual) {
                folders.push(usual.clone());
            }
        }
        (folders, file)
    }

    /// The folder that a log means by `written`, if it lies within the recording.
    fn inside(&self, written: &str) -> Option<PathBuf> {
        if written.is_empty() {
            return None;
        }
        if Path::new(written).is_absolute() {
            let path = plain(Path::new(written));
            return self.tops.iter().find_map(|top| Some(self.top.join(path.strip_prefix(top).ok()?)));
        }
        // The path of a drive or of a network share of Windows.
        if written.contains(':') || written.starts_with(['/', '\\']) {
            return None;
        }
        let path = self.base.join(written.replace('\\', "/"));
        if !path.components().any(|part| part == Component::ParentDir) {
            return Some(path);
        }
        let absolute = plain(&std::path::absolute(&path).ok()?);
        self.tops.iter().any(|top| absolute.starts_with(top)).then(|| plain(&path))
    }

    /// Folder and name of a picture that exists, after a look at its first and last bytes.
    ///
    /// # Errors
    /// What is wrong with it, and in words.
    pub fn check(&self, written: &str) -> Result<(PathBuf, String), (Reason, String)> {
        let (folders, file) = self.folders(written);
        let missing = || (Reason::ImageMissing, format!("{written}: {}", Reason::ImageMissing.text()));
        // `..` and the like are no names of pictures.
        if file.is_empty() || file == "." || file == ".." {
            return Err(missing());
        }
        for folder in folders {
            let path = folder.join(file);
            match self.check_image(&path) {
                Err(Reason::ImageMissing) => {}
                Err(reason) => return Err((reason, format!("{}: {}", path.display(), reason.text()))),
                Ok(()) => return Ok((folder, file.to_owned())),
            }
        }
        let path =
            self.by_name(written, file).map_err(|message| (Reason::ImageMissing, message))?.ok_or_else(missing)?;
        let (Some(folder), Some(name)) = (path.parent(), path.file_name().and_then(|name| name.to_str())) else {
            return Err(missing());
        };
        match self.check_image(&path) {
            Ok(()) => Ok((folder.to_path_buf(), name.to_owned())),
            Err(reason) => Err((reason, format!("{}: {}", path.display(), reason.text()))),
        }
    }

    /// The likeliest folder, without looking at the picture.
    pub fn assume(&self, written: &str) -> (PathBuf, String) {
        let (folders, file) = self.folders(written);
        let likeliest = folders.iter().position(|folder| self.store.is_folder(folder)).unwrap_or(0);
        (folders.into_iter().nth(likeliest).unwrap_or_default(), file.to_owned())
    }

    /// The picture `file` anywhere in the recording; of several, the one whose folders agree best with `written`.
    fn by_name(&self, written: &str, file: &str) -> Result<Option<PathBuf>, String> {
        let index = self.index.get_or_init(|| {
            let mut index = HashMap::new();
            self.collect(&self.base, 0, &mut 0, &mut index);
            index
        });
        let Some(found) = index.get(&file.to_lowercase()) else { return Ok(None) };
        let parts = |path: &str| -> Vec<String> { path.split(['/', '\\']).rev().map(str::to_lowercase).collect() };
        let wanted = parts(written);
        let agreement = |path: &PathBuf| {
            let path = parts(&path.to_string_lossy());
            path.iter().zip(&wanted).take_while(|(a, b)| a == b).count()
        };
        let best = found.iter().map(agreement).max().unwrap_or(0);
        let mut best = found.iter().filter(|path| agreement(path) == best);
        match (best.next(), best.next()) {
            (Some(one), Some(other)) => {
                Err(format!("{written} could be {} or {}: the log does not say which", one.display(), other.display()))
            }
            (one, _) => Ok(one.cloned()),
        }
    }

    fn collect(&self, folder: &Path, depth: usize, count: &mut usize, index: &mut HashMap<String, Vec<PathBuf>>) {
        for path in self.store.list(folder).unwrap_or_default() {
            let name = path.file_name().and_then(|name| name.to_str()).map(str::to_lowercase);
            let Some(name) = name.filter(|_| *count < MAX_INDEXED) else { continue };
            if is_picture_name(&name) {
                *count += 1;
                index.entry(name).or_default().push(path);
            } else if depth < MAX_DEPTH && self.store.is_folder(&path) {
                self.collect(&path, depth + 1, count, index);
            }
        }
    }

    /// A cheap look at a picture: it begins as one and ends as one. Where its end is unusual, it is decoded.
    fn check_image(&self, path: &Path) -> Result<(), Reason> {
        match self.store.ends(path) {
            Ok((_, 0, _)) => Err(Reason::ImageTruncated),
            Ok((head, filled, _)) if !starts_as_image(&head[..filled]) => Err(Reason::NotAnImage),
            Ok((_, _, tail)) if ends_complete(&tail) => Ok(()),
            Ok(_) => {
                let (mut bytes, mut image) = (Vec::new(), RgbImage::default());
                self.store.read(path, &mut bytes).map_err(|_| Reason::NotAnImage)?;
                decode_rgb(&bytes, &mut image).map_err(|_| Reason::ImageTruncated)
            }
            Err(error) if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => {
                Err(Reason::ImageMissing)
            }
            Err(_) if self.store.kind(path) == Kind::Special => Err(Reason::NotAFile),
            // A path of another system can be no valid name at all here.
            Err(error) if matches!(error.kind(), io::ErrorKind::InvalidFilename) => Err(Reason::ImageMissing),
            Err(error) if error.kind() == io::ErrorKind::InvalidInput && self.store.kind(path) == Kind::Nothing => {
                Err(Reason::ImageMissing)
            }
            Err(_) => Err(Reason::NotAnImage),
        }
    }
}

/// Whether a file of this name, in small letters, is taken for a picture.
pub(crate) fn is_picture_name(name: &str) -> bool {
    [".jpg", ".jpeg", ".png"].iter().any(|extension| name.ends_with(extension))
}

/// `path` without `.` and `..`; a `..` that leads above its beginning stays.
fn plain(path: &Path) -> PathBuf {
    let mut plain = PathBuf::new();
    for part in path.components() {
        match part {
            Component::CurDir => {}
            Component::ParentDir if matches!(plain.components().next_back(), Some(Component::Normal(_))) => {
                plain.pop();
            }
            part => plain.push(part),
        }
    }
    plain
}

/// Folder and file name of a path of any system.
pub(crate) fn split_path(path: &str) -> (&str, &str) {
    match path.rfind(['/', '\\']) {
        Some(at) => (&path[..at.max(1)], &path[at + 1..]),
        None => ("", path),
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
