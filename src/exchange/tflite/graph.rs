//! Building a graph of TensorFlow Lite operator by operator. Pictures are `[1, h, w, c]`, vectors `[1, c]`.

use std::collections::HashMap;

use crate::exchange::picture_graph::{Axis, Op, PictureGraph};

/// A graph under construction. Each tensor has a unique name.
#[derive(Debug, Default)]
pub struct Graph {
    pub tensors: Vec<Tensor>,
    pub operators: Vec<Operator>,
    by_name: HashMap<String, usize>,
}

/// A tensor: a constant, or what an operator computes.
#[derive(Debug)]
pub struct Tensor {
    pub name: String,
    pub dims: Vec<usize>,
    pub kind: Kind,
    /// The numbers of a constant, little-endian, row-major.
    pub constant: Option<Vec<u8>>,
}

/// Type of a tensor's numbers; the values are those of `TensorType`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    Float32 = 0,
    Int32 = 2,
    Bool = 6,
}

/// An operator; its tensors are numbered.
#[derive(Debug)]
pub struct Operator {
    pub code: Code,
    pub options: Options,
    pub inputs: Vec<usize>,
    pub outputs: Vec<usize>,
}

/// The operators in use, all of version 1; the values are those of `BuiltinOperator`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Code {
    Add = 0,
    AveragePool2d = 1,
    Concatenation = 2,
    Conv2d = 3,
    DepthwiseConv2d = 4,
    Floor = 8,
    FullyConnected = 9,
    Logistic = 14,
    MaxPool2d = 17,
    Mul = 18,
    Relu = 19,
    Reshape = 22,
    Tanh = 28,
    Pad = 34,
    Gather = 36,
    Sub = 41,
    Div = 42,
    Split = 49,
    Cast = 53,
    PRelu = 54,
    Maximum = 55,
    Minimum = 57,
    Less = 58,
    Greater = 61,
    Slice = 65,
    Equal = 71,
    LeakyRelu = 98,
    Abs = 101,
    Elu = 111,
    Round = 116,
    SelectV2 = 123,
}

/// What an operator needs besides its inputs. `relu` rectifies its result.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Options {
    None,
    Conv2d {
        depthwise: bool,
        is_same: bool,
        stride: [usize; 2],
        relu: bool,
    },
    /// Without padding.
    Pool2d {
        window: [usize; 2],
        stride: [usize; 2],
    },
    FullyConnected {
        relu: bool,
    },
    Concatenation {
        axis: i32,
    },
    Gather {
        axis: i32,
    },
    Split {
        count: i32,
    },
    Cast {
        from: Kind,
        to: Kind,
    },
    LeakyRelu {
        slope: f32,
    },
}

impl Graph {
    /// The number of the tensor `name`.
    ///
    /// # Panics
    /// If there is none.
    pub fn index(&self, name: &str) -> usize {
        self.by_name[name]
    }

    /// The sizes of the tensor `name`.
    pub fn dims(&self, name: &str) -> &[usize] {
        &self.tensors[self.index(name)].dims
    }

    fn kind(&self, name: &str) -> Kind {
        self.tensors[self.index(name)].kind
    }

    /// A name that no tensor has, `stem` or with a number behind it.
    fn unique(&self, stem: &str) -> String {
        if !self.by_name.contains_key(stem) {
            return stem.into();
        }
        let mut number = self.tensors.len();
        while self.by_name.contains_key(&format!("{stem}.{number}")) {
            number += 1;
        }
        format!("{stem}.{number}")
    }

    fn tensor(&mut self, name: &str, dims: Vec<usize>, kind: Kind, constant: Option<Vec<u8>>) -> String {
        let name = self.unique(name);
        self.by_name.insert(name.clone(), self.tensors.len());
        self.tensors.push(Tensor { name: name.clone(), dims, kind, constant });
        name
    }

    /// Declares an input of floats.
    pub fn input(&mut self, name: &str, dims: &[usize]) -> String {
        self.tensor(name, dims.to_vec(), Kind::Float32, None)
    }

    /// Adds a constant of floats.
    pub fn floats(&mut self, name: &str, dims: &[usize], values: &[f32]) -> String {
        assert_eq!(dims.iter().product::<usize>(), values.len(), "{name}");
        let data = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        self.tensor(name, dims.to_vec(), Kind::Float32, Some(data))
    }

