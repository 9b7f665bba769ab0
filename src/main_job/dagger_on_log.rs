//! DAgger (Ross, Gordon and Bagnell 2011) without a simulator: the model drives on the recording it was trained on, and each view
//! it meets is labelled with the steering that leads back to the driven path.

use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

use rayon::prelude::*;

use super::job::{JobEvent, dagger_folder, observed};
use super::on_recording::{judge_run, sides};
use crate::dataset::udacity_writer::{HEADER, picture_name, write_row};
use crate::dataset::{DESCRIPTION_FILE, Description, Unit};
use crate::error::{Error, Result};
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

/// Does `rounds` of DAgger on the recordings of the run in `folder`, which has ended: in each the model drives on the training side,
/// and training goes on from its weights with the views it met, for half as many epochs. Round `k` goes to the folder's name with
/// `-dagger-k`. `request` is that of the first run. Call it inside a rayon pool.
///
/// # Errors
///
/// As [`record_views`], [`training::train`] and [`judge_run`]; the rounds that were done are in `done` all the same.
pub fn rounds(
    folder: &Path,
    rounds: u32,
    request: &TrainRequest,
    observer: &mut (dyn Observer<JobEvent> + Send),
    stop: &StopSignal,
    done: &mut Vec<Round>,
) -> Result<()> {
    let mut request = request.clone();
    request.recipe.epochs = request.recipe.epochs.div_ceil(2);
    for round in 1..=rounds {
        let before = done.last().map_or(folder, |round| &round.folder).to_path_buf();
        let views = folder.join("dagger").join(format!("round-{round}"));
        let what = format!("the model drives on the recording (round {round})");
        let (views, met) =
            observed(what, observer, stop, |observer| record_views(&before, &views, round, observer, stop))?;
        observer
            .observe(JobEvent::Notice(format!("round {round}: training goes on with {met} views the model met")))?;
        request.also.extend(views);
        request.out = dagger_folder(&before, round - 1, round)?;
        request.from = Some(TransferRequest { model: RunFolder::open(&before)?.model(), freeze: Vec::new() });
        let mut of_training = |event| observer.observe(JobEvent::Training(event));
        let training = training::train(request.clone(), &mut of_training, stop)?;
        let verdict = judge_run(&request.out)?;
        done.push(Round { folder: request.out.clone(), training, verdict });
    }
    Ok(())
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
    speed_mph: f32,
}

/// Lets the model of the run in `path` drive on the training side of its recordings, and writes the views it met to the new folder
/// `out` as a recording of round `round` (from 1), with the steering towards the driven path. What another camera saw goes to a folder
/// of its own: `out` with `-camera-2` and so on. Returns the folders and the number of views. Call it inside a rayon pool.
///
/// # Errors
///
/// [`Error::Data`] if nothing of the training side can be driven; pictures that cannot be read, files that cannot be written;
/// [`Error::Interrupted`] if `stop` is requested.
pub fn record_views(
    path: &Path,
    out: &Path,
    round: u32,
    observer: &mut (dyn Observer<Progress> + Send),
    stop: &StopSignal,
) -> Result<(Vec<PathBuf>, usize)> {
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
    let every = (DRIVE_HZ / KEPT_HZ).round() as usize;
    let met = Mutex::new(Vec::new());
    logs.par_iter().enumerate().try_for_each(|(number, log)| {
        let (frames, reached) = (AtomicUsize::new(0), AtomicUsize::new(0));
        let seen = |_: usize, frame: &ReplayFrame| -> Result<()> {
            stop.check()?;
            let along = frame.moment.along_m as usize;
            tally.add(along.saturating_sub(reached.swap(along, Relaxed)))?;
            let index = frames.fetch_add(1, Relaxed);
            let Some(pursuit) = frame.moment.pursuit.filter(|_| index % every == 0) else { return Ok(()) };
            let (jpeg, speed_mph) = (frame.view.to_jpeg(), (frame.moment.speed_mps * MPH_PER_MPS) as f32);
            let view = Met { place: (number, index), jpeg, steering: pursuit as f32, speed_mph };
            met.lock().map_err(|_| Error::Fault("a drive has panicked".into()))?.push(view);
            Ok(())
        };
        let new_driver = || {
            let mut pilot = pilot.clone();
            Ok(move |picture: &RgbImage| pilot.steer(picture.view()))
        };
        let look_ahead = recipe.labels.look_ahead(&log.geometry);
        replay(log, &ReplayOptions { latency_ms: 0.0, look_ahead }, new_driver, &seen).map(drop)
    })?;
    let mut met = met.into_inner().map_err(|_| Error::Fault("a drive has panicked".into()))?;
    met.sort_by_key(|view| view.place);
    let mut cameras: Vec<&CarGeometry> = Vec::new();
    for log in &logs {
        if !cameras.contains(&&log.geometry) {
            cameras.push(&log.geometry);
        }
    }
    let mut folders = Vec::new();
    let mut time_ms = BEGIN_MS + u64::from(round - 1) * ROUND_MS;
    for camera in cameras {
        let of_camera: Vec<&Met> = met.iter().filter(|view| logs[view.place.0].geometry == *camera).collect();
        if of_camera.is_empty() {
            continue;
        }
        let out = match folders.len() {
            0 => out.to_path_buf(),
            others => {
                let mut name = out.as_os_str().to_os_string();
                name.push(format!("-camera-{}", others + 1));
                PathBuf::from(name)
            }
        };
        let new = NewFolder::create(&out)?;
        write(&of_camera, camera, &mut time_ms, new.unfinished()).map_err(|error| new.explain(error))?;
        new.finish()?;
        folders.push(out);
    }
    Ok((folders, met.len()))
}

/// Writes `met`, all seen by `camera`, as a recording into `folder`, with times after `time_ms`. Pieces are sessions of their own.
fn write(met: &[&Met], camera: &CarGeometry, time_ms: &mut u64, folder: &Path) -> Result<()> {
    let said = Description { camera: Some(camera.into()), unit: Some(Unit::Lock), ..Description::default() };
    let file = folder.join(DESCRIPTION_FILE);
    let text = toml::to_string(&said).map_err(|e| Error::Fault(format!("cannot be written as TOML: {e}")))?;
    std::fs::write(&file, text).map_err(Error::io(&file))?;
    let images = folder.join("IMG");
    std::fs::create_dir_all(&images).map_err(Error::io(&images))?;
    let mut log = Vec::from(HEADER);
    let step_ms = (1000.0 / KEPT_HZ) as u64;
    for (number, view) in met.iter().enumerate() {
        let new_piece = number > 0 && met[number - 1].place.0 != view.place.0;
        *time_ms += if new_piece { 60_000 } else { step_ms };
        let name = picture_name("center", *time_ms);
        let file = images.join(&name);
        std::fs::write(&file, &view.jpeg).map_err(Error::io(&file))?;
        let numbers = [view.steering, 1.0, 0.0, view.speed_mph];
        write_row(&mut log, ", ", [&format!("IMG/{name}"), &"", &""], numbers)
            .map_err(|source| Error::Io { path: folder.join("driving_log.csv"), source })?;
    }
    let path = folder.join("driving_log.csv");
    std::fs::write(&path, log).map_err(Error::io(&path))
}
