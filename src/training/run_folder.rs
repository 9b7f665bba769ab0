//! The folder of a run.

use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use steersman_kernels::conv::ConvAlgorithm;

use super::history::{EpochRecord, history_csv, read_history};
use super::request::TrainResult;
use crate::dataset::Description;
use crate::error::{Error, Result};
use crate::files::lock::{LOCK_NAME, Lock};
use crate::files::{checksums, unfinished};
use crate::model_file::Transfer;
use crate::recipe::Recipe;
use crate::replay::RecordingVerdict;

/// The folder of a run, and the names of what is in it.
#[derive(Clone, Debug)]
pub(crate) struct RunFolder {
    path: PathBuf,
}

/// The folder of a run that is about to begin.
#[derive(Debug)]
pub(crate) struct NewRun {
    path: PathBuf,
    /// Whether it was made just now.
    made: bool,
}

impl NewRun {
    /// The folder `out` that the user named, or a new one under `runs/` for a recipe `name`.
    ///
    /// # Errors
    ///
    /// As [`RunFolder::create_next`].
    pub fn at(out: Option<PathBuf>, name: &str) -> Result<NewRun> {
        match out {
            Some(path) => Ok(NewRun { path, made: false }),
            None => Ok(NewRun { path: RunFolder::create_next(name)?, made: true }),
        }
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Removes the folder if it was made here and the run ended before it had put anything there, and `runs/` if that was made for it.
    pub fn settle<T>(self, result: Result<T>) -> Result<T> {
        if result.is_err() && self.made {
            // A folder with something in it stays; so does `runs/` with other runs in it.
            let _ = std::fs::remove_dir(&self.path);
            let _ = self.path.parent().map(std::fs::remove_dir);
        }
        result
    }
}

/// The lock of a run folder. It ends with its process, however that ends.
#[derive(Debug)]
pub(crate) struct RunLock {
    _lock: Lock,
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
    /// Absolute paths of those that are the validation side; without any, a share of the rows of the others is.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub validate: Vec<PathBuf>,
    /// Absolute paths of views that a model met, which are always trained on.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub also: Vec<PathBuf>,
    /// Absolute paths of the simulator's set, of which each epoch draws some.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub simulator: Vec<PathBuf>,
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
    /// What was trained on, in words: the paths of the recordings, and of the folder of the simulator's set.
    pub fn trained_on(&self) -> Vec<String> {
        let recordings = self.recordings.iter().map(|path| path.display().to_string());
        let set = self.simulator.first().and_then(|path| path.parent());
        let set = set.map(|path| format!("the simulator's set in {}", path.display()));
        recordings.chain(set).collect()
    }

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
    /// Name of the file that says which rounds of DAgger on the recording follow. It may be there before a run begins, too.
    pub const DAGGER_NOTE: &str = "dagger.json";
    /// Name of the file that says what the model is worth on its recordings.
    pub const REPLAY: &str = "replay.json";

    /// Checks that a new run can begin in `path`: it must not exist or be empty.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] if there is something in it already, [`Error::Io`] if it cannot be read.
    pub fn require_free(path: &Path) -> Result<()> {
        let may_be_there = [Self::JOB_NOTE, Self::DAGGER_NOTE, LOCK_NAME, checksums::FILE_NAME];
        let taken = |entry: std::io::Result<std::fs::DirEntry>| {
            entry
                .is_ok_and(|e| !may_be_there.iter().any(|name| e.file_name() == *name) && !unfinished::is_left_over(&e))
        };
        if path.exists() && std::fs::read_dir(path).map_err(Error::io(path))?.any(taken) {
            return Err(Error::Usage(format!(
                "{} is not empty and stays as it is; give another folder with --out, or go on with that run: --resume {}",
                path.display(),
                path.display()
            )));
        }
        Ok(())
    }

    /// A new run in `path`, which must not exist or be empty, and the lock of its folder.
    ///
    /// # Errors
    ///
    /// As [`RunFolder::require_free`] and [`RunFolder::lock`]; [`Error::Io`] if it cannot be made.
    pub fn create(path: &Path) -> Result<(RunFolder, RunLock)> {
        RunFolder::require_free(path)?;
        std::fs::create_dir_all(path).map_err(Error::io(path))?;
        let folder = RunFolder { path: path.to_path_buf() };
        let lock = folder.lock()?;
        // Another run may have begun here in between.
        RunFolder::require_free(path)?;
        Ok((folder, lock))
    }

    /// A folder for a copy of a run.
    pub(super) fn at(path: &Path) -> RunFolder {
        RunFolder { path: path.to_path_buf() }
    }

