//! The history of a run: one record for each epoch.

use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};

/// One line of `history.csv`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EpochRecord {
    /// Number of the epoch, from 1.
    pub epoch: u32,
    /// Mean loss over the epoch's training batches, each before its update and with dropout.
    pub train_loss: f64,
    /// Mean squared error of the steering over all validation images.
    pub val_mse: Option<f64>,
    /// Mean squared error over the validation images of the centre camera.
    pub val_center_mse: Option<f64>,
    /// Mean absolute error over the validation images of the centre camera, in degrees of the front wheels.
    pub val_mae_deg: Option<f64>,
    /// `val_center_mse` ÷ the mean squared label of the same images: 1 is as good as always predicting zero.
    pub relative_to_zero: Option<f64>,
    /// Mean squared error of the validation images of the centre camera against the steering that follows the driven path, where
    /// the recipe keeps by that.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub val_path_mse: Option<f64>,
    /// Sum of the mean squared errors of all outputs over all validation images, each times its weight in the loss; of networks with
    /// more outputs than the steering.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub val_weighted_mse: Option<f64>,
    /// Mean absolute error of the throttle over the validation images of the centre camera, of networks that give one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub val_throttle_mae: Option<f64>,
    /// The same of the speed, mph.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub val_speed_mae_mph: Option<f64>,
    /// Learning rate of the last update.
    pub learning_rate: f64,
    /// Number of training images.
    pub images: usize,
    /// Time of the training batches without validation, seconds.
    pub train_seconds: f64,
    /// Time of the whole epoch, seconds.
    pub seconds: f64,
}

/// `history` as the CSV of the file `path`.
///
/// # Errors
///
/// [`Error::Data`] for values that CSV cannot hold.
pub(super) fn history_csv(path: &Path, history: &[EpochRecord]) -> Result<Vec<u8>> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    for record in history {
        writer.serialize(record).map_err(|e| Error::data(path, e.to_string()))?;
    }
    writer.into_inner().map_err(|e| Error::data(path, e.to_string()))
}

/// Reads what `history_csv` made.
///
/// # Errors
///
/// [`Error::Io`], and [`Error::Data`] with the line that is wrong.
pub fn read_history(path: &Path) -> Result<Vec<EpochRecord>> {
    let bytes = std::fs::read(path).map_err(Error::io(path))?;
    let mut history = Vec::new();
    for record in csv::Reader::from_reader(&bytes[..]).deserialize() {
        let line = history.len() as u64 + 2;
        history.push(record.map_err(|e: csv::Error| Error::data_at(path, line, e.to_string()))?);
    }
    Ok(history)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_history_comes_back_as_it_was_and_a_damaged_one_is_an_error_with_its_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("history.csv");
        let record = EpochRecord {
            epoch: 1,
            train_loss: 0.1 + 0.2,
            val_mse: Some(1.0 / 3.0),
            val_center_mse: None,
            val_mae_deg: None,
            relative_to_zero: None,
            val_path_mse: None,
            val_weighted_mse: None,
            val_throttle_mae: None,
            val_speed_mae_mph: None,
            learning_rate: 1e-3,
            images: 7,
            train_seconds: 1.5,
            seconds: 2.0,
        };
        let history = [record, EpochRecord { epoch: 2, ..record }];
        std::fs::write(&path, history_csv(&path, &history).unwrap()).unwrap();
        assert_eq!(read_history(&path).unwrap(), history);
        std::fs::write(&path, std::fs::read_to_string(&path).unwrap().replace("\n2,", "\nx,")).unwrap();
        assert!(read_history(&path).unwrap_err().to_string().contains("history.csv:3:"));
    }
}