    /// Adds a constant of 32-bit integers.
    pub fn int32s(&mut self, name: &str, dims: &[usize], values: &[i32]) -> String {
        assert_eq!(dims.iter().product::<usize>(), values.len(), "{name}");
        let data = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        self.tensor(name, dims.to_vec(), Kind::Int32, Some(data))
    }

    /// Adds a constant vector of sizes or positions.
    pub fn sizes(&mut self, name: &str, values: &[usize]) -> String {
        let values: Vec<i32> = values.iter().map(|value| *value as i32).collect();
        self.int32s(name, &[values.len()], &values)
    }

    /// Adds an operator with one output of floats, of these sizes, and returns the output's name.
    pub fn operator(&mut self, code: Code, name: &str, inputs: &[&str], options: Options, dims: &[usize]) -> String {
        self.operator_of(code, name, inputs, options, dims.to_vec(), Kind::Float32)
    }

    fn operator_of(
        &mut self,
        code: Code,
        name: &str,
        inputs: &[&str],
        options: Options,
        dims: Vec<usize>,
        kind: Kind,
    ) -> String {
        let inputs = inputs.iter().map(|input| self.index(input)).collect();
        let outputs = vec![self.tensors.len()];
        let name = self.tensor(name, dims, kind, None);
        self.operators.push(Operator { code, options, inputs, outputs });
        name
    }

    /// Adds an operator on each value of its inputs, which are broadcast.
    pub fn elementwise(&mut self, code: Code, name: &str, inputs: &[&str]) -> String {
        self.elementwise_with(code, name, inputs, Options::None)
    }

    /// The same with options.
    pub fn elementwise_with(&mut self, code: Code, name: &str, inputs: &[&str], options: Options) -> String {
        let kind = match code {
            Code::Equal | Code::Less | Code::Greater => Kind::Bool,
            _ => self.kind(inputs[inputs.len() - 1]),
        };
        let dims = inputs.iter().fold(Vec::new(), |all, input| broadcast(&all, self.dims(input)));
        self.operator_of(code, name, inputs, options, dims, kind)
    }

    /// Splits the last axis of `x` into parts of one each.
    pub fn split(&mut self, x: &str, names: &[&str]) -> Vec<String> {
        let mut dims = self.dims(x).to_vec();
        let last = dims.len() - 1;
        assert_eq!(dims[last], names.len());
        dims[last] = 1;
        let axis = self.int32s("axis", &[], &[last as i32]);
        let inputs = vec![self.index(&axis), self.index(x)];
        let names: Vec<String> =
            names.iter().map(|name| self.tensor(name, dims.clone(), Kind::Float32, None)).collect();
        let outputs = names.iter().map(|name| self.index(name)).collect();
        let options = Options::Split { count: names.len() as i32 };
        self.operators.push(Operator { code: Code::Split, options, inputs, outputs });
        names
    }

    /// The part of `x` with these sizes from `begin` on.
    pub fn slice(&mut self, name: &str, x: &str, begin: &[usize], dims: &[usize]) -> String {
        let begin = self.sizes(&format!("{name}.begin"), begin);
        let size = self.sizes(&format!("{name}.size"), dims);
        self.operator(Code::Slice, name, &[x, &begin, &size], Options::None, dims)
    }

    /// `x` with other sizes.
    pub fn reshape(&mut self, name: &str, x: &str, dims: &[usize]) -> String {
        if self.dims(x) == dims {
            return x.into();
        }
        let shape = self.sizes(&format!("{name}.shape"), dims);
        self.operator(Code::Reshape, name, &[x, &shape], Options::None, dims)
    }

    /// `x` with zeros above, to the left, below and to the right of each channel.
    pub fn pad(&mut self, name: &str, x: &str, [top, left, bottom, right]: [usize; 4]) -> String {
        if [top, left, bottom, right] == [0; 4] {
            return x.into();
        }
        let mut dims = self.dims(x).to_vec();
        dims[1] += top + bottom;
        dims[2] += left + right;
        let around = [0, 0, top, bottom, left, right, 0, 0].map(|size| size as i32);
        let paddings = self.int32s(&format!("{name}.paddings"), &[4, 2], &around);
        self.operator(Code::Pad, name, &[x, &paddings], Options::None, &dims)
    }

    /// The elements `positions` of `x` along `axis`.
    pub fn gather_along(&mut self, name: &str, x: &str, axis: usize, positions: &[usize]) -> String {
        let mut dims = self.dims(x).to_vec();
        dims[axis] = positions.len();
        let positions = self.sizes(&format!("{name}.positions"), positions);
        self.operator_of(
            Code::Gather,
            name,
            &[x, &positions],
            Options::Gather { axis: axis as i32 },
            dims,
            self.kind(x),
        )
    }
}

