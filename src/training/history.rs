//! What each epoch brought.

use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::atomic_file;
use crate::error::{Error, Result};

/// One line of `history.csv`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EpochRecord {
    /// Number of the epoch, from 1.
    pub epoch: u32,
    /// Mean loss over the epoch's training batches, each before its update and with dropout.
    pub train_loss: f64,
    /// Mean squared error over all validation images.
    pub val_mse: Option<f64>,
    /// Mean squared error over the validation images of the centre camera.
    pub val_center_mse: Option<f64>,
    /// Mean absolute error over the validation images of the centre camera, in degrees of the front wheels.
    pub val_mae_deg: Option<f64>,
    /// `val_center_mse` ÷ the mean squared label of the same images: 1 is as good as always predicting zero.
    pub relative_to_zero: Option<f64>,
    /// Learning rate of the last update.
    pub learning_rate: f64,
    /// Training images.
    pub images: usize,
    /// Time the training batches took, without validation.
    pub train_seconds: f64,
    /// Time of the whole epoch.
    pub seconds: f64,
}

/// Writes `history` as CSV, in whole or not at all.
///
/// # Errors
///
/// [`Error::Io`].
pub fn write_history(path: &Path, history: &[EpochRecord]) -> Result<()> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    for record in history {
        writer.serialize(record).map_err(|e| Error::data(path, e.to_string()))?;
    }
    let bytes = writer.into_inner().map_err(|e| Error::data(path, e.to_string()))?;
    atomic_file::write(path, &bytes)
}
