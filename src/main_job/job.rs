//! The main job from first to last: record the expert, train, let the model drive and learn from that (DAgger), test.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use steersman_kernels::conv::ConvAlgorithm;

use super::training_set::{self, Take};
use super::{MainJobResult, TRACKS, TrackResult, dagger};

use crate::error::{Error, Result};
use crate::files::checksums;
use crate::files::new_folder::NewFolder;
use crate::geometry::CarGeometry;
use crate::observer::{Observer, Progress, StopSignal};
use crate::pilot::Pilot;
use crate::recipe::Recipe;
use crate::report::charts::map;
use crate::simulator::trial::trajectory::write_trajectories;
use crate::simulator::{DriveOptions, Leg, LegResult, Track, Wheel, drive_legs};
use crate::training::{self, RunFolder, TrainRequest, TrainResult, TrainingEvent, TransferRequest};

/// Where the main job keeps what it records.
pub const RECORDINGS: &str = "data/recordings";

/// The state of the main job in a run folder, from which a stopped run goes on to the end of the job.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JobNote {
    /// Trials of the finished model on each track.
    pub runs: usize,
    /// Number of DAgger rounds: the model drives, the expert labels, and training begins anew on all recordings.
    pub dagger_rounds: u32,
    /// Number of rounds before this run.
    pub round: u32,
}

impl JobNote {
    /// The note in the run folder `folder`; `None` if the run is no part of a main job.
    ///
    /// # Errors
    ///
    /// [`Error::Io`] and [`Error::Data`] for a note that cannot be read.
    pub fn read(folder: &Path) -> Result<Option<JobNote>> {
        let path = folder.join(RunFolder::JOB_NOTE);
        if !path.is_file() {
            return Ok(None);
        }
        let bytes = checksums::read(folder, RunFolder::JOB_NOTE)?;
        serde_json::from_slice(&bytes).map(Some).map_err(|e| Error::data_at(&path, e.line() as u64, e.to_string()))
    }

    fn write(&self, folder: &Path) -> Result<()> {
        std::fs::create_dir_all(folder).map_err(Error::io(folder))?;
        write_json(folder, RunFolder::JOB_NOTE, self)
    }
}

pub(super) fn write_json(folder: &Path, name: &str, value: &impl Serialize) -> Result<()> {
    let text = serde_json::to_string_pretty(value).map_err(|e| Error::data(folder.join(name), e.to_string()))?;
    checksums::write(folder, name, (text + "\n").as_bytes())
}

/// What happens in a main job.
#[derive(Clone, Debug, PartialEq)]
pub enum JobEvent {
    /// Something the user should know.
    Notice(String),
    /// Recording or driving begins: its [`JobEvent::Progress`] follows, then [`JobEvent::End`].
    Begin {
        /// What begins, as in `recording the expert`.
        what: String,
    },
    /// A share of what has begun is done.
    Progress(Progress),
    /// What had begun has ended, well or not.
    End,
    /// Something happens in a training run.
    Training(TrainingEvent),
}

/// Runs `work` between [`JobEvent::Begin`] and [`JobEvent::End`]. Its progress goes to `observer`, and `stop` ends it.
pub(super) fn observed<T>(
    what: String,
    observer: &mut (dyn Observer<JobEvent> + Send),
    stop: &StopSignal,
    work: impl FnOnce(&mut (dyn Observer<Progress> + Send)) -> Result<T>,
) -> Result<T> {
    observer.observe(JobEvent::Begin { what })?;
    let result = work(&mut |progress| {
        observer.observe(JobEvent::Progress(progress))?;
        stop.check()
    });
    let ended = observer.observe(JobEvent::End);
    result.and_then(|value| ended.map(|()| value))
}

/// What a job records and where, and where it drives.
#[derive(Clone, Debug)]
pub struct Scope {
    /// Folder of the training sets.
    pub recordings: PathBuf,
    /// Takes to record and train on.
    pub takes: Vec<Take>,
    /// Tracks to drive.
    pub tracks: Vec<String>,
}

