//! A model as arrays, buffers and calls, independent of the language that it will be written in.

use std::ops::Range;

use crate::dataset::colour::{Colour, HSV, L_SCALE, L_SHIFT, LAB};
use crate::dataset::resize::{AreaTaps, LinearTap, Method, Resizer};
use crate::engine::layers::{ExportForm, Formula, Function};
use crate::engine::tensor::Shape;
use crate::exchange::chain::{ChainStep, ChannelAffine, scale_and_shift};
use crate::recipe::Recipe;

/// Content of the source file of a model.
pub struct Program<'a> {
    pub recipe: &'a Recipe,
    /// Arrays that functions of the library read by their names.
    pub tables: Vec<Array>,
    /// Numbers that functions of the library read by their names.
    pub constants: Vec<(&'static str, i32)>,
    /// Sections of the library that the calls need.
    pub sections: Vec<&'static str>,
    /// Arrays that the calls name.
    pub arrays: Vec<Array>,
    pub buffers: Vec<(Buffer, usize)>,
    pub statements: Vec<Statement>,
    /// The buffer that holds the steering at the end.
    pub result: Buffer,
}

/// A constant array.
pub struct Array {
    /// In lower case.
    pub name: String,
    pub values: Values,
}

pub enum Values {
    F32(Vec<f32>),
    I32(Vec<i32>),
    U16(Vec<u16>),
}

/// A buffer of the model. The first three hold bytes, the others floats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Buffer {
    Blurred,
    Pixels,
    Planes,
    A,
    B,
}

impl Buffer {
    pub fn name(self) -> &'static str {
        match self {
            Buffer::Blurred => "blurred",
            Buffer::Pixels => "pixels",
            Buffer::Planes => "planes",
            Buffer::A => "a",
            Buffer::B => "b",
        }
    }

    pub fn holds_bytes(self) -> bool {
        matches!(self, Buffer::Blurred | Buffer::Pixels | Buffer::Planes)
    }
}

/// One statement of `steer`.
pub enum Statement {
    /// Calls a function of the library.
    Call {
        /// Comment above the call; `None` if it continues the work of the call before.
        comment: Option<String>,
        function: &'static str,
        args: Vec<Arg>,
    },
    /// Replaces each of the first `len` numbers of a buffer by the formula of it.
    Map { comment: String, buffer: Buffer, len: usize, formula: Formula },
}

#[derive(Clone)]
pub enum Arg {
    /// Bytes of the camera image.
    Image(Range<usize>),
    /// A buffer from an offset on, to be read.
    Read(Buffer, usize),
    /// A buffer from an offset on, to be overwritten.
    Write(Buffer, usize),
    /// The first numbers of a buffer, to be changed.
    Change(Buffer, usize),
    Array(String),
    Int(usize),
    Float(f32),
    /// A structure and its fields.
    Sizes(&'static str, Vec<(&'static str, usize)>),
    Function(&'static str),
}

/// Sections of the library that a function needs besides its own.
fn needs(function: &str) -> &'static [&'static str] {
    match function {
        "resize_halve" | "resize_linear" => &["resize"],
        "resize_area" => &["resize", "round_half_even"],
        "gray" => &["descale"],
        "yuv" => &["descale", "clamp_level"],
        "yuv_old" => &["descale", "clamp_level", "yuv"],
        "saturation" => &["descale", "extremes"],
        "hsv" => &["descale", "clamp_level", "extremes", "saturation"],
        "hls" => &["extremes", "round_half_even"],
        "lab" => &["descale", "clamp_level"],
        "depthwise" => &["conv2d"],
        "max_pool" | "average_pool" => &["pool"],
        "elu" | "hyperbolic_tangent" | "sigmoid" => &["exp"],
        _ => &[],
    }
}

/// Name in the library and constant of a function.
fn library_function(function: Function) -> (&'static str, Option<f32>) {
    match function {
        Function::Relu => ("relu", None),
        Function::Elu { alpha } => ("elu", Some(alpha)),
        Function::LeakyRelu { slope } => ("leaky_relu", Some(slope)),
        Function::Tanh => ("hyperbolic_tangent", None),
        Function::Softsign => ("softsign", None),
        Function::Sigmoid => ("sigmoid", None),
    }
}

