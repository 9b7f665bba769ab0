//! The files: HDF5 of Keras 1 and 2, the zip archive of Keras 3, and where each keeps its weights.
//!
//! Memory stays within a small multiple of the file: sizes that a file declares are believed only up to [`INFLATION`] times
//! its own length.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::Path;

use serde::Deserialize;

use super::architecture::KerasLayer;
use super::hdf5::{self, Attribute, Dataset, Group};
use super::limits::MAX_JSON_BYTES;
use super::messages::{shown, shown_list};
use crate::error::{Error, Result};
use crate::files::zip_archive::ZipArchive;

/// Larger files are refused: networks that steer have megabytes.
const MAX_FILE_BYTES: u64 = 1 << 30;

/// How many times longer than the file its unpacked content may be. Weights hardly shrink.
const INFLATION: usize = 16;

/// An opened file.
pub(super) struct KerasFile {
    /// The architecture's JSON, if the file has one.
    pub architecture: Option<String>,
    /// Version of Keras that wrote it, if it says.
    pub keras_version: Option<String>,
    /// `tensorflow`, `theano` …, if it says.
    pub backend: Option<String>,
    /// The weights.
    pub weights: Weights,
}

impl KerasFile {
    /// Opens `path`: HDF5 or a zip archive, by content.
    pub fn open(path: &Path) -> Result<KerasFile> {
        let len = std::fs::metadata(path).map_err(Error::io(path))?.len();
        if len > MAX_FILE_BYTES {
            return Err(Error::data(path, format!("has {len} bytes; more than {MAX_FILE_BYTES} are not read")));
        }
        let bytes = std::fs::read(path).map_err(Error::io(path))?;
        KerasFile::parse(bytes).map_err(|message| Error::data(path, message))
    }

    fn parse(bytes: Vec<u8>) -> Result<KerasFile, String> {
        if bytes.starts_with(b"version https://git-lfs") {
            return Err(
                "is a pointer of Git LFS, not the model itself: `git lfs pull` in its repository fetches the model"
                    .into(),
            );
        }
        if bytes.get(4..8) == Some(b"TFL3") {
            return Err(
                "is a TensorFlow Lite file, which is not read: import the Keras file (.h5 or .keras) that it was made \
                        from"
                    .into(),
            );
        }
        if bytes.starts_with(b"PK") { KerasFile::from_zip(bytes) } else { KerasFile::from_hdf5(bytes) }
    }

    fn from_zip(bytes: Vec<u8>) -> Result<KerasFile, String> {
        let limit = inflated(bytes.len());
        let mut source = Cursor::new(bytes);
        let archive = ZipArchive::open(&mut source)?;
        let mut entry = |name: &str, limit: usize| -> Result<Vec<u8>, String> {
            let entry = archive.find(name).ok_or_else(|| format!("has no `{name}`"))?;
            ZipArchive::read(&mut source, entry, limit as u64).map_err(|message| format!("`{name}` {message}"))
        };
        let text = |bytes: Vec<u8>, name: &str| String::from_utf8(bytes).map_err(|_| format!("`{name}` is no text"));
        let architecture = text(entry("config.json", MAX_JSON_BYTES)?, "config.json")?;
        let metadata = entry("metadata.json", MAX_JSON_BYTES).ok();
        let metadata = metadata.and_then(|bytes| serde_json::from_slice::<Metadata>(&bytes).ok());
        let root = open_hdf5(entry("model.weights.h5", limit)?)?;
        Ok(KerasFile {
            architecture: Some(architecture),
            keras_version: metadata.and_then(|metadata| metadata.keras_version).map(|version| shown(&version)),
            backend: None,
            weights: Weights::find(&root)?,
        })
    }

    fn from_hdf5(bytes: Vec<u8>) -> Result<KerasFile, String> {
        let root = open_hdf5(bytes)?;
        let text = |name: &str| strings(&root, name).ok().and_then(|mut all| all.pop());
        let weights = Weights::find(&root)?;
        let beside_weights = |name: &str| strings(&weights.group, name).ok().and_then(|mut all| all.pop());
        let architecture = text("model_config");
        if let Some(len) = architecture.as_ref().map(String::len).filter(|len| *len > MAX_JSON_BYTES) {
            return Err(format!("its architecture has {len} bytes; more than {MAX_JSON_BYTES} are not read"));
        }
        let keras_version = text("keras_version").or_else(|| beside_weights("keras_version"));
        Ok(KerasFile {
            architecture,
            keras_version: keras_version.map(|version| shown(&version)),
            backend: text("backend").or_else(|| beside_weights("backend")),
            weights,
        })
    }
}

/// What of `metadata.json` matters here; the rest is not kept.
#[derive(Deserialize)]
struct Metadata {
    keras_version: Option<String>,
}

fn inflated(len: usize) -> usize {
    len.saturating_mul(INFLATION)
}

/// A reader's message, which may repeat what it found in the file.
fn said(message: String) -> String {
    shown(&message)
}

