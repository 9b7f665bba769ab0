//! All runs below some folders in one table.

use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use serde::Serialize;

use super::drives;
use super::html::Page;
use crate::dataset::udacity_writer::civil;
use crate::error::{Error, Result};
use crate::training::RunFolder;

/// Folders within folders in which runs are looked for.
const MAX_DEPTH: usize = 4;
/// Headers of [`RunLine::row`].
pub const HEADERS: [&str; 8] =
    ["run", "begun (UTC)", "recipe", "trained on", "epochs", "error ÷ never steering", "drives, autonomy", "replay"];

/// A run in the table. Shares are percent.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RunLine {
    /// Its folder.
    pub run: PathBuf,
    /// When it began: milliseconds after 1970, by the time of its first file.
    pub begun_ms: u64,
    /// Name of its recipe.
    pub recipe: String,
    /// What it was trained on.
    pub recordings: Vec<PathBuf>,
    /// Epochs done, and those of the recipe.
    pub epochs: [u32; 2],
    /// Whether it has a result.
    pub finished: bool,
    /// Validation error of its model: squared error of the centre camera over that of a wheel held straight.
    pub relative_to_zero: Option<f64>,
    /// Mean autonomy over the tracks of its drives, trained and held-out ones apart.
    pub autonomy_percent: Option<f64>,
    /// The same over held-out tracks.
    pub held_out_autonomy_percent: Option<f64>,
    /// Autonomy on the pictures of its validation side, or of its training side where there is no other.
    pub replay_autonomy_percent: Option<f64>,
    /// Why it cannot be read, if so.
    pub trouble: Option<String>,
}

/// The runs in `folders` and below them, the oldest first.
///
/// # Errors
///
/// [`Error::Io`] for a folder that is not there. A run that is damaged has its line, with the reason.
pub fn read(folders: &[PathBuf]) -> Result<Vec<RunLine>> {
    let mut lines = Vec::new();
    for folder in folders {
        std::fs::read_dir(folder).map_err(Error::io(folder))?;
        look_below(folder, 0, &mut lines);
    }
    lines.sort_by(|a, b| (a.begun_ms, &a.run).cmp(&(b.begun_ms, &b.run)));
    lines.dedup_by(|a, b| a.run == b.run);
    Ok(lines)
}

fn look_below(folder: &Path, depth: usize, lines: &mut Vec<RunLine>) {
    let info = folder.join("run.json");
    if info.is_file() {
        let mut line = RunLine::empty(folder, &folder.join("recipe.toml"));
        if let Err(error) = line.fill(folder) {
            line.trouble = Some(error.to_string());
        }
        lines.push(line);
    } else if depth < MAX_DEPTH {
        let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
        let folders = entries.filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()));
        folders.for_each(|entry| look_below(&entry.path(), depth + 1, lines));
    }
}

impl RunLine {
    fn empty(run: &Path, first_file: &Path) -> RunLine {
        let modified = std::fs::metadata(first_file).and_then(|metadata| metadata.modified()).ok();
        let since = modified.and_then(|time| time.duration_since(UNIX_EPOCH).ok());
        RunLine {
            run: run.into(),
            begun_ms: since.map_or(0, |since| since.as_millis() as u64),
            recipe: String::new(),
            recordings: Vec::new(),
            epochs: [0; 2],
            finished: false,
            relative_to_zero: None,
            autonomy_percent: None,
            held_out_autonomy_percent: None,
            replay_autonomy_percent: None,
            trouble: None,
        }
    }

    fn fill(&mut self, path: &Path) -> Result<()> {
        let folder = RunFolder::open(path)?;
        let recipe = folder.recipe()?;
        self.recordings = folder.info()?.recordings;
        (self.recipe, self.epochs[1]) = (recipe.name, recipe.epochs);
        if folder.file("history.csv").is_file() {
            self.epochs[0] = folder.history()?.last().map_or(0, |record| record.epoch);
        }
        if let Some(result) = folder.result()? {
            self.finished = true;
            self.relative_to_zero = result.relative_to_zero;
        }
        let driven = drives::read(path)?;
        let mean = |held_out: bool| {
            let all: Vec<f64> = (driven.iter().map(|drive| &drive.summary))
                .filter(|summary| summary.held_out == held_out)
                .map(|summary| summary.autonomy_percent)
                .collect();
            (!all.is_empty()).then(|| all.iter().sum::<f64>() / all.len() as f64)
        };
        (self.autonomy_percent, self.held_out_autonomy_percent) = (mean(false), mean(true));
        let replayed = folder.replay()?;
        self.replay_autonomy_percent =
            replayed.and_then(|verdict| Some(verdict.sides.last()?.drive.as_ref()?.autonomy_percent));
        Ok(())
    }

