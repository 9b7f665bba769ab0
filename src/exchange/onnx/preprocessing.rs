//! Preprocessing as ONNX nodes that give the same grey levels as [`Preprocessor`](crate::dataset::preprocess::Preprocessor),
//! to the bit.
//!
//! Between nodes a picture is a float tensor `[N, c, h, w]` of whole numbers from 0 to 255. Floats hold integers below 2²⁴
//! exactly, so the nodes compute these in floats and larger ones in 32-bit integers. The area method adds its sums in the
//! engine's order.

use super::graph::{GraphBuilder, int, ints};
use super::proto::{AttributeProto, DataType};
use crate::dataset::colour::{Colour, HSV, L_SCALE, L_SHIFT, LAB};
use crate::dataset::preprocess::Preprocessing;
use crate::dataset::resize::{AreaTaps, LinearTap, Method, Resizer};

/// Axes of height and width in `[N, c, h, w]`.
const HEIGHT: i64 = 2;
const WIDTH: i64 = 3;

/// Adds the nodes from `image`, uint8 `[N, height, width, 3]`, to `output`, the network's input `[N, c, h, w]`.
pub fn add(graph: &mut GraphBuilder, spec: &Preprocessing, image: &str, output: &str) {
    let mut nodes = Nodes { graph, count: 0 };
    let [first, end] = spec.rows;
    let mut x = image.to_string();
    if spec.rows != [0, spec.source[0]] {
        let rows = [("starts", first), ("ends", end), ("axes", 1)]
            .map(|(name, value)| nodes.graph.int64s(&format!("preprocessing.{name}"), &[value]));
        x = nodes.op("Slice", &[&x, &rows[0], &rows[1], &rows[2]]);
    }
    x = nodes.op_with("Transpose", &[&x], vec![ints("perm", &[0, 3, 1, 2])]);
    x = nodes.cast(&x, DataType::Float);
    let resizer = Resizer::new([end - first, spec.source[1]], spec.resize, 1, spec.interpolation);
    if !spec.colour_first {
        x = nodes.resize(&resizer, &x);
    }
    x = nodes.colour(spec.colour, &x);
    if spec.colour_first {
        x = nodes.resize(&resizer, &x);
    }
    let scale = nodes.number(spec.scale as f32);
    let scaled = nodes.op("Mul", &[&x, &scale]);
    let offset = nodes.number(spec.offset as f32);
    nodes.graph.node("Add", output, &[&scaled, &offset], vec![]);
}

/// Nodes and constants called `preprocessing.1`, `preprocessing.2`, …
struct Nodes<'a> {
    graph: &'a mut GraphBuilder,
    count: usize,
}

