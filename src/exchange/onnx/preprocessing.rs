//! The nodes of the preprocessing.

use super::graph::{GraphBuilder, int, ints};
use super::proto::{AttributeProto, DataType};
use crate::dataset::preprocess::Preprocessing;
use crate::exchange::picture_graph::{self, Axis, Op, PictureGraph};

/// Adds the nodes from `image`, uint8 `[N, height, width, 3]`, to `output`, the network's input `[N, c, h, w]`.
pub fn add(graph: &mut GraphBuilder, spec: &Preprocessing, image: &str, output: &str) {
    let mut nodes = Nodes { graph, count: 0 };
    let [first, end] = spec.rows;
    let mut x = image.to_string();
    if spec.rows != [0, spec.source[0]] {
        let rows = [("starts", first), ("ends", end), ("axes", 1)]
            .map(|(name, value)| nodes.graph.int64s(&format!("preprocessing.{name}"), &[value]));
        x = nodes.node("Slice", &[&x, &rows[0], &rows[1], &rows[2]], vec![]);
    }
    x = nodes.node("Transpose", &[&x], vec![ints("perm", &[0, 3, 1, 2])]);
    x = nodes.cast(&x, DataType::Float);
    x = picture_graph::add(&mut nodes, spec, &x);
    let scale = nodes.number(spec.scale as f32);
    let scaled = nodes.op(Op::Mul, &[&x, &scale]);
    let offset = nodes.number(spec.offset as f32);
    nodes.graph.node("Add", output, &[&scaled, &offset], vec![]);
}

/// Nodes and constants called `preprocessing.1`, `preprocessing.2`, …; pictures are `[N, c, h, w]`.
struct Nodes<'a> {
    graph: &'a mut GraphBuilder,
    count: usize,
}

impl Nodes<'_> {
    fn name(&mut self) -> String {
        self.count += 1;
        format!("preprocessing.{}", self.count)
    }

    fn node(&mut self, op: &str, inputs: &[&str], attributes: Vec<AttributeProto>) -> String {
        let name = self.name();
        self.graph.node(op, &name, inputs, attributes)
    }

    fn cast(&mut self, x: &str, data_type: DataType) -> String {
        self.node("Cast", &[x], vec![int("to", data_type as i64)])
    }
}

impl PictureGraph for Nodes<'_> {
    fn op(&mut self, op: Op, inputs: &[&str]) -> String {
        let op = match op {
            Op::Add => "Add",
            Op::Sub => "Sub",
            Op::Mul => "Mul",
            Op::Div => "Div",
            Op::Max => "Max",
            Op::Min => "Min",
            Op::Equal => "Equal",
            Op::Less => "Less",
            Op::Greater => "Greater",
            Op::Where => "Where",
            Op::Floor => "Floor",
            Op::Round => "Round",
        };
        self.node(op, inputs, vec![])
    }

    fn number(&mut self, value: f32) -> String {
        let name = self.name();
        self.graph.floats(&name, &[], &[value])
    }

    fn integer(&mut self, value: i32) -> String {
        let name = self.name();
        self.graph.int32s(&name, &[], &[value])
    }

    fn floats_along(&mut self, axis: Axis, values: &[f32]) -> String {
        let name = self.name();
        self.graph.floats(&name, &along(axis, values.len()), values)
    }

    fn integers_along(&mut self, axis: Axis, values: &[i32]) -> String {
        let name = self.name();
        self.graph.int32s(&name, &along(axis, values.len()), values)
    }

    fn to_integers(&mut self, x: &str) -> String {
        self.cast(x, DataType::Int32)
    }

    fn to_floats(&mut self, x: &str) -> String {
        self.cast(x, DataType::Float)
    }

    fn gather(&mut self, x: &str, axis: Axis, positions: &[usize]) -> String {
        let name = self.name();
        let positions = self.graph.int64s(&name, positions);
        let axis = match axis {
            Axis::Row => 2,
            Axis::Column => 3,
        };
        self.node("Gather", &[x, &positions], vec![int("axis", axis)])
    }

    fn look_up(&mut self, table: &[f32], index: &str) -> String {
        let name = self.name();
        let table = self.graph.floats(&name, &[table.len()], table);
        self.node("Gather", &[&table, index], vec![int("axis", 0)])
    }

    fn mean_of_2x2(&mut self, x: &str) -> String {
        self.node("AveragePool", &[x], vec![ints("kernel_shape", &[2, 2]), ints("strides", &[2, 2])])
    }

    fn split_channels(&mut self, x: &str) -> [String; 3] {
        let outputs = [self.name(), self.name(), self.name()];
        let sizes = self.name();
        let sizes = self.graph.int64s(&sizes, &[1, 1, 1]);
        let name = self.name();
        let names = outputs.each_ref().map(String::as_str);
        self.graph.node_with_outputs("Split", &name, &[x, &sizes], &names, vec![int("axis", 1)]);
        outputs
    }

    fn join_channels(&mut self, channels: &[&str]) -> String {
        self.node("Concat", channels, vec![int("axis", 1)])
    }
}

/// The shape that broadcasts a vector of `len` along `axis`.
fn along(axis: Axis, len: usize) -> Vec<usize> {
    match axis {
        Axis::Row => vec![len, 1],
        Axis::Column => vec![len],
    }
}
