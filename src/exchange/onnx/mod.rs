//! ONNX files, for ONNX Runtime and everything else that reads them.
//!
//! The graph uses operators of opset 17 only, with a free batch dimension `N`. It takes either the preprocessed picture,
//! `input` float `[N, c, h, w]`, or with the preprocessing in the graph the camera image, `image` uint8
//! `[N, height, width, 3]` in RGB at the recipe's `source` size. It gives `steering` float `[N, 1]`, and of a model with more outputs
//! `throttle` or `speed` behind it, float `[N, 1]` too.
//!
//! The metadata has `label` (the units), `full_lock_deg`, `top_speed_mph` (of models that give a speed), `recipe` (TOML text) and
//! `steersman_version`.

mod graph;
mod preprocessing;
mod proto;

use prost::Message;
use steersman_kernels::Isa;

use self::graph::{GraphBuilder, float, int, ints};
use self::proto::{DataType, ModelProto, OperatorSetIdProto, StringStringEntryProto};
use super::chain::{ChainStep, chain, check_finite, check_size, fold_batch_norm};
use crate::dataset::Outputs;
use crate::engine::layers::{ExportForm, Formula, Function};
use crate::error::Result;
use crate::model_file::Model;

/// Version of the set of standard operators. ONNX Runtime reads it from 1.12 (2022) on.
pub const OPSET: i64 = 17;

/// Version of the file format that came with [`OPSET`].
const IR_VERSION: i64 = 8;

/// How to write an ONNX file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct OnnxOptions {
    /// Take the camera image instead of the preprocessed picture.
    pub with_preprocessing: bool,
    /// Merge batch normalisation into the layer before it.
    pub fold_batch_norm: bool,
}

/// `model` as an ONNX file.
///
/// # Errors
///
/// [`Error::Network`](crate::Error::Network) names a layer whose weights do not fit into an ONNX file, or are not finite after folding.
pub fn onnx(model: &Model, options: OnnxOptions) -> Result<Vec<u8>> {
    let recipe = &model.recipe;
    let mut steps = chain(&recipe.network(Isa::PORTABLE)?, &model.parameters);
    if options.fold_batch_norm {
        steps = fold_batch_norm(steps);
    }
    check_finite(&steps)?;
    check_size(&steps, "an ONNX file")?;

    let mut graph = GraphBuilder::default();
    let [c, h, w] = recipe.preprocessing.output();
    if options.with_preprocessing {
        let [height, width] = recipe.preprocessing.source;
        graph.input("image", DataType::Uint8, &[height, width, 3], "camera image, RGB, row by row");
        preprocessing::add(&mut graph, &recipe.preprocessing, "image", "input");
    } else {
        let doc = format!(
            "preprocessed picture: grey level * {} + {}",
            recipe.preprocessing.scale, recipe.preprocessing.offset
        );
        graph.input("input", DataType::Float, &[c, h, w], &doc);
    }
    network(&mut graph, &steps, "input", &recipe.outputs);
    for output in recipe.outputs.specs() {
        graph.output(output.name.name(), DataType::Float, &[1], &recipe.outputs.meaning(output.name));
    }

    let entry = |key: &str, value: String| StringStringEntryProto { key: key.into(), value };
    let top_speed = recipe.outputs.top_speed_mph().map(|mph| entry("top_speed_mph", mph.to_string()));
    let model = ModelProto {
        ir_version: IR_VERSION,
        producer_name: "steersman".into(),
        producer_version: env!("CARGO_PKG_VERSION").into(),
        doc_string: recipe.about.clone(),
        graph: Some(graph.finish(&recipe.name)),
        opset_import: vec![OperatorSetIdProto { domain: String::new(), version: OPSET }],
        metadata_props: [
            entry("label", recipe.outputs.label()),
            entry("full_lock_deg", recipe.full_lock_deg.to_string()),
            entry("recipe", recipe.to_toml()?),
            entry("steersman_version", env!("CARGO_PKG_VERSION").into()),
        ]
        .into_iter()
        .chain(top_speed)
        .collect(),
    };
    Ok(model.encode_to_vec())
}