impl Nodes<'_> {
    fn name(&mut self) -> String {
        self.count += 1;
        format!("preprocessing.{}", self.count)
    }

    fn op(&mut self, op: &str, inputs: &[&str]) -> String {
        self.op_with(op, inputs, vec![])
    }

    fn op_with(&mut self, op: &str, inputs: &[&str], attributes: Vec<AttributeProto>) -> String {
        let name = self.name();
        self.graph.node(op, &name, inputs, attributes)
    }

    fn number(&mut self, value: f32) -> String {
        let name = self.name();
        self.graph.floats(&name, &[], &[value])
    }

    fn cast(&mut self, x: &str, data_type: DataType) -> String {
        self.op_with("Cast", &[x], vec![int("to", data_type as i64)])
    }

    /// Applies the operator `op` to `x` and a number.
    fn with(&mut self, op: &str, x: &str, value: f32) -> String {
        let value = self.number(value);
        self.op(op, &[x, &value])
    }

    /// Gathers the rows or columns `positions` of `x`.
    fn gather(&mut self, x: &str, axis: i64, positions: &[usize]) -> String {
        let name = self.name();
        let positions = self.graph.int64s(&name, positions);
        self.op_with("Gather", &[x, &positions], vec![int("axis", axis)])
    }

    fn resize(&mut self, resizer: &Resizer, x: &str) -> String {
        match resizer.method() {
            Method::Copy => x.into(),
            Method::Halve => {
                // The mean of four whole numbers is exact; half of one is rounded up.
                let window = vec![ints("kernel_shape", &[2, 2]), ints("strides", &[2, 2])];
                let mean = self.op_with("AveragePool", &[x], window);
                let up = self.with("Add", &mean, 0.5);
                self.op("Floor", &[&up])
            }
            Method::Linear { x: columns, y: rows, .. } => {
                let x = self.cast(x, DataType::Int32);
                let wide = self.blend(&x, WIDTH, columns, None);
                let shifted = self.int32_op("Div", &wide, 1 << 4);
                let sum = self.blend(&shifted, HEIGHT, rows, Some(1 << 16));
                let rounded = self.int32_op("Add", &sum, 2);
                let levels = self.int32_op("Div", &rounded, 4);
                self.cast(&levels, DataType::Float)
            }
            Method::Area { x: columns, y: rows, .. } => {
                let down = self.weighted_sum(x, HEIGHT, rows);
                let cells = self.weighted_sum(&down, WIDTH, columns);
                self.op("Round", &[&cells])
            }
        }
    }

    fn int32_op(&mut self, op: &str, x: &str, value: i32) -> String {
        let name = self.name();
        let value = self.graph.int32s(&name, &[], &[value]);
        self.op(op, &[x, &value])
    }

    /// Interpolates between the two source positions of each tap in 32-bit integers, and divides by `divisor`. All values are
    /// positive, so the division rounds down.
    fn blend(&mut self, x: &str, axis: i64, taps: &[LinearTap], divisor: Option<i32>) -> String {
        let mut side = |position: fn(&LinearTap) -> usize, weight: fn(&LinearTap) -> i32| {
            let positions: Vec<usize> = taps.iter().map(position).collect();
            let source = self.gather(x, axis, &positions);
            let weights: Vec<i32> = taps.iter().map(weight).collect();
            let name = self.name();
            let weights = self.graph.int32s(&name, &along(axis, taps.len()), &weights);
            let product = self.op("Mul", &[&source, &weights]);
            match divisor {
                Some(divisor) => self.int32_op("Div", &product, divisor),
                None => product,
            }
        };
        let (low, high) = (side(|tap| tap.low, |tap| tap.weights[0]), side(|tap| tap.high, |tap| tap.weights[1]));
        self.op("Add", &[&low, &high])
    }

    /// Sums the source positions that each output position covers, in their order. Where a position covers fewer than the
    /// others, the missing ones have a weight of 0.
    fn weighted_sum(&mut self, x: &str, axis: i64, taps: &AreaTaps) -> String {
        let covered: Vec<(usize, &[f32])> = (0..taps.first.len()).map(|i| taps.of(i)).collect();
        let most = covered.iter().map(|(_, weights)| weights.len()).max().unwrap_or(0);
        let mut sum: Option<String> = None;
        for k in 0..most {
            let positions: Vec<usize> =
                covered.iter().map(|(first, weights)| first + k.min(weights.len() - 1)).collect();
            let weights: Vec<f32> = covered.iter().map(|(_, weights)| weights.get(k).copied().unwrap_or(0.0)).collect();
            let source = self.gather(x, axis, &positions);
            let name = self.name();
            let weights = self.graph.floats(&name, &along(axis, covered.len()), &weights);
            let product = self.op("Mul", &[&source, &weights]);
            sum = Some(match sum {
                Some(sum) => self.op("Add", &[&sum, &product]),
                None => product,
            });
        }
        sum.expect("every output position covers a source position")
    }

    fn colour(&mut self, colour: Colour, x: &str) -> String {
        if colour == Colour::Rgb {
            return x.into();
        }
        let outputs = [self.name(), self.name(), self.name()];
        let names = outputs.each_ref().map(String::as_str);
        let sizes = self.name();
        let sizes = self.graph.int64s(&sizes, &[1, 1, 1]);
        let name = self.name();
        self.graph.node_with_outputs("Split", &name, &[x, &sizes], &names, vec![int("axis", 1)]);
        let [r, g, b] = names;
        let planes = match colour {
            Colour::Rgb => unreachable!("returned above"),
            Colour::Bgr => [b, g, r].map(String::from),
            Colour::Yuv => self.yuv([r, g, b]),
            Colour::YuvOld => self.yuv([b, g, r]),
            Colour::Gray => return self.luminance([r, g, b], [9798.0, 19235.0, 3735.0], 15),
            Colour::Saturation => {
                let Extremes { max, spread, .. } = self.extremes([r, g, b]);
                return self.saturation(&max, &spread);
            }
            Colour::Hsv => self.hsv([r, g, b]),
            Colour::Hls => self.hls([r, g, b]),
            Colour::Lab => self.lab([r, g, b]),
        };
        let planes = planes.each_ref().map(String::as_str);
        self.op_with("Concat", &planes, vec![int("axis", 1)])
    }

    /// `x / 2^bits`, rounded half up.
    fn descale(&mut self, x: &str, bits: i32) -> String {
        let half = self.with("Add", x, 2f32.powi(bits - 1));
        let scaled = self.with("Mul", &half, 2f32.powi(-bits));
        self.op("Floor", &[&scaled])
    }

    fn clip(&mut self, x: &str) -> String {
        let (low, high) = (self.number(0.0), self.number(255.0));
        self.op("Clip", &[x, &low, &high])
    }

    /// The weighted sum of the channels, divided by `2^bits` and rounded half up.
    fn luminance(&mut self, rgb: [&str; 3], weights: [f32; 3], bits: i32) -> String {
        let terms: Vec<String> = rgb.iter().zip(weights).map(|(x, weight)| self.with("Mul", x, weight)).collect();
        let sum = self.op("Add", &[&terms[0], &terms[1]]);
        let sum = self.op("Add", &[&sum, &terms[2]]);
        self.descale(&sum, bits)
    }

    fn yuv(&mut self, [r, g, b]: [&str; 3]) -> [String; 3] {
        let y = self.luminance([r, g, b], [4899.0, 9617.0, 1868.0], 14);
        let mut chroma = |x: &str, weight: f32| {
            let difference = self.op("Sub", &[x, &y]);
            let scaled = self.with("Mul", &difference, weight);
            let level = self.descale(&scaled, 14);
            let centred = self.with("Add", &level, 128.0);
            self.clip(&centred)
        };
        let (u, v) = (chroma(b, 8061.0), chroma(r, 14369.0));
        [y, u, v]
    }

    fn extremes(&mut self, rgb: [&str; 3]) -> Extremes {
        let (max, min) = (self.op("Max", &rgb), self.op("Min", &rgb));
        let spread = self.op("Sub", &[&max, &min]);
        Extremes { max, min, spread }
    }

    /// Looks up each value of `x` in `table`.
    fn look_up(&mut self, table: &[i32], x: &str) -> String {
        let table: Vec<f32> = table.iter().map(|value| *value as f32).collect();
        let name = self.name();
        let table = self.graph.floats(&name, &[table.len()], &table);
        let index = self.cast(x, DataType::Int32);
        self.op_with("Gather", &[&table, &index], vec![int("axis", 0)])
    }

    fn saturation(&mut self, max: &str, spread: &str) -> String {
        let reciprocal = self.look_up(&HSV.saturation, max);
        let product = self.op("Mul", &[spread, &reciprocal]);
        self.descale(&product, 12)
    }

    /// The element of `sectors` (red, green, blue) that belongs to the largest channel; of equal ones the first.
    fn by_largest(&mut self, [r, g]: [&str; 2], max: &str, [red, green, blue]: [String; 3]) -> String {
        let is_green = self.op("Equal", &[max, g]);
        let not_red = self.op("Where", &[&is_green, &green, &blue]);
        let is_red = self.op("Equal", &[max, r]);
        self.op("Where", &[&is_red, &red, &not_red])
    }

    /// Adds `turn` to negative values.
    fn wrap(&mut self, angle: &str, turn: f32) -> String {
        let zero = self.number(0.0);
        let negative = self.op("Less", &[angle, &zero]);
        let turned = self.with("Add", angle, turn);
        self.op("Where", &[&negative, &turned, angle])
    }

    fn hsv(&mut self, [r, g, b]: [&str; 3]) -> [String; 3] {
        let Extremes { max, spread, .. } = self.extremes([r, g, b]);
        let mut sector = |x: &str, y: &str, spreads: f32| {
            let difference = self.op("Sub", &[x, y]);
            let offset = self.with("Mul", &spread, spreads);
            self.op("Add", &[&difference, &offset])
        };
        let sectors = [sector(g, b, 0.0), sector(b, r, 2.0), sector(r, g, 4.0)];
        let sector = self.by_largest([r, g], &max, sectors);
        let reciprocal = self.look_up(&HSV.hue, &spread);
        let product = self.op("Mul", &[&sector, &reciprocal]);
        let hue = self.descale(&product, 12);
        let hue = self.wrap(&hue, 180.0);
        let hue = self.clip(&hue);
        let saturation = self.saturation(&max, &spread);
        [hue, saturation, max]
    }

    fn hls(&mut self, rgb: [&str; 3]) -> [String; 3] {
        let rgb = rgb.map(|x| self.with("Mul", x, 1.0 / 255.0));
        let [r, g, b] = rgb.each_ref().map(String::as_str);
        let Extremes { max, min, spread } = self.extremes([r, g, b]);
        let sum = self.op("Add", &[&max, &min]);
        let lightness = self.with("Mul", &sum, 0.5);

        let (half, two) = (self.number(0.5), self.number(2.0));
        let is_dark = self.op("Less", &[&lightness, &half]);
        let rest = self.op("Sub", &[&two, &max]);
        let rest = self.op("Sub", &[&rest, &min]);
        let (dark, light) = (self.op("Div", &[&spread, &sum]), self.op("Div", &[&spread, &rest]));
        let saturation = self.op("Where", &[&is_dark, &dark, &light]);

        let sixty = self.number(60.0);
        let step = self.op("Div", &[&sixty, &spread]);
        let mut sector = |x: &str, y: &str, offset_deg: f32| {
            let difference = self.op("Sub", &[x, y]);
            let angle = self.op("Mul", &[&difference, &step]);
            self.with("Add", &angle, offset_deg)
        };
        let sectors = [sector(g, b, 0.0), sector(b, r, 120.0), sector(r, g, 240.0)];
        let hue_deg = self.by_largest([r, g], &max, sectors);
        let hue_deg = self.wrap(&hue_deg, 360.0);

        // Grey has neither: the divisions by 0 above are not looked at.
        let (least, zero) = (self.number(f32::EPSILON), self.number(0.0));
        let is_coloured = self.op("Greater", &[&spread, &least]);
        let mut level = |x: &str, scale: f32| {
            let scaled = self.with("Mul", x, scale);
            self.op("Round", &[&scaled])
        };
        let (hue, lightness, saturation) = (level(&hue_deg, 0.5), level(&lightness, 255.0), level(&saturation, 255.0));
        [
            self.op("Where", &[&is_coloured, &hue, &zero]),
            lightness,
            self.op("Where", &[&is_coloured, &saturation, &zero]),
        ]
    }

    fn lab(&mut self, rgb: [&str; 3]) -> [String; 3] {
        let tables = &*LAB;
        let linear = rgb.map(|x| self.look_up(&tables.linear, x));
        let linear = linear.each_ref().map(String::as_str);
        let roots = tables.xyz.map(|weights| {
            let index = self.luminance(linear, weights.map(|weight| weight as f32), 12);
            self.look_up(&tables.root, &index)
        });
        let lightness = self.with("Mul", &roots[1], L_SCALE as f32);
        let lightness = self.with("Add", &lightness, L_SHIFT as f32);
        let lightness = self.descale(&lightness, 15);
        let mut opponent = |x: &str, y: &str, weight: f32| {
            let difference = self.op("Sub", &[x, y]);
            let scaled = self.with("Mul", &difference, weight);
            // The centre is added last, so that no number passes 2²⁴.
            let level = self.descale(&scaled, 15);
            let centred = self.with("Add", &level, 128.0);
            self.clip(&centred)
        };
        let (a, b) = (opponent(&roots[0], &roots[1], 500.0), opponent(&roots[1], &roots[2], 200.0));
        [self.clip(&lightness), a, b]
    }
}

/// Largest and smallest channel, and their difference.
struct Extremes {
    max: String,
    min: String,
    spread: String,
}

/// The shape that broadcasts a vector of `len` along `axis`.
fn along(axis: i64, len: usize) -> Vec<usize> {
    if axis == HEIGHT { vec![len, 1] } else { vec![len] }
}