/// `formula` as an expression of C and Rust, where `x` is the input value and `number` writes a constant.
pub fn expression(formula: &Formula, x: &str, number: fn(f32) -> String) -> String {
    let part = |formula: &Formula| expression(formula, x, number);
    let factor = |formula: &Formula| match formula {
        Formula::Sum(_) => format!("({})", part(formula)),
        _ => part(formula),
    };
    match formula {
        Formula::X => x.into(),
        Formula::Number(value) => number(*value),
        Formula::Sum(terms) => format!("{} + {}", part(&terms[0]), part(&terms[1])),
        // Factors in parentheses where the order of the roundings depends on it.
        Formula::Product(factors) => match &factors[1] {
            Formula::Product(_) => format!("{} * ({})", factor(&factors[0]), part(&factors[1])),
            last => format!("{} * {}", factor(&factors[0]), factor(last)),
        },
        Formula::Apply(function, argument) => {
            let (name, constant) = library_function(*function);
            let args = [part(argument)].into_iter().chain(constant.map(number));
            format!("{name}({})", args.collect::<Vec<_>>().join(", "))
        }
    }
}

impl<'a> Program<'a> {
    pub fn new(recipe: &'a Recipe, steps: &[ChainStep]) -> Program<'a> {
        let mut program = Program {
            recipe,
            tables: Vec::new(),
            constants: Vec::new(),
            sections: Vec::new(),
            arrays: Vec::new(),
            buffers: Vec::new(),
            statements: Vec::new(),
            result: Buffer::A,
        };
        program.preprocess();
        for step in steps {
            program.step(step);
        }
        program
    }

    /// The sections of the library that hold the functions in `formula`.
    fn need_functions_of(&mut self, formula: &Formula) {
        match formula {
            Formula::X | Formula::Number(_) => {}
            Formula::Sum(parts) | Formula::Product(parts) => {
                parts.iter().for_each(|part| self.need_functions_of(part));
            }
            Formula::Apply(function, argument) => {
                let (name, _) = library_function(*function);
                self.sections.extend(needs(name));
                self.sections.push(name);
                self.need_functions_of(argument);
            }
        }
    }

    fn call(&mut self, comment: Option<String>, function: &'static str, args: Vec<Arg>) {
        let named = args.iter().filter_map(|arg| if let Arg::Function(name) = arg { Some(*name) } else { None });
        for function in [function].into_iter().chain(named) {
            self.sections.extend(needs(function));
            self.sections.push(function);
        }
        self.statements.push(Statement::Call { comment, function, args });
    }

    fn array(&mut self, name: String, values: Values) -> Arg {
        self.arrays.push(Array { name: name.clone(), values });
        Arg::Array(name)
    }

    /// Makes room for `len` numbers in a buffer.
    fn reserve(&mut self, buffer: Buffer, len: usize) {
        match self.buffers.iter_mut().find(|(other, _)| *other == buffer) {
            Some((_, size)) => *size = len.max(*size),
            None => self.buffers.push((buffer, len)),
        }
    }

    /// Adds the calls that turn the camera image into the network's input in buffer `a`.
    fn preprocess(&mut self) {
        let spec = &self.recipe.preprocessing;
        let ([first, end], width) = (spec.rows, spec.source[1]);
        let kept = [end - first, width];
        let [channels, h, w] = spec.output();
        let mut at = Arg::Image(first * width * 3..end * width * 3);
        let mut kept_rows = format!("Rows {first} to {end}");
        if spec.blur {
            let comment = Some(format!("{kept_rows}, blurred"));
            self.reserve(Buffer::Blurred, kept[0] * kept[1] * 3);
            self.call(comment, "blur", vec![at, Arg::Write(Buffer::Blurred, 0), Arg::Int(kept[0]), Arg::Int(kept[1])]);
            kept_rows = "The blurred rows".into();
            at = Arg::Read(Buffer::Blurred, 0);
        }
        if spec.colour_first {
            let comment = Some(format!("{kept_rows} in {}", colour_name(spec.colour)));
            self.colour(spec.colour, at, Buffer::Pixels, kept, comment);
            at = Arg::Read(Buffer::Pixels, 0);
            for channel in 0..channels {
                let comment = (channel == 0).then(|| format!("Each plane resized to {h}x{w}"));
                let (from, to) = (channel * kept[0] * kept[1], channel * h * w);
                let src = Arg::Read(Buffer::Pixels, from);
                if self.resize(src, Arg::Write(Buffer::Planes, to), kept, 1, comment) {
                    self.reserve(Buffer::Planes, channels * h * w);
                    at = Arg::Read(Buffer::Planes, 0);
                }
            }
        } else {
            let comment = Some(format!("{kept_rows}, resized to {h}x{w}"));
            if self.resize(at.clone(), Arg::Write(Buffer::Pixels, 0), kept, 3, comment) {
                self.reserve(Buffer::Pixels, 3 * h * w);
                at = Arg::Read(Buffer::Pixels, 0);
            }
            self.colour(
                spec.colour,
                at,
                Buffer::Planes,
                [h, w],
                Some(format!("Planes of {}", colour_name(spec.colour))),
            );
            at = Arg::Read(Buffer::Planes, 0);
        }
        let len = channels * h * w;
        let (factor, offset) = (Arg::Float(spec.scale as f32), Arg::Float(spec.offset as f32));
        self.reserve(Buffer::A, len);
        self.call(None, "to_input", vec![at, Arg::Write(Buffer::A, 0), Arg::Int(len), factor, offset]);
    }

    /// Adds the calls that resize; `false` if there is nothing to resize. Several calls share their arrays.
    fn resize(&mut self, src: Arg, dst: Arg, from: [usize; 2], channels: usize, comment: Option<String>) -> bool {
        let spec = &self.recipe.preprocessing;
        let resizer = Resizer::new(from, spec.resize, channels, spec.interpolation);
        let [to_h, to_w] = spec.resize;
        let sizes = [("from_h", from[0]), ("from_w", from[1]), ("to_h", to_h), ("to_w", to_w), ("channels", channels)];
        let mut args = vec![src, dst, Arg::Sizes("resize", sizes.to_vec())];
        let known = self.arrays.iter().any(|array| array.name == "resize_rows");
        let mut arrays: Vec<(&str, Values)> = Vec::new();
        let function = match resizer.method() {
            Method::Copy => return false,
            Method::Halve => "resize_halve",
            Method::Linear { x, y, .. } => {
                let taps = |taps: &[LinearTap]| {
                    let tap = |tap: &LinearTap| [tap.low as u16, tap.high as u16, tap.weights[1] as u16];
                    Values::U16(taps.iter().flat_map(tap).collect())
                };
                arrays.extend([("resize_rows", taps(y)), ("resize_columns", taps(x))]);
                "resize_linear"
            }
            Method::Area { x, y, .. } => {
                let taps = |taps: &AreaTaps| {
                    let ends = taps.starts.windows(2);
                    let tap = |(first, ends): (&usize, &[usize])| [*first as u16, ends[0] as u16, ends[1] as u16];
                    Values::U16(taps.first.iter().zip(ends).flat_map(tap).collect())
                };
                arrays.extend([("resize_rows", taps(y)), ("resize_row_weights", Values::F32(y.weights.clone()))]);
                arrays.extend([("resize_columns", taps(x)), ("resize_column_weights", Values::F32(x.weights.clone()))]);
                "resize_area"
            }
        };
        for (name, values) in arrays {
            args.push(if known { Arg::Array(name.into()) } else { self.array(name.into(), values) });
        }
        self.call(comment, function, args);
        true
    }

    /// Adds the call that converts `[h][w][3]` to planes in `buffer`.
    fn colour(&mut self, colour: Colour, src: Arg, buffer: Buffer, [h, w]: [usize; 2], comment: Option<String>) {
        let mut table = |name: &str, values| self.tables.push(Array { name: name.into(), values });
        let convert = match colour {
            Colour::Rgb => "rgb",
            Colour::Bgr => "bgr",
            Colour::Yuv => "yuv",
            Colour::YuvOld => "yuv_old",
            Colour::Hsv => {
                table("hsv_saturation", Values::I32(HSV.saturation.to_vec()));
                table("hsv_hue", Values::I32(HSV.hue.to_vec()));
                "hsv"
            }
            Colour::Saturation => {
                table("hsv_saturation", Values::I32(HSV.saturation.to_vec()));
                "saturation"
            }
            Colour::Hls => "hls",
            Colour::Lab => {
                let small = |values: &[i32]| Values::U16(values.iter().map(|value| *value as u16).collect());
                table("lab_linear", small(&LAB.linear));
                table("lab_root", small(&LAB.root));
                table("lab_xyz", small(LAB.xyz.as_flattened()));
                self.constants.extend([("LAB_L_SCALE", L_SCALE), ("LAB_L_SHIFT", L_SHIFT)]);
                "lab"
            }
            Colour::Gray => "gray",
        };
        let channels = colour.channels();
        self.reserve(buffer, channels * h * w);
        let sizes = [Arg::Int(h * w), Arg::Int(channels), Arg::Function(convert)];
        let args = [src, Arg::Write(buffer, 0)].into_iter().chain(sizes).collect();
        self.call(comment, "to_planes", args);
    }

    fn step(&mut self, step: &ChainStep) {
        let ChainStep { name, input, output, form } = step;
        let array = |what: &str| format!("{name}_{what}");
        let change = |program: &Program| Arg::Change(program.result, input.len());
        match form {
            ExportForm::Conv { depthwise, kernel, stride, pads, weight, bias } => {
                let function = if *depthwise { "depthwise" } else { "conv2d" };
                let weight = self.array(array("weight"), Values::F32(weight.clone()));
                let bias = self.array(array("bias"), Values::F32(bias.clone()));
                let mut sizes = map_sizes(*input);
                sizes.push(("filters", output.c));
                sizes.extend([("kernel_h", kernel[0]), ("kernel_w", kernel[1])]);
                sizes.extend([("stride_h", stride[0]), ("stride_w", stride[1])]);
                sizes.extend([("pad_top", pads.top), ("pad_left", pads.left)]);
                sizes.extend([("out_h", output.h), ("out_w", output.w)]);
                self.map_call(step, function, vec![weight, bias, Arg::Sizes("conv", sizes)]);
            }
            ExportForm::Dense { weight, bias } => {
                let weight = self.array(array("weight"), Values::F32(weight.clone()));
                let bias = self.array(array("bias"), Values::F32(bias.clone()));
                self.map_call(step, "dense", vec![weight, bias, Arg::Int(input.len()), Arg::Int(output.len())]);
            }
            ExportForm::BatchNorm { gamma, beta, mean, variance, epsilon } => {
                let ChannelAffine { scale, shift } = scale_and_shift(gamma, beta, mean, variance, *epsilon);
                let numbers = |values: Vec<f64>| Values::F32(values.into_iter().map(|value| value as f32).collect());
                let scale = self.array(array("scale"), numbers(scale));
                let shift = self.array(array("shift"), numbers(shift));
                let args = vec![change(self), scale, shift, Arg::Int(input.positions())];
                self.call(Some(name.clone()), "scale_channels", args);
            }
            ExportForm::Elementwise(formula) => {
                self.need_functions_of(formula);
                let (buffer, len) = (self.result, input.len());
                self.statements.push(Statement::Map { comment: name.clone(), buffer, len, formula: formula.clone() });
            }
            ExportForm::PRelu { slopes } => {
                let repeat = Arg::Int(input.len() / slopes.len());
                let slopes = self.array(array("slope"), Values::F32(slopes.clone()));
                self.call(Some(name.clone()), "prelu", vec![change(self), slopes, repeat]);
            }
            ExportForm::MaxPool { window, stride } => {
                let sizes = pool_sizes(*input, *output, *window, *stride);
                self.map_call(step, "max_pool", vec![sizes]);
            }
            ExportForm::AveragePool { window, stride } => {
                let sizes = pool_sizes(*input, *output, *window, *stride);
                self.map_call(step, "average_pool", vec![sizes]);
            }
            ExportForm::Crop { top, left } => {
                let mut sizes = map_sizes(*input);
                sizes.extend([("top", *top), ("left", *left), ("out_h", output.h), ("out_w", output.w)]);
                self.map_call(step, "crop", vec![Arg::Sizes("crop", sizes)]);
            }
            ExportForm::ZeroPad { top, left } => {
                let mut sizes = map_sizes(*input);
                sizes.extend([("top", *top), ("left", *left), ("out_h", output.h), ("out_w", output.w)]);
                self.map_call(step, "zero_pad", vec![Arg::Sizes("pad", sizes)]);
            }
            ExportForm::Resize { rows, columns } => {
                let mut args = Vec::new();
                for (axis, taps) in [("row", rows), ("column", columns)] {
                    let (mut ranges, mut all) = (Vec::new(), Vec::new());
                    for i in 0..taps.outputs() {
                        let (first, weights) = taps.of(i);
                        ranges.extend([first as i32, all.len() as i32, (all.len() + weights.len()) as i32]);
                        all.extend_from_slice(weights);
                    }
                    args.push(self.array(array(&format!("{axis}s")), Values::I32(ranges)));
                    args.push(self.array(array(&format!("{axis}_weights")), Values::F32(all)));
                }
                let mut sizes = map_sizes(*input);
                sizes.extend([("out_h", output.h), ("out_w", output.w)]);
                args.push(Arg::Sizes("resample", sizes));
                self.map_call(step, "resample_map", args);
            }
            // A map is laid out as the vector is.
            ExportForm::Flatten | ExportForm::Identity => {}
        }
    }

    /// A call that reads one float buffer and writes the other.
    fn map_call(&mut self, step: &ChainStep, function: &'static str, rest: Vec<Arg>) {
        let (from, to) = (self.result, if self.result == Buffer::A { Buffer::B } else { Buffer::A });
        self.reserve(to, step.output.len());
        let args = [Arg::Read(from, 0), Arg::Write(to, 0)].into_iter().chain(rest).collect();
        self.call(Some(format!("{}: {}", step.name, step.output)), function, args);
        self.result = to;
    }
}

/// As in a recipe.
fn colour_name(colour: Colour) -> String {
    serde_json::to_value(colour).ok().and_then(|name| name.as_str().map(String::from)).unwrap_or_default()
}

fn map_sizes(input: Shape) -> Vec<(&'static str, usize)> {
    vec![("c", input.c), ("h", input.h), ("w", input.w)]
}

fn pool_sizes(input: Shape, output: Shape, window: [usize; 2], stride: [usize; 2]) -> Arg {
    let mut sizes = map_sizes(input);
    sizes.extend([("window_h", window[0]), ("window_w", window[1])]);
    sizes.extend([("stride_h", stride[0]), ("stride_w", stride[1])]);
    sizes.extend([("out_h", output.h), ("out_w", output.w)]);
    Arg::Sizes("pool", sizes)
}

/// The sections of `library` that `wanted` names, in the library's order. A section begins with a line `… == name`.
pub fn pick_sections(library: &str, wanted: &[&str]) -> String {
    let mut picked = String::new();
    let mut is_wanted = false;
    for line in library.lines() {
        match section_name(line) {
            Some(name) => is_wanted = wanted.contains(&name),
            None if is_wanted => {
                picked.push_str(line);
                picked.push('\n');
            }
            None => {}
        }
    }
    picked
}

fn section_name(line: &str) -> Option<&str> {
    let rest = line.strip_prefix("/* == ").or(line.strip_prefix("// == "))?;
    Some(rest.trim_end_matches("*/").trim())
}

/// A statement `function(args);`, over several lines if one of 120 columns does not hold it.
pub fn statement(function: &str, args: &[String], indent: &str) -> String {
    let line = format!("{indent}{function}({});", args.join(", "));
    if line.len() <= 120 {
        return line;
    }
    let separator = format!(",\n{indent}    ");
    format!("{indent}{function}(\n{indent}    {}\n{indent});", args.join(&separator))
}

/// `numbers` over lines of at most 120 columns, indented by four.
pub fn wrap(numbers: impl Iterator<Item = String>) -> String {
    let mut text = String::new();
    let mut column = usize::MAX;
    for number in numbers {
        if column.saturating_add(number.len() + 2) > 120 {
            text.push_str(if text.is_empty() { "    " } else { "\n    " });
            column = 4;
        } else {
            text.push(' ');
            column += 1;
        }
        column += number.len() + 1;
        text.push_str(&number);
        text.push(',');
    }
    text
}
