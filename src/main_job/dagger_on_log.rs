//! DAgger (Ross, Gordon and Bagnell 2011) without a simulator: the model drives on the recording it was trained on, and each view
//! it meets is labelled with the steering that leads back to the driven path.

use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::job::{JobEvent, dagger_folder, observed, write_json};
use super::on_recording::{judge_run, sides};
use crate::dataset::udacity_writer::{HEADER, picture_name, write_row};
use crate::dataset::{self, DESCRIPTION_FILE, Description, OutputKind, Unit};
use crate::error::{Error, Result};
use crate::files::checksums;
use crate::files::new_folder::NewFolder;
use crate::geometry::{CarGeometry, MPH_PER_MPS};
use crate::observer::{Observer, Progress, StopSignal, Tally};
use crate::picture::RgbImage;
use crate::pilot::Pilot;
use crate::replay::{DRIVE_HZ, RecordingVerdict, ReplayFrame, ReplayOptions, pieces, replay};
use crate::training::{self, Data, RunFolder, TrainRequest, TrainResult, TransferRequest};

/// Views a second that are kept.
const KEPT_HZ: f64 = 5.0;
/// Noon of 1 January 2026, UTC, where the times in names of the first round's pictures begin: ms since 1970.
const BEGIN_MS: u64 = 1_767_268_800_000;
/// Time from round to round there, so that pictures of different rounds have different names.
const ROUND_MS: u64 = 365 * 86_400_000;

/// A training run and what its model is worth on the recordings.
#[derive(Debug)]
pub struct Round {
    /// Its run folder.
    pub folder: PathBuf,
    /// What the training came to.
    pub training: TrainResult,
    /// What the model is worth.
    pub verdict: RecordingVerdict,
}

/// What follows on a training of `train RECORDING --dagger`; a note in its run folder, from which a stopped run goes on to the end.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DaggerNote {
    /// Rounds that were asked for.
    pub rounds: u32,
    /// Number of this round; 0 for the first training.
    pub round: u32,
}

impl DaggerNote {
    /// The note in the run folder `folder`; `None` if no round follows on its run.
    ///
    /// # Errors
    ///
    /// [`Error::Io`] and [`Error::Data`] for a note that cannot be read.
    pub fn read(folder: &Path) -> Result<Option<DaggerNote>> {
        let path = folder.join(RunFolder::DAGGER_NOTE);
        if !path.is_file() {
            return Ok(None);
        }
        let bytes = checksums::read(folder, RunFolder::DAGGER_NOTE)?;
        serde_json::from_slice(&bytes).map(Some).map_err(|e| Error::data_at(&path, e.line() as u64, e.to_string()))
    }

    /// Writes the note into `folder`, which is made if it is not there, before its training begins.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] if there is another run in it, [`Error::Io`] if it cannot be written.
    pub fn write(&self, folder: &Path) -> Result<()> {
        RunFolder::require_free(folder)?;
        std::fs::create_dir_all(folder).map_err(Error::io(folder))?;
        write_json(folder, RunFolder::DAGGER_NOTE, self)
    }

    /// Takes the note back if the training in `folder` has not begun.
    pub fn take_back(folder: &Path) {
        if RunFolder::open(folder).is_err() {
            for name in [RunFolder::DAGGER_NOTE, checksums::FILE_NAME] {
                // The error of the training is what matters.
                let _ = std::fs::remove_file(folder.join(name));
            }
            // A folder with something else in it stays.
            let _ = std::fs::remove_dir(folder);
        }
    }

    /// The run folder of round `round` (0: the first training), where `folder` is that of this note.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] if `folder` has no name.
    pub fn folder(&self, folder: &Path, round: u32) -> Result<PathBuf> {
        match round {
            _ if round == self.round => Ok(folder.to_path_buf()),
            0 => {
                let next = dagger_folder(folder, self.round, 1)?;
                let name = next.file_name().unwrap_or_default().to_string_lossy().into_owned();
                Ok(next.with_file_name(name.strip_suffix("-dagger-1").unwrap_or(&name)))
            }
            _ => dagger_folder(folder, self.round, round),
        }
    }
}