    /// Locks the folder against other processes as long as the lock lives, and removes what killed ones left unfinished.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] if another process has the lock, [`Error::Io`] if the folder cannot be written.
    pub fn lock(&self) -> Result<RunLock> {
        let lock = Lock::try_take(&self.path).map_err(Error::io(&self.path))?.ok_or_else(|| {
            let remedy = "another process works on this run; wait for its end, or stop it";
            Error::Usage(format!("{}: {remedy}", self.path.display()))
        })?;
        unfinished::clean(&self.path);
        Ok(RunLock { _lock: lock })
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

    /// Creates the first of `runs/NAME-1`, `runs/NAME-2`, … that does not exist. Each caller gets a folder of its own, even at
    /// the same moment.
    ///
    /// # Errors
    ///
    /// [`Error::CannotWrite`] and [`Error::Io`] if it cannot be created.
    pub fn create_next(name: &str) -> Result<PathBuf> {
        RunFolder::create_next_in(Path::new("runs"), name)
    }

    fn create_next_in(parent: &Path, name: &str) -> Result<PathBuf> {
        std::fs::create_dir_all(parent).map_err(Error::io(parent))?;
        for n in 1u64.. {
            let path = parent.join(format!("{name}-{n}"));
            match std::fs::create_dir(&path) {
                Ok(()) => return Ok(path),
                Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {}
                Err(error) => return Err(Error::io(&path)(error)),
            }
        }
        unreachable!("a number is free")
    }

    /// How the run was begun.
    ///
    /// # Errors
    ///
    /// [`Error::Io`] and [`Error::Data`] for a damaged folder.
    pub fn info(&self) -> Result<RunInfo> {
        self.read_json("run.json")
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
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
        checksums::read(&self.path, "recipe.toml")?;
        Recipe::find(&self.file("recipe.toml").display().to_string(), &[])
    }

    /// The epochs that are done.
    ///
    /// # Errors
    ///
    /// As [`read_history`].
    pub fn history(&self) -> Result<Vec<EpochRecord>> {
        checksums::read(&self.path, "history.csv")?;
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
        checksums::write(&self.path, name, (text + "\n").as_bytes())
    }

    /// What the model is worth on its recordings, where that was measured.
    ///
    /// # Errors
    ///
    /// [`Error::Io`] and [`Error::Data`].
    pub fn replay(&self) -> Result<Option<RecordingVerdict>> {
        if self.file(Self::REPLAY).is_file() { self.read_json(Self::REPLAY).map(Some) } else { Ok(None) }
    }

    fn read_json<T: DeserializeOwned>(&self, name: &str) -> Result<T> {
        let path = self.file(name);
        let bytes = checksums::read(&self.path, name)?;
        serde_json::from_slice(&bytes).map_err(|e| Error::data_at(&path, e.line() as u64, e.to_string()))
    }

    pub(super) fn write_recipe(&self, recipe: &Recipe) -> Result<()> {
        checksums::write(&self.path, "recipe.toml", recipe.to_toml()?.as_bytes())
    }

    pub(super) fn write_history(&self, history: &[EpochRecord]) -> Result<()> {
        checksums::write(&self.path, "history.csv", &history_csv(&self.file("history.csv"), history)?)
    }

    /// Whether the files of the run have digests; those of earlier versions have none.
    pub fn has_checksums(&self) -> bool {
        checksums::exist(&self.path)
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
    fn callers_at_the_same_moment_get_folders_of_their_own() {
        let scratch = tempfile::tempdir().unwrap();
        let runs = scratch.path().join("runs");
        let mut paths = std::thread::scope(|scope| {
            let create = || (0..25).map(|_| RunFolder::create_next_in(&runs, "a").unwrap()).collect::<Vec<_>>();
            let threads: Vec<_> = (0..4).map(|_| scope.spawn(create)).collect();
            threads.into_iter().flat_map(|thread| thread.join().unwrap()).collect::<Vec<_>>()
        });
        paths.sort();
        paths.dedup();
        assert_eq!(paths.len(), 100);
    }

    #[test]
    fn a_second_process_is_refused_and_left_overs_are_removed() {
        let scratch = tempfile::tempdir().unwrap();
        let path = scratch.path().join("run");
        std::fs::create_dir(&path).unwrap();
        std::fs::write(path.join(".model.safetensors-unfinished-x"), "half").unwrap();
        let (folder, lock) = RunFolder::create(&path).unwrap();
        assert_eq!(std::fs::read_dir(&path).unwrap().count(), 1, "only the lock");
        assert!(folder.lock().unwrap_err().to_string().contains("another process works on this run"));
        drop(lock);
        assert!(folder.lock().is_ok());
    }

    #[test]
    fn what_is_no_run_folder_cannot_be_opened() {
        let folder = tempfile::tempdir().unwrap();
        assert!(RunFolder::open(folder.path()).unwrap_err().to_string().ends_with("it has no run.json"));
    }
}
