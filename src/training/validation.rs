//! Evaluation on the validation side after each epoch.

use ndarray::ArrayViewMut1;

use super::data;
use super::together::Together;
use crate::dataset::leak::NearTwins;
use crate::dataset::loader::{Batch, Loader, LoaderTimes};
use crate::dataset::{OutputKind, Outputs, View};
use crate::engine::network::{InferencePlan, Network, Parameters};
use crate::engine::stopwatch::Stopwatch;
use crate::error::Result;
use crate::recipe::Recipe;

/// Errors of the network on the validation side.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct ValidationResult {
    /// Mean squared error of the steering over all validation images.
    pub mse: f64,
    /// Sum of the mean squared errors of all outputs over all images, each times its weight in the loss: `mse` where there is but the
    /// steering.
    pub weighted_mse: f64,
    /// Mean absolute error of the throttle over the centre camera's images, of networks that give one.
    pub throttle_mae: Option<f64>,
    /// The same of the speed, mph.
    pub speed_mae_mph: Option<f64>,
    /// Mean squared error over the images of the centre camera, not mirrored; the fields below are of the same images.
    pub center_mse: f64,
    /// Mean absolute error in degrees of the front wheels.
    pub mae_deg: f64,
    /// `center_mse` ÷ mean squared label; absent if all labels are zero.
    pub relative_to_zero: Option<f64>,
    /// Mean squared error against the steering that follows the driven path; absent if it was not asked for, or nothing has one.
    pub path_mse: Option<f64>,
}

/// The validation side with its buffers.
#[derive(Debug)]
pub(super) struct Validation {
    loader: Loader,
    plan: InferencePlan,
    batches: [Batch; 2],
    /// Those of this process, and those of all with their labels.
    predictions: Vec<f32>,
    all_predictions: Vec<f32>,
    all_labels: Vec<f32>,
    full_lock_deg: f64,
    outputs: Outputs,
    /// For each row of each recording, as far as asked for.
    path_labels: Vec<Vec<Option<f32>>>,
}

impl Validation {
    /// Validates the network of `recipe` on the images of `loader`, whose batches have at most `capacity`.
    pub fn new(loader: Loader, network: &Network, capacity: usize, recipe: &Recipe) -> Validation {
        Validation {
            plan: InferencePlan::new(network, capacity),
            batches: [Batch::default(), Batch::default()],
            predictions: vec![0.0; capacity * network.output().len()],
            all_predictions: Vec::new(),
            all_labels: Vec::new(),
            loader,
            full_lock_deg: recipe.full_lock_deg,
            outputs: recipe.outputs.clone(),
            path_labels: Vec::new(),
        }
    }

    /// The same, which also compares with `path_labels`, those of each row of each recording.
    pub fn with_path_labels(self, path_labels: Vec<Vec<Option<f32>>>) -> Validation {
        Validation { path_labels, ..self }
    }

    /// Measures from now on: adds the times to `loading` and `evaluation`.
    pub fn measure(&mut self, loading: &LoaderTimes, evaluation: Stopwatch) {
        self.loader.measure(loading);
        self.plan.measure(evaluation);
    }

    /// The images of the side.
    pub fn loader(&self) -> &Loader {
        &self.loader
    }

    /// Number of images without those that could not be decoded so far, each mirrored one counted too.
    pub fn images(&self) -> usize {
        self.loader.samples_used()
    }

    /// Images that could not be decoded so far: their number, and the first few with their paths.
    pub fn undecodable(&self) -> (usize, Vec<String>) {
        self.loader.undecodable()
    }

    /// The validation frames that are nearly identical to one of `training`, among those decoded so far.
    pub fn near_twins(&self, training: &Loader) -> NearTwins {
        self.loader.near_twins(training)
    }

