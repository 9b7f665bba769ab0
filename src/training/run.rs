//! A training run from recordings to model files, and how it goes on after a stop.

use std::path::{Path, PathBuf};
use std::time::Instant;

use ndarray::ArrayView1;
use serde::{Deserialize, Serialize};
use steersman_kernels::conv::ConvAlgorithm;
use steersman_kernels::{Backend, Isa};

use super::averaged;
use super::checkpoint::{Progress, State};
use super::data::{Data, Sources, images};
use super::history::EpochRecord;
use super::profile::{Profile, ProfileReport};
use super::run_folder::{RunFolder, RunInfo, RunLock};
use super::transfer::{Start, TransferRequest};
use super::validation::{Validation, ValidationResult};
use crate::dataset::Description;
use crate::dataset::held_out::held_out_tracks;
use crate::dataset::loader::{Batch, Loader};
use crate::engine::loss::{PairTerms, Smoothness};
use crate::engine::network::{Network, PAIRS_CAPACITY, Parameters, StepInput, TrainingPlan};
use crate::engine::optimizer::{Optimizer, WeightAverage};
use crate::engine::stopwatch::Stopwatch;
use crate::error::{Error, Result};
use crate::files::atomic_file;
use crate::files::limits::keep_elsewhere;
use crate::model_file::{Model, TrainingRecord, weights_hash};
use crate::observer::{Observer, StopSignal};
use crate::recipe::{Keep, KeepBy, Recipe};

/// Maximum of images of one row: three cameras, each mirrored. A batch of whole rows has at least one row.
const MAX_ROW_IMAGES: usize = 6;

/// What to train on, and how.
#[derive(Clone, Debug)]
pub struct TrainRequest {
    /// Udacity logs or donkeycar tubs.
    pub recordings: Vec<PathBuf>,
    /// Recordings that are the validation side, whole; without any, a share of the rows of the others is.
    pub validate: Vec<PathBuf>,
    /// Views that a model met, recordings too, which are always trained on.
    pub also: Vec<PathBuf>,
    /// The simulator's set, of which each epoch draws the share that the recipe says; see
    /// [`simulator_share`](crate::dataset::SampleSpec::simulator_share).
    pub simulator: Vec<PathBuf>,
    /// What the user says about the recordings.
    pub said: Description,
    /// The experiment.
    pub recipe: Recipe,
    /// Run folder; must not exist or be empty.
    pub out: PathBuf,
    /// Seed of all random choices.
    pub seed: u64,
    /// Memory for decoded images in MiB; what does not fit goes to a temporary file.
    pub cache_mib: usize,
    /// A model to begin from instead of fresh weights.
    pub from: Option<TransferRequest>,
    /// How convolutions are computed; `None` for [`ConvAlgorithm::of_environment`].
    pub algorithm: Option<ConvAlgorithm>,
    /// Whether the result says where the time went.
    pub profile: bool,
}

/// What happens in a run.
#[derive(Clone, Debug, PartialEq)]
pub enum TrainingEvent {
    /// A run begins, or goes on.
    Begin {
        /// Its folder.
        folder: PathBuf,
    },
    /// Something the user should know.
    Notice(String),
    /// A batch is done.
    Batch {
        /// Number of its epoch, from 1.
        epoch: u32,
        /// Epochs in all, unless the run stops early.
        epochs: u32,
        /// Images of the epoch that are done.
        images: usize,
        /// Images of the epoch in all.
        of: usize,
        /// Mean loss of the batch.
        loss: f64,
    },
    /// An epoch is done.
    Epoch {
        /// Its figures.
        record: EpochRecord,
        /// Epochs in all.
        of: u32,
    },
}