/// Adds the nodes of the network, which reads `input`, `[N, c, h, w]`, and gives each of `outputs`, `[N, 1]`.
fn network(graph: &mut GraphBuilder, steps: &[ChainStep], input: &str, outputs: &Outputs) {
    let mut value = input.to_string();
    // A vector is [N, c] in ONNX, and [N, c, 1, 1] for the layers of maps.
    let mut is_map = true;
    for step in steps {
        let takes = match step.form {
            ExportForm::Conv { .. }
            | ExportForm::MaxPool { .. }
            | ExportForm::AveragePool { .. }
            | ExportForm::Crop { .. }
            | ExportForm::ZeroPad { .. }
            | ExportForm::Resize { .. } => Some(true),
            ExportForm::Dense { .. } | ExportForm::Flatten => Some(false),
            ExportForm::Identity
            | ExportForm::Elementwise(_)
            | ExportForm::BatchNorm { .. }
            | ExportForm::PRelu { .. } => None,
        };
        match takes {
            Some(true) if !is_map => {
                let shape =
                    graph.int64s(&format!("{}.map_shape", step.name), &[0, step.input.c, step.input.h, step.input.w]);
                value = graph.node("Reshape", &format!("{}.map", step.name), &[&value, &shape], vec![]);
            }
            Some(false) if is_map => {
                value = graph.node("Flatten", &format!("{}.vector", step.name), &[&value], vec![int("axis", 1)]);
            }
            _ => {}
        }
        is_map = takes.unwrap_or(is_map);
        value = operation(graph, step, &value, is_map);
    }
    if is_map {
        value = graph.node("Flatten", "vector", &[&value], vec![int("axis", 1)]);
    }
    let names: Vec<&str> = outputs.specs().iter().map(|output| output.name.name()).collect();
    match names[..] {
        [only] => {
            graph.node("Identity", only, &[&value], vec![]);
        }
        _ => {
            let lengths = graph.int64s("outputs.lengths", &vec![1; names.len()]);
            graph.node_with_outputs("Split", "outputs", &[&value, &lengths], &names, vec![int("axis", 1)]);
        }
    }
}

/// Adds the nodes of one step and returns the name of its result.
fn operation(graph: &mut GraphBuilder, step: &ChainStep, x: &str, is_map: bool) -> String {
    let ChainStep { name, input, output, form } = step;
    let constant = |what: &str| format!("{name}.{what}");
    match form {
        ExportForm::Conv { depthwise, kernel, stride, pads, weight, bias } => {
            let group = if *depthwise { input.c } else { 1 };
            let weight = graph.floats(&constant("weight"), &[output.c, input.c / group, kernel[0], kernel[1]], weight);
            let bias = graph.floats(&constant("bias"), &[output.c], bias);
            let pads = ints("pads", &[pads.top, pads.left, pads.bottom, pads.right]);
            let attributes =
                vec![ints("kernel_shape", kernel), ints("strides", stride), pads, int("group", group as i64)];
            graph.node("Conv", name, &[x, &weight, &bias], attributes)
        }
        ExportForm::Dense { weight, bias } => {
            let weight = graph.floats(&constant("weight"), &[output.len(), input.len()], weight);
            let bias = graph.floats(&constant("bias"), &[output.len()], bias);
            graph.node("Gemm", name, &[x, &weight, &bias], vec![int("transB", 1)])
        }
        ExportForm::BatchNorm { gamma, beta, mean, variance, epsilon } => {
            let mut tensor = |what: &str, values: &[f32]| graph.floats(&constant(what), &[input.c], values);
            let (gamma, beta) = (tensor("gamma", gamma), tensor("beta", beta));
            let (mean, variance) = (tensor("running_mean", mean), tensor("running_variance", variance));
            let inputs = [x, &gamma, &beta, &mean, &variance];
            graph.node("BatchNormalization", name, &inputs, vec![float("epsilon", *epsilon)])
        }
        ExportForm::Elementwise(formula) => elementwise(graph, name, name, formula, x, &mut 0),
        ExportForm::PRelu { slopes } => {
            // The slopes are broadcast from the right.
            let dims: &[usize] = match (is_map, slopes.len() == input.len()) {
                (false, _) => &[input.c],
                (true, true) => &[input.c, input.h, input.w],
                (true, false) => &[input.c, 1, 1],
            };
            let slopes = graph.floats(&constant("slope"), dims, slopes);
            graph.node("PRelu", name, &[x, &slopes], vec![])
        }
        ExportForm::MaxPool { window, stride } => {
            graph.node("MaxPool", name, &[x], vec![ints("kernel_shape", window), ints("strides", stride)])
        }
        ExportForm::AveragePool { window, stride } => {
            graph.node("AveragePool", name, &[x], vec![ints("kernel_shape", window), ints("strides", stride)])
        }
        ExportForm::Crop { top, left } => {
            let starts = graph.int64s(&constant("starts"), &[*top, *left]);
            let ends = graph.int64s(&constant("ends"), &[top + output.h, left + output.w]);
            let axes = graph.int64s(&constant("axes"), &[2, 3]);
            graph.node("Slice", name, &[x, &starts, &ends, &axes], vec![])
        }
        ExportForm::ZeroPad { top, left } => {
            let (bottom, right) = (output.h - input.h - top, output.w - input.w - left);
            let pads = graph.int64s(&constant("pads"), &[0, 0, *top, *left, 0, 0, bottom, right]);
            graph.node("Pad", name, &[x, &pads], vec![])
        }
        ExportForm::Resize { rows, columns } => {
            // The weights as matrices: rows · x · columns.
            let mut down = vec![0.0; output.h * input.h];
            for i in 0..output.h {
                let (first, weights) = rows.of(i);
                down[i * input.h + first..][..weights.len()].copy_from_slice(weights);
            }
            let mut across = vec![0.0; input.w * output.w];
            for j in 0..output.w {
                let (first, weights) = columns.of(j);
                weights.iter().enumerate().for_each(|(l, weight)| across[(first + l) * output.w + j] = *weight);
            }
            let down = graph.floats(&constant("rows"), &[output.h, input.h], &down);
            let across = graph.floats(&constant("columns"), &[input.w, output.w], &across);
            let rows = graph.node("MatMul", &constant("down"), &[&down, x], vec![]);
            graph.node("MatMul", name, &[&rows, &across], vec![])
        }
        ExportForm::Flatten | ExportForm::Identity => x.into(),
    }
}