fn open_hdf5(bytes: Vec<u8>) -> Result<Group, String> {
    let neither = "is neither an HDF5 file nor the zip archive of Keras 3, or is damaged";
    hdf5::open(bytes).map_err(|message| format!("{neither}: {}", said(message)))
}

/// The strings of attribute `name`; of `name0`, `name1`, … where Keras had to split a long list.
fn strings(group: &Group, name: &str) -> Result<Vec<String>, String> {
    let attributes = group
        .attributes()
        .map_err(|e| format!("the attributes of `{}` are damaged: {}", shown(group.name()), said(e)))?;
    let find = |name: &str| attributes.iter().find(|attribute| attribute.name == name);
    if let Some(attribute) = find(name) {
        return list(attribute);
    }
    let mut all = Vec::new();
    for part in 0.. {
        match find(&format!("{name}{part}")) {
            Some(attribute) => all.extend(list(attribute)?),
            None if part == 0 => return Err(format!("`{}` has no attribute `{name}`", shown(group.name()))),
            None => break,
        }
    }
    Ok(all)
}

fn list(attribute: &Attribute) -> Result<Vec<String>, String> {
    // numpy writes an empty list as an array of zero numbers.
    if attribute.shape.contains(&0) {
        return Ok(Vec::new());
    }
    attribute.strings().map_err(|e| format!("attribute `{}` is no list of names: {}", shown(&attribute.name), said(e)))
}

/// The tensors of a file, by layer.
pub(super) struct Weights {
    group: Group,
    /// Groups of the layers that have tensors, in the order of the file; the name is Keras' name of the layer.
    layers: Vec<(String, Group)>,
    kind: Kind,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    /// `weight_names` lists the tensors of a layer.
    Listed,
    /// The tensors of a layer are `vars/0`, `vars/1`, …
    Numbered {
        /// The groups go by the layers' classes (`conv2d`, `conv2d_1`), not by their names.
        by_class: bool,
    },
}

impl Weights {
    fn find(root: &Group) -> Result<Weights, String> {
        let group = root.group("model_weights").unwrap_or_else(|_| root.clone());
        if let Ok(names) = strings(&group, "layer_names") {
            let mut layers = Vec::new();
            for name in names {
                // Names of Keras 2 may have slashes, which are groups in groups.
                let mut parts = name.split('/').filter(|part| !part.is_empty());
                let layer = parts.try_fold(group.clone(), |group, part| group.group(part));
                let layer =
                    layer.map_err(|e| format!("layer `{}` has no group of weights: {}", shown(&name), said(e)))?;
                if !strings(&layer, "weight_names").unwrap_or_default().is_empty() {
                    layers.push((name, layer));
                }
            }
            return Ok(Weights { group, layers, kind: Kind::Listed });
        }
        let container = group.group("layers").or_else(|_| group.group("_layer_checkpoint_dependencies"));
        let container =
            container.map_err(|_| "has no weights: neither `layer_names` nor a group `layers`".to_string())?;
        let (mut layers, mut by_class) = (Vec::new(), false);
        for layer in container.groups().map_err(|e| format!("the list of layers is damaged: {}", said(e)))? {
            let Ok(tensors) = layer.group("vars") else { continue };
            let name = strings(&tensors, "name").ok().and_then(|mut names| names.pop());
            by_class |= name.is_none();
            layers.push((layer.name().to_string(), name, tensors));
        }
        // Earlier versions of Keras 3 did not note the names.
        let named = |(key, name, tensors): (String, Option<String>, Group)| match name {
            Some(name) if !by_class => (name, tensors),
            _ => (key, tensors),
        };
        let layers = layers.into_iter().map(named).collect();
        Ok(Weights { group, layers, kind: Kind::Numbered { by_class } })
    }

    /// The tensors of each of `layers`, which is the whole chain, in its order. Tensors are found by the names of their layers;
    /// where those are others than in the architecture, as in files of another run, by the order of the layers that have some.
    pub fn of_chain(&self, layers: &[KerasLayer], has_weights: &[bool]) -> Result<Vec<Vec<Tensor>>, String> {
        let keys = match self.kind {
            Kind::Numbered { by_class: true } => class_keys(layers),
            _ => layers.iter().map(|layer| layer.name.clone()).collect(),
        };
        let by_name: BTreeMap<&str, &Group> = self.layers.iter().map(|(name, group)| (name.as_str(), group)).collect();
        let wanted = || keys.iter().zip(has_weights).filter(|(_, has)| **has).map(|(key, _)| key.as_str());
        let mut in_order = Vec::new();
        if let Some(missing) = wanted().find(|key| !by_name.contains_key(key)) {
            let count = wanted().count();
            if self.kind != Kind::Listed || count != self.layers.len() {
                return Err(format!(
                    "has no weights for layer `{}`; it has them for {}: do architecture and weights belong together?",
                    shown(missing),
                    shown_list(self.layers.iter().map(|(name, _)| name.as_str()))
                ));
            }
            in_order.extend(self.layers.iter().map(|(_, group)| group));
        }
        let mut in_order = in_order.into_iter();
        let mut next = |key: &str| in_order.next().or_else(|| by_name.get(key).copied());
        keys.iter()
            .zip(has_weights)
            .map(|(key, has)| match has.then(|| next(key)).flatten() {
                Some(group) => self.tensors(group),
                None => Ok(Vec::new()),
            })
            .collect()
    }

