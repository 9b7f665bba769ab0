//! The loop over the epochs of a run.

use std::time::{Duration, Instant};

use ndarray::ArrayView1;
use steersman_kernels::{Backend, Isa};

use super::averaged;
use super::checkpoint::{Progress, State};
use super::data::{Data, images};
use super::history::EpochRecord;
use super::profile::Profile;
use super::request::{TrainResult, TrainingEvent};
use super::run_folder::{RunFolder, RunInfo, RunLock};
use super::together::Together;
use super::transfer::Start;
use super::validation::{Validation, ValidationResult};
use crate::cluster::process::peak_memory_mb;
use crate::dataset::loader::{Batch, Loader};
use crate::engine::loss::{PairTerms, Smoothness};
use crate::engine::network::{Network, StepInput, TrainingPlan};
use crate::engine::optimizer::{Optimizer, WeightAverage};
use crate::engine::stopwatch::Stopwatch;
use crate::error::{Error, Result};
use crate::observer::{Observer, StopSignal};
use crate::recipe::{Keep, KeepBy, Recipe};

/// Maximum of images of one row: three cameras, each mirrored. A batch of whole rows has at least one row.
const MAX_ROW_IMAGES: usize = 6;

/// A run: its data, its network, and how far it is.
pub(super) struct TrainingRun {
    pub(super) folder: RunFolder,
    /// Held until the end of the run by the process that writes.
    pub(super) _lock: Option<RunLock>,
    pub(super) info: RunInfo,
    pub(super) recipe: Recipe,
    pub(super) network: Network,
    pub(super) plan: TrainingPlan,
    pub(super) training: Loader,
    /// The terms of the loss for pairs, if the recipe has any.
    pub(super) smoothness: Option<Smoothness>,
    pub(super) training_rows: Vec<u64>,
    pub(super) validation: Option<Validation>,
    pub(super) leak_percent: f64,
    pub(super) notices: Vec<String>,
    pub(super) state: State,
    pub(super) started: Instant,
    pub(super) profile: Option<Profile>,
    pub(super) together: Together,
}

