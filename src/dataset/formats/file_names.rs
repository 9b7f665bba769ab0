//! Pictures whose names carry the label, as in `frame_00012_ttl_0.25_agl_-0.4_mil_0.0.jpg`.

use std::path::{Path, PathBuf};

use super::Format;
use crate::dataset::description::Unit;
use crate::dataset::pictures::files::is_picture_name;
use crate::dataset::recording::file_name;
use crate::dataset::rows::{Entry, NO_NUMBER, Rows};
use crate::dataset::store::Store;
use crate::dataset::unusable::Reason;
use crate::{Error, Result};

/// Pictures whose names carry the label.
pub(super) const FORMAT: Format = Format {
    id: "file-names",
    name: "labels in file names",
    marks: "a folder of pictures, or `IMG` or `images` in it, named `…_agl_-0.4…` (or `angle`, `steering`, `steer`, `st`), or all of \
            them `…_-0.40.jpg` or `…_095.jpg`",
    labels: "shares of full lock, or what `unit` says; three digits at the end are degrees of a servo",
    unit: Unit::Lock,
    hz: 20.0,
    cameras: 1,
    find,
    base: |_, folder| folder.to_path_buf(),
    read,
};

/// Words before the label.
const WORDS: [&str; 5] = ["agl", "angle", "steering", "steer", "st"];
/// Pictures that are looked at to tell the format.
const LOOKED_AT: usize = 20;

/// How the names of a folder carry the label.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Style {
    /// After a word.
    Word,
    /// A number with a point at the end.
    Last,
    /// Three digits at the end.
    Servo,
}

impl Style {
    fn label(self, name: &str) -> Option<f64> {
        let stem = name.rsplit_once('.').map_or(name, |(stem, _)| stem);
        match self {
            Style::Word => {
                let parts: Vec<&str> = stem.split(['_', '=', ' ']).collect();
                parts.windows(2).find_map(|pair| {
                    WORDS.iter().any(|word| pair[0].eq_ignore_ascii_case(word)).then(|| pair[1].parse().ok())?
                })
            }
            Style::Last => {
                let last = stem.rsplit('_').next()?;
                last.contains('.').then(|| last.parse().ok())?
            }
            Style::Servo => {
                let last = stem.rsplit('_').next().filter(|last| *last != stem)?;
                let digits = last.len() == 3 && last.bytes().all(|byte| byte.is_ascii_digit());
                digits.then(|| last.parse().ok())?.filter(|label: &f64| *label <= 180.0)
            }
        }
    }

    /// The style that all of `names` have.
    fn of(names: &[String]) -> Option<Style> {
        let all = |style: Style| !names.is_empty() && names.iter().all(|name| style.label(name).is_some());
        let servo = |style: Style| {
            // Numbers of pictures run on; degrees of a servo stay about 90.
            let mut labels: Vec<f64> = names.iter().filter_map(|name| style.label(name)).collect();
            labels.sort_unstable_by(f64::total_cmp);
            style != Style::Servo || labels.get(labels.len() / 2).is_some_and(|middle| (60.0..=120.0).contains(middle))
        };
        [Style::Word, Style::Last, Style::Servo].into_iter().find(|&style| all(style) && servo(style))
    }
}

/// The first number in a name, by which pictures are sorted; then the name itself.
fn order(name: &str) -> (u64, String) {
    let digits: String =
        name.chars().skip_while(|c| !c.is_ascii_digit()).take_while(char::is_ascii_digit).take(18).collect();
    (digits.parse().unwrap_or(u64::MAX), name.to_owned())
}

fn pictures(store: &Store, folder: &Path) -> Result<Vec<String>> {
    let names = store.list(folder)?.into_iter().map(|path| file_name(&path));
    Ok(names.filter(|name| is_picture_name(&name.to_lowercase())).collect())
}

fn find(store: &Store, path: &Path) -> Result<Option<PathBuf>> {
    if !store.is_folder(path) {
        return Ok(None);
    }
    for folder in [path.to_path_buf(), path.join("IMG"), path.join("images"), path.join("data")] {
        if store.is_folder(&folder) {
            let names = pictures(store, &folder)?;
            let step = names.len().div_ceil(LOOKED_AT).max(1);
            let some: Vec<String> = names.into_iter().step_by(step).collect();
            if Style::of(&some).is_some() {
                return Ok(Some(folder));
            }
        }
    }
    Ok(None)
}

fn read(store: &Store, folder: &Path, rows: &mut Rows) -> Result<()> {
    rows.read_from(&file_name(folder));
    let mut names = pictures(store, folder)?;
    names.sort_by_cached_key(|name| order(name));
    let step = names.len().div_ceil(LOOKED_AT).max(1);
    let some: Vec<String> = names.iter().step_by(step).cloned().collect();
    let style = Style::of(&some).ok_or_else(|| Error::data(folder, "the names of the pictures carry no labels"))?;
    if style == Style::Servo {
        rows.set_unit(Unit::Servo);
        rows.notice(
            "numbers at the end of names are taken for degrees of a servo, 90 is straight; say --unit if they are not"
                .into(),
        );
    }
    for (i, name) in names.into_iter().enumerate() {
        let line = i as u32 + 1;
        let time_ms = super::udacity::time_of(&name);
        match style.label(&name) {
            Some(steering) => rows.push(Entry {
                // Its place among the names changes with the files there.
                number: NO_NUMBER,
                images: [Some(name), None, None],
                steering,
                time_ms,
                ..Entry::at(line)
            })?,
            None => rows.unusable(line, Reason::NotANumber, &format!("{name} carries no label")),
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_carry_labels_in_three_ways() {
        let names = |all: &[&str]| all.iter().map(|name| (*name).to_owned()).collect::<Vec<_>>();
        let word = names(&["frame_00001_ttl_0.25_agl_-0.4_mil_0.0.jpg", "frame_00002_ttl_0.2_agl_0.1_mil_0.0.jpg"]);
        assert_eq!((Style::of(&word), Style::Word.label(&word[0])), (Some(Style::Word), Some(-0.4)));
        let last = names(&["12_-0.25.png", "13_0.5.png"]);
        assert_eq!((Style::of(&last), Style::Last.label(&last[0])), (Some(Style::Last), Some(-0.25)));
        let servo = names(&["video_001_090.png", "video_002_101.png", "video_003_085.png"]);
        assert_eq!((Style::of(&servo), Style::Servo.label(&servo[1])), (Some(Style::Servo), Some(101.0)));
        for none in [
            names(&["IMG_001.jpg", "IMG_002.jpg"]),
            names(&["a.jpg"]),
            names(&[]),
            names(&["center_2016_12_01_13_30_48_287.jpg"]),
        ] {
            assert_eq!(Style::of(&none), None, "{none:?}");
        }
        assert!(order("9_a.jpg") < order("10_a.jpg"));
    }
}