    fn tensors(&self, layer: &Group) -> Result<Vec<Tensor>, String> {
        if self.kind == Kind::Listed {
            let open = |name: String| {
                let mut parts: Vec<&str> = name.split('/').filter(|part| !part.is_empty()).collect();
                let last = parts.pop().unwrap_or_default();
                let dataset = parts.iter().try_fold(layer.clone(), |group, part| group.group(part));
                let dataset = dataset.and_then(|group| group.dataset(last));
                let name = shown(&name);
                let dataset =
                    dataset.map_err(|e| format!("tensor `{name}` of `{}`: {}", shown(layer.name()), said(e)))?;
                Ok(Tensor { name, dataset })
            };
            return strings(layer, "weight_names")?.into_iter().map(open).collect();
        }
        let damaged = |e| format!("the tensors of a layer are damaged: {}", said(e));
        let mut datasets = layer.datasets().map_err(damaged)?;
        datasets.sort_by_key(|dataset| dataset.name().parse::<u64>().unwrap_or(u64::MAX));
        Ok(datasets.into_iter().map(|dataset| Tensor { name: shown(dataset.name()), dataset }).collect())
    }
}

/// One tensor of a layer; its numbers are read when its shape has been found right.
pub(super) struct Tensor {
    /// Its name in the file, as messages show it.
    pub name: String,
    dataset: Dataset,
}

impl Tensor {
    /// Extent of each axis.
    pub fn shape(&self) -> Vec<usize> {
        self.dataset.shape().iter().map(|extent| usize::try_from(*extent).unwrap_or(usize::MAX)).collect()
    }

    /// The numbers, row-major; all of them finite.
    pub fn read(&self) -> Result<Vec<f32>, String> {
        let values = self.dataset.read().map_err(|message| format!("tensor `{}`: {}", self.name, said(message)))?;
        match values.iter().position(|value| !value.is_finite()) {
            Some(place) => Err(format!("tensor `{}` has {} at place {place}", self.name, values[place])),
            None => Ok(values),
        }
    }
}

/// What Keras 3 calls the groups of layers where it does not note their names: class and number.
fn class_keys(layers: &[KerasLayer]) -> Vec<String> {
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    let mut key = |layer: &KerasLayer| {
        let class = snake_case(&layer.class);
        let count = counts.entry(class.clone()).or_default();
        *count += 1;
        if *count == 1 { class } else { format!("{class}_{}", *count - 1) }
    };
    layers.iter().map(&mut key).collect()
}

/// `BatchNormalization` as `batch_normalization`, `PReLU` as `p_re_lu`, `Conv2D` as `conv2d`, the way Keras does it.
fn snake_case(class: &str) -> String {
    let chars: Vec<char> = class.chars().filter(|c| c.is_alphanumeric()).collect();
    let mut text = String::new();
    for (i, c) in chars.iter().enumerate() {
        let before = i.checked_sub(1).map(|i| chars[i]);
        let word_begins = c.is_ascii_uppercase() && chars.get(i + 1).is_some_and(char::is_ascii_lowercase);
        let word_ended = c.is_ascii_uppercase() && before.is_some_and(|c| c.is_ascii_lowercase());
        if before.is_some() && (word_begins || word_ended) {
            text.push('_');
        }
        text.extend(c.to_lowercase());
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn classes_become_group_names_as_in_keras() {
        for (class, name) in [
            ("BatchNormalization", "batch_normalization"),
            ("PReLU", "p_re_lu"),
            ("LeakyReLU", "leaky_re_lu"),
            ("Conv2D", "conv2d"),
            ("ZeroPadding2D", "zero_padding2d"),
            ("GlobalAveragePooling2D", "global_average_pooling2d"),
            ("ELU", "elu"),
            ("InputLayer", "input_layer"),
        ] {
            assert_eq!(snake_case(class), name);
        }
        let layer = |class: &str| KerasLayer { name: "x".into(), class: class.into(), config: Default::default() };
        assert_eq!(class_keys(&[layer("Dense"), layer("ELU"), layer("Dense")]), ["dense", "elu", "dense_1"]);
    }

    #[test]
    fn what_is_neither_format_is_an_error() {
        for (bytes, named) in [
            (&b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n"[..], "git lfs pull"),
            (b"\x1c\0\0\0TFL3\0\0", "TensorFlow Lite"),
        ] {
            let message = KerasFile::parse(bytes.to_vec()).map(drop).unwrap_err();
            assert!(message.contains(named), "{message}");
        }
        for bytes in [&b""[..], b"PK\x03\x04", b"hello", b"\x89HDF\r\n\x1a\n"] {
            assert!(KerasFile::parse(bytes.to_vec()).is_err());
        }
    }
}
