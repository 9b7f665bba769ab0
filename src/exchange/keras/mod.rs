//! Models that Keras saved: HDF5 of Keras 1 and 2, and the `.keras` archive of Keras 3.
//!
//! `file` opens a file and finds architecture and weights. `architecture` reads the JSON into a chain of layers. `translate`
//! finds the counterpart of each layer, `lambda` what a `Lambda` layer computes. `assemble` checks the shapes and permutes the
//! weights. No code of a file is executed and no size in it is trusted; what does not fit is an error that names the layer.
//!
//! A file does not say how an image becomes the network's input: colour space, crop, and often the scaling.

mod architecture;
mod assemble;
mod file;
mod hdf5;
mod lambda;
mod limits;
mod marshal;
mod messages;
mod translate;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::Serialize;
use steersman_kernels::Isa;

use self::assemble::{Assembly, Context};
use self::file::KerasFile;
use self::lambda::LambdaAffine;
use self::limits::{MAX_JSON_BYTES, check_size};
use self::messages::{Problem, listed, shown};
use self::translate::{AxisOrder, KerasStep, Operation};
use crate::dataset::preprocess::Preprocessing;
use crate::dataset::{OutputKind, Outputs};
use crate::engine::network::{LayerSpec, Network, Parameters};
use crate::engine::tensor::Shape;
use crate::error::{Error, Result};
use crate::model_file::{Model, TrainingRecord};
use crate::recipe::Recipe;

/// What the user adds to the file.
#[derive(Clone, Debug, Default)]
pub struct ImportOptions {
    /// Architecture as JSON, for files that hold weights only; it replaces the one in the file.
    pub architecture: Option<PathBuf>,
    /// What `Lambda` layers compute, by name: a and b of x / a − b.
    pub lambdas: BTreeMap<String, (f64, f64)>,
    /// Whether the weights were trained on Theano, whose convolution rotates its kernels by 180 degrees. Files since Keras 2
    /// say so themselves.
    pub theano_kernels: bool,
    /// Shape of the input for files that leave it out.
    pub input: Option<Shape>,
    /// The first output straight on, and how much more it is at full lock to the right, where that is not 0 and 1.
    pub output_scale: Option<[f64; 2]>,
}

/// An imported network.
#[derive(Clone, Debug)]
pub struct Imported {
    /// Shape of one input image.
    pub input: Shape,
    /// The layers.
    pub layers: Vec<LayerSpec>,
    /// Their parameters.
    pub parameters: Parameters,
    /// What the network gives: the steering, or steering and throttle.
    pub outputs: Outputs,
    /// Version of Keras that wrote the file, if it says.
    pub keras_version: Option<String>,
    /// What became of each layer of the file.
    pub report: Vec<LayerReport>,
    /// What the user should know.
    pub notices: Vec<String>,
}

impl Imported {
    /// Whether `preprocessing` gives what the network takes.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] if it gives another shape.
    pub fn check_input(&self, preprocessing: &Preprocessing) -> Result<()> {
        let [c, h, w] = preprocessing.output();
        let Shape { c: planes, h: rows, w: columns } = self.input;
        if [c, h, w] == [planes, rows, columns] {
            return Ok(());
        }
        Err(Error::Usage(format!(
            "the network takes images of {rows}x{columns} with {planes} colour planes, the preprocessing gives {h}x{w} \
             with {c}: set its resize and colour accordingly"
        )))
    }

    /// The model called `name` that sees images through `preprocessing`. Its recipe has Adam at a small rate, for training it
    /// further.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] as [`check_input`](Imported::check_input); [`Error::Recipe`] if the numbers do not go into a recipe.
    pub fn into_model(self, name: &str, preprocessing: Preprocessing) -> Result<Model> {
        self.check_input(&preprocessing)?;
        let version = self.keras_version.map_or(String::new(), |version| format!(" {version}"));
        let table = |e: toml::ser::Error| Error::Recipe { recipe: name.into(), message: e.to_string() };
        let optimizer = toml::toml! {
            kind = "adam"
            learning_rate = 1e-4
        };
        let mut recipe = toml::Table::new();
        recipe.insert("name".into(), name.into());
        recipe.insert("about".into(), format!("imported from Keras{version}").into());
        recipe.insert("epochs".into(), 10.into());
        recipe.insert("batch".into(), 64.into());
        recipe.insert("layers".into(), toml::Value::try_from(&self.layers).map_err(table)?);
        if !self.outputs.is_default() {
            recipe.insert("outputs".into(), toml::Value::try_from(&self.outputs).map_err(table)?);
        }
        recipe.insert("preprocessing".into(), toml::Value::try_from(&preprocessing).map_err(table)?);
        recipe.insert("optimizer".into(), optimizer.into());
        let recipe = Recipe::parse(name, &recipe.to_string(), &[])?;
        let record = TrainingRecord { version: env!("CARGO_PKG_VERSION").into(), ..TrainingRecord::default() };
        Ok(Model { recipe, parameters: self.parameters, record, training_rows: Vec::new() })
    }
}

