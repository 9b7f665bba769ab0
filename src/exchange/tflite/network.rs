//! The network as operators on `[1, h, w, c]` and `[1, c]`, where the engine has `[c][h][w]`.

use super::graph::{Code, Graph, Options};
use crate::engine::layers::{ExportForm, Formula, Function, Pads, Taps};
use crate::engine::tensor::Shape;
use crate::exchange::chain::{ChainStep, ChannelAffine, scale_and_shift};

/// A value on its way through the network.
struct Value {
    tensor: String,
    layout: Layout,
}

#[derive(Clone, Copy, PartialEq)]
enum Layout {
    /// `[1, h, w, c]`.
    Map,
    /// `[1, c]`, in the engine's order.
    Vector,
    /// `[1, h · w · c]`: a map that was flattened in its order of rows, columns and channels.
    FlatMap(Shape),
}

/// Adds the operators of `steps`, which read the picture `input`, `[1, h, w, c]`, and returns the answers, `[1, outputs]`.
pub fn add(graph: &mut Graph, steps: &[ChainStep], input: &str) -> String {
    let mut value = Value { tensor: input.into(), layout: Layout::Map };
    let mut steps = steps.iter().peekable();
    while let Some(step) = steps.next() {
        let relu = Function::Relu.of(Formula::X);
        let is_before_relu = matches!(step.form, ExportForm::Conv { .. } | ExportForm::Dense { .. })
            && steps.next_if(|next| next.form == ExportForm::Elementwise(relu)).is_some();
        value = operation(graph, step, value, is_before_relu);
    }
    vector(graph, "vector", value)
}

/// `value` as `[1, h, w, c]`; a vector becomes one position.
fn map(graph: &mut Graph, name: &str, value: Value) -> String {
    match value.layout {
        Layout::Map => value.tensor,
        Layout::Vector | Layout::FlatMap(_) => {
            let vector = vector(graph, name, value);
            let c = graph.dims(&vector)[1];
            graph.reshape(&format!("{name}.map"), &vector, &[1, 1, 1, c])
        }
    }
}

/// `value` as `[1, c]` in the engine's order.
fn vector(graph: &mut Graph, name: &str, value: Value) -> String {
    let Value { tensor, layout } = flat(graph, name, value);
    match layout {
        Layout::FlatMap(shape) => graph.gather_along(&format!("{name}.order"), &tensor, 1, &positions(shape)),
        Layout::Map | Layout::Vector => tensor,
    }
}

/// `value` as `[1, c]`, the order as it is.
fn flat(graph: &mut Graph, name: &str, value: Value) -> Value {
    if value.layout != Layout::Map {
        return value;
    }
    let &[_, h, w, c] = graph.dims(&value.tensor) else { panic!("{} is no map", value.tensor) };
    let shape = Shape::new(c, h, w);
    let tensor = graph.reshape(&format!("{name}.vector"), &value.tensor, &[1, shape.len()]);
    // One channel or one position has but one order.
    let layout = if c == 1 || h * w == 1 { Layout::Vector } else { Layout::FlatMap(shape) };
    Value { tensor, layout }
}

/// Where the numbers of `[c][h][w]`, in this order, lie in `[h][w][c]`.
fn positions(Shape { c, h, w }: Shape) -> Vec<usize> {
    (0..c).flat_map(|channel| (0..h * w).map(move |position| position * c + channel)).collect()
}

/// `values`, rows of `[c][h][w]`, as rows of `[h][w][c]`.
fn reordered(values: &[f32], shape: Shape) -> Vec<f32> {
    let positions = positions(shape);
    let mut reordered = vec![0.0; values.len()];
    for (row, to) in values.chunks_exact(shape.len()).zip(reordered.chunks_exact_mut(shape.len())) {
        row.iter().zip(&positions).for_each(|(value, position)| to[*position] = *value);
    }
    reordered
}

/// `values` of a layer, one for each channel, or for each value of the map, as they are broadcast to a value of this layout.
fn broadcast_constant(graph: &mut Graph, name: &str, values: &[f32], input: Shape, layout: Layout) -> String {
    match layout {
        Layout::Map if values.len() == input.c => graph.floats(name, &[1, 1, input.c], values),
        Layout::Map => graph.floats(name, &[input.h, input.w, input.c], &reordered(values, input)),
        Layout::Vector => graph.floats(name, &[values.len()], values),
        Layout::FlatMap(shape) => graph.floats(name, &[values.len()], &reordered(values, shape)),
    }
}

