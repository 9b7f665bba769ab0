//! What a run is asked to do, what happens in it, and what it comes to.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use steersman_kernels::conv::ConvAlgorithm;

use super::history::EpochRecord;
use super::profile::ProfileReport;
use crate::dataset::Description;
use crate::model_file::Transfer;
use crate::recipe::Recipe;

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

/// The model to start from, and the layers to freeze.
#[derive(Clone, Debug)]
pub struct TransferRequest {
    /// The model file.
    pub model: PathBuf,
    /// Layers to freeze.
    pub freeze: Vec<String>,
}

impl TransferRequest {
    /// The request that led to `transfer`.
    pub(super) fn of(transfer: &Transfer) -> TransferRequest {
        TransferRequest { model: PathBuf::from(&transfer.model), freeze: transfer.frozen.clone() }
    }
}

/// Memory for decoded images unless another is asked for, MiB.
pub const DEFAULT_CACHE_MIB: usize = 1024;

impl TrainRequest {
    /// To train `recipe` on `recordings` alone, of which nothing is said, into the run folder `out`: seed 1, fresh weights.
    pub fn new(recordings: Vec<PathBuf>, recipe: Recipe, out: PathBuf) -> TrainRequest {
        TrainRequest {
            recordings,
            validate: Vec::new(),
            also: Vec::new(),
            simulator: Vec::new(),
            said: Description::default(),
            recipe,
            out,
            seed: 1,
            cache_mib: DEFAULT_CACHE_MIB,
            from: None,
            algorithm: None,
            profile: false,
        }
    }
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
