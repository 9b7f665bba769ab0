//! A graph as a flatbuffer. Tables and slots are those of TensorFlow Lite's `schema.fbs`, version 3, as far as a graph of ours
//! needs them.

use flatbuffers::{FlatBufferBuilder, ForwardsUOffset, TableFinishedWIPOffset, Vector, WIPOffset};

use super::graph::{Code, Graph, Operator, Options, Tensor};

type Builder = FlatBufferBuilder<'static>;
type Table = WIPOffset<TableFinishedWIPOffset>;
type Tables = WIPOffset<Vector<'static, ForwardsUOffset<TableFinishedWIPOffset>>>;

/// Version of the schema.
const SCHEMA: u32 = 3;

/// Constants begin at multiples of this many bytes, so that an interpreter can use them where they lie.
const ALIGNMENT: usize = 16;

/// `SIGNATURE_KEY` of programs that know but one.
const SIGNATURE: &str = "serving_default";

/// What a file says besides the graph.
#[derive(Debug)]
pub struct Frame<'a> {
    pub description: &'a str,
    /// Names in the signature and tensors.
    pub inputs: &'a [(&'a str, String)],
    /// Names in the signature and tensors.
    pub outputs: &'a [(&'a str, String)],
    pub metadata: &'a [(&'a str, String)],
}

/// Number of a table's slot as the builder counts it.
const fn slot(number: u16) -> u16 {
    4 + 2 * number
}

/// The file.
pub fn write(graph: &Graph, frame: &Frame) -> Vec<u8> {
    let mut builder = Builder::new();
    let b = &mut builder;

    // Buffer 0 is empty by convention.
    let mut buffers = vec![buffer(b, &[])];
    let mut tensors = Vec::new();
    for tensor in &graph.tensors {
        let number = match &tensor.constant {
            Some(data) => {
                buffers.push(buffer(b, data));
                buffers.len() - 1
            }
            None => 0,
        };
        tensors.push(self::tensor(b, tensor, number));
    }
    let mut metadata = Vec::new();
    for (name, text) in frame.metadata {
        buffers.push(buffer(b, text.as_bytes()));
        let name = b.create_string(name);
        let number = buffers.len() - 1;
        metadata.push(table(b, |b| {
            b.push_slot_always(slot(0), name);
            b.push_slot_always(slot(1), number as u32);
        }));
    }

    let mut codes: Vec<Code> = graph.operators.iter().map(|operator| operator.code).collect();
    codes.sort_unstable();
    codes.dedup();
    let operators: Vec<Table> = graph.operators.iter().map(|operator| self::operator(b, operator, &codes)).collect();
    let codes: Vec<Table> = codes.iter().map(|code| operator_code(b, *code)).collect();

    let tensors = b.create_vector(&tensors);
    let operators = b.create_vector(&operators);
    let numbers = |b: &mut Builder, named: &[(&str, String)]| {
        let numbers: Vec<i32> = named.iter().map(|(_, tensor)| graph.index(tensor) as i32).collect();
        b.create_vector(&numbers)
    };
    let (inputs, outputs) = (numbers(b, frame.inputs), numbers(b, frame.outputs));
    let name = b.create_string("main");
    let subgraph = table(b, |b| {
        b.push_slot_always(slot(0), tensors);
        b.push_slot_always(slot(1), inputs);
        b.push_slot_always(slot(2), outputs);
        b.push_slot_always(slot(3), operators);
        b.push_slot_always(slot(4), name);
    });

    let (inputs, outputs) = (tensor_maps(b, graph, frame.inputs), tensor_maps(b, graph, frame.outputs));
    let key = b.create_string(SIGNATURE);
    let signature = table(b, |b| {
        b.push_slot_always(slot(0), inputs);
        b.push_slot_always(slot(1), outputs);
        b.push_slot_always(slot(2), key);
        b.push_slot_always(slot(4), 0u32);
    });

    let codes = b.create_vector(&codes);
    let subgraphs = b.create_vector(&[subgraph]);
    let buffers = b.create_vector(&buffers);
    let metadata = b.create_vector(&metadata);
    let signatures = b.create_vector(&[signature]);
    let description = b.create_string(frame.description);
    let model = table(b, |b| {
        b.push_slot_always(slot(0), SCHEMA);
        b.push_slot_always(slot(1), codes);
        b.push_slot_always(slot(2), subgraphs);
        b.push_slot_always(slot(3), description);
        b.push_slot_always(slot(4), buffers);
        b.push_slot_always(slot(6), metadata);
        b.push_slot_always(slot(7), signatures);
    });
    // The builder writes from the end of the file to its begin; in front come the root's offset and the identifier.
    pad_to_alignment(b, 8);
    b.finish(model, Some("TFL3"));
    builder.finished_data().to_vec()
}

/// Adds zero bytes until what is written and `next` bytes more end at a multiple of [`ALIGNMENT`], counted from the end of the
/// file.
fn pad_to_alignment(b: &mut Builder, next: usize) {
    while !(b.unfinished_data().len() + next).is_multiple_of(ALIGNMENT) {
        b.push(0u8);
    }
}