/// Does the rounds of DAgger that `note` asks for on the recordings of the run in `at`, which has ended: in each the model drives on
/// the training side, and training goes on from its weights with the views it met, for half as many epochs as the first one took. Round
/// `k` goes to the first folder's name with `-dagger-k`; what a stopped round left there is gone on with. With `profile` results say
/// where the time went. `at` becomes the folder that `train --resume` takes after a stop. Call it inside a rayon pool.
///
/// # Errors
///
/// As [`record_views`], [`training::train`] and [`judge_run`]; the rounds that were done are in `done` all the same.
pub fn rounds(
    note: &DaggerNote,
    profile: bool,
    observer: &mut (dyn Observer<JobEvent> + Send),
    stop: &StopSignal,
    at: &mut PathBuf,
    done: &mut Vec<Round>,
) -> Result<()> {
    let first = note.folder(at, 0)?;
    for round in note.round + 1..=note.rounds {
        let before = RunFolder::open(at)?;
        let (info, mut recipe) = (before.info()?, before.recipe()?);
        if round == 1 {
            recipe.epochs = recipe.epochs.div_ceil(2);
        }
        let views = first.join("dagger").join(format!("round-{round}"));
        let what = format!("the model drives on the recording (round {round})");
        let views = observed(what, observer, stop, |observer| record_views(at, &views, round, observer, stop))?;
        for notice in views.notices(round) {
            observer.observe(JobEvent::Notice(notice))?;
        }
        let request = TrainRequest {
            algorithm: Some(info.conv_algorithm(&before)?),
            recordings: info.recordings,
            validate: info.validate,
            also: [info.also, views.folders].concat(),
            simulator: info.simulator,
            said: info.said,
            recipe,
            out: dagger_folder(at, round - 1, round)?,
            seed: info.seed,
            cache_mib: info.cache_mib,
            from: Some(TransferRequest { model: before.model(), freeze: Vec::new() }),
            profile,
        };
        let (out, noted) = (request.out.clone(), DaggerNote { round, ..note.clone() });
        let mut of_training = |event| observer.observe(JobEvent::Training(event));
        let training = if is_begun(&out, &request, &noted)? {
            at.clone_from(&out);
            training::resume(&out, profile, &mut of_training, stop)
        } else {
            noted.write(&out)?;
            let training = training::train(request, &mut of_training, stop);
            // Before `run.json` is there this run cannot be resumed, but the one before it can.
            match RunFolder::open(&out) {
                Ok(_) => at.clone_from(&out),
                Err(_) => DaggerNote::take_back(&out),
            }
            training
        }?;
        let verdict = judge_run(&out, stop)?;
        done.push(Round { folder: out, training, verdict });
    }
    Ok(())
}

/// Whether `out` holds the run of `request` with the note `noted` already, begun before a stop.
fn is_begun(out: &Path, request: &TrainRequest, noted: &DaggerNote) -> Result<bool> {
    let Ok(folder) = RunFolder::open(out) else { return Ok(false) };
    if DaggerNote::read(out)?.as_ref() != Some(noted) {
        return Ok(false);
    }
    let info = folder.info()?;
    let absolute = |path: &PathBuf| std::path::absolute(path).map_err(Error::io(path));
    let also: Vec<PathBuf> = request.also.iter().map(absolute).collect::<Result<_>>()?;
    Ok(info.seed == request.seed && info.recordings == request.recordings && info.also == also)
}

/// Checks that round `round` of the run in `folder` can be written.
///
/// # Errors
///
/// [`Error::Usage`] if there is something in its folder already.
pub fn require_free(folder: &Path, round: u32) -> Result<()> {
    RunFolder::require_free(&dagger_folder(folder, 0, round)?)
}

/// A view that the model met.
struct Met {
    /// Number of the piece, and of the frame in it.
    place: (usize, usize),
    jpeg: Vec<u8>,
    steering: f32,
    /// Throttle and brake of the row whose picture was shown, where a label is made of them.
    pedals: [f32; 2],
    speed_mph: f32,
}

/// The views of a round.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Views {
    /// The recordings that hold them.
    pub folders: Vec<PathBuf>,
    /// Their number.
    pub met: usize,
    /// Why a picture could not be read, for each frame that was left out for that.
    pub unreadable: Vec<String>,
}