/// Adds the nodes that compute `formula` of `x`, and returns the name of the result, which is `result` for the last node. Other
/// nodes and constants take the layer's name and a number.
fn elementwise(
    graph: &mut GraphBuilder,
    layer: &str,
    result: &str,
    formula: &Formula,
    x: &str,
    count: &mut usize,
) -> String {
    let mut part = |graph: &mut GraphBuilder, formula: &Formula| {
        *count += 1;
        let name = format!("{layer}.part{count}");
        elementwise(graph, layer, &name, formula, x, count)
    };
    match formula {
        Formula::X => x.into(),
        Formula::Number(number) => graph.floats(result, &[], &[*number]),
        Formula::Sum(terms) => {
            let terms = terms.each_ref().map(|term| part(graph, term));
            graph.node("Add", result, &terms.each_ref().map(String::as_str), vec![])
        }
        Formula::Product(factors) => {
            let factors = factors.each_ref().map(|factor| part(graph, factor));
            graph.node("Mul", result, &factors.each_ref().map(String::as_str), vec![])
        }
        Formula::Apply(function, argument) => {
            let (op, attributes) = match *function {
                Function::Relu => ("Relu", vec![]),
                Function::Elu { alpha } => ("Elu", vec![float("alpha", alpha)]),
                Function::LeakyRelu { slope } => ("LeakyRelu", vec![float("alpha", slope)]),
                Function::Tanh => ("Tanh", vec![]),
                Function::Softsign => ("Softsign", vec![]),
                Function::Sigmoid => ("Sigmoid", vec![]),
            };
            let argument = part(graph, argument);
            graph.node(op, result, &[&argument], attributes)
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::proto::GraphProto;
    use super::*;
    use crate::model_file::TrainingRecord;
    use crate::recipe::{Recipe, SHIPPED};

    fn model(name: &str) -> Model {
        let recipe = Recipe::find(name, &[]).unwrap();
        let parameters = recipe.network(Isa::PORTABLE).unwrap().initialize(1);
        Model { recipe, parameters, record: TrainingRecord::default(), training_rows: vec![] }
    }

    fn decode(name: &str, options: OnnxOptions) -> (ModelProto, GraphProto) {
        let decoded = ModelProto::decode(onnx(&model(name), options).unwrap().as_slice()).unwrap();
        let graph = decoded.graph.clone().unwrap();
        (decoded, graph)
    }

    #[test]
    fn every_value_is_made_once_and_before_it_is_used() {
        for (name, _) in SHIPPED {
            for (with_preprocessing, fold_batch_norm) in [(false, false), (true, false), (true, true)] {
                let (_, graph) = decode(name, OnnxOptions { with_preprocessing, fold_batch_norm });
                let inputs = graph.input.iter().map(|input| input.name.as_str());
                let mut known: HashSet<&str> = inputs.collect();
                for constant in &graph.initializer {
                    assert!(known.insert(&constant.name), "{name}: {} twice", constant.name);
                }
                for node in &graph.node {
                    assert!(node.input.iter().all(|input| known.contains(input.as_str())), "{name}: {node:?}");
                    assert!(node.output.iter().all(|output| known.insert(output)), "{name}: {node:?}");
                }
                assert!(known.contains("steering"), "{name}");
            }
        }
    }

    #[test]
    fn several_outputs_have_their_names_in_the_order_of_the_recipe() {
        let set = ["layers.last.units=2", "outputs=[{ name = 'steering' }, { name = 'speed', top_speed_mph = 28.5 }]"];
        let recipe = Recipe::find("lenet", &set.map(String::from)).unwrap();
        let parameters = recipe.network(Isa::PORTABLE).unwrap().initialize(1);
        let model = Model { recipe, parameters, record: TrainingRecord::default(), training_rows: vec![] };
        let decoded = ModelProto::decode(onnx(&model, OnnxOptions::default()).unwrap().as_slice()).unwrap();
        let graph = decoded.graph.unwrap();
        let names: Vec<&str> = graph.output.iter().map(|output| output.name.as_str()).collect();
        assert_eq!(names, ["steering", "speed"]);
        let split = graph.node.last().unwrap();
        assert_eq!((split.op_type.as_str(), &split.output[..]), ("Split", &["steering".into(), "speed".into()][..]));
        let entry = |key: &str| decoded.metadata_props.iter().find(|entry| entry.key == key).unwrap().value.clone();
        assert_eq!(entry("top_speed_mph"), "28.5");
        assert!(entry("label").contains("speed: speed to drive at; times 28.5"), "{}", entry("label"));
    }

    #[test]
    fn inputs_are_as_asked_for_and_the_batch_is_free() {
        for (with_preprocessing, expected) in [(false, vec![3, 40, 160]), (true, vec![160, 320, 3])] {
            let (_, graph) = decode("hyper", OnnxOptions { with_preprocessing, fold_batch_norm: false });
            let tensor = graph.input[0].r#type.clone().unwrap().tensor_type.unwrap();
            let dims = tensor.shape.unwrap().dim;
            assert_eq!(dims[0].dim_param.as_deref(), Some("N"));
            assert_eq!(dims[1..].iter().map(|dim| dim.dim_value.unwrap()).collect::<Vec<_>>(), expected);
        }
    }

    #[test]
    fn batch_norm_is_folded_only_when_asked_for() {
        let count = |fold_batch_norm| {
            let (_, graph) = decode("hyper", OnnxOptions { with_preprocessing: false, fold_batch_norm });
            graph.node.iter().filter(|node| node.op_type == "BatchNormalization").count()
        };
        assert_eq!((count(false), count(true)), (6, 0));
    }

    #[test]
    fn a_blur_is_a_convolution_with_a_group_for_each_channel() {
        let (_, graph) = decode("default", OnnxOptions::default());
        let blurs: Vec<_> = graph.node.iter().filter(|node| node.name.starts_with("blur")).collect();
        assert!(!blurs.is_empty());
        for blur in blurs {
            let weight = graph.initializer.iter().find(|constant| constant.name == blur.input[1]).unwrap();
            let group = blur.attribute.iter().find(|attribute| attribute.name == "group").unwrap();
            assert_eq!((blur.op_type.as_str(), &weight.dims[..]), ("Conv", &[group.i.unwrap(), 1, 3, 3][..]));
        }
    }

    #[test]
    fn the_metadata_says_how_to_use_it() {
        let (decoded, _) = decode("lenet", OnnxOptions::default());
        let entry = |key: &str| decoded.metadata_props.iter().find(|entry| entry.key == key).unwrap().value.clone();
        assert_eq!(entry("full_lock_deg"), "25");
        assert!(entry("label").contains("positive to the right"));
        assert_eq!(Recipe::parse("metadata", &entry("recipe"), &[]).unwrap(), model("lenet").recipe);
        assert_eq!(decoded.opset_import[0].version, OPSET);
    }
}