/// What became of a layer.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LayerReport {
    /// Its name in the file.
    pub layer: String,
    /// Its class in the file.
    pub class: String,
    /// Names of the layers that stand for it.
    pub becomes: Vec<String>,
}

/// Reads the model in `path`.
///
/// # Errors
///
/// [`Error::Io`] if a file cannot be read; [`Error::Data`] if it is damaged, is no model of Keras, gives more than two numbers,
/// or has layers without a counterpart, which are listed with the reason.
pub fn import(path: &Path, options: &ImportOptions) -> Result<Imported> {
    let file = KerasFile::open(path)?;
    let wrong = |message: String| Error::data(path, message);
    let (place, text) = match (&options.architecture, &file.architecture) {
        (Some(json), _) => (json.as_path(), read_architecture(json)?),
        (None, Some(text)) => (path, text.clone()),
        (None, None) => {
            return Err(wrong(
                "has weights only; give the architecture that Keras' to_json wrote: --architecture FILE.json".into(),
            ));
        }
    };
    let chain = architecture::chain(&text).map_err(|message| Error::data(place, message))?;
    let mut unknown: BTreeSet<&String> = options.lambdas.keys().collect();

    let mut problems = chain.problems;
    let mut steps = Vec::new();
    for layer in &chain.layers {
        unknown.remove(&layer.name);
        let known = options.lambdas.get(&layer.name).map(|(a, b)| LambdaAffine { factor: 1.0 / a, offset: -b });
        match translate::translate(layer, known) {
            Ok(step) => steps.push(step),
            Err(reason) if problems.iter().all(|problem| problem.layer != layer.name) => {
                problems.push(layer.problem(reason));
            }
            Err(_) => {}
        }
    }
    if let Some(name) = unknown.first() {
        return Err(wrong(format!("has no layer `{name}`, which --lambda names")));
    }
    let order = axis_order(&chain.layers, &steps, &mut problems);
    if !problems.is_empty() {
        return Err(wrong(listed(&problems)));
    }

    let said = steps.iter().find_map(|step| step.input.as_ref()).or(chain.input.as_ref());
    let input = input_shape(said, order, options.input).map_err(wrong)?;
    let has_weights: Vec<bool> = steps.iter().map(|step| step.operation.has_weights()).collect();
    let tensors = file.weights.of_chain(&chain.layers, &has_weights).map_err(wrong)?;
    let flip_kernels = options.theano_kernels || file.backend.as_deref() == Some("theano");
    let context = Context { input, order, flip_kernels };
    let assembly =
        assemble::assemble(&context, &chain.layers, &steps, &tensors, chain.heads).map_err(|p| wrong(listed(&[p])))?;
    let Assembly { specs, mut parameters, ends } = assembly;
    let network = Network::new(input, &specs, Isa::PORTABLE)?;
    if let Some([straight, span]) = options.output_scale {
        scale_first_output(&network, &mut parameters, straight, span).map_err(wrong)?;
    }
    let heads = &chain.layers[chain.layers.len() - chain.heads..];
    let names: Vec<&str> = heads.iter().map(|layer| layer.name.as_str()).collect();
    let mut notices = Vec::new();
    let outputs = match (network.output().len(), &names[..]) {
        (1, _) => Outputs::default(),
        // No layer of a file is called so by chance.
        (2, [first, second]) if first.contains("throttle") && !second.contains("throttle") => {
            return Err(wrong(format!(
                "gives `{}` before `{}`: a model here gives the steering first; save it with its outputs in that order",
                shown(first),
                shown(second)
            )));
        }
        (2, _) => {
            let named = names.iter().map(|name| format!("`{}`", shown(name))).collect::<Vec<_>>().join(" and ");
            notices.push(format!("gives two numbers ({named}): the first counts as steering, the second as throttle"));
            Outputs::with(OutputKind::Throttle, None)
        }
        (outputs, _) => {
            return Err(wrong(format!(
                "gives {outputs} numbers for an image; a model here gives one, the steering, or two, steering and throttle"
            )));
        }
    };

    let mut report = Vec::new();
    let mut start = 0;
    for ((layer, step), end) in chain.layers.iter().zip(&steps).zip(ends) {
        let becomes = network.layers()[start..end].iter().map(|layer| layer.name.clone()).collect();
        let (name, class) = (shown(&layer.name), shown(&layer.class));
        notices.extend(step.notice.map(|notice| format!("{name} ({class}): {notice}")));
        report.push(LayerReport { layer: name, class, becomes });
        // The heads are one layer.
        start = if chain.heads > 1 && end == network.layers().len() { start } else { end };
    }
    if order == AxisOrder::ChannelsFirst && file.backend.is_none() && !flip_kernels {
        notices.push(
            "the file does not say whether it was trained on Theano, whose kernels are turned by 180 degrees: \
             if it steers badly, try --theano-kernels"
                .into(),
        );
    }
    Ok(Imported { input, layers: specs, parameters, outputs, keras_version: file.keras_version, report, notices })
}