/// The result of a run; `train --json` prints it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainResult {
    /// Path of the model: the weights of the best epoch, or of the last one if the recipe keeps that.
    pub model: PathBuf,
    /// Epochs done.
    pub epochs: u32,
    /// The epoch of the model, from 1; "best" below is this one.
    pub best_epoch: u32,
    /// Mean loss over the last epoch's training batches.
    pub train_mse: f64,
    /// Of the best epoch: mean squared error over all validation images.
    pub val_mse: Option<f64>,
    /// Of the best epoch: the same over the centre camera's images.
    pub val_center_mse: Option<f64>,
    /// Of the best epoch: mean absolute error over the centre camera's images, in degrees of the front wheels.
    pub val_mae_deg: Option<f64>,
    /// Of the best epoch: `val_center_mse` ÷ mean squared label.
    pub relative_to_zero: Option<f64>,
    /// Of the best epoch: mean absolute error of the throttle over the centre camera's images, of networks that give one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub val_throttle_mae: Option<f64>,
    /// The same of the speed, mph.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub val_speed_mae_mph: Option<f64>,
    /// Training images an epoch.
    pub train_images: usize,
    /// Those of them that are the simulator's.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub simulator_images: usize,
    /// Validation images.
    pub val_images: usize,
    /// Wall time of the run, interruptions left out.
    pub seconds: f64,
    /// Training images a second while training, validation left out.
    pub images_per_second: f64,
    /// How convolutions were computed, if not by the default algorithms: `im2col`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub algorithm: Option<String>,
    /// Over all tensors of the last model.
    pub weights_hash: String,
    /// Share of validation frames with a training frame of the same session within a second, in percent.
    pub leak_percent: f64,
    /// Share of validation frames of the centre camera that look the same as a training frame, in percent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub near_twin_percent: Option<f64>,
    /// Held-out tracks that were trained on all the same, here or by the model that training began from.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub trained_on_held_out: Vec<String>,
    /// Where the time went, if that was asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub profile: Option<ProfileReport>,
}

fn is_zero(number: &usize) -> bool {
    *number == 0
}

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
    let run = TrainingRun::new((folder, lock), info, recipe, data, start, started)?;
    run.measured(profile).run(observer, stop)
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
    if !info.pictures_hash.is_empty() && data.pictures_hash() != info.pictures_hash {
        let message =
            "pictures of the recordings have changed since the run began; it can only go on with the same pictures";
        return Err(Error::data(folder.file("run.json"), message));
    }
    if moved.is_some() {
        folder.write_json("run.json", &info)?;
    }
    let from = info.transfer.as_ref().map(TransferRequest::of);
    let start = from.map(|from| Start::load(&folder.from(), &from, &recipe, info.seed)).transpose()?;
    let mut run = TrainingRun::new((folder, lock), info, recipe, data, start, started)?;
    run.restore()?;
    run.measured(profile).run(observer, stop)
}

struct TrainingRun {
    folder: RunFolder,
    /// Held until the end of the run.
    _lock: RunLock,
    info: RunInfo,
    recipe: Recipe,
    network: Network,
    plan: TrainingPlan,
    training: Loader,
    /// The terms of the loss for pairs, if the recipe has any.
    smoothness: Option<Smoothness>,
    training_rows: Vec<u64>,
    validation: Option<Validation>,
    leak_percent: f64,
    notices: Vec<String>,
    state: State,
    started: Instant,
    profile: Option<Profile>,
}

