//! How a run begins, and how it goes on after a stop.

use std::path::{Path, PathBuf};
use std::time::Instant;

use steersman_kernels::Isa;
use steersman_kernels::conv::ConvAlgorithm;

use super::data::{Data, Sources};
use super::profile::Profile;
use super::request::{TrainRequest, TrainResult, TrainingEvent, TransferRequest};
use super::run::TrainingRun;
use super::run_folder::{RunFolder, RunInfo};
use super::together;
use super::transfer::Start;
use crate::dataset::held_out::held_out_tracks;
use crate::error::{Error, Result};
use crate::files::atomic_file;
use crate::observer::{Observer, StopSignal};

/// Trains anew. Call it inside a rayon pool; `stop` and errors of `observer` end it after the current batch.
///
/// # Errors
///
/// [`Error::Data`] and [`Error::Io`] for recordings that cannot be used, [`Error::Usage`] for a folder that is not empty or
/// a run that diverges, [`Error::Interrupted`] after saving if `stop` is requested; the observer's own.
pub fn train(
    request: TrainRequest,
    observer: &mut dyn Observer<TrainingEvent>,
    stop: &StopSignal,
) -> Result<TrainResult> {
    let started = Instant::now();
    let TrainRequest {
        recordings,
        validate,
        also,
        simulator,
        said,
        recipe,
        out,
        seed,
        cache_mib,
        from,
        algorithm,
        profile,
    } = request;
    let profile = profile.then(Profile::start);
    let algorithm = algorithm.unwrap_or_else(ConvAlgorithm::of_environment);
    let start = from.as_ref().map(|from| Start::load(&from.model, from, &recipe, seed)).transpose()?;
    let sources = Sources { paths: &recordings, validate: &validate, also: &also, simulator: &simulator };
    let data = Data::prepare(sources, &said, &recipe, seed, cache_mib)?;
    let mut trained_on_held_out = held_out_tracks(&recordings)?;
    for track in start.iter().flat_map(|start| &start.trained_on_held_out) {
        if !trained_on_held_out.contains(track) {
            trained_on_held_out.push(track.clone());
        }
    }
    let (folder, lock) = RunFolder::create(&out)?;
    folder.write_recipe(&recipe)?;
    let absolute = |path: &PathBuf| std::path::absolute(path).map_err(Error::io(path));
    let info = RunInfo {
        version: env!("CARGO_PKG_VERSION").into(),
        isa: Isa::best().name().into(),
        algorithm: (algorithm != ConvAlgorithm::Auto).then(|| algorithm.to_string()),
        seed,
        recordings: recordings.iter().map(absolute).collect::<Result<_>>()?,
        validate: validate.iter().map(absolute).collect::<Result<_>>()?,
        also: also.iter().map(absolute).collect::<Result<_>>()?,
        simulator: simulator.iter().map(absolute).collect::<Result<_>>()?,
        cache_mib,
        said,
        rows_hash: data.rows_hash(),
        pictures_hash: data.pictures_hash(),
        transfer: start.as_ref().map(|start| start.transfer.clone()),
        trained_on_held_out,
    };
    if let Some(from) = &from {
        let bytes = std::fs::read(&from.model).map_err(Error::io(&from.model))?;
        atomic_file::write(&folder.from(), &bytes)?;
    }
    data.write_split(&folder.file("split.csv"))?;
    folder.write_json("run.json", &info)?;
    // The other ranks look for the recordings where the user said, which may be another folder there.
    let given = RunInfo { recordings, validate, also, simulator, ..info.clone() };
    let mut run = TrainingRun::new((folder, Some(lock)), info, recipe, data, start, started)?.measured(profile);
    let _claim = together::invite(&mut run, &given)?;
    run.run(observer, stop)
}

/// Goes on with the run in `path`, as if it had never stopped; returns the result again if it is finished. With `profile` the
/// result says where the time went.
///
/// # Errors
///
/// As [`train`]; [`Error::Data`] also for damaged run folders and recordings that have changed.
pub fn resume(
    path: &Path,
    profile: bool,
    observer: &mut dyn Observer<TrainingEvent>,
    stop: &StopSignal,
) -> Result<TrainResult> {
    resume_with(path, None, profile, observer, stop)
}

