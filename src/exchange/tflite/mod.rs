//! TensorFlow Lite files, `.tflite`, for donkeycar and for LiteRT.
//!
//! The file is what donkeycar's linear pilot loads: one signature, `serving_default`, with the input `img_in`, float
//! `[1, height, width, 3]`, a camera image in RGB at the recipe's `source` size divided by 255, and the outputs `n_outputs0`
//! (steering) and `n_outputs1` (throttle), float `[1, 1]` each. Preprocessing is part of the graph; it begins with the whole grey
//! levels, so that a picture gives what it gives the engine. Batch normalisation is merged into the layer before it.
//!
//! The metadata has `label` (the units), `full_lock_deg`, `recipe` (TOML text) and `steersman_version`.

mod file;
mod graph;
mod network;

use steersman_kernels::Isa;

use self::file::Frame;
use self::graph::{Code, Graph, Options};
use super::chain::{chain, check_finite, check_size, fold_batch_norm};
use super::picture_graph;
use crate::dataset::OutputKind;
use crate::dataset::colour::Colour;
use crate::dataset::preprocess::Preprocessing;
use crate::error::{Error, Result};
use crate::model_file::Model;

/// Name of the input in the signature.
const INPUT: &str = "img_in";

/// Name of its tensor, which donkeycar looks for.
const INPUT_TENSOR: &str = "serving_default_img_in:0";

/// Names of steering and throttle. The interpreter hands the outputs over in the order of their names.
const OUTPUTS: [&str; 2] = ["n_outputs0", "n_outputs1"];

/// `model` as a TensorFlow Lite file. `throttle`, in [-1, 1], is the constant throttle of a model that gives none.
///
/// # Errors
///
/// [`Error::Usage`] if model and `throttle` give no throttle, or two; [`Error::Network`] names a layer whose weights do not fit
/// into a file, or are not finite after folding.
pub fn tflite(model: &Model, throttle: Option<f32>) -> Result<Vec<u8>> {
    let recipe = &model.recipe;
    let own_throttle = recipe.outputs.index(OutputKind::Throttle);
    check_throttle(model, throttle)?;
    let steps = fold_batch_norm(chain(&recipe.network(Isa::PORTABLE)?, &model.parameters));
    check_finite(&steps)?;
    check_size(&steps, "a TensorFlow Lite file")?;

    let mut graph = Graph::default();
    let [height, width] = recipe.preprocessing.source;
    let image = graph.input(INPUT_TENSOR, &[1, height, width, 3]);
    let picture = preprocessing(&mut graph, &recipe.preprocessing, &image);
    let answers = network::add(&mut graph, &steps, &picture);

    let answers = match recipe.outputs.count() {
        1 => vec![answers],
        count => graph.split(&answers, &vec!["outputs"; count]),
    };
    let steering = output(&mut graph, OUTPUTS[0], &answers[0], [1.0, 0.0]);
    let throttle = match (own_throttle, throttle) {
        (Some(index), _) => output(&mut graph, OUTPUTS[1], &answers[index], [1.0, 0.0]),
        (None, throttle) => output(&mut graph, OUTPUTS[1], &answers[0], [0.0, throttle.unwrap_or_default()]),
    };

    let description = format!("steersman {}: {}", env!("CARGO_PKG_VERSION"), recipe.about);
    let metadata = [
        ("label", recipe.outputs.label()),
        ("full_lock_deg", recipe.full_lock_deg.to_string()),
        ("recipe", recipe.to_toml()?),
        ("steersman_version", env!("CARGO_PKG_VERSION").into()),
    ];
    let frame = Frame {
        description: &description,
        inputs: &[(INPUT, image)],
        outputs: &[(OUTPUTS[0], steering), (OUTPUTS[1], throttle)],
        metadata: &metadata,
    };
    Ok(file::write(&graph, &frame))
}

fn check_throttle(model: &Model, throttle: Option<f32>) -> Result<()> {
    let outputs = &model.recipe.outputs;
    let wrong = |message: &str| Err(Error::Usage(message.into()));
    match throttle {
        Some(value) if !(-1.0..=1.0).contains(&value) => wrong("--throttle: must be a number from -1 to 1"),
        Some(_) if outputs.index(OutputKind::Throttle).is_some() => {
            wrong("the model gives its own throttle: leave --throttle away")
        }
        None if outputs.index(OutputKind::Speed).is_some() => wrong(
            "the model gives a speed, and donkeycar takes a throttle: --throttle VALUE leaves the speed out and drives at a \
             constant throttle; or train with the output `throttle`, as the recipe `donkey` does",
        ),
        None if outputs.index(OutputKind::Throttle).is_none() => wrong(
            "the model steers only, and donkeycar takes a throttle too: --throttle VALUE drives at a constant one; or train \
             with the output `throttle`, as the recipe `donkey` does",
        ),
        _ => Ok(()),
    }
}

/// Adds `answer · factor + offset` as an output of the graph. An output has its own operator, so that it has its own memory.
fn output(graph: &mut Graph, name: &str, answer: &str, [factor, offset]: [f32; 2]) -> String {
    let weight = graph.floats(&format!("{name}.weight"), &[1, 1], &[factor]);
    let bias = graph.floats(&format!("{name}.bias"), &[1], &[offset]);
    let options = Options::FullyConnected { relu: false };
    graph.operator(Code::FullyConnected, name, &[answer, &weight, &bias], options, &[1, 1])
}

/// Adds the operators from `image`, grey levels divided by 255, to the network's input `[1, h, w, c]`.
fn preprocessing(graph: &mut Graph, spec: &Preprocessing, image: &str) -> String {
    let name = "preprocessing";
    let [first, end] = spec.rows;
    let width = spec.source[1];
    let mut x = image.to_string();
    if spec.rows != [0, spec.source[0]] {
        x = graph.slice(name, &x, &[0, first, 0, 0], &[1, end - first, width, 3]);
    }
    let by = |graph: &mut Graph, code: Code, x: &str, value: f64| {
        let value = graph.floats(name, &[], &[value as f32]);
        graph.elementwise(code, name, &[x, &value])
    };
    let is_affine = !spec.blur && [end - first, width] == spec.resize && spec.colour == Colour::Rgb;
    let mut scale = spec.scale;
    if is_affine {
        // The division by 255 goes into the scale.
        scale *= 255.0;
    } else {
        let levels = by(graph, Code::Mul, &x, 255.0);
        let levels = graph.elementwise(Code::Round, name, &[&levels]);
        x = picture_graph::add(graph, spec, &levels);
    }
    if scale as f32 != 1.0 {
        x = by(graph, Code::Mul, &x, scale);
    }
    if spec.offset as f32 != 0.0 {
        x = by(graph, Code::Add, &x, spec.offset);
    }
    x
}
