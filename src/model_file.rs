//! The model file: one [safetensors](https://huggingface.co/docs/safetensors) file with everything a model needs to drive.
//!
//! Tensors carry the names of the network (`conv1.weight`, `bn1.running_mean`; see [`Network::tensors`]). The metadata has one
//! entry, `steersman`, a JSON object: `format` (a number), `label`, `recipe` (network, preprocessing and all the rest) and
//! `training` (the [`TrainingRecord`]). One more tensor, `training_rows`, says which rows the model was trained on.

use std::collections::HashMap;
use std::path::Path;

use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use steersman_kernels::Isa;

use crate::engine::network::{Network, Parameters};
use crate::error::{Error, Result};
use crate::files::atomic_file;
use crate::recipe::Recipe;

const FORMAT: u32 = 1;
const METADATA_KEY: &str = "steersman";
const TRAINING_ROWS: &str = "training_rows";
/// The meaning of the output of a model.
pub(crate) const LABEL: &str =
    "steering in [-1, 1], positive to the right; times recipe.full_lock_deg it is degrees of the front wheels";

/// A trained network: recipe, parameters, and the record of its training.
#[derive(Clone, Debug, PartialEq)]
pub struct Model {
    /// The recipe: network, preprocessing, full-lock angle, and how it was trained.
    pub recipe: Recipe,
    /// The numbers.
    pub parameters: Parameters,
    /// The record of a training run.
    pub record: TrainingRecord,
    /// [`row_id`](crate::dataset::Recording::row_id)s of the rows it was trained on, sorted.
    pub training_rows: Vec<u64>,
}

/// The record of a training run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingRecord {
    /// Version of the program.
    pub version: String,
    /// Vector code it ran on: `avx512`, `avx2`, `neon`, `portable`.
    pub isa: String,
    /// Seed of all random choices.
    pub seed: u64,
    /// Recordings, as they were named on the command line.
    pub recordings: Vec<String>,
    /// Epochs behind these weights.
    pub epochs: u32,
    /// Mean loss over the last epoch's training batches.
    pub train_loss: f64,
    /// Mean squared error over all validation images; absent without a validation side.
    pub val_mse: Option<f64>,
    /// Mean squared error over the validation images of the centre camera.
    pub val_center_mse: Option<f64>,
    /// Share of validation frames with a training frame of the same session within one second, in percent.
    pub leak_percent: f64,
    /// The model that training began from; absent for a fresh start.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub transfer: Option<Transfer>,
    /// Held-out tracks of the simulator that were trained on all the same, here or by the model that training began from.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub trained_on_held_out: Vec<String>,
}

/// What a training run took from a model.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Transfer {
    /// The model, as it was named on the command line.
    pub model: String,
    /// Layers that began with its weights.
    pub taken: Vec<String>,
    /// Layers that began with fresh ones.
    pub fresh: Vec<String>,
    /// Layers that kept what they were given, their running statistics too.
    pub frozen: Vec<String>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Metadata {
    format: u32,
    label: String,
    recipe: Recipe,
    training: TrainingRecord,
}

impl Model {
    /// Writes the model to `path`, in whole or not at all.
    ///
    /// # Errors
    ///
    /// [`Error::Io`], and [`Error::Network`] if the recipe does not fit the parameters.
    pub fn save(&self, path: &Path) -> Result<()> {
        let network = self.recipe.network(Isa::PORTABLE)?;
        let metadata = Metadata {
            format: FORMAT,
            label: LABEL.into(),
            recipe: self.recipe.clone(),
            training: self.record.clone(),
        };
        let metadata = serde_json::to_string(&metadata).expect("metadata is made of strings and numbers");
        let mut tensors = tensors_of(&network, &self.parameters);
        let rows = self.training_rows.iter().flat_map(|row| row.to_le_bytes()).collect();
        tensors.push(StoredTensor {
            name: TRAINING_ROWS.into(),
            dtype: Dtype::U64,
            shape: vec![self.training_rows.len()],
            bytes: rows,
        });
        write_tensors(path, &tensors, metadata)
    }