impl TrainingRun {
    fn new(
        (folder, lock): (RunFolder, RunLock),
        info: RunInfo,
        recipe: Recipe,
        data: Data,
        start: Option<Start>,
        started: Instant,
    ) -> Result<TrainingRun> {
        let mut network = recipe.network(Backend { isa: Isa::best(), conv: info.conv_algorithm(&folder)? })?;
        if let Some(start) = &start {
            network.freeze(&start.transfer.frozen)?;
        }
        let optimizer = Optimizer::new(recipe.optimizer, recipe.clip_gradient_norm, network.tensors(), network.isa());
        let (leak_percent, mut training_rows) = (data.leak_percent(), data.training_row_ids());
        let mut notices = data.notices().to_vec();
        let parameters = match start {
            Some(start) => {
                notices.extend(start.notices(&recipe, &data));
                training_rows.extend(start.rows);
                training_rows.sort_unstable();
                training_rows.dedup();
                start.parameters
            }
            None => network.initialize(info.seed),
        };
        let path_labels = match recipe.keep_by {
            KeepBy::Loss => Vec::new(),
            KeepBy::Path => data.path_labels()?,
        };
        let (mut training, validation) = data.into_loaders()?;
        let smoothness = recipe.smoothness.filter(|smoothness| !smoothness.is_off());
        if let Some(smoothness) = &smoothness {
            let (neighbours, images) = (training.pair_up(smoothness), training.images());
            if smoothness.temporal > 0.0 && neighbours * 2 < images {
                notices.push(format!(
                    "[smoothness] temporal: {neighbours} of {images} training images have a neighbour within 0.25 s"
                ));
            }
        }
        // No batch is larger than a side has samples, whatever the recipe asks for.
        let most = training.samples().max(validation.as_ref().map_or(0, Loader::samples));
        let capacity = recipe.batch.min(most).max(MAX_ROW_IMAGES);
        let plan_capacity = match smoothness {
            // Each sample may bring a partner.
            Some(_) => recipe.batch.min(2 * most).max(capacity).next_multiple_of(PAIRS_CAPACITY),
            None => capacity,
        };
        let plan = TrainingPlan::new(&network, plan_capacity);
        Ok(TrainingRun {
            plan: match recipe.outputs.loss_weights() {
                None => plan,
                Some(weights) => plan.with_output_weights(&weights),
            },
            smoothness,
            validation: validation
                .map(|loader| Validation::new(loader, &network, capacity, &recipe).with_path_labels(path_labels)),
            state: State {
                average: recipe.averaging.map(|spec| WeightAverage::new(spec, &parameters, network.isa())),
                parameters,
                optimizer,
                best: None,
                progress: Progress::default(),
            },
            folder,
            _lock: lock,
            info,
            recipe,
            network,
            training,
            training_rows,
            leak_percent,
            notices,
            started,
            profile: None,
        })
    }

    /// The run, with `profile` measuring what it does from now on.
    fn measured(mut self, profile: Option<Profile>) -> TrainingRun {
        if let Some(profile) = &profile {
            self.training.measure(&profile.loading);
            self.plan.measure(profile.update.clone());
            self.state.optimizer.measure(profile.update.clone());
            if let Some(validation) = &mut self.validation {
                validation.measure(&profile.loading, profile.evaluation.clone());
            }
        }
        TrainingRun { profile, ..self }
    }

    /// Restores the state of the last checkpoint, if there is one.
    fn restore(&mut self) -> Result<()> {
        let path = self.folder.file("checkpoint.safetensors");
        if path.is_file() {
            let (optimizer, average) = (self.state.optimizer.clone(), self.state.average.clone());
            self.state = State::load(&path, &self.network, optimizer, average)?;
        }
        Ok(())
    }

    fn run(mut self, observer: &mut dyn Observer<TrainingEvent>, stop: &StopSignal) -> Result<TrainResult> {
        observer.observe(TrainingEvent::Begin { folder: self.folder.path().into() })?;
        for notice in &self.notices {
            observer.observe(TrainingEvent::Notice(notice.clone()))?;
        }
        let seconds_before = self.state.progress.seconds;
        let mut images_unreported = true;
        let mut batches = [Batch::default(), Batch::default()];
        while self.state.progress.epoch < self.recipe.epochs && !self.stop_early() {
            let epoch_started = Instant::now();
            // In the first whole epoch of this process every image is decoded.
            let whole = self.state.progress.next_batch == 0;
            self.train_epoch(&mut batches, observer, stop, seconds_before)?;
            if self.state.progress.images == 0 {
                let examples = self.training.undecodable().1.join("; ");
                return Err(Error::Data {
                    place: "the recordings".into(),
                    message: format!("no training image can be decoded: {examples}"),
                });
            }
            averaged::refit_statistics(
                &mut self.state,
                (&self.network, &mut self.plan),
                &self.training,
                &mut batches,
                self.info.seed,
            )?;
            let validation = match &mut self.validation {
                Some(validation) => validation.run(&self.network, self.state.model())?,
                None => None,
            };
            if validation.is_some_and(|v| !(v.mse.is_finite() && v.weighted_mse.is_finite())) {
                return Err(self.diverged("the validation loss is not finite"));
            }
            let record = self.end_epoch(validation, epoch_started);
            let observed = observer.observe(TrainingEvent::Epoch { record, of: self.recipe.epochs });
            if whole && std::mem::take(&mut images_unreported) {
                self.report_images(observer)?;
            }
            self.state.progress.seconds = seconds_before + self.started.elapsed().as_secs_f64();
            self.save_checkpoint()?;
            observed?;
        }
        self.finish()
    }