    /// Runs the network over the whole side, with those that train together. `None` if no image can be read.
    ///
    /// # Errors
    ///
    /// [`Error::Io`](crate::Error::Io) if the image cache fails.
    pub fn run(
        &mut self,
        network: &Network,
        parameters: &Parameters,
        together: &Together,
    ) -> Result<Option<ValidationResult>> {
        let Validation { loader, plan, batches: [current, next], predictions, full_lock_deg, outputs, .. } = self;
        let (all_predictions, all_labels, path_labels) =
            (&mut self.all_predictions, &mut self.all_labels, &self.path_labels);
        let count = outputs.count();
        // Of the outputs beside the steering.
        let mut squares_beside = vec![0.0; count - 1];
        let mut absolute_beside = vec![0.0; count - 1];
        let (mut squares, mut images) = (0.0, 0usize);
        let (mut center_squares, mut center_absolute, mut label_squares, mut center_images) = (0.0, 0.0, 0.0, 0usize);
        let (mut path_squares, mut path_images) = (0.0, 0usize);
        let filled = together.fill(loader, 0, current);
        let complete = together.meet(filled, Ok(()))?;
        together.settle(loader, current, complete)?;
        for batch in 0..loader.batches() {
            // The next batch is loaded while the network evaluates this one.
            let predictions = &mut predictions[..current.share.len() * count];
            let ((), filled) = rayon::join(
                || {
                    if !current.share.is_empty() {
                        plan.run(
                            network,
                            parameters,
                            data::images(network.input(), current),
                            ArrayViewMut1::from(&mut *predictions),
                        );
                    }
                },
                || if batch + 1 < loader.batches() { together.fill(loader, batch + 1, next) } else { Ok(true) },
            );
            let complete = together.meet(filled, Ok(()))?;
            together.gather(predictions, current.n, count, all_predictions);
            together.gather(&current.labels, current.n, count, all_labels);
            let answers = all_labels.chunks_exact(count).zip(all_predictions.chunks_exact(count));
            for (sample, (labels, predictions)) in current.samples.iter().zip(answers) {
                let is_plain = sample.camera == View::Centre && !sample.mirrored;
                for beside in 1..count {
                    let error = f64::from(predictions[beside]) - f64::from(labels[beside]);
                    squares_beside[beside - 1] += error * error;
                    absolute_beside[beside - 1] += if is_plain { error.abs() } else { 0.0 };
                }
                let (label, prediction) = (&labels[0], &predictions[0]);
                let (label, error) = (f64::from(*label), f64::from(*prediction) - f64::from(*label));
                squares += error * error;
                images += 1;
                if is_plain {
                    center_squares += error * error;
                    center_absolute += error.abs();
                    label_squares += label * label;
                    center_images += 1;
                    let of_recording = path_labels.get(usize::from(sample.recording));
                    if let Some(Some(path_label)) = of_recording.and_then(|labels| labels.get(sample.row as usize)) {
                        path_squares += (f64::from(*prediction) - f64::from(*path_label)).powi(2);
                        path_images += 1;
                    }
                }
            }
            std::mem::swap(current, next);
            if batch + 1 < loader.batches() {
                together.settle(loader, current, complete)?;
            }
        }
        if images == 0 {
            return Ok(None);
        }
        let center = center_images.max(1) as f64;
        let weighted = outputs.specs()[1..].iter().zip(&squares_beside);
        let beside: f64 = weighted.map(|(output, squares)| output.loss_weight * squares / images as f64).sum();
        let mae = |kind| outputs.index(kind).map(|index| absolute_beside[index - 1] / center);
        Ok(Some(ValidationResult {
            mse: squares / images as f64,
            weighted_mse: outputs.specs()[0].loss_weight * (squares / images as f64) + beside,
            throttle_mae: mae(OutputKind::Throttle),
            speed_mae_mph: mae(OutputKind::Speed).zip(outputs.top_speed_mph()).map(|(mae, top_mph)| mae * top_mph),
            center_mse: center_squares / center,
            mae_deg: center_absolute / center * *full_lock_deg,
            relative_to_zero: (label_squares > 0.0).then(|| center_squares / label_squares),
            path_mse: (path_images > 0).then(|| path_squares / path_images as f64),
        }))
    }
}
