//! The model file: one [safetensors](https://huggingface.co/docs/safetensors) file with everything a model needs to drive.
//!
//! Tensors carry the names of the network (`conv1.weight`, `bn1.running_mean`; see [`Network::tensors`]). The metadata has one
//! entry, `steersman`, a JSON object: `format` (a number), `label` (what the outputs mean), `recipe` (outputs by their names, network,
//! preprocessing and all the rest) and
//! `training` (the [`TrainingRecord`]). One more tensor, `training_rows`, says which rows the model was trained on.

use std::collections::HashMap;
use std::fs::File;
use std::io::Read as _;
use std::path::Path;

use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use steersman_kernels::Isa;

use crate::engine::network::{MAX_PARAMETERS, Network, Parameters};
use crate::error::{Error, Result};
use crate::files::atomic_file;
use crate::recipe::Recipe;

const FORMAT: u32 = 1;
const METADATA_KEY: &str = "steersman";
const TRAINING_ROWS: &str = "training_rows";

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
        atomic_file::write(path, &self.to_file(path)?)
    }

    /// The bytes of the file `path`, as [`save`](Model::save) writes it.
    pub(crate) fn to_file(&self, path: &Path) -> Result<Vec<u8>> {
        let network = self.recipe.network(Isa::PORTABLE)?;
        let metadata = Metadata {
            format: FORMAT,
            label: self.recipe.outputs.label(),
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
        tensor_bytes(path, &tensors, metadata)
    }

    /// Reads a model.
    ///
    /// # Errors
    ///
    /// [`Error::Io`] if the file cannot be read; [`Error::Data`] if it is damaged, has been made by something else, or its
    /// tensors do not fit its recipe.
    pub fn load(path: &Path) -> Result<Model> {
        Model::of_file(path, &read_file(path)?)
    }

    /// The model of the file `path` with these bytes.
    pub(crate) fn of_file(path: &Path, bytes: &[u8]) -> Result<Model> {
        let (tensors, metadata) = read_tensors(path, bytes)?;
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

/// The bytes of a safetensors file `path` of ours.
///
/// # Errors
///
/// [`Error::Data`] if the format cannot hold them.
pub(crate) fn tensor_bytes(path: &Path, tensors: &[StoredTensor], metadata: String) -> Result<Vec<u8>> {
    let views = tensors.iter().map(|tensor| {
        let view = TensorView::new(tensor.dtype, tensor.shape.clone(), &tensor.bytes);
        (tensor.name.as_str(), view.expect("a stored tensor has as many bytes as its shape says"))
    });
    let metadata =
        sealed(metadata, tensors.iter().map(|tensor| (&*tensor.name, tensor.dtype, &*tensor.shape, &*tensor.bytes)));
    // One entry only: the order of several would be that of a hash map, and the same model another file each time.
    let info = HashMap::from([(METADATA_KEY.to_string(), metadata)]);
    safetensors::serialize(views, Some(info)).map_err(|e| Error::data(path, e.to_string()))
}

/// Tensors and metadata of a safetensors file of ours.
pub(crate) fn read_tensors<'a>(path: &Path, bytes: &'a [u8]) -> Result<(SafeTensors<'a>, String)> {
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(damaged(path))?;
    let tensors = SafeTensors::deserialize(bytes).map_err(damaged(path))?;
    let metadata = header.metadata().as_ref().and_then(|info| info.get(METADATA_KEY)).cloned();
    let missing = || Error::data(path, format!("has no `{METADATA_KEY}` metadata: it was not written by steersman"));
    let metadata = metadata.ok_or_else(missing)?;
    let Some((content, digest)) = unsealed(&metadata) else { return Ok((tensors, metadata)) };
    let all = tensors.iter().collect::<Vec<_>>();
    let parts = all.iter().map(|(name, tensor)| (*name, tensor.dtype(), tensor.shape(), tensor.data()));
    if digest_of(&content, parts) != digest {
        let remedy = "take a copy that is whole, or train again";
        return Err(Error::data(path, format!("is damaged: its content does not fit its digest; {remedy}")));
    }
    Ok((tensors, content))
}

/// What stands before the digest at the end of the metadata.
const SEAL: &str = ",\"sha256\":\"";

/// The JSON object `metadata` with the digest of itself and of the tensors as its last entry.
fn sealed<'a>(metadata: String, tensors: impl Iterator<Item = TensorParts<'a>>) -> String {
    let digest = digest_of(&metadata, tensors);
    match metadata.strip_suffix('}') {
        Some(open) if !open.ends_with('{') => format!("{open}{SEAL}{digest}\"}}"),
        _ => metadata,
    }
}

