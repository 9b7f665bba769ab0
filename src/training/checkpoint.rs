//! The state of a run on disk: a resumed run gives the same bits as one that never stopped.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::history::EpochRecord;
use crate::engine::network::{Network, Parameters};
use crate::engine::optimizer::{Optimizer, Plateau, WeightAverage};
use crate::error::{Error, Result};
use crate::files::atomic_file;
use crate::model_file::{self, StoredTensor};

const FORMAT: u32 = 1;
const OPTIMIZER_FIRST: &str = "optimizer.first";
const OPTIMIZER_SECOND: &str = "optimizer.second";
const BEST: &str = "best.";
const AVERAGE: &str = "average.";

/// Everything that changes during a run.
#[derive(Clone, Debug)]
pub(super) struct State {
    /// The weights as they are now.
    pub parameters: Parameters,
    /// Number of updates and moving averages.
    pub optimizer: Optimizer,
    /// The average of the weights, if the recipe asks for one.
    pub average: Option<WeightAverage>,
    /// The weights of the best epoch so far, or their average.
    pub best: Option<Parameters>,
    /// Counters and measures.
    pub progress: Progress,
}

/// Counters and measures of [`State`].
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Progress {
    /// The current epoch, from 0; the next five fields belong to it.
    pub epoch: u32,
    /// The next batch of the epoch.
    pub next_batch: usize,
    /// Sum of the losses of its images so far.
    pub loss_sum: f64,
    /// Images trained on so far.
    pub images: usize,
    /// Training time so far, seconds.
    pub train_seconds: f64,
    /// Learning rate of the last update.
    pub learning_rate: f64,
    /// The epoch of the best weights, from 1.
    pub best_epoch: u32,
    /// Validation error of the best weights, by what the recipe keeps them.
    // The name is that of the format.
    pub best_val_mse: Option<f64>,
    /// Epochs since that error last improved by the recipe's `min_delta`.
    pub epochs_since_improvement: u32,
    /// The error at the last improvement.
    pub improved_val_mse: Option<f64>,
    /// State of the learning-rate schedule.
    pub plateau: Plateau,
    /// The epochs that are done.
    pub history: Vec<EpochRecord>,
    /// Wall time of the run so far, seconds.
    pub seconds: f64,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Metadata {
    format: u32,
    updates: u64,
    has_best: bool,
    /// Updates that are in the average; absent if none is taken.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    averaged_updates: Option<u64>,
    progress: Progress,
}

impl State {
    /// The parameters that are evaluated and saved: the average, once it has begun.
    pub fn model(&self) -> &Parameters {
        match &self.average {
            Some(average) if average.updates > 0 => &average.parameters,
            _ => &self.parameters,
        }
    }

    /// Writes the state, in whole or not at all.
    ///
    /// # Errors
    ///
    /// [`Error::Io`].
    pub fn save(&self, path: &Path, network: &Network) -> Result<()> {
        atomic_file::write(path, &self.to_bytes(path, network)?)
    }

    /// The bytes of the state in the file `path`.
    ///
    /// # Errors
    ///
    /// [`Error::Data`] if the format cannot hold it.
    pub fn to_bytes(&self, path: &Path, network: &Network) -> Result<Vec<u8>> {
        let metadata = Metadata {
            format: FORMAT,
            updates: self.optimizer.updates,
            has_best: self.best.is_some(),
            averaged_updates: self.average.as_ref().map(|average| average.updates),
            progress: self.progress.clone(),
        };
        let metadata = serde_json::to_string(&metadata).map_err(|e| Error::data(path, e.to_string()))?;
        let mut tensors = model_file::tensors_of(network, &self.parameters);
        for (name, values) in [(OPTIMIZER_FIRST, &self.optimizer.first), (OPTIMIZER_SECOND, &self.optimizer.second)] {
            tensors.push(StoredTensor::vector(name, values));
        }
        let average = self.average.as_ref().filter(|average| average.updates > 0).map(|average| &average.parameters);
        for (prefix, parameters) in [(BEST, self.best.as_ref()), (AVERAGE, average)] {
            for tensor in parameters.iter().flat_map(|parameters| model_file::tensors_of(network, parameters)) {
                tensors.push(StoredTensor { name: format!("{prefix}{}", tensor.name), ..tensor });
            }
        }
        model_file::tensor_bytes(path, &tensors, metadata)
    }

    /// Reads a state for `network`; `optimizer` and `average` are fresh ones and take over what is stored.
    ///
    /// # Errors
    ///
    /// [`Error::Io`] and [`Error::Data`].
    pub fn load(path: &Path, network: &Network, optimizer: Optimizer, average: Option<WeightAverage>) -> Result<State> {
        State::of_bytes(path, &model_file::read_file(path)?, network, optimizer, average)
    }

    /// The same of the `bytes` of a file, which errors call `path`.
    ///
    /// # Errors
    ///
    /// [`Error::Data`].
    pub fn of_bytes(
        path: &Path,
        bytes: &[u8],
        network: &Network,
        mut optimizer: Optimizer,
        mut average: Option<WeightAverage>,
    ) -> Result<State> {
        let (tensors, metadata) = model_file::read_tensors(path, bytes)?;
        let metadata: Metadata =
            serde_json::from_str(&metadata).map_err(|e| Error::data(path, format!("is no checkpoint: {e}")))?;
        if metadata.format != FORMAT {
            return Err(Error::data(path, format!("is a checkpoint of format {}, not {FORMAT}", metadata.format)));
        }
        for (name, values) in [(OPTIMIZER_FIRST, &mut optimizer.first), (OPTIMIZER_SECOND, &mut optimizer.second)] {
            *values = model_file::find_f32(path, &tensors, name, &[values.len()])?;
        }
        optimizer.updates = metadata.updates;
        if average.is_some() != metadata.averaged_updates.is_some() {
            return Err(Error::data(path, "does not belong to the recipe beside it: one of them averages the weights"));
        }
        if let (Some(average), Some(updates)) = (&mut average, metadata.averaged_updates) {
            average.updates = updates;
            if updates > 0 {
                average.parameters = model_file::read_parameters(path, network, &tensors, AVERAGE)?;
            }
        }
        let best = match metadata.has_best {
            true => Some(model_file::read_parameters(path, network, &tensors, BEST)?),
            false => None,
        };
        let parameters = model_file::read_parameters(path, network, &tensors, "")?;
        Ok(State { parameters, optimizer, average, best, progress: metadata.progress })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::optimizer::{AveragingSpec, OptimizerSpec};
    use crate::recipe::Recipe;
    use steersman_kernels::Isa;

    #[test]
    fn a_state_comes_back_as_it_was() {
        let network = Recipe::find("lenet", &[]).unwrap().network(Isa::PORTABLE).unwrap();
        let spec = OptimizerSpec::Sgd { learning_rate: 0.1, momentum: 0.9, l2: 0.0, decoupled_weight_decay: 0.0 };
        let averaging = AveragingSpec::Ema { decay: 0.9, from_share: 0.0, refit_batches: 0 };
        let average = |of: u64| Some(WeightAverage::new(averaging, &network.initialize(of), network.isa()));
        let mut state = State {
            parameters: network.initialize(1),
            average: average(3),
            optimizer: Optimizer::new(spec, None, network.tensors(), network.isa()),
            best: Some(network.initialize(2)),
            progress: Progress { epoch: 3, loss_sum: 0.1 + 0.2, best_val_mse: Some(1.0 / 3.0), ..Progress::default() },
        };
        state.optimizer.updates = 77;
        state.optimizer.first[5] = 0.25;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("checkpoint.safetensors");
        let fresh = || Optimizer::new(spec, None, network.tensors(), network.isa());
        // An average that has not begun has no weights.
        state.save(&path, &network).unwrap();
        let read = State::load(&path, &network, fresh(), average(1)).unwrap();
        assert_eq!((read.average.as_ref().unwrap().updates, read.model()), (0, &state.parameters));
        state.average.as_mut().unwrap().updates = 5;
        state.save(&path, &network).unwrap();
        let read = State::load(&path, &network, fresh(), average(1)).unwrap();
        assert_eq!((read.average.as_ref().unwrap().updates, read.model()), (5, &network.initialize(3)));
        assert!(State::load(&path, &network, fresh(), None).unwrap_err().to_string().contains("averages the weights"));
        assert_eq!(read.parameters, state.parameters);
        assert_eq!(read.best, state.best);
        assert_eq!(read.progress, state.progress);
        assert_eq!((read.optimizer.updates, read.optimizer.first), (77, state.optimizer.first));
    }
}