fn table(b: &mut Builder, fill: impl FnOnce(&mut Builder)) -> Table {
    let start = b.start_table();
    fill(b);
    b.end_table(start)
}

fn buffer(b: &mut Builder, data: &[u8]) -> Table {
    if data.is_empty() {
        return table(b, |_| {});
    }
    pad_to_alignment(b, data.len());
    let data = b.create_vector(data);
    table(b, |b| b.push_slot_always(slot(0), data))
}

fn tensor(b: &mut Builder, tensor: &Tensor, buffer: usize) -> Table {
    let dims: Vec<i32> = tensor.dims.iter().map(|size| *size as i32).collect();
    let dims = b.create_vector(&dims);
    let name = b.create_string(&tensor.name);
    table(b, |b| {
        b.push_slot_always(slot(0), dims);
        b.push_slot_always(slot(1), tensor.kind as i8);
        b.push_slot_always(slot(2), buffer as u32);
        b.push_slot_always(slot(3), name);
        b.push_slot_always(slot(8), true); // It has a rank, be that 0.
    })
}

/// The operator's number stands twice: old readers know the one of 8 bits only.
fn operator_code(b: &mut Builder, code: Code) -> Table {
    table(b, |b| {
        b.push_slot_always(slot(0), code as i8);
        b.push_slot_always(slot(2), 1i32);
        b.push_slot_always(slot(3), code as i32);
    })
}

fn operator(b: &mut Builder, operator: &Operator, codes: &[Code]) -> Table {
    let code = codes.binary_search(&operator.code).expect("its code was collected") as u32;
    let numbers = |b: &mut Builder, tensors: &[usize]| {
        let numbers: Vec<i32> = tensors.iter().map(|number| *number as i32).collect();
        b.create_vector(&numbers)
    };
    let (inputs, outputs) = (numbers(b, &operator.inputs), numbers(b, &operator.outputs));
    let options = options(b, operator.options);
    table(b, |b| {
        b.push_slot_always(slot(0), code);
        b.push_slot_always(slot(1), inputs);
        b.push_slot_always(slot(2), outputs);
        if let Some((kind, options)) = options {
            b.push_slot_always(slot(3), kind);
            b.push_slot_always(slot(4), options);
        }
    })
}

/// The operator's table and its number in the union `BuiltinOptions`.
fn options(b: &mut Builder, options: Options) -> Option<(u8, Table)> {
    // Of `Padding` and `ActivationFunctionType`.
    let padding = |is_same: bool| if is_same { 0i8 } else { 1 };
    let activation = |relu: bool| i8::from(relu);
    let written = match options {
        Options::None => return None,
        Options::Conv2d { depthwise, is_same, stride: [dy, dx], relu } => {
            let fill = |b: &mut Builder| {
                b.push_slot_always(slot(0), padding(is_same));
                b.push_slot_always(slot(1), dx as i32);
                b.push_slot_always(slot(2), dy as i32);
                // `depth_multiplier`, the outputs of a channel.
                let rest = if depthwise {
                    b.push_slot_always(slot(3), 1i32);
                    4
                } else {
                    3
                };
                b.push_slot_always(slot(rest), activation(relu));
                b.push_slot_always(slot(rest + 1), 1i32);
                b.push_slot_always(slot(rest + 2), 1i32);
            };
            (if depthwise { 2 } else { 1 }, table(b, fill))
        }
        Options::Pool2d { window: [h, w], stride: [dy, dx] } => {
            let fill = |b: &mut Builder| {
                b.push_slot_always(slot(0), padding(false));
                for (number, size) in [dx, dy, w, h].into_iter().enumerate() {
                    b.push_slot_always(slot(1 + number as u16), size as i32);
                }
            };
            (5, table(b, fill))
        }
        Options::FullyConnected { relu } => (8, table(b, |b| b.push_slot_always(slot(0), activation(relu)))),
        Options::Concatenation { axis } => (10, table(b, |b| b.push_slot_always(slot(0), axis))),
        Options::Gather { axis } => (23, table(b, |b| b.push_slot_always(slot(0), axis))),
        Options::Split { count } => (35, table(b, |b| b.push_slot_always(slot(0), count))),
        Options::Cast { from, to } => {
            let fill = |b: &mut Builder| {
                b.push_slot_always(slot(0), from as i8);
                b.push_slot_always(slot(1), to as i8);
            };
            (37, table(b, fill))
        }
        Options::LeakyRelu { slope } => (75, table(b, |b| b.push_slot_always(slot(0), slope))),
    };
    Some(written)
}

fn tensor_maps(b: &mut Builder, graph: &Graph, named: &[(&str, String)]) -> Tables {
    let maps: Vec<Table> = named
        .iter()
        .map(|(name, tensor)| {
            let name = b.create_string(name);
            table(b, |b| {
                b.push_slot_always(slot(0), name);
                b.push_slot_always(slot(1), graph.index(tensor) as u32);
            })
        })
        .collect();
    b.create_vector(&maps)
}
