//! Reads the architecture that Keras saved, JSON of many versions, into a chain of layers.

use std::collections::BTreeMap;

use serde_json::{Map, Value};

use super::messages::Problem;

/// One layer of the chain.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct KerasLayer {
    /// Its name, by which its weights are found.
    pub name: String,
    /// Its class, as in `Convolution2D`.
    pub class: String,
    /// Its options.
    pub config: Map<String, Value>,
}

impl KerasLayer {
    /// A problem with this layer.
    pub fn problem(&self, reason: impl Into<String>) -> Problem {
        Problem { layer: self.name.clone(), class: self.class.clone(), reason: reason.into() }
    }
}

/// Layers in the order in which they are computed.
#[derive(Debug)]
pub(super) struct Chain {
    pub layers: Vec<KerasLayer>,
    /// How many layers at the end read the same one, each giving outputs of its own, in the order of the outputs; 1 in a plain chain.
    pub heads: usize,
    /// Extents of the input without the batch, if they stand beside the layers; 0 where they are open.
    pub input: Option<Vec<usize>>,
    /// Reasons why the layers form no chain. If there are any, the layers stand in the order of the file.
    pub problems: Vec<Problem>,
}

/// Most layers of an architecture.
const MAX_LAYERS: usize = 1000;

/// The chain of layers in `text`.
///
/// `text` may be JSON inside a JSON string, as some programs saved it. The layers of a functional model are put in the order of
/// its connections.
///
/// # Errors
///
/// A message that says why `text` is no architecture.
pub(super) fn chain(text: &str) -> Result<Chain, String> {
    let mut value: Value = serde_json::from_str(text).map_err(|e| format!("its architecture is no JSON: {e}"))?;
    while let Value::String(inner) = value {
        value =
            serde_json::from_str(&inner).map_err(|e| format!("its architecture is no JSON in a JSON string: {e}"))?;
    }
    let config = value.get("config").unwrap_or(&value);
    let entries = match config {
        Value::Array(entries) => entries,
        Value::Object(object) => match object.get("layers") {
            Some(Value::Array(entries)) => entries,
            _ => return Err("its architecture has no list of layers".into()),
        },
        _ => return Err("its architecture has no list of layers".into()),
    };
    if entries.is_empty() || entries.len() > MAX_LAYERS {
        return Err(format!("its architecture has {} layers, not 1 to {MAX_LAYERS}", entries.len()));
    }
    let input = config.get("build_input_shape").and_then(Value::as_array).map(|extents| {
        let size = |extent: &Value| extent.as_u64().and_then(|extent| usize::try_from(extent).ok()).unwrap_or_default();
        extents.iter().skip(1).map(size).collect()
    });
    let mut nodes = Vec::new();
    for (index, entry) in entries.iter().enumerate() {
        nodes.push(node(index, entry)?);
    }
    if nodes.iter().all(|node| node.inputs.is_none()) {
        return Ok(Chain {
            layers: nodes.into_iter().map(|node| node.layer).collect(),
            heads: 1,
            input,
            problems: Vec::new(),
        });
    }
    let heads = heads(&nodes, config);
    let is_head = |node: &&Node| heads.contains(&node.layer.name.as_str());
    // The trunk and one of the heads are a chain.
    let names: Vec<String> = heads.iter().map(|name| name.to_string()).collect();
    let first = names.first().cloned();
    let chained: Vec<usize> = (nodes.iter().enumerate())
        .filter(|(_, node)| !is_head(node) || Some(&node.layer.name) == first.as_ref())
        .map(|(index, _)| index)
        .collect();
    let (of_chain, others): (Vec<_>, Vec<_>) =
        nodes.into_iter().enumerate().partition(|(index, _)| chained.contains(index));
    let nodes: Vec<Node> = of_chain.into_iter().map(|(_, node)| node).collect();
    let mut others: Vec<KerasLayer> = others.into_iter().map(|(_, node)| node.layer).collect();
    others.sort_by_key(|layer| names.iter().position(|name| *name == layer.name));
    let found = order(&nodes);
    let layers: Vec<KerasLayer> = nodes.into_iter().map(|node| node.layer).collect();
    let (mut layers, problems) = match found {
        Ok(order) => (order.into_iter().map(|index| layers[index].clone()).collect::<Vec<_>>(), vec![]),
        Err(problems) => (layers, problems),
    };
    layers.extend(others);
    Ok(Chain { layers, heads: names.len().max(1), input, problems })
}