/// Makes the first output of the last dense layer `(y − straight) / span`.
fn scale_first_output(network: &Network, parameters: &mut Parameters, straight: f64, span: f64) -> Result<(), String> {
    let last = network.layers().iter().rev().find(|layer| !matches!(layer.spec, LayerSpec::Dropout(_)));
    let last = last.filter(|layer| matches!(layer.spec, LayerSpec::Dense(_))).ok_or(
        "--output-scale needs a network that ends with a dense layer without an activation, whose weights it changes",
    )?;
    let (inputs, units) = (last.layer.input().len(), last.layer.output().len());
    let values = &mut parameters.values[last.params.clone()];
    values[..inputs].iter_mut().for_each(|weight| *weight = (f64::from(*weight) / span) as f32);
    let bias = &mut values[inputs * units];
    *bias = ((f64::from(*bias) - straight) / span) as f32;
    Ok(())
}

fn read_architecture(path: &Path) -> Result<String> {
    let len = std::fs::metadata(path).map_err(Error::io(path))?.len();
    if len > MAX_JSON_BYTES as u64 {
        return Err(Error::data(path, format!("has {len} bytes, which is no architecture")));
    }
    std::fs::read_to_string(path).map_err(Error::io(path))
}

/// The order of axes that all layers of the chain agree on.
fn axis_order(layers: &[architecture::KerasLayer], steps: &[KerasStep], problems: &mut Vec<Problem>) -> AxisOrder {
    // Flatten has an order of its own.
    let says = |step: &KerasStep| step.order.filter(|_| step.operation != Operation::Flatten);
    let order = steps.iter().find_map(says).unwrap_or(AxisOrder::ChannelsLast);
    if layers.len() == steps.len() {
        for (layer, _) in layers.iter().zip(steps).filter(|(_, step)| says(step).is_some_and(|own| own != order)) {
            problems.push(layer.problem("has another order of axes than the layers before it"));
        }
    }
    order
}

/// Shape of the input: what the file says, or else what the user's preprocessing gives.
fn input_shape(said: Option<&Vec<usize>>, order: AxisOrder, given: Option<Shape>) -> Result<Shape, String> {
    let shape = match said.map(Vec::as_slice) {
        Some(&[a, b, c]) if a > 0 && b > 0 && c > 0 => match order {
            AxisOrder::ChannelsLast => Shape::new(c, a, b),
            AxisOrder::ChannelsFirst => Shape::new(a, b, c),
        },
        Some(extents) if extents.len() != 3 => {
            let axes = extents.len();
            return Err(format!(
                "its input has {axes} axes, which is no image: an image has height, width and colours"
            ));
        }
        _ => given.ok_or(
            "does not say how large its input is: give the preprocessing, whose size it then is, with --preprocessing",
        )?,
    };
    check_size(shape).map_err(|message| format!("its input: {message}"))?;
    Ok(shape)
}
