//! What a run leaves on the disk: checkpoints, models, and its result.

use std::path::Path;

use super::request::TrainResult;
use super::run::TrainingRun;
use super::run_folder::RunFolder;
use super::validation::Validation;
use crate::engine::network::Parameters;
use crate::error::{Error, Result};
use crate::files::limits::keep_elsewhere;
use crate::model_file::{Model, TrainingRecord, weights_hash};

impl TrainingRun {
    /// Writes the checkpoint and the models. The weights are those of the last epoch that is done.
    pub(super) fn save_checkpoint(&self) -> Result<()> {
        if !self.together.leads() {
            return Ok(());
        }
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

    pub(super) fn finish(mut self) -> Result<TrainResult> {
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