    /// Trains on the remaining batches of the current epoch.
    fn train_epoch(
        &mut self,
        [current, next]: &mut [Batch; 2],
        observer: &mut dyn Observer<TrainingEvent>,
        stop: &StopSignal,
        seconds_before: f64,
    ) -> Result<()> {
        let epoch = self.state.progress.epoch;
        let seconds_of_epoch_before = self.state.progress.train_seconds;
        let started = Instant::now();
        self.training.begin_epoch(epoch);
        let batches = self.training.batches();
        let waiting = self.profile.as_ref().map_or_else(Stopwatch::default, |profile| profile.waiting.clone());
        let updates_in_all = batches as u64 * u64::from(self.recipe.epochs);
        if self.state.progress.next_batch < batches {
            let (training, batch) = (&self.training, self.state.progress.next_batch);
            waiting.time(|| training.fill(batch, current))?;
        }
        while self.state.progress.next_batch < batches {
            let batch = self.state.progress.next_batch;
            let (training, following) = (&self.training, batch + 1);
            let step = u64::from(epoch) * batches as u64 + batch as u64;
            let State { parameters, optimizer, average, progress, .. } = &mut self.state;
            let (network, plan, loss) = (&self.network, &mut self.plan, &self.recipe.loss);
            let pairs = self.smoothness.map_or_else(PairTerms::default, |terms| PairTerms::new(&terms, current.pairs));
            // The next batch is loaded while the network trains on this one.
            let ((mean_loss, step_done), filled) = rayon::join(
                || {
                    if current.n == 0 {
                        return (0.0, Instant::now());
                    }
                    let (x, labels) = (images(network.input(), current), ArrayView1::from(&current.labels));
                    let input = StepInput { x, labels, seed: self.info.seed, step };
                    (plan.step_with_pairs(network, parameters, loss, &pairs, input), Instant::now())
                },
                || if following < batches { training.fill(following, next) } else { Ok(()) },
            );
            filled?;
            waiting.add(step_done.elapsed());
            if current.n > 0 {
                let norm = plan.gradient_norm();
                if !(mean_loss.is_finite() && norm.is_finite()) {
                    return Err(self.diverged("the loss or its gradient is not finite"));
                }
                let fraction = self.recipe.schedule.fraction(optimizer.updates, updates_in_all, &progress.plateau);
                progress.learning_rate = self.recipe.optimizer.learning_rate() * fraction;
                optimizer.step(progress.learning_rate, &mut parameters.values, plan.gradient_mut(), norm);
                if let Some(average) = average {
                    average.take_in(parameters, optimizer.updates, updates_in_all);
                }
            }
            progress.loss_sum += mean_loss * current.n as f64;
            progress.images += current.n;
            progress.next_batch = following;
            progress.train_seconds = seconds_of_epoch_before + started.elapsed().as_secs_f64();
            let observed = observer.observe(TrainingEvent::Batch {
                epoch: epoch + 1,
                epochs: self.recipe.epochs,
                images: progress.images,
                of: training.samples(),
                loss: mean_loss,
            });
            std::mem::swap(current, next);
            let ended = observed.and_then(|()| stop.check()).and_then(|()| self.require_pictures());
            if let Err(error) = ended {
                self.state.progress.seconds = seconds_before + self.started.elapsed().as_secs_f64();
                self.save_checkpoint()?;
                return Err(error);
            }
        }
        Ok(())
    }

    /// Fails if more than a fifth of the training pictures could not be read: they vanished while the run went on.
    fn require_pictures(&self) -> Result<()> {
        if !self.training.has_decayed() {
            return Ok(());
        }
        let (count, examples) = self.training.undecodable();
        let message = format!(
            "{count} of {} pictures cannot be read, more than a fifth is too much: {}. The run is saved; go on with --resume once \
             they are back",
            self.training.images(),
            examples.join("; ")
        );
        Err(Error::Data { place: "the recordings".into(), message })
    }

    fn diverged(&self, what: &str) -> Error {
        Error::Diverged(format!(
            "training diverged in epoch {}: {what}. Try a smaller learning rate, as in --set optimizer.learning_rate={:e}",
            self.state.progress.epoch + 1,
            self.recipe.optimizer.learning_rate() / 10.0
        ))
    }