impl Views {
    fn notices(&self, round: u32) -> Vec<String> {
        let mut notices = vec![format!("round {round}: training goes on with {} views the model met", self.met)];
        if let Some(first) = self.unreadable.first() {
            let frames = self.unreadable.len();
            let what = "frames have no picture that can be read; they are left out, and the wheel stays as it was";
            notices.push(format!("round {round}: {frames} {what}: {first}"));
        }
        notices
    }
}

/// The recordings of a round's views that were made before a stop: `out`, which is written last, and the others beside it.
fn found(out: &Path) -> Result<Option<Views>> {
    let all: Vec<PathBuf> = (1..).map(|camera| of_camera(out, camera)).take_while(|path| path.exists()).collect();
    if out.exists() {
        let rows = |path: &PathBuf| dataset::load(path).map(|recording| recording.rows.len());
        let met = all.iter().map(rows).sum::<Result<usize>>()?;
        return Ok(Some(Views { folders: all, met, unreadable: Vec::new() }));
    }
    // Those of a round that was stopped between two folders are not whole.
    for path in (2..).map(|camera| of_camera(out, camera)).take_while(|path| path.exists()) {
        std::fs::remove_dir_all(&path).map_err(Error::io(&path))?;
    }
    Ok(None)
}

/// The folder for views of camera number `camera` (from 1).
fn of_camera(out: &Path, camera: usize) -> PathBuf {
    let mut name = out.as_os_str().to_os_string();
    if camera > 1 {
        name.push(format!("-camera-{camera}"));
    }
    PathBuf::from(name)
}

/// Lets the model of the run in `path` drive on the training side of its recordings, and writes the views it met to the folder `out`
/// as a recording of round `round` (from 1), with the steering towards the driven path, the speed that was driven there, and for a recipe
/// that learns it the throttle of the row whose picture is shown; a view of a row without one is left out. What another camera saw goes
/// to a folder of its own: `out` with `-camera-2` and so on. Nothing is driven if `out` is there already. Frames whose picture cannot be
/// read are left out. Call it inside a rayon pool.
///
/// # Errors
///
/// [`Error::Data`] if nothing of the training side can be driven, or none of its pictures can be read; files that cannot be written;
/// [`Error::Interrupted`] if `stop` is requested.
pub fn record_views(
    path: &Path,
    out: &Path,
    round: u32,
    observer: &mut (dyn Observer<Progress> + Send),
    stop: &StopSignal,
) -> Result<Views> {
    if let Some(views) = found(out)? {
        return Ok(views);
    }
    let folder = RunFolder::open(path)?;
    let (info, recipe) = (folder.info()?, folder.recipe()?);
    let pilot = Pilot::load(&folder.model())?;
    let data = Data::of_run(&info, &recipe, 0)?;
    let sides = sides(&data);
    let other: Vec<(usize, usize)> = sides[1..].iter().flat_map(|side| side.rows.iter().copied()).collect();
    let logs = pieces(data.driven(), &sides[0], &other);
    if logs.is_empty() {
        let message =
            "no stretch of the training side is 20 m long, so the model cannot drive on it; --dagger needs one".into();
        return Err(Error::Data { place: "the recordings".into(), message });
    }
    let meters = logs.iter().map(|log| log.sessions[0].path.length_m() as usize + 1).sum();
    let tally = Tally::new(meters, observer);
    let learns_throttle = recipe.outputs.index(OutputKind::Throttle).is_some();
    let every = (DRIVE_HZ / KEPT_HZ).round() as usize;
    let met = Mutex::new(Vec::new());
    let drives = logs.par_iter().enumerate().map(|(number, log)| {
        let (frames, reached) = (AtomicUsize::new(0), AtomicUsize::new(0));
        let seen = |_: usize, frame: &ReplayFrame| -> Result<()> {
            stop.check()?;
            let along = frame.moment.along_m as usize;
            tally.add(along.saturating_sub(reached.swap(along, Relaxed)))?;
            let index = frames.fetch_add(1, Relaxed);
            let Some(pursuit) = frame.moment.pursuit.filter(|_| index % every == 0) else { return Ok(()) };
            let (jpeg, speed_mph) = (frame.view.to_jpeg(), (frame.moment.speed_mps * MPH_PER_MPS) as f32);
            let row = &log.recording.rows[frame.moment.row];
            let pedals = match learns_throttle {
                true if row.throttle.is_nan() => return Ok(()),
                true => [row.throttle, if row.brake.is_nan() { 0.0 } else { row.brake }],
                false => [1.0, 0.0],
            };
            let view = Met { place: (number, index), jpeg, steering: pursuit as f32, pedals, speed_mph };
            met.lock().map_err(|_| Error::Fault("a drive has panicked".into()))?.push(view);
            Ok(())
        };
        let new_driver = || {
            let mut pilot = pilot.clone();
            Ok(move |picture: &RgbImage| pilot.steer(picture.view()))
        };
        let look_ahead = recipe.labels.look_ahead(&log.geometry);
        let options = ReplayOptions { latency_ms: 0.0, look_ahead, leave_out_unreadable: true };
        let runs = replay(log, &options, new_driver, &seen)?;
        Ok(runs.into_iter().flat_map(|run| run.unreadable).collect::<Vec<String>>())
    });
    let unreadable = drives.collect::<Result<Vec<_>>>()?.concat();
    let mut met = met.into_inner().map_err(|_| Error::Fault("a drive has panicked".into()))?;
    met.sort_by_key(|view| view.place);
    if let (true, Some(first)) = (met.is_empty(), unreadable.first()) {
        let message = format!("no picture of the training side can be read, so the model cannot drive on it: {first}");
        return Err(Error::Data { place: "the recordings".into(), message });
    }
    let mut cameras: Vec<&CarGeometry> = Vec::new();
    for log in &logs {
        if !cameras.contains(&&log.geometry) {
            cameras.push(&log.geometry);
        }
    }
    // The first camera is written last: its folder says that all are there.
    let mut time_ms = BEGIN_MS + u64::from(round - 1) * ROUND_MS;
    let of_cameras = cameras
        .iter()
        .map(|camera| -> Vec<&Met> { met.iter().filter(|view| logs[view.place.0].geometry == **camera).collect() });
    let of_cameras: Vec<Vec<&Met>> = of_cameras.filter(|met| !met.is_empty()).collect();
    let folders: Vec<PathBuf> = (1..=of_cameras.len()).map(|camera| of_camera(out, camera)).collect();
    let mut news = Vec::new();
    for (of_camera, folder) in of_cameras.iter().zip(&folders) {
        let new = NewFolder::create(folder)?;
        let camera = &logs[of_camera[0].place.0].geometry;
        write(of_camera, camera, &mut time_ms, new.unfinished()).map_err(|error| new.explain(error))?;
        news.push(new);
    }
    news.into_iter().rev().try_for_each(NewFolder::finish)?;
    Ok(Views { folders, met: met.len(), unreadable })
}