impl Default for Scope {
    /// The whole set under [`RECORDINGS`], all of [`TRACKS`].
    fn default() -> Scope {
        Scope { recordings: RECORDINGS.into(), takes: training_set::takes(), tracks: TRACKS.map(String::from).to_vec() }
    }
}

/// A main job under way. Run it inside a rayon pool.
pub struct Job<'a> {
    scope: Scope,
    note: JobNote,
    observer: &'a mut (dyn Observer<JobEvent> + Send),
    stop: &'a StopSignal,
    profile: bool,
    folder: Option<PathBuf>,
}

/// The request for the first training of a job.
#[derive(Clone, Debug)]
pub struct JobRequest {
    /// The experiment.
    pub recipe: Recipe,
    /// Run folder; must not exist or be empty. Round `k` of DAgger goes to this name with `-dagger-k`.
    pub out: PathBuf,
    /// Seed of all random choices.
    pub seed: u64,
    /// Memory for decoded images in MiB.
    pub cache_mib: usize,
    /// Weights to begin the first training with; rounds of DAgger begin anew.
    pub from: Option<TransferRequest>,
    /// As in [`TrainRequest::algorithm`].
    pub algorithm: Option<ConvAlgorithm>,
}

impl<'a> Job<'a> {
    /// A job that continues from `note`.
    pub fn new(
        scope: Scope,
        note: JobNote,
        observer: &'a mut (dyn Observer<JobEvent> + Send),
        stop: &'a StopSignal,
    ) -> Job<'a> {
        Job { scope, note, observer, stop, profile: false, folder: None }
    }

    /// The same job; with `profile` the results of its training say where the time went.
    pub fn with_profile(self, profile: bool) -> Job<'a> {
        Job { profile, ..self }
    }

    /// The run folder that `train --resume` takes after a stop; `None` as long as nothing was trained.
    pub fn folder(&self) -> Option<&Path> {
        self.folder.as_deref()
    }

    /// Does the job from the beginning.
    ///
    /// # Errors
    ///
    /// As [`training_set::recordings`], [`training::train`] and [`test_on_tracks`]; [`Error::Interrupted`] after a stop.
    pub fn begin(&mut self, request: JobRequest) -> Result<MainJobResult> {
        let JobRequest { recipe, out, seed, cache_mib, from, algorithm } = request;
        RunFolder::require_free(&out)?;
        for round in 1..=self.note.dagger_rounds {
            RunFolder::require_free(&dagger_folder(&out, 0, round)?)?;
        }
        let takes = training_set::labelled(&self.scope.takes, &recipe);
        let recordings = training_set(&self.scope.recordings, &takes, None, self.observer, self.stop)?;
        let profile = self.profile;
        let request = TrainRequest::new(recordings, recipe, out);
        let training = self.train(TrainRequest { seed, cache_mib, from, profile, algorithm, ..request })?;
        self.rest(training)
    }

    /// Goes on with the job whose run lies in `folder`.
    ///
    /// # Errors
    ///
    /// As [`Job::begin`] and [`training::resume`].
    pub fn go_on(&mut self, folder: &Path) -> Result<MainJobResult> {
        self.folder = Some(folder.to_path_buf());
        let training = self.resume(folder)?;
        self.rest(training)
    }

    fn rest(&mut self, mut training: TrainResult) -> Result<MainJobResult> {
        while self.note.round < self.note.dagger_rounds {
            training = self.dagger_round(&training)?;
        }
        let _lock = self.folder.as_ref().map(|folder| RunFolder::open(folder)?.lock()).transpose()?;
        let result = MainJobResult { drives: self.drives(&training.model)?, training };
        if let Some(folder) = &self.folder {
            write_json(folder, "drives.json", &result.drives)?;
        }
        Ok(result)
    }

    fn train(&mut self, request: TrainRequest) -> Result<TrainResult> {
        // The note of another run is not overwritten.
        RunFolder::require_free(&request.out)?;
        self.note.write(&request.out)?;
        let out = request.out.clone();
        let result = training::train(request, &mut |event| self.observer.observe(JobEvent::Training(event)), self.stop);
        // Before `run.json` is there this run cannot be resumed, but the one before it can.
        if RunFolder::open(&out).is_ok() {
            self.folder = Some(out);
        }
        result
    }

    fn resume(&mut self, folder: &Path) -> Result<TrainResult> {
        let mut observer = |event| self.observer.observe(JobEvent::Training(event));
        training::resume(folder, self.profile, &mut observer, self.stop)
    }

    /// The model drives, the expert labels; then training begins anew on all there is.
    fn dagger_round(&mut self, training: &TrainResult) -> Result<TrainResult> {
        let path = self.folder.clone().unwrap_or_default();
        let round = self.note.round + 1;
        let out = dagger_folder(&path, self.note.round, round)?;
        let folder = RunFolder::open(&path)?;
        let (info, recipe) = (folder.info()?, folder.recipe()?);
        let pilot = Pilot::load(&training.model)?;
        let takes = training_set::labelled(&self.scope.takes, &recipe);
        let what = format!("the model drives, the expert labels (round {round})");
        let recorded = observed(what, self.observer, self.stop, |observer| {
            dagger::recordings(&pilot, &takes, &path.join("dagger"), round, observer)
        })?;
        let algorithm = Some(info.conv_algorithm(&folder)?);
        let mut recordings = info.recordings;
        recordings.extend(recorded);
        self.note.round = round;
        if self.is_own(&out, &recordings, info.seed)? {
            self.folder = Some(out.clone());
            return self.resume(&out);
        }
        let (seed, cache_mib, profile) = (info.seed, info.cache_mib, self.profile);
        let request = TrainRequest::new(recordings, recipe, out);
        self.train(TrainRequest { seed, cache_mib, profile, algorithm, ..request })
    }

    /// Whether `out` holds the run of this job's round on `recordings` already, begun before a stop.
    fn is_own(&self, out: &Path, recordings: &[PathBuf], seed: u64) -> Result<bool> {
        let Ok(folder) = RunFolder::open(out) else { return Ok(false) };
        let absolute = |path: &PathBuf| std::path::absolute(path).map_err(Error::io(path));
        let recordings: Vec<PathBuf> = recordings.iter().map(absolute).collect::<Result<_>>()?;
        let info = folder.info()?;
        let noted = JobNote::read(out)?.as_ref() == Some(&self.note);
        Ok(noted && info.seed == seed && info.recordings == recordings)
    }

    /// Drives `model` on every track of the job.
    fn drives(&mut self, model: &Path) -> Result<Vec<TrackResult>> {
        let pilot = Pilot::load(model)?;
        let options = DriveOptions { runs: self.note.runs, ..Default::default() };
        let keep = self.folder.as_ref().map(|folder| folder.join("drives"));
        test_on_tracks(&pilot, &self.scope.tracks, &options, keep.as_deref(), self.observer, self.stop)
    }
}