/// As [`resume`], with the recordings of the run, in their order, where they are now: `moved`.
///
/// # Errors
///
/// As [`resume`]; [`Error::Usage`] if their number is another.
pub fn resume_with(
    path: &Path,
    moved: Option<&[PathBuf]>,
    profile: bool,
    observer: &mut dyn Observer<TrainingEvent>,
    stop: &StopSignal,
) -> Result<TrainResult> {
    let started = Instant::now();
    let profile = profile.then(Profile::start);
    let folder = RunFolder::open(path)?;
    let lock = folder.lock()?;
    if !folder.has_checksums() {
        let notice =
            "this run was begun by an earlier version and has no checksums: damage to its files may go unnoticed";
        observer.observe(TrainingEvent::Notice(notice.into()))?;
    }
    if let Some(result) = folder.result()? {
        observer.observe(TrainingEvent::Notice("this run is finished; here is its result again".into()))?;
        return Ok(TrainResult { model: folder.model(), ..result });
    }
    let mut info = folder.info()?;
    if let Some(moved) = moved {
        let training = info.recordings.len();
        let (driven, needed) = (training + info.validate.len(), training + info.validate.len() + info.also.len());
        if moved.len() != needed {
            let found = moved.len();
            return Err(Error::Usage(format!(
                "the run has {needed} recordings, --recordings names {found}: name all, in their order"
            )));
        }
        let absolute = |path: &PathBuf| std::path::absolute(path).map_err(Error::io(path));
        info.recordings = moved[..training].iter().map(absolute).collect::<Result<_>>()?;
        info.validate = moved[training..driven].iter().map(absolute).collect::<Result<_>>()?;
        info.also = moved[driven..].iter().map(absolute).collect::<Result<_>>()?;
    }
    let recipe = folder.recipe()?;
    let isa = Isa::best().name();
    if info.isa != isa {
        observer.observe(TrainingEvent::Notice(format!(
            "the run began with {} vector code and goes on with {isa}: the last bits will differ; STEERSMAN_ISA={} \
             keeps them, where the machine has it",
            info.isa, info.isa
        )))?;
    }
    if let Some(gone) =
        info.recordings.iter().chain(&info.validate).chain(&info.also).find(|path| moved.is_none() && !path.exists())
    {
        let message = "the recording is not there any more; if it was moved, say where it is with --recordings";
        return Err(Error::data(gone, message));
    }
    if let Some(gone) = info.simulator.iter().find(|path| !path.exists()) {
        let message = "this recording of the simulator's set is not there any more, and the run can only go on with it; any \
                       `train RECORDING --with-simulator` in the same folder records it again";
        return Err(Error::data(gone, message));
    }
    let data = Data::of_run(&info, &recipe, info.cache_mib)?;
    if data.rows_hash() != info.rows_hash {
        let message = "the recordings have changed since the run began; it can only go on with the same rows";
        return Err(Error::data(folder.file("run.json"), message));
    }
    // Runs of older versions have no such hash.
    let pictures_hash = data.pictures_hash();
    if !info.pictures_hash.is_empty() && pictures_hash != info.pictures_hash {
        let message =
            "pictures of the recordings have changed since the run began; it can only go on with the same pictures";
        return Err(Error::data(folder.file("run.json"), message));
    }
    if moved.is_some() {
        folder.write_json("run.json", &info)?;
    }
    let from = info.transfer.as_ref().map(TransferRequest::of);
    let start = from.map(|from| Start::load(&folder.from(), &from, &recipe, info.seed)).transpose()?;
    // Runs of older versions have no hash of the pictures.
    let given = RunInfo { pictures_hash, ..info.clone() };
    let mut run = TrainingRun::new((folder, Some(lock)), info, recipe, data, start, started)?.measured(profile);
    run.restore()?;
    let _claim = together::invite(&mut run, &given)?;
    run.run(observer, stop)
}