/// Writes `met`, all seen by `camera`, as a recording into `folder`, with times after `time_ms`. Pieces are sessions of their own.
fn write(met: &[&Met], camera: &CarGeometry, time_ms: &mut u64, folder: &Path) -> Result<()> {
    let said = Description { camera: Some(camera.into()), unit: Some(Unit::Lock), ..Description::default() };
    let file = folder.join(DESCRIPTION_FILE);
    std::fs::write(&file, said.to_toml()?).map_err(Error::io(&file))?;
    let images = folder.join("IMG");
    std::fs::create_dir_all(&images).map_err(Error::io(&images))?;
    let mut log = Vec::from(HEADER);
    for (number, view) in met.iter().enumerate() {
        let before = number.checked_sub(1).map(|before| met[before].place).filter(|place| place.0 == view.place.0);
        // Between two views of a piece lie as many frames as were driven, kept or not.
        *time_ms += match before {
            Some(place) => ((view.place.1 - place.1) as f64 * 1000.0 / DRIVE_HZ) as u64,
            None => 60_000,
        };
        let name = picture_name("center", *time_ms);
        let file = images.join(&name);
        std::fs::write(&file, &view.jpeg).map_err(Error::io(&file))?;
        let numbers = [view.steering, view.pedals[0], view.pedals[1], view.speed_mph];
        write_row(&mut log, ", ", [&format!("IMG/{name}"), &"", &""], numbers)
            .map_err(|source| Error::Io { path: folder.join("driving_log.csv"), source })?;
    }
    let path = folder.join("driving_log.csv");
    std::fs::write(&path, log).map_err(Error::io(&path))
}
