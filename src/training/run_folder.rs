//! The folder of a run.

use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use steersman_kernels::conv::ConvAlgorithm;

use super::history::{EpochRecord, read_history};
use super::run::TrainResult;
use crate::dataset::Description;
use crate::error::{Error, Result};
use crate::files::atomic_file;
use crate::model_file::Transfer;
use crate::recipe::Recipe;

/// The folder of a run, and the names of what is in it.
#[derive(Clone, Debug)]
pub(crate) struct RunFolder {
    path: PathBuf,
}

/// The content of `run.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct RunInfo {
    /// Version of the program that began the run.
    pub version: String,
    /// Vector code it ran on.
    pub isa: String,
    /// How its convolutions were computed, if not by the default algorithms: `im2col`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub algorithm: Option<String>,
    /// Seed of all random choices.
    pub seed: u64,
    /// Absolute paths of the recordings.
    pub recordings: Vec<PathBuf>,
    /// Memory for decoded images, in MiB.
    pub cache_mib: usize,
    /// What the user said about the recordings.
    #[serde(default, skip_serializing_if = "Description::is_empty")]
    pub said: Description,
    /// Hash over the rows of both sides: the recordings must not change during a run.
    pub rows_hash: String,
    /// Hash over their pictures.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub pictures_hash: String,
    /// What the run took over from the model `from.safetensors`; absent for a fresh start.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub transfer: Option<Transfer>,
    /// As in [`TrainingRecord`](crate::model_file::TrainingRecord).
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub trained_on_held_out: Vec<String>,
}

impl RunInfo {
    /// How the convolutions of the run in `folder` are computed.
    ///
    /// # Errors
    ///
    /// [`Error::Data`] for an algorithm that this version does not know.
    pub fn conv_algorithm(&self, folder: &RunFolder) -> Result<ConvAlgorithm> {
        let named = self.algorithm.as_deref().map(str::parse).transpose();
        let unknown = |message: String| Error::data(folder.file("run.json"), format!("algorithm: {message}"));
        Ok(named.map_err(unknown)?.unwrap_or_default())
    }
}

impl RunFolder {
    /// Name of the file in which the main job notes what follows on the training. It may be there before a run begins.
    pub const JOB_NOTE: &str = "main-job.json";

    /// Checks that a new run can begin in `path`: it must not exist or be empty.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] if there is something in it already, [`Error::Io`] if it cannot be read.
    pub fn require_free(path: &Path) -> Result<()> {
        let taken = |entry: std::io::Result<std::fs::DirEntry>| entry.is_ok_and(|e| e.file_name() != Self::JOB_NOTE);
        if path.exists() && std::fs::read_dir(path).map_err(Error::io(path))?.any(taken) {
            return Err(Error::Usage(format!(
                "{} is not empty and stays as it is; give another folder with --out, or go on with that run: --resume {}",
                path.display(),
                path.display()
            )));
        }
        Ok(())
    }

    /// A new run in `path`, which must not exist or be empty.
    ///
    /// # Errors
    ///
    /// As [`RunFolder::require_free`]; [`Error::Io`] if it cannot be made.
    pub fn create(path: &Path) -> Result<RunFolder> {
        RunFolder::require_free(path)?;
        std::fs::create_dir_all(path).map_err(Error::io(path))?;
        Ok(RunFolder { path: path.to_path_buf() })
    }

    /// The run in `path`.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] if `path` is no run folder.
    pub fn open(path: &Path) -> Result<RunFolder> {
        let folder = RunFolder { path: path.to_path_buf() };
        if !folder.file("run.json").is_file() {
            return Err(Error::Usage(format!("{} is no run folder: it has no run.json", path.display())));
        }
        Ok(folder)
    }

    /// The first of `runs/NAME-1`, `runs/NAME-2`, … that does not exist.
    pub fn next_free(name: &str) -> PathBuf {
        (1..).map(|n| Path::new("runs").join(format!("{name}-{n}"))).find(|path| !path.exists()).expect("numbers go on")
    }

    /// How the run was begun.
    ///
    /// # Errors
    ///
    /// [`Error::Io`] and [`Error::Data`] for a damaged folder.
    pub fn info(&self) -> Result<RunInfo> {
        self.read_json("run.json")
    }

    /// A file in the folder.
    pub fn file(&self, name: &str) -> PathBuf {
        self.path.join(name)
    }

    /// The best model.
    pub fn model(&self) -> PathBuf {
        self.file("model.safetensors")
    }

    /// The model that the run began from, where it did not begin afresh.
    pub fn from(&self) -> PathBuf {
        self.file("from.safetensors")
    }

    /// The recipe of the run.
    ///
    /// # Errors
    ///
    /// As [`Recipe::find`].
    pub fn recipe(&self) -> Result<Recipe> {
        Recipe::find(&self.file("recipe.toml").display().to_string(), &[])
    }

    /// The epochs that are done.
    ///
    /// # Errors
    ///
    /// As [`read_history`].
    pub fn history(&self) -> Result<Vec<EpochRecord>> {
        read_history(&self.file("history.csv"))
    }

    /// The result of the run; `None` while it is not finished.
    ///
    /// # Errors
    ///
    /// [`Error::Io`] and [`Error::Data`].
    pub fn result(&self) -> Result<Option<TrainResult>> {
        if self.file("result.json").is_file() { self.read_json("result.json").map(Some) } else { Ok(None) }
    }

    pub(super) fn write_json(&self, name: &str, value: &impl Serialize) -> Result<()> {
        let path = self.file(name);
        let text = serde_json::to_string_pretty(value).map_err(|e| Error::data(&path, e.to_string()))?;
        atomic_file::write(&path, (text + "\n").as_bytes())
    }

    fn read_json<T: DeserializeOwned>(&self, name: &str) -> Result<T> {
        let path = self.file(name);
        let text = std::fs::read_to_string(&path).map_err(Error::io(&path))?;
        serde_json::from_str(&text).map_err(|e| Error::data_at(&path, e.line() as u64, e.to_string()))
    }

    pub(super) fn write_recipe(&self, recipe: &Recipe) -> Result<()> {
        atomic_file::write(&self.file("recipe.toml"), recipe.to_toml()?.as_bytes())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_with_something_in_it_is_refused_and_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("mine.txt"), "x").unwrap();
        let error = RunFolder::create(folder.path()).unwrap_err().to_string();
        assert!(error.contains("is not empty and stays as it is"), "{error}");
        assert!(folder.path().join("mine.txt").exists());
        assert!(RunFolder::create(&folder.path().join("new")).is_ok());
    }

    #[test]
    fn what_is_no_run_folder_cannot_be_opened() {
        let folder = tempfile::tempdir().unwrap();
        assert!(RunFolder::open(folder.path()).unwrap_err().to_string().ends_with("it has no run.json"));
    }
}