    fn end_epoch(&mut self, validation: Option<ValidationResult>, started: Instant) -> EpochRecord {
        let progress = &mut self.state.progress;
        let record = EpochRecord {
            epoch: progress.epoch + 1,
            train_loss: progress.loss_sum / progress.images.max(1) as f64,
            val_mse: validation.map(|v| v.mse),
            val_center_mse: validation.map(|v| v.center_mse),
            val_mae_deg: validation.map(|v| v.mae_deg),
            relative_to_zero: validation.and_then(|v| v.relative_to_zero),
            val_path_mse: validation.and_then(|v| v.path_mse),
            val_weighted_mse: validation.map(|v| v.weighted_mse).filter(|_| self.recipe.outputs.count() > 1),
            val_throttle_mae: validation.and_then(|v| v.throttle_mae),
            val_speed_mae_mph: validation.and_then(|v| v.speed_mae_mph),
            learning_rate: progress.learning_rate,
            images: progress.images,
            train_seconds: progress.train_seconds,
            seconds: started.elapsed().as_secs_f64().max(progress.train_seconds),
        };
        progress.history.push(record);
        progress.epoch += 1;
        (progress.next_batch, progress.loss_sum, progress.images, progress.train_seconds) = (0, 0.0, 0, 0.0);

        // Without a validation side, or with `keep = "last"`, the latest weights count as the best.
        let measure = match self.recipe.keep_by {
            KeepBy::Loss => record.val_weighted_mse.or(record.val_mse),
            KeepBy::Path => record.val_path_mse,
        };
        let better = match (measure, progress.best_val_mse) {
            (Some(now), Some(before)) => now < before || self.recipe.keep == Keep::Last,
            _ => true,
        };
        if better {
            progress.best_val_mse = measure;
            progress.best_epoch = record.epoch;
            let mut best = self.state.best.take().unwrap_or_else(|| self.state.parameters.clone());
            best.clone_from(self.state.model());
            self.state.best = Some(best);
        }
        let progress = &mut self.state.progress;
        if let Some(now) = record.val_weighted_mse.or(record.val_mse) {
            self.recipe.schedule.end_epoch(now, &mut progress.plateau);
        }
        if let Some(now) = measure {
            let min_delta = self.recipe.early_stopping.map_or(0.0, |stopping| stopping.min_delta);
            if progress.improved_val_mse.is_none_or(|before| now < before - min_delta) {
                progress.improved_val_mse = Some(now);
                progress.epochs_since_improvement = 0;
            } else {
                progress.epochs_since_improvement += 1;
            }
        }
        record
    }

    fn stop_early(&self) -> bool {
        let patience = self.recipe.early_stopping.map(|stopping| stopping.patience_epochs.max(1));
        patience.is_some_and(|patience| self.state.progress.epochs_since_improvement >= patience)
    }

    /// Writes the checkpoint and the models. The weights are those of the last epoch that is done.
    fn save_checkpoint(&self) -> Result<()> {
        self.save_with_last(self.state.progress.history.len() as u32)
    }

    /// The same, where the weights are those after `epoch` (from 1).
    ///
    /// # Errors
    ///
    /// [`Error::EndedEarly`] if the run folder cannot be written, and all of the run is kept among the temporary files.
    fn save_with_last(&self, epoch: u32) -> Result<()> {
        self.save_into(&self.folder, epoch).map_err(|cause| {
            let copy = |path: &Path| self.copy_into(&RunFolder::at(path), epoch);
            keep_elsewhere(cause, copy, |path| {
                let path = path.display();
                format!("the run so far is kept in {path}; go on with: steersman train --resume {path}")
            })
        })
    }

    /// Writes all that is needed to go on with the run into another folder.
    fn copy_into(&self, folder: &RunFolder, epoch: u32) -> Result<()> {
        folder.write_recipe(&self.recipe)?;
        folder.write_json("run.json", &self.info)?;
        for name in ["from.safetensors", "split.csv", RunFolder::JOB_NOTE, RunFolder::DAGGER_NOTE] {
            if self.folder.file(name).is_file() {
                std::fs::copy(self.folder.file(name), folder.file(name)).map_err(Error::io(folder.file(name)))?;
            }
        }
        self.save_into(folder, epoch)
    }