/// Tests `pilot` on all of `tracks` at once, on all ranks; the results are in their order. The trajectories of a track are saved in a folder
/// of its own below `keep`, if that is given; a folder that this test left there before a stop is kept. Call it inside a rayon pool.
///
/// # Errors
///
/// As [`drive_legs`] and `write_trajectories`; [`Error::Interrupted`] if `stop` is requested.
pub fn test_on_tracks<T: AsRef<str>>(
    pilot: &Pilot,
    tracks: &[T],
    options: &DriveOptions,
    keep: Option<&Path>,
    observer: &mut (dyn Observer<JobEvent> + Send),
    stop: &StopSignal,
) -> Result<Vec<TrackResult>> {
    observed(format!("driving on {} tracks", tracks.len()), observer, stop, |observer| {
        let leg = |name: &T| {
            let track = Arc::new(Track::load(name.as_ref())?);
            Ok(Leg { track, options: options.clone() })
        };
        let legs: Vec<Leg> = tracks.iter().map(leg).collect::<Result<_>>()?;
        let wheel = Wheel::Model(Box::new(pilot.clone()));
        let (results, _) = drive_legs(&wheel, legs.clone(), true, observer)?;
        let result = |(LegResult { drive, offline_mae_deg, complete }, leg): (LegResult, &Leg)| -> Result<_> {
            // What is whole is kept, also after a stop.
            let (Some(drive), Some(offline_mae_deg), true) = (drive, offline_mae_deg, complete) else {
                return Ok(None);
            };
            // Names of random tracks have a colon, which no file's name has everywhere.
            let folder = keep.map(|keep| keep.join(leg.track.name().replace(['/', '\\', ':'], "-")));
            if let Some(folder) = folder.filter(|folder| !folder.exists()) {
                let folder = NewFolder::create(&folder)?;
                map::write(&leg.track, &drive, &folder)?;
                write_trajectories(&drive, folder)?;
            }
            Ok(Some(TrackResult { drive: drive.summary, offline_mae_deg }))
        };
        let results = results.into_iter().zip(&legs).map(result).collect::<Result<Vec<_>>>()?;
        results.into_iter().collect::<Option<_>>().ok_or(Error::Interrupted)
    })
}