fn operation(graph: &mut Graph, step: &ChainStep, value: Value, relu: bool) -> Value {
    let ChainStep { name, input, output, form } = step;
    let map_dims = [1, output.h, output.w, output.c];
    let constant = |what: &str| format!("{name}.{what}");
    let is_map = |tensor: String| Value { tensor, layout: Layout::Map };
    match form {
        ExportForm::Conv { depthwise, kernel, stride, pads, weight, bias } => {
            let x = map(graph, name, value);
            let is_same = *pads == same_pads(*input, *kernel, *stride);
            let Pads { top, left, bottom, right } = *pads;
            let around = if is_same { [0; 4] } else { [top, left, bottom, right] };
            let x = graph.pad(&constant("pad"), &x, around);
            let [h, w] = *kernel;
            // A depthwise convolution has one kernel that is as deep as the map.
            let (code, kernels) = if *depthwise { (Code::DepthwiseConv2d, 1) } else { (Code::Conv2d, output.c) };
            let weight = reordered(weight, Shape::new(input.c, h, w));
            let weight = graph.floats(&constant("weight"), &[kernels, h, w, input.c], &weight);
            let bias = graph.floats(&constant("bias"), &[output.c], bias);
            let options = Options::Conv2d { depthwise: *depthwise, is_same, stride: *stride, relu };
            is_map(graph.operator(code, name, &[&x, &weight, &bias], options, &map_dims))
        }
        ExportForm::Dense { weight, bias } => {
            let Value { tensor, layout } = flat(graph, name, value);
            let dims = [output.len(), input.len()];
            let weight = match layout {
                Layout::FlatMap(shape) => graph.floats(&constant("weight"), &dims, &reordered(weight, shape)),
                Layout::Map | Layout::Vector => graph.floats(&constant("weight"), &dims, weight),
            };
            let bias = graph.floats(&constant("bias"), &[output.len()], bias);
            let (inputs, options) = ([&*tensor, &weight, &bias], Options::FullyConnected { relu });
            let tensor = graph.operator(Code::FullyConnected, name, &inputs, options, &[1, output.len()]);
            Value { tensor, layout: Layout::Vector }
        }
        ExportForm::BatchNorm { gamma, beta, mean, variance, epsilon } => {
            let ChannelAffine { scale, shift } = scale_and_shift(gamma, beta, mean, variance, *epsilon);
            let mut tensor = |what: &str, values: &[f64]| {
                let values: Vec<f32> = values.iter().map(|value| *value as f32).collect();
                broadcast_constant(graph, &constant(what), &values, *input, value.layout)
            };
            let (scale, shift) = (tensor("scale", &scale), tensor("shift", &shift));
            let scaled = graph.elementwise(Code::Mul, &constant("scaled"), &[&value.tensor, &scale]);
            Value { tensor: graph.elementwise(Code::Add, name, &[&scaled, &shift]), layout: value.layout }
        }
        ExportForm::PRelu { slopes } => {
            let slopes = broadcast_constant(graph, &constant("slope"), slopes, *input, value.layout);
            Value { tensor: graph.elementwise(Code::PRelu, name, &[&value.tensor, &slopes]), layout: value.layout }
        }
        ExportForm::Elementwise(formula) => {
            Value { tensor: elementwise(graph, name, formula, &value.tensor), layout: value.layout }
        }
        ExportForm::MaxPool { window, stride } | ExportForm::AveragePool { window, stride } => {
            let x = map(graph, name, value);
            let is_max = matches!(form, ExportForm::MaxPool { .. });
            let code = if is_max { Code::MaxPool2d } else { Code::AveragePool2d };
            let options = Options::Pool2d { window: *window, stride: *stride };
            is_map(graph.operator(code, name, &[&x], options, &map_dims))
        }
        ExportForm::Crop { top, left } => {
            let x = map(graph, name, value);
            is_map(graph.slice(name, &x, &[0, *top, *left, 0], &map_dims))
        }
        ExportForm::ZeroPad { top, left } => {
            let x = map(graph, name, value);
            let (bottom, right) = (output.h - input.h - top, output.w - input.w - left);
            is_map(graph.pad(name, &x, [*top, *left, bottom, right]))
        }
        ExportForm::Resize { rows, columns } => {
            let x = map(graph, name, value);
            let down = weighted_sum(graph, &constant("rows"), &x, 1, rows);
            is_map(weighted_sum(graph, name, &down, 2, columns))
        }
        ExportForm::Flatten => flat(graph, name, value),
        ExportForm::Identity => value,
    }
}