impl TrainingRun {
    pub(super) fn new(
        (folder, lock): (RunFolder, Option<RunLock>),
        info: RunInfo,
        recipe: Recipe,
        data: Data,
        start: Option<Start>,
        started: Instant,
    ) -> Result<TrainingRun> {
        let mut network = recipe.network(Backend { isa: Isa::best(), conv: info.conv_algorithm(&folder)? })?;
        if let Some(transfer) = &info.transfer {
            network.freeze(&transfer.frozen)?;
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
            Some(_) => recipe.batch.min(2 * most).max(capacity),
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
            together: Together::default(),
        })
    }

    /// The run, with `profile` measuring what it does from now on.
    pub(super) fn measured(mut self, profile: Option<Profile>) -> TrainingRun {
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
    pub(super) fn restore(&mut self) -> Result<()> {
        let path = self.folder.file("checkpoint.safetensors");
        if path.is_file() {
            let (optimizer, average) = (self.state.optimizer.clone(), self.state.average.clone());
            self.state = State::load(&path, &self.network, optimizer, average)?;
        }
        Ok(())
    }

    pub(super) fn run(mut self, observer: &mut dyn Observer<TrainingEvent>, stop: &StopSignal) -> Result<TrainResult> {
        let begun = self.tell(observer);
        self.go(begun, observer, stop)?;
        self.finish()
    }

    fn tell(&self, observer: &mut dyn Observer<TrainingEvent>) -> Result<()> {
        observer.observe(TrainingEvent::Begin { folder: self.folder.path().into() })?;
        self.notices.iter().try_for_each(|notice| observer.observe(TrainingEvent::Notice(notice.clone())))
    }

    /// Trains until the last epoch has ended, unless what `begun` says failed on this or another rank.
    pub(super) fn go(
        &mut self,
        begun: Result<()>,
        observer: &mut dyn Observer<TrainingEvent>,
        stop: &StopSignal,
    ) -> Result<()> {
        self.together.meet(Ok(true), begun)?;
        let (updates_before, sent_before) = (self.state.optimizer.updates, self.together.sent_bytes());
        let (mut stepping, mut meeting) = (Duration::ZERO, Duration::ZERO);
        let seconds_before = self.state.progress.seconds;
        let mut images_unreported = true;
        let mut batches = [Batch::default(), Batch::default()];
        while self.state.progress.epoch < self.recipe.epochs && !self.stop_early() {
            let epoch_started = Instant::now();
            // In the first whole epoch of this process every image is decoded.
            let whole = self.state.progress.next_batch == 0;
            let met_before = self.together.met();
            self.train_epoch(&mut batches, observer, stop, seconds_before)?;
            stepping += epoch_started.elapsed();
            meeting += self.together.met() - met_before;
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
                (&self.training, &self.together),
                &mut batches,
                self.info.seed,
            )?;
            let validation = match &mut self.validation {
                Some(validation) => validation.run(&self.network, self.state.model(), &self.together)?,
                None => None,
            };
            if validation.is_some_and(|v| !(v.mse.is_finite() && v.weighted_mse.is_finite())) {
                return Err(self.diverged("the validation loss is not finite"));
            }
            let record = self.end_epoch(validation, epoch_started);
            let observed = observer.observe(TrainingEvent::Epoch { record, of: self.recipe.epochs });
            let reported = match whole && std::mem::take(&mut images_unreported) {
                true => {
                    self.collect_thumbnails();
                    if self.together.leads() { self.report_images(observer) } else { Ok(()) }
                }
                false => Ok(()),
            };
            self.state.progress.seconds = seconds_before + self.started.elapsed().as_secs_f64();
            let saved = self.save_checkpoint();
            self.together.meet(Ok(true), saved.and(observed).and(reported))?;
        }
        self.collect_thumbnails();
        let updates = self.state.optimizer.updates - updates_before;
        if self.together.team().is_some() && updates > 0 {
            let each_mb = (self.together.sent_bytes() - sent_before) as f64 / updates as f64 / 1e6;
            let meeting = 100.0 * meeting.as_secs_f64() / stepping.as_secs_f64();
            let notice = self.together_notice(updates, each_mb, meeting);
            observer.observe(TrainingEvent::Notice(notice))?;
        }
        Ok(())
    }

    /// What working together has cost, where each rank sent about `each_mb` a step and this one spent `meeting` percent of its time where all
    /// meet. All ranks call it at once.
    fn together_notice(&self, updates: u64, each_mb: f64, meeting: f64) -> String {
        let meeting = self.together.of_all(meeting);
        let memory = self.together.of_all(peak_memory_mb().unwrap_or_default());
        let ranks = meeting.len();
        let range = |values: &[f64]| {
            let (low, high) = values.iter().fold((f64::MAX, 0.0f64), |(low, high), v| (low.min(*v), high.max(*v)));
            format!("{low:.0} to {high:.0}")
        };
        format!(
            "{ranks} ranks made {updates} steps together; each sent about {each_mb:.2} MB a step, spent {} % of the steps' time waiting \
             for others and for data on its way, and needed {} MB of memory",
            range(&meeting),
            range(&memory)
        )
    }

    fn collect_thumbnails(&self) {
        let validation = self.validation.as_ref().map(Validation::loader);
        self.together.collect_thumbnails(&[&self.training].into_iter().chain(validation).collect::<Vec<_>>());
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
            let (training, together, batch) = (&self.training, &self.together, self.state.progress.next_batch);
            waiting.time(|| {
                let filled = together.fill(training, batch, current);
                let complete = together.meet(filled, Ok(()))?;
                together.settle(training, current, complete)
            })?;
        }
        while self.state.progress.next_batch < batches {
            let batch = self.state.progress.next_batch;
            let (training, together, following) = (&self.training, &self.together, batch + 1);
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
                    (plan.step_of_share(network, parameters, loss, &pairs, input, current.n), Instant::now())
                },
                || if following < batches { together.fill(training, following, next) } else { Ok(true) },
            );
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
            let met = self.together.meet(filled, ended).and_then(|complete| match following < batches {
                true => self.together.settle(&self.training, current, complete),
                false => Ok(()),
            });
            if let Err(error) = met {
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
}