/// The recordings of `takes` under `folder`, recorded now as `car`, or as the simulator's own, if they are not there.
///
/// # Errors
///
/// As [`training_set::recordings`].
pub fn training_set(
    folder: &Path,
    takes: &[Take],
    car: Option<&CarGeometry>,
    observer: &mut (dyn Observer<JobEvent> + Send),
    stop: &StopSignal,
) -> Result<Vec<PathBuf>> {
    let (paths, reused) = observed("recording the expert".into(), observer, stop, |observer| {
        training_set::recordings(folder, takes, car, observer)
    })?;
    let verb = if reused { "found" } else { "recorded" };
    let notice = format!("{verb} the training set of {} recordings under {}", paths.len(), folder.display());
    observer.observe(JobEvent::Notice(notice))?;
    Ok(paths)
}

/// The run folder of DAgger's round `round`, where `folder` is that of round `from` (0: the first training).
pub(super) fn dagger_folder(folder: &Path, from: u32, round: u32) -> Result<PathBuf> {
    let name = folder.file_name().map(|name| name.to_string_lossy().into_owned());
    let name = name.ok_or_else(|| Error::Usage(format!("{}: a folder with a name is needed", folder.display())))?;
    let first = name.strip_suffix(&format!("-dagger-{from}")).unwrap_or(&name);
    Ok(folder.with_file_name(format!("{first}-dagger-{round}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounds_of_dagger_are_named_after_the_first_run() {
        let folder = |path: &str, from, round| dagger_folder(Path::new(path), from, round).unwrap();
        assert_eq!(folder("runs/default-1", 0, 1), Path::new("runs/default-1-dagger-1"));
        assert_eq!(folder("runs/default-1-dagger-1", 1, 2), Path::new("runs/default-1-dagger-2"));
        assert!(dagger_folder(Path::new(".."), 0, 1).is_err());
    }

    #[test]
    fn notes_come_back_and_a_broken_one_names_its_line() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(JobNote::read(folder.path()).unwrap(), None);
        let note = JobNote { runs: 3, dagger_rounds: 2, round: 1 };
        note.write(folder.path()).unwrap();
        assert_eq!(JobNote::read(folder.path()).unwrap(), Some(note));
        std::fs::write(folder.path().join(RunFolder::JOB_NOTE), "{\n\"runs\": true}").unwrap();
        let damaged = JobNote::read(folder.path()).unwrap_err().to_string();
        assert!(damaged.contains("checksums.txt"), "{damaged}");
        // A folder of before there were digests.
        std::fs::remove_file(folder.path().join("checksums.txt")).unwrap();
        let error = JobNote::read(folder.path()).unwrap_err().to_string();
        assert!(error.contains("main-job.json:2"), "{error}");
    }
}