/// The sizes of a result whose inputs have the sizes `a` and `b`, which are aligned at their ends.
fn broadcast(a: &[usize], b: &[usize]) -> Vec<usize> {
    let len = a.len().max(b.len());
    let at = |dims: &[usize], i: usize| (i + dims.len()).checked_sub(len).map_or(1, |i| dims[i]);
    (0..len).map(|i| at(a, i).max(at(b, i))).collect()
}

/// Name of the tensors of the preprocessing.
const PREPROCESSING: &str = "preprocessing";

impl PictureGraph for Graph {
    fn op(&mut self, op: Op, inputs: &[&str]) -> String {
        let code = match op {
            Op::Add => Code::Add,
            Op::Sub => Code::Sub,
            Op::Mul => Code::Mul,
            Op::Div => Code::Div,
            Op::Max => Code::Maximum,
            Op::Min => Code::Minimum,
            Op::Equal => Code::Equal,
            Op::Less => Code::Less,
            Op::Greater => Code::Greater,
            Op::Where => Code::SelectV2,
            Op::Floor => Code::Floor,
            Op::Round => Code::Round,
        };
        match (op, inputs) {
            // Here they take two.
            (Op::Max | Op::Min, [a, b, c]) => {
                let two = self.elementwise(code, PREPROCESSING, &[a, b]);
                self.elementwise(code, PREPROCESSING, &[&two, c])
            }
            _ => self.elementwise(code, PREPROCESSING, inputs),
        }
    }

    fn number(&mut self, value: f32) -> String {
        self.floats(PREPROCESSING, &[], &[value])
    }

    fn integer(&mut self, value: i32) -> String {
        self.int32s(PREPROCESSING, &[], &[value])
    }

    fn floats_along(&mut self, axis: Axis, values: &[f32]) -> String {
        self.floats(PREPROCESSING, &along(axis, values.len()), values)
    }

    fn integers_along(&mut self, axis: Axis, values: &[i32]) -> String {
        self.int32s(PREPROCESSING, &along(axis, values.len()), values)
    }

    fn to_integers(&mut self, x: &str) -> String {
        let options = Options::Cast { from: Kind::Float32, to: Kind::Int32 };
        self.operator_of(Code::Cast, PREPROCESSING, &[x], options, self.dims(x).to_vec(), Kind::Int32)
    }

    fn to_floats(&mut self, x: &str) -> String {
        let options = Options::Cast { from: Kind::Int32, to: Kind::Float32 };
        self.operator_of(Code::Cast, PREPROCESSING, &[x], options, self.dims(x).to_vec(), Kind::Float32)
    }

    fn gather(&mut self, x: &str, axis: Axis, positions: &[usize]) -> String {
        let axis = match axis {
            Axis::Row => 1,
            Axis::Column => 2,
        };
        self.gather_along(PREPROCESSING, x, axis, positions)
    }

    fn look_up(&mut self, table: &[f32], index: &str) -> String {
        let table = self.floats(PREPROCESSING, &[table.len()], table);
        let dims = self.dims(index).to_vec();
        self.operator(Code::Gather, PREPROCESSING, &[&table, index], Options::Gather { axis: 0 }, &dims)
    }

    fn mean_of_2x2(&mut self, x: &str) -> String {
        let &[n, h, w, c] = self.dims(x) else { panic!("{x} is no picture") };
        let options = Options::Pool2d { window: [2, 2], stride: [2, 2] };
        self.operator(Code::AveragePool2d, PREPROCESSING, &[x], options, &[n, h / 2, w / 2, c])
    }

    fn split_channels(&mut self, x: &str) -> [String; 3] {
        let channels = self.split(x, &[PREPROCESSING; 3]);
        channels.try_into().expect("three parts")
    }

    fn join_channels(&mut self, channels: &[&str]) -> String {
        let mut dims = self.dims(channels[0]).to_vec();
        dims[3] = channels.len();
        self.operator(Code::Concatenation, PREPROCESSING, channels, Options::Concatenation { axis: 3 }, &dims)
    }
}

/// The sizes that broadcast a vector of `len` along `axis`.
fn along(axis: Axis, len: usize) -> Vec<usize> {
    match axis {
        Axis::Row => vec![1, len, 1, 1],
        Axis::Column => vec![1, 1, len, 1],
    }
}