/// The weighted sums of `taps` along `axis` of a map, in the order of the inputs. Where an output sees fewer than others do, its last
/// input counts again, with a weight of 0.
fn weighted_sum(graph: &mut Graph, name: &str, x: &str, axis: usize, taps: &Taps) -> String {
    let seen: Vec<(usize, &[f32])> = (0..taps.outputs()).map(|i| taps.of(i)).collect();
    let most = seen.iter().map(|(_, weights)| weights.len()).max().unwrap_or(0);
    let mut dims = vec![1; 4];
    dims[axis] = seen.len();
    let mut sum: Option<String> = None;
    for k in 0..most {
        let positions: Vec<usize> = seen.iter().map(|(first, weights)| first + k.min(weights.len() - 1)).collect();
        let weights: Vec<f32> = seen.iter().map(|(_, weights)| weights.get(k).copied().unwrap_or(0.0)).collect();
        let inputs = graph.gather_along(&format!("{name}.{k}"), x, axis, &positions);
        let weights = graph.floats(&format!("{name}.{k}.weights"), &dims, &weights);
        let product = graph.elementwise(Code::Mul, &format!("{name}.{k}.product"), &[&inputs, &weights]);
        sum = Some(match sum {
            Some(sum) => graph.elementwise(Code::Add, name, &[&sum, &product]),
            None => product,
        });
    }
    sum.expect("every output sees an input")
}

/// The zeros that TensorFlow puts around the input so that the output has one value for each step: of an odd number more below
/// and to the right.
fn same_pads(input: Shape, kernel: [usize; 2], stride: [usize; 2]) -> Pads {
    let around = |size: usize, axis: usize| {
        let total = ((size.div_ceil(stride[axis]) - 1) * stride[axis] + kernel[axis]).saturating_sub(size);
        (total / 2, total.div_ceil(2))
    };
    let ((top, bottom), (left, right)) = (around(input.h, 0), around(input.w, 1));
    Pads { top, left, bottom, right }
}

/// Adds the operators that compute `formula` of `x`, and returns the name of the result.
fn elementwise(graph: &mut Graph, name: &str, formula: &Formula, x: &str) -> String {
    match formula {
        Formula::X => x.into(),
        Formula::Number(number) => graph.floats(&format!("{name}.number"), &[], &[*number]),
        Formula::Sum(terms) => two(graph, Code::Add, name, terms, x),
        Formula::Product(factors) => two(graph, Code::Mul, name, factors, x),
        Formula::Apply(function, argument) => {
            let argument = elementwise(graph, name, argument, x);
            apply(graph, name, *function, &argument)
        }
    }
}

fn two(graph: &mut Graph, code: Code, name: &str, parts: &[Formula; 2], x: &str) -> String {
    let parts = parts.each_ref().map(|part| elementwise(graph, name, part, x));
    graph.elementwise(code, name, &parts.each_ref().map(String::as_str))
}

fn apply(graph: &mut Graph, name: &str, function: Function, x: &str) -> String {
    let number = |graph: &mut Graph, value: f32| graph.floats(&format!("{name}.number"), &[], &[value]);
    match function {
        Function::Relu => graph.elementwise(Code::Relu, name, &[x]),
        Function::Elu { alpha: 1.0 } => graph.elementwise(Code::Elu, name, &[x]),
        Function::Elu { alpha } => {
            // The operator has no alpha: the part below zero is scaled alone.
            let zero = number(graph, 0.0);
            let negative = graph.elementwise(Code::Minimum, name, &[x, &zero]);
            let curved = graph.elementwise(Code::Elu, name, &[&negative]);
            let alpha = number(graph, alpha);
            let scaled = graph.elementwise(Code::Mul, name, &[&curved, &alpha]);
            let positive = graph.elementwise(Code::Relu, name, &[x]);
            graph.elementwise(Code::Add, name, &[&positive, &scaled])
        }
        Function::LeakyRelu { slope } => {
            graph.elementwise_with(Code::LeakyRelu, name, &[x], Options::LeakyRelu { slope })
        }
        Function::Tanh => graph.elementwise(Code::Tanh, name, &[x]),
        Function::Softsign => {
            let size = graph.elementwise(Code::Abs, name, &[x]);
            let one = number(graph, 1.0);
            let divisor = graph.elementwise(Code::Add, name, &[&size, &one]);
            graph.elementwise(Code::Div, name, &[x, &divisor])
        }
        Function::Sigmoid => graph.elementwise(Code::Logistic, name, &[x]),
    }
}