    /// What people are told, below [`HEADERS`].
    pub fn row(&self) -> Vec<String> {
        let [year, month, day, hour, minute, _] = civil(self.begun_ms);
        let percent = |value: Option<f64>| value.map(|value| format!("{value:.0} %"));
        let driven =
            [percent(self.autonomy_percent), percent(self.held_out_autonomy_percent).map(|text| text + " held out")];
        let driven: Vec<String> = driven.into_iter().flatten().collect();
        let or_dash = |text: Option<String>| text.unwrap_or_else(|| "-".into());
        let unfinished = if self.finished { "" } else { ", unfinished" };
        let row = vec![
            self.run.display().to_string(),
            format!("{year:04}-{month:02}-{day:02} {hour:02}:{minute:02}"),
            self.recipe.clone(),
            recordings(&self.recordings),
            format!("{} of {}{unfinished}", self.epochs[0], self.epochs[1]),
            or_dash(self.relative_to_zero.map(|value| format!("{value:.2}"))),
            or_dash((!driven.is_empty()).then(|| driven.join(", "))),
            or_dash(percent(self.replay_autonomy_percent)),
        ];
        match &self.trouble {
            None => row,
            Some(trouble) => vec![row[0].clone(), row[1].clone(), "cannot be read".into(), trouble.clone()],
        }
    }
}

/// The names of a few recordings, the number of many.
pub(super) fn recordings(paths: &[PathBuf]) -> String {
    let names: Vec<_> =
        paths.iter().map(|path| path.file_name().unwrap_or(path.as_os_str()).to_string_lossy()).collect();
    if names.len() > 3 { format!("{} recordings", names.len()) } else { names.join(", ") }
}

/// The page.
pub fn page(lines: &[RunLine]) -> String {
    let what = if lines.len() == 1 { "1 run".into() } else { format!("{} runs", lines.len()) };
    let mut page = Page::new("Runs", &format!("{what}, the oldest first"));
    let rows: Vec<Vec<String>> = lines.iter().map(RunLine::row).collect();
    page.table(&HEADERS, &rows);
    page.paragraph(
        "Validation errors compare only runs on the same data; what a model is worth shows when it drives: on tracks, or on recorded \
         pictures (replay).",
    );
    page.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_at_any_depth_are_listed_and_damaged_ones_say_why() {
        let folder = tempfile::tempdir().unwrap();
        let below = folder.path().join("a/b/run-1");
        std::fs::create_dir_all(&below).unwrap();
        std::fs::write(below.join("run.json"), "{").unwrap();
        std::fs::create_dir_all(folder.path().join("elsewhere")).unwrap();
        let lines = read(&[folder.path().into(), folder.path().join("a")]).unwrap();
        assert_eq!(lines.len(), 1, "named twice, listed once");
        assert!(lines[0].trouble.is_some() && lines[0].row()[2] == "cannot be read", "{lines:?}");
        assert!(page(&lines).contains("1 run, the oldest first"));
        assert!(read(&[folder.path().join("nowhere")]).is_err());
    }

    #[test]
    fn a_line_says_what_people_ask_for() {
        let line = RunLine {
            run: "runs/lenet-1".into(),
            begun_ms: 1_709_210_096_789,
            recipe: "lenet".into(),
            recordings: ["a/lake", "b/coast"].map(PathBuf::from).to_vec(),
            epochs: [3, 10],
            relative_to_zero: Some(0.3333),
            autonomy_percent: Some(99.6),
            held_out_autonomy_percent: Some(75.2),
            ..RunLine::empty(Path::new("x"), Path::new("nowhere"))
        };
        let expected = [
            "runs/lenet-1",
            "2024-02-29 12:34",
            "lenet",
            "lake, coast",
            "3 of 10, unfinished",
            "0.33",
            "100 %, 75 % held out",
            "-",
        ];
        assert_eq!(line.row(), expected);
        crate::report::pages::html::assert_stands_alone(&page(&[line]));
    }
}