/// The metadata without its digest, and the digest; `None` for a file of an earlier version, which has none.
fn unsealed(metadata: &str) -> Option<(String, &str)> {
    let (open, digest) = metadata.strip_suffix("\"}")?.rsplit_once(SEAL)?;
    Some((format!("{open}}}"), digest))
}

/// Name, type, shape and bytes of a tensor.
type TensorParts<'a> = (&'a str, Dtype, &'a [usize], &'a [u8]);

/// SHA-256 over the metadata and the tensors, whatever their order.
fn digest_of<'a>(metadata: &str, tensors: impl Iterator<Item = TensorParts<'a>>) -> String {
    let mut tensors: Vec<_> = tensors.collect();
    tensors.sort_by_key(|(name, ..)| *name);
    let mut hash = Sha256::new();
    let mut field = |bytes: &[u8]| {
        hash.update((bytes.len() as u64).to_le_bytes());
        hash.update(bytes);
    };
    field(metadata.as_bytes());
    for (name, dtype, shape, bytes) in tensors {
        field(name.as_bytes());
        field(format!("{dtype:?} {shape:?}").as_bytes());
        field(bytes);
    }
    hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

/// A notice about the model or checkpoint `path` if it has no digest, because an earlier version wrote it.
///
/// # Errors
///
/// As [`Model::load`] for a file that is no model.
pub fn notice_without_digest(path: &Path) -> Result<Option<String>> {
    let bytes = read_file(path)?;
    let (_, header) = SafeTensors::read_metadata(&bytes).map_err(damaged(path))?;
    let metadata = header.metadata().as_ref().and_then(|info| info.get(METADATA_KEY));
    Ok(metadata.filter(|metadata| unsealed(metadata).is_none()).map(|_| {
        format!(
            "{}: an earlier version wrote this file, without a digest: damage to it may go unnoticed",
            path.display()
        )
    }))
}

fn damaged(path: &Path) -> impl Fn(safetensors::SafeTensorError) -> Error {
    move |e| Error::data(path, format!("is no safetensors file, or is damaged: {e}"))
}

/// Longest header of a file: names and shapes of the tensors, and the metadata.
const MAX_HEADER_LEN: u64 = 4 << 20;

/// Reads a safetensors file whose length is the one that its header says.
pub(crate) fn read_file(path: &Path) -> Result<Vec<u8>> {
    let refuse = |message: String| Err(Error::data(path, format!("is no safetensors file, or is damaged: {message}")));
    let mut file = File::open(path).map_err(Error::io(path))?;
    let len = file.metadata().map_err(Error::io(path))?.len();
    let mut bytes = Vec::new();
    (&mut file).take(8).read_to_end(&mut bytes).map_err(Error::io(path))?;
    let Some(header_len) = bytes.first_chunk().map(|bytes| u64::from_le_bytes(*bytes)) else {
        return refuse(format!("it has {len} bytes"));
    };
    if header_len > MAX_HEADER_LEN {
        return refuse(format!("its header has {header_len} bytes, and at most {} MiB are read", MAX_HEADER_LEN >> 20));
    }
    (&mut file).take(header_len).read_to_end(&mut bytes).map_err(Error::io(path))?;
    let Ok(header) = serde_json::from_slice::<HashMap<String, HeaderEntry>>(&bytes[8..]) else {
        return refuse("its header cannot be read".into());
    };
    let end = header.values().filter_map(|entry| entry.data_offsets).map(|[_, end]| end).max().unwrap_or(0);
    let expected = 8 + header_len + end.min(u64::MAX / 2);
    if len != expected {
        return refuse(format!("it has {len} bytes, and its header says {expected}"));
    }
    if end > MAX_TENSOR_BYTES {
        let most = MAX_TENSOR_BYTES >> 20;
        return refuse(format!("it has {} MiB of numbers, and at most {most} MiB are read", end >> 20));
    }
    bytes.reserve_exact(end as usize);
    file.take(end).read_to_end(&mut bytes).map_err(Error::io(path))?;
    Ok(bytes)
}

/// Most numbers that are read, bytes: the weights of the largest network four times, as a checkpoint has them, and the rows.
const MAX_TENSOR_BYTES: u64 = 16 * MAX_PARAMETERS as u64 + (512 << 20);

/// What the header says of a tensor; the metadata have no offsets.
#[derive(Deserialize)]
struct HeaderEntry {
    data_offsets: Option<[u64; 2]>,
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
        std::fs::write(&path, tensor_bytes(&path, &[], metadata).unwrap()).unwrap();
        assert!(load().contains("is a model of format 99; this program reads format 1"));
    }

    #[test]
    fn a_flipped_bit_anywhere_is_an_error_that_names_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.safetensors");
        model().save(&path).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let header_len = u64::from_le_bytes(*bytes.first_chunk().unwrap()) as usize;
        // Every byte of the header, and some of the numbers. Spaces after the JSON say nothing.
        let text_len = 8 + bytes[8..8 + header_len].trim_ascii_end().len();
        for at in (0..text_len).chain((8 + header_len..bytes.len()).step_by(1009)) {
            let mut flipped = bytes.clone();
            flipped[at] ^= 1 << (at % 8);
            std::fs::write(&path, flipped).unwrap();
            let error = Model::load(&path).expect_err(&format!("byte {at}")).to_string();
            assert!(error.contains("m.safetensors"), "{error}");
        }
        assert!(notice_without_digest(&path).is_ok());
    }

    #[test]
    fn a_file_without_a_digest_still_loads_with_a_notice() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.safetensors");
        model().save(&path).unwrap();
        assert_eq!(notice_without_digest(&path).unwrap(), None);
        let bytes = std::fs::read(&path).unwrap();
        let header_len = u64::from_le_bytes(*bytes.first_chunk().unwrap()) as usize;
        let header = String::from_utf8(bytes[8..8 + header_len].to_vec()).unwrap();
        // As an earlier version wrote it: the same without the last entry of the metadata.
        let seal = header.find(r#",\"sha256\":\""#).unwrap();
        let old = format!("{}{}", &header[..seal], &header[seal + r#",\"sha256\":\"\""#.len() + 64..]);
        let old_file = [&(old.len() as u64).to_le_bytes()[..], old.as_bytes(), &bytes[8 + header_len..]].concat();
        std::fs::write(&path, old_file).unwrap();
        assert_eq!(Model::load(&path).unwrap(), model());
        assert!(notice_without_digest(&path).unwrap().unwrap().contains("m.safetensors: an earlier version"));
    }

    #[test]
    fn a_file_is_not_read_whole_before_its_length_is_checked() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.safetensors");
        let write = |header_len: u64, header: &str, len: u64| {
            std::fs::write(&path, [&header_len.to_le_bytes()[..], header.as_bytes()].concat()).unwrap();
            File::options().write(true).open(&path).unwrap().set_len(len).unwrap();
            Model::load(&path).unwrap_err().to_string()
        };
        let gib = 1 << 30;
        let huge = r#"{"a":{"dtype":"U8","shape":[8000000000],"data_offsets":[0,8000000000]}}"#;
        for (header_len, header, len, words) in [
            (80 << 20, "{", 100 << 20, "at most 4 MiB are read"),
            (2, "{}", 4 * gib, "its header says 10"),
            (huge.len() as u64, huge, 8 + huge.len() as u64 + 8_000_000_000, "MiB are read"),
        ] {
            let error = write(header_len, header, len);
            assert!(error.contains("m.safetensors") && error.contains(words), "{error}");
        }
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