    /// Reads a model.
    ///
    /// # Errors
    ///
    /// [`Error::Io`] if the file cannot be read; [`Error::Data`] if it is damaged, has been made by something else, or its
    /// tensors do not fit its recipe.
    pub fn load(path: &Path) -> Result<Model> {
        let bytes = std::fs::read(path).map_err(Error::io(path))?;
        let (tensors, metadata) = read_tensors(path, &bytes)?;
        let version: FormatNumber = parse_metadata(path, &metadata)?;
        if version.format != FORMAT {
            let message = format!("is a model of format {}; this program reads format {FORMAT}", version.format);
            return Err(Error::data(path, message));
        }
        let metadata: Metadata = parse_metadata(path, &metadata)?;
        // Parsing the recipe's text again applies every check that a recipe file has to pass.
        let recipe = Recipe::parse(&path.display().to_string(), &metadata.recipe.to_toml()?, &[])?;
        let network = recipe.network(Isa::PORTABLE)?;
        let parameters = read_parameters(path, &network, &tensors, "")?;
        let rows = find(path, &tensors, TRAINING_ROWS, Dtype::U64)?;
        let training_rows = rows.data().as_chunks::<8>().0.iter().map(|bytes| u64::from_le_bytes(*bytes)).collect();
        Ok(Model { recipe, parameters, record: metadata.training, training_rows })
    }
}

/// What every format of the metadata has.
#[derive(Deserialize)]
struct FormatNumber {
    format: u32,
}

fn parse_metadata<T: serde::de::DeserializeOwned>(path: &Path, text: &str) -> Result<T> {
    serde_json::from_str(text).map_err(|e| Error::data(path, format!("its `{METADATA_KEY}` metadata is damaged: {e}")))
}

/// SHA-256 over name, shape and numbers of every tensor, in the network's order, as lower-case hexadecimal digits. Equal
/// hashes mean equal bits.
pub fn weights_hash(network: &Network, parameters: &Parameters) -> String {
    let mut hash = Sha256::new();
    for tensor in tensors_of(network, parameters) {
        hash.update(tensor.name.as_bytes());
        hash.update([0]);
        for extent in &tensor.shape {
            hash.update((*extent as u64).to_le_bytes());
        }
        hash.update(&tensor.bytes);
    }
    hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

/// A tensor as it stands in a file.
pub(crate) struct StoredTensor {
    pub name: String,
    pub dtype: Dtype,
    pub shape: Vec<usize>,
    pub bytes: Vec<u8>,
}

impl StoredTensor {
    /// A vector of `f32`.
    pub fn vector(name: &str, values: &[f32]) -> StoredTensor {
        StoredTensor { name: name.into(), dtype: Dtype::F32, shape: vec![values.len()], bytes: f32_bytes(values) }
    }
}

fn f32_bytes(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|value| value.to_le_bytes()).collect()
}

/// All tensors of a network, in its order.
pub(crate) fn tensors_of(network: &Network, parameters: &Parameters) -> Vec<StoredTensor> {
    let stored = |tensor: &crate::engine::network::Tensor| StoredTensor {
        name: tensor.name.clone(),
        dtype: Dtype::F32,
        shape: tensor.spec.shape.clone(),
        bytes: f32_bytes(parameters.tensor(tensor)),
    };
    network.tensors().iter().map(stored).collect()
}

/// Writes a safetensors file, in whole or not at all.
pub(crate) fn write_tensors(path: &Path, tensors: &[StoredTensor], metadata: String) -> Result<()> {
    let views = tensors.iter().map(|tensor| {
        let view = TensorView::new(tensor.dtype, tensor.shape.clone(), &tensor.bytes);
        (tensor.name.as_str(), view.expect("a stored tensor has as many bytes as its shape says"))
    });
    // One entry only: the order of several would be that of a hash map, and the same model another file each time.
    let info = HashMap::from([(METADATA_KEY.to_string(), metadata)]);
    let bytes = safetensors::serialize(views, Some(info)).map_err(|e| Error::data(path, e.to_string()))?;
    atomic_file::write(path, &bytes)
}

/// Tensors and metadata of a safetensors file of ours.
pub(crate) fn read_tensors<'a>(path: &Path, bytes: &'a [u8]) -> Result<(SafeTensors<'a>, String)> {
    let damaged =
        |e: safetensors::SafeTensorError| Error::data(path, format!("is no safetensors file, or is damaged: {e}"));
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(damaged)?;
    let tensors = SafeTensors::deserialize(bytes).map_err(damaged)?;
    let metadata = header.metadata().as_ref().and_then(|info| info.get(METADATA_KEY)).cloned();
    let missing = || Error::data(path, format!("has no `{METADATA_KEY}` metadata: it was not written by steersman"));
    Ok((tensors, metadata.ok_or_else(missing)?))
}

