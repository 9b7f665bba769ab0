//! Building an ONNX graph node by node.

use super::proto::{
    AttributeProto, AttributeType, DataType, Dimension, GraphProto, NodeProto, TensorProto, TensorShapeProto,
    TensorType, TypeProto, ValueInfoProto,
};

/// A graph under construction. Each value has a unique name.
#[derive(Debug, Default)]
pub struct GraphBuilder {
    graph: GraphProto,
}

impl GraphBuilder {
    /// Adds a node with one output, which is called `name`.
    pub fn node(&mut self, op: &str, name: &str, inputs: &[&str], attributes: Vec<AttributeProto>) -> String {
        self.node_with_outputs(op, name, inputs, &[name], attributes);
        name.into()
    }

    /// Adds a node with several outputs.
    pub fn node_with_outputs(
        &mut self,
        op: &str,
        name: &str,
        inputs: &[&str],
        outputs: &[&str],
        attribute: Vec<AttributeProto>,
    ) {
        let strings = |names: &[&str]| names.iter().map(|name| name.to_string()).collect();
        let (input, output) = (strings(inputs), strings(outputs));
        self.graph.node.push(NodeProto { input, output, name: name.into(), op_type: op.into(), attribute });
    }

    /// Adds a constant of 32-bit floats.
    pub fn floats(&mut self, name: &str, dims: &[usize], values: &[f32]) -> String {
        self.constant(name, dims, DataType::Float, values.iter().flat_map(|v| v.to_le_bytes()).collect())
    }

    /// Adds a constant of 32-bit integers.
    pub fn int32s(&mut self, name: &str, dims: &[usize], values: &[i32]) -> String {
        self.constant(name, dims, DataType::Int32, values.iter().flat_map(|v| v.to_le_bytes()).collect())
    }

    /// Adds a constant vector of 64-bit integers, the type of axes and indices.
    pub fn int64s(&mut self, name: &str, values: &[usize]) -> String {
        let raw_data = values.iter().flat_map(|v| (*v as i64).to_le_bytes()).collect();
        self.constant(name, &[values.len()], DataType::Int64, raw_data)
    }

    fn constant(&mut self, name: &str, dims: &[usize], data_type: DataType, raw_data: Vec<u8>) -> String {
        let dims = dims.iter().map(|dim| *dim as i64).collect();
        self.graph.initializer.push(TensorProto { dims, data_type: data_type.into(), name: name.into(), raw_data });
        name.into()
    }

    /// Declares the graph's input; its first axis is the batch, of any size.
    pub fn input(&mut self, name: &str, data_type: DataType, image: &[usize], doc: &str) {
        self.graph.input.push(value_info(name, data_type, image, doc));
    }

    /// Declares the graph's output; its first axis is the batch, of any size.
    pub fn output(&mut self, name: &str, data_type: DataType, image: &[usize], doc: &str) {
        self.graph.output.push(value_info(name, data_type, image, doc));
    }

    /// The finished graph.
    pub fn finish(self, name: &str) -> GraphProto {
        GraphProto { name: name.into(), ..self.graph }
    }
}

fn value_info(name: &str, data_type: DataType, image: &[usize], doc: &str) -> ValueInfoProto {
    let batch = Dimension { dim_value: None, dim_param: Some("N".into()) };
    let fixed = image.iter().map(|size| Dimension { dim_value: Some(*size as i64), dim_param: None });
    let shape = TensorShapeProto { dim: [batch].into_iter().chain(fixed).collect() };
    let tensor_type = TensorType { elem_type: data_type.into(), shape: Some(shape) };
    ValueInfoProto {
        name: name.into(),
        r#type: Some(TypeProto { tensor_type: Some(tensor_type) }),
        doc_string: doc.into(),
    }
}

/// An integer attribute of a node.
pub fn int(name: &str, value: i64) -> AttributeProto {
    AttributeProto { name: name.into(), i: Some(value), r#type: AttributeType::Int.into(), ..AttributeProto::default() }
}

/// A float attribute of a node.
pub fn float(name: &str, value: f32) -> AttributeProto {
    let r#type = AttributeType::Float.into();
    AttributeProto { name: name.into(), f: Some(value), r#type, ..AttributeProto::default() }
}

/// An attribute of a node that is a list of integers.
pub fn ints(name: &str, values: &[usize]) -> AttributeProto {
    let ints = values.iter().map(|value| *value as i64).collect();
    AttributeProto { name: name.into(), ints, r#type: AttributeType::Ints.into(), ..AttributeProto::default() }
}