/// Names of the dense layers that read one and the same layer and are read by none, in the order of the model's outputs; empty if there
/// is but one, or something else is read by none.
fn heads<'a>(nodes: &'a [Node], config: &Value) -> Vec<&'a str> {
    let sources = |node: &'a Node| match node.inputs.as_deref().unwrap_or_default() {
        [inputs] => &inputs[..],
        _ => &[],
    };
    let is_read = |name: &str| nodes.iter().any(|node| node.inputs.iter().flatten().flatten().any(|from| from == name));
    let ends: Vec<&Node> = nodes.iter().filter(|node| !is_read(&node.layer.name)).collect();
    let source = ends.first().map_or(&[][..], |node| sources(node));
    let together = source.len() == 1
        && ends.iter().all(|node| node.layer.class == "Dense" && sources(node) == source)
        && !source.iter().any(|name| ends.iter().any(|node| node.layer.name == *name));
    if ends.len() < 2 || !together {
        return Vec::new();
    }
    let outputs: Vec<String> = config.get("output_layers").map(names_of_outputs).unwrap_or_default();
    let mut heads: Vec<&str> = ends.iter().map(|node| node.layer.name.as_str()).collect();
    // Stable: what the file does not list keeps its order.
    heads.sort_by_key(|name| outputs.iter().position(|output| output == name).unwrap_or(usize::MAX));
    heads
}

/// The layers in `output_layers`: `[["a", 0, 0], ["b", 0, 0]]`, or one alone: `["a", 0, 0]`.
fn names_of_outputs(listed: &Value) -> Vec<String> {
    match listed {
        Value::Array(parts) => match parts.first() {
            Some(Value::String(name)) => vec![name.clone()],
            _ => parts.iter().flat_map(names_of_outputs).collect(),
        },
        Value::Object(named) => named.values().flat_map(names_of_outputs).collect(),
        _ => Vec::new(),
    }
}

/// A layer and the layers it takes its input from: one entry for each time it is called. `None` in a sequential model.
struct Node {
    layer: KerasLayer,
    inputs: Option<Vec<Vec<String>>>,
}

fn node(index: usize, entry: &Value) -> Result<Node, String> {
    let class = entry.get("class_name").and_then(Value::as_str);
    let class =
        class.ok_or_else(|| format!("layer {} of its architecture has no `class_name`", index + 1))?.to_string();
    let config = entry.get("config").and_then(Value::as_object).cloned().unwrap_or_default();
    let name = config.get("name").or(entry.get("name")).and_then(Value::as_str);
    let name = name.map_or_else(|| format!("layer {}", index + 1), String::from);
    let inputs = entry.get("inbound_nodes").and_then(Value::as_array);
    let inputs = inputs.map(|calls| calls.iter().map(sources).collect());
    Ok(Node { layer: KerasLayer { name, class, config }, inputs })
}

/// Names of the layers that a call takes its input from. Keras 1 and 2: `[["name", 0, 0, {}]]`; Keras 3: tensors whose
/// `keras_history` begins with the name.
fn sources(call: &Value) -> Vec<String> {
    match call {
        Value::Array(parts) => match parts.first() {
            Some(Value::String(name)) => vec![name.clone()],
            _ => parts.iter().flat_map(sources).collect(),
        },
        Value::Object(object) => match object.get("keras_history") {
            Some(history) => sources(history),
            None => object.values().flat_map(sources).collect(),
        },
        _ => Vec::new(),
    }
}