/// The tensor `name`.
pub(crate) fn find<'a>(path: &Path, tensors: &SafeTensors<'a>, name: &str, dtype: Dtype) -> Result<TensorView<'a>> {
    let tensor = tensors.tensor(name).map_err(|_| Error::data(path, format!("has no tensor `{name}`")))?;
    if tensor.dtype() != dtype {
        return Err(Error::data(path, format!("tensor `{name}` is of type {:?}, not {dtype:?}", tensor.dtype())));
    }
    Ok(tensor)
}

/// The numbers of tensor `name`, which must be finite and of the given shape.
pub(crate) fn find_f32(path: &Path, tensors: &SafeTensors, name: &str, shape: &[usize]) -> Result<Vec<f32>> {
    let tensor = find(path, tensors, name, Dtype::F32)?;
    if tensor.shape() != shape {
        let message = format!("tensor `{name}` has shape {:?}; the recipe says {shape:?}", tensor.shape());
        return Err(Error::data(path, message));
    }
    let values: Vec<f32> = tensor.data().as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
    match values.iter().position(|value| !value.is_finite()) {
        Some(index) => Err(Error::data(path, format!("tensor `{name}` has {} at place {index}", values[index]))),
        None => Ok(values),
    }
}

/// The numbers of a network whose tensors stand in the file under `prefix` and their names.
pub(crate) fn read_parameters(
    path: &Path,
    network: &Network,
    tensors: &SafeTensors,
    prefix: &str,
) -> Result<Parameters> {
    // Grown tensor by tensor, so that a recipe cannot ask for more memory than the file has numbers.
    let mut parameters = Parameters { values: Vec::new(), statistics: Vec::new() };
    for tensor in network.tensors() {
        let values = find_f32(path, tensors, &format!("{prefix}{}", tensor.name), &tensor.spec.shape)?;
        if tensor.trainable { parameters.values.extend(values) } else { parameters.statistics.extend(values) }
    }
    Ok(parameters)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model() -> Model {
        let recipe = Recipe::find("lenet", &[]).unwrap();
        let parameters = recipe.network(Isa::PORTABLE).unwrap().initialize(3);
        let record = TrainingRecord { seed: 3, epochs: 1, val_mse: Some(0.1), ..TrainingRecord::default() };
        Model { recipe, parameters, record, training_rows: vec![1, u64::MAX] }
    }

    #[test]
    fn a_model_comes_back_as_it_was_and_the_same_model_is_the_same_file() {
        let folder = tempfile::tempdir().unwrap();
        let (a, b) = (folder.path().join("a.safetensors"), folder.path().join("b.safetensors"));
        model().save(&a).unwrap();
        assert_eq!(Model::load(&a).unwrap(), model());
        Model::load(&a).unwrap().save(&b).unwrap();
        assert_eq!(std::fs::read(a).unwrap(), std::fs::read(b).unwrap());
    }

    #[test]
    fn a_truncated_file_is_an_error_at_every_length() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.safetensors");
        model().save(&path).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        for len in (0..bytes.len()).step_by(997) {
            std::fs::write(&path, &bytes[..len]).unwrap();
            let error = Model::load(&path).unwrap_err().to_string();
            assert!(error.contains("m.safetensors: is no safetensors file, or is damaged"), "{error}");
        }
    }

    #[test]
    fn foreign_and_unfitting_files_are_errors() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.safetensors");
        let load = || Model::load(&path).unwrap_err().to_string();

        let views = [("a", TensorView::new(Dtype::F32, vec![1], &[0; 4]).unwrap())];
        std::fs::write(&path, safetensors::serialize(views, None).unwrap()).unwrap();
        assert!(load().contains("was not written by steersman"));

        let mut wrong = model();
        wrong.parameters.values[40] = f32::NAN;
        wrong.save(&path).unwrap();
        assert!(load().contains("tensor `conv1.weight` has NaN at place 40"));

        let metadata = r#"{"format": 99}"#.to_string();
        write_tensors(&path, &[], metadata).unwrap();
        assert!(load().contains("is a model of format 99; this program reads format 1"));
    }

    #[test]
    fn the_hash_sees_a_single_bit() {
        let (network, mut parameters) = (model().recipe.network(Isa::PORTABLE).unwrap(), model().parameters);
        let before = weights_hash(&network, &parameters);
        assert_eq!(before.len(), 64);
        parameters.values[7] = f32::from_bits(parameters.values[7].to_bits() ^ 1);
        assert_ne!(before, weights_hash(&network, &parameters));
    }
}