    fn save_into(&self, folder: &RunFolder, epoch: u32) -> Result<()> {
        if !self.state.progress.history.is_empty() {
            folder.write_history(&self.state.progress.history)?;
        }
        self.state.save(&folder.file("checkpoint.safetensors"), &self.network)?;
        if let Some(best) = &self.state.best {
            let progress = &self.state.progress;
            self.model(best, progress.best_epoch).save(&folder.model())?;
            // In the middle of an epoch the weights have no measures of their own; only the checkpoint stores them.
            if progress.next_batch == 0 {
                self.model(self.state.model(), epoch).save(&folder.file("last.safetensors"))?;
            }
        }
        Ok(())
    }

    /// The weights after `epoch` (from 1) as a model.
    fn model(&self, parameters: &Parameters, epoch: u32) -> Model {
        let record = self.state.progress.history[epoch as usize - 1];
        Model {
            recipe: self.recipe.clone(),
            parameters: parameters.clone(),
            record: TrainingRecord {
                version: env!("CARGO_PKG_VERSION").into(),
                isa: self.network.isa().name().into(),
                seed: self.info.seed,
                recordings: self.info.trained_on(),
                epochs: epoch,
                train_loss: record.train_loss,
                val_mse: record.val_mse,
                val_center_mse: record.val_center_mse,
                leak_percent: self.leak_percent,
                transfer: self.info.transfer.clone(),
                trained_on_held_out: self.info.trained_on_held_out.clone(),
            },
            training_rows: self.training_rows.clone(),
        }
    }

    /// Reports what is known only after every image has been decoded: unreadable images and near twins.
    fn report_images(&self, observer: &mut dyn Observer<TrainingEvent>) -> Result<()> {
        let sides = [Some(self.training.undecodable()), self.validation.as_ref().map(Validation::undecodable)];
        for (count, examples) in sides.into_iter().flatten().filter(|(count, _)| *count > 0) {
            let notice = format!("{count} images cannot be decoded and are left out: {}", examples.join("; "));
            observer.observe(TrainingEvent::Notice(notice))?;
        }
        if let Some(validation) = &self.validation {
            observer.observe(TrainingEvent::Notice(validation.near_twins(&self.training).summary()))?;
        }
        Ok(())
    }

    fn finish(mut self) -> Result<TrainResult> {
        let mut epoch_of_weights = self.state.progress.history.len() as u32;
        if self.recipe.early_stopping.is_some()
            && let Some(best) = &self.state.best
        {
            self.state.parameters.clone_from(best);
            if let Some(average) = &mut self.state.average {
                average.updates = 0;
            }
            epoch_of_weights = self.state.progress.best_epoch;
        }
        let progress = &self.state.progress;
        let best = progress.history[progress.best_epoch as usize - 1];
        let last = progress.history[progress.history.len() - 1];
        let (images, seconds) = progress
            .history
            .iter()
            .fold((0, 0.0), |(images, seconds), epoch| (images + epoch.images, seconds + epoch.train_seconds));
        let result = TrainResult {
            model: self.folder.model(),
            epochs: last.epoch,
            best_epoch: best.epoch,
            train_mse: last.train_loss,
            val_mse: best.val_mse,
            val_center_mse: best.val_center_mse,
            val_mae_deg: best.val_mae_deg,
            relative_to_zero: best.relative_to_zero,
            val_throttle_mae: best.val_throttle_mae,
            val_speed_mae_mph: best.val_speed_mae_mph,
            train_images: self.training.samples_used(),
            simulator_images: self.training.simulator_samples(),
            val_images: self.validation.as_ref().map_or(0, Validation::images),
            seconds: progress.seconds,
            images_per_second: images as f64 / seconds,
            algorithm: self.info.algorithm.clone(),
            weights_hash: weights_hash(&self.network, self.state.model()),
            leak_percent: self.leak_percent,
            near_twin_percent: self.validation.as_ref().map(|v| 100.0 * v.near_twins(&self.training).share()),
            trained_on_held_out: self.info.trained_on_held_out.clone(),
            profile: None,
        };
        self.save_with_last(epoch_of_weights)?;
        let profile = self.profile.as_ref().map(|profile| profile.report(&self.network, &self.plan));
        let result = TrainResult { profile, ..result };
        self.folder.write_json("result.json", &result)?;
        Ok(result)
    }
}