/// Indices of a graph's layers in the order of its connections, if the graph is a chain.
fn order(nodes: &[Node]) -> Result<Vec<usize>, Vec<Problem>> {
    let mut problems = Vec::new();
    let mut readers: BTreeMap<&str, usize> = BTreeMap::new();
    let mut after: BTreeMap<&str, usize> = BTreeMap::new();
    let mut first = Vec::new();
    for (index, node) in nodes.iter().enumerate() {
        match node.inputs.as_deref().unwrap_or_default() {
            [] => first.push(index),
            [inputs] => match &inputs[..] {
                [] => first.push(index),
                [source] => {
                    *readers.entry(source).or_default() += 1;
                    after.insert(source, index);
                }
                several => {
                    for source in several {
                        *readers.entry(source).or_default() += 1;
                    }
                    problems.push(node.layer.problem("takes several inputs; only a chain of layers can be imported"));
                }
            },
            _ => problems.push(node.layer.problem("is used several times; only a chain of layers can be imported")),
        }
    }
    for index in first.iter().skip(1) {
        problems.push(nodes[*index].layer.problem("is a second input; only a chain of layers can be imported"));
    }
    for node in nodes {
        if readers.get(node.layer.name.as_str()).is_some_and(|count| *count > 1) {
            problems.push(node.layer.problem("feeds several layers; only a chain of layers can be imported"));
        }
    }
    if !problems.is_empty() {
        return Err(problems);
    }
    let mut order = Vec::new();
    let mut next = first.first().copied();
    while let Some(index) = next {
        if order.len() == nodes.len() {
            return Err(vec![nodes[index].layer.problem("is connected in a circle")]);
        }
        order.push(index);
        next = after.get(nodes[index].layer.name.as_str()).copied();
    }
    let unreached = (0..nodes.len()).filter(|index| !order.contains(index));
    let problems: Vec<Problem> =
        unreached.map(|index| nodes[index].layer.problem("is not connected to the input")).collect();
    if problems.is_empty() { Ok(order) } else { Err(problems) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn names(value: &Value) -> Vec<String> {
        let chain = chain(&value.to_string()).unwrap();
        assert_eq!(chain.problems, []);
        chain.layers.into_iter().map(|layer| layer.name).collect()
    }

    #[test]
    fn every_generation_of_a_chain_is_read() {
        let layers =
            json!([{"class_name": "A", "config": {"name": "a"}}, {"class_name": "B", "config": {"name": "b"}}]);
        assert_eq!(names(&json!({"class_name": "Sequential", "config": layers})), ["a", "b"]);
        assert_eq!(names(&json!({"class_name": "Sequential", "config": {"name": "s", "layers": layers}})), ["a", "b"]);
        let text = json!({"config": layers}).to_string();
        assert_eq!(names(&Value::String(text)), ["a", "b"]);
        let built = chain(&json!({"config": {"layers": layers, "build_input_shape": [null, 66, null, 3]}}).to_string());
        assert_eq!(built.unwrap().input, Some(vec![66, 0, 3]));
        let reversed = json!({"config": {"layers": [
            {"class_name": "B", "config": {"name": "b"}, "inbound_nodes": [[["a", 0, 0, {}]]]},
            {"class_name": "A", "config": {"name": "a"}, "inbound_nodes": []},
        ]}});
        assert_eq!(names(&reversed), ["a", "b"]);
        let tensor =
            json!({"class_name": "__keras_tensor__", "config": {"shape": [null, 3], "keras_history": ["a", 0, 0]}});
        let keras3 = json!({"config": {"layers": [
            {"class_name": "A", "config": {"name": "a"}, "inbound_nodes": []},
            {"class_name": "B", "config": {"name": "b"}, "inbound_nodes": [{"args": [tensor], "kwargs": {"mask": null}}]},
        ]}});
        assert_eq!(names(&keras3), ["a", "b"]);
    }

    #[test]
    fn dense_layers_behind_one_trunk_are_outputs_in_the_order_of_the_model() {
        let dense = |name: &str, from: &str| json!({"class_name": "Dense", "config": {"name": name}, "inbound_nodes": [[[from, 0, 0, {}]]]});
        let graph = |last: Value| {
            json!({"config": {
                "layers": [
                    {"class_name": "InputLayer", "config": {"name": "in"}, "inbound_nodes": []},
                    dense("b", "trunk"), dense("a", "trunk"), dense("trunk", "in"), last,
                ],
                "output_layers": [["a", 0, 0], ["b", 0, 0], ["c", 0, 0]],
            }})
        };
        let heads = chain(&graph(dense("c", "trunk")).to_string()).unwrap();
        assert_eq!((heads.heads, heads.problems.len()), (3, 0));
        let names: Vec<_> = heads.layers.iter().map(|layer| layer.name.as_str()).collect();
        assert_eq!(names, ["in", "trunk", "a", "b", "c"]);
        // Outputs of different depth are no heads of one trunk.
        let other = chain(&graph(dense("c", "in")).to_string()).unwrap();
        assert_eq!(other.heads, 1);
        assert!(other.problems.iter().any(|problem| problem.reason.contains("feeds several layers")));
    }

    #[test]
    fn what_is_no_chain_is_listed_layer_by_layer() {
        let graph = json!({"config": {"layers": [
            {"class_name": "InputLayer", "config": {"name": "a"}, "inbound_nodes": []},
            {"class_name": "InputLayer", "config": {"name": "speed"}, "inbound_nodes": []},
            {"class_name": "B", "config": {"name": "b"}, "inbound_nodes": [[["a", 0, 0]]]},
            {"class_name": "C", "config": {"name": "c"}, "inbound_nodes": [[["a", 0, 0]]]},
            {"class_name": "Add", "config": {"name": "sum"}, "inbound_nodes": [[["b", 0, 0], ["c", 0, 0]]]},
            {"class_name": "D", "config": {"name": "d"}, "inbound_nodes": [[["sum", 0, 0]], [["b", 0, 0]]]},
        ]}});
        let problems = chain(&graph.to_string()).unwrap().problems;
        let named: Vec<_> = problems.iter().map(|p| (p.layer.as_str(), p.reason.split(';').next().unwrap())).collect();
        assert_eq!(
            named,
            [
                ("sum", "takes several inputs"),
                ("d", "is used several times"),
                ("speed", "is a second input"),
                ("a", "feeds several layers")
            ]
        );
        let circle = json!({"config": {"layers": [
            {"class_name": "A", "config": {"name": "a"}, "inbound_nodes": [[["b", 0, 0]]]},
            {"class_name": "B", "config": {"name": "b"}, "inbound_nodes": [[["a", 0, 0]]]},
        ]}});
        assert_eq!(chain(&circle.to_string()).unwrap().problems.len(), 2);
    }

    #[test]
    fn what_is_no_architecture_is_an_error() {
        for text in ["", "{", "7", "[]", "{\"config\": {}}", "{\"config\": [7]}", "\"\\\"x\""] {
            assert!(chain(text).is_err(), "{text}");
        }
        let deep = "[".repeat(100_000);
        assert!(chain(&deep).unwrap_err().contains("recursion limit"));
    }
}
