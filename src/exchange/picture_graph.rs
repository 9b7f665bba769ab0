//! Preprocessing as operations of a graph that give the same grey levels as
//! [`Preprocessor`](crate::dataset::preprocess::Preprocessor), to the bit.
//!
//! Between operations a picture is a float tensor of whole numbers from 0 to 255. Floats hold integers below 2²⁴ exactly, so
//! the graph computes these in floats and larger ones in 32-bit integers. The area method adds its sums in the engine's order.

use crate::dataset::blur::neighbours;
use crate::dataset::colour::{Colour, HSV, L_SCALE, L_SHIFT, LAB};
use crate::dataset::preprocess::Preprocessing;
use crate::dataset::resize::{AreaTaps, LinearTap, Method, Resizer};

/// An operator on each value of its inputs, which are broadcast.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Op {
    Add,
    Sub,
    Mul,
    /// Of integers the quotient without its fraction.
    Div,
    /// Of two or three inputs.
    Max,
    /// Of two or three inputs.
    Min,
    Equal,
    Less,
    Greater,
    /// The second input where the first holds, else the third.
    Where,
    Floor,
    /// To the nearest whole number, of two the even one.
    Round,
}

/// A direction in a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Axis {
    Row,
    Column,
}

/// A graph of a file format. Values have names; a picture has one to three channels, in the order of axes of the format.
pub(crate) trait PictureGraph {
    /// Adds an operator on each value.
    fn op(&mut self, op: Op, inputs: &[&str]) -> String;
    /// Adds a constant float.
    fn number(&mut self, value: f32) -> String;
    /// Adds a constant 32-bit integer.
    fn integer(&mut self, value: i32) -> String;
    /// Adds a constant that differs along `axis` alone.
    fn floats_along(&mut self, axis: Axis, values: &[f32]) -> String;
    /// Adds a constant of 32-bit integers that differs along `axis` alone.
    fn integers_along(&mut self, axis: Axis, values: &[i32]) -> String;
    /// Floats as 32-bit integers, without their fractions.
    fn to_integers(&mut self, x: &str) -> String;
    /// 32-bit integers as floats.
    fn to_floats(&mut self, x: &str) -> String;
    /// The rows or columns `positions` of `x`.
    fn gather(&mut self, x: &str, axis: Axis, positions: &[usize]) -> String;
    /// The elements of `table` at the integers `index`.
    fn look_up(&mut self, table: &[f32], index: &str) -> String;
    /// The mean of each 2x2 pixels.
    fn mean_of_2x2(&mut self, x: &str) -> String;
    /// The three channels of `x`.
    fn split_channels(&mut self, x: &str) -> [String; 3];
    /// The picture of these channels.
    fn join_channels(&mut self, channels: &[&str]) -> String;
}

/// Adds what makes the network's picture out of the kept rows of a camera image `x`, both in grey levels. `scale` and `offset`
/// are left to the caller.
pub(crate) fn add<G: PictureGraph>(graph: &mut G, spec: &Preprocessing, x: &str) -> String {
    let mut pictures = Pictures { graph };
    let [first, end] = spec.rows;
    let kept = [end - first, spec.source[1]];
    let resizer = Resizer::new(kept, spec.resize, 1, spec.interpolation);
    let blurred = if spec.blur { pictures.blur(kept, x) } else { x.into() };
    let x = blurred.as_str();
    if spec.colour_first {
        let x = pictures.colour(spec.colour, x);
        pictures.resize(&resizer, &x)
    } else {
        let x = pictures.resize(&resizer, x);
        pictures.colour(spec.colour, &x)
    }
}

struct Pictures<'a, G> {
    graph: &'a mut G,
}

impl<G: PictureGraph> Pictures<'_, G> {
    /// The weights 1, 2, 1 in each direction, and a sixteenth of it rounded half up. All sums are whole numbers below 2^24.
    fn blur(&mut self, [h, w]: [usize; 2], x: &str) -> String {
        let mut sum = x.to_string();
        for (axis, n) in [(Axis::Row, h), (Axis::Column, w)] {
            let [before, after] = [0, 1].map(|side| {
                let positions: Vec<usize> = (0..n).map(|i| neighbours(i, n)[side]).collect();
                self.graph.gather(&sum, axis, &positions)
            });
            let sides = self.graph.op(Op::Add, &[&before, &after]);
            let twice = self.with(Op::Mul, &sum, 2.0);
            sum = self.graph.op(Op::Add, &[&sides, &twice]);
        }
        self.descale(&sum, 4)
    }

    fn resize(&mut self, resizer: &Resizer, x: &str) -> String {
        match resizer.method() {
            Method::Copy => x.into(),
            Method::Halve => {
                // The mean of four whole numbers is exact; half of one is rounded up.
                let mean = self.graph.mean_of_2x2(x);
                let up = self.with(Op::Add, &mean, 0.5);
                self.graph.op(Op::Floor, &[&up])
            }
            Method::Linear { x: columns, y: rows, .. } => {
                let x = self.graph.to_integers(x);
                let wide = self.blend(&x, Axis::Column, columns, None);
                let shifted = self.int32_op(Op::Div, &wide, 1 << 4);
                let sum = self.blend(&shifted, Axis::Row, rows, Some(1 << 16));
                let rounded = self.int32_op(Op::Add, &sum, 2);
                let levels = self.int32_op(Op::Div, &rounded, 4);
                self.graph.to_floats(&levels)
            }
            Method::Area { x: columns, y: rows, .. } => {
                let down = self.weighted_sum(x, Axis::Row, rows);
                let cells = self.weighted_sum(&down, Axis::Column, columns);
                self.graph.op(Op::Round, &[&cells])
            }
        }
    }

    /// Applies the operator `op` to `x` and a number.
    fn with(&mut self, op: Op, x: &str, value: f32) -> String {
        let value = self.graph.number(value);
        self.graph.op(op, &[x, &value])
    }

    fn int32_op(&mut self, op: Op, x: &str, value: i32) -> String {
        let value = self.graph.integer(value);
        self.graph.op(op, &[x, &value])
    }

    /// Interpolates between the two source positions of each tap in 32-bit integers, and divides by `divisor`. All values are
    /// positive, so the division rounds down.
    fn blend(&mut self, x: &str, axis: Axis, taps: &[LinearTap], divisor: Option<i32>) -> String {
        let mut side = |position: fn(&LinearTap) -> usize, weight: fn(&LinearTap) -> i32| {
            let positions: Vec<usize> = taps.iter().map(position).collect();
            let source = self.graph.gather(x, axis, &positions);
            let weights: Vec<i32> = taps.iter().map(weight).collect();
            let weights = self.graph.integers_along(axis, &weights);
            let product = self.graph.op(Op::Mul, &[&source, &weights]);
            match divisor {
                Some(divisor) => self.int32_op(Op::Div, &product, divisor),
                None => product,
            }
        };
        let (low, high) = (side(|tap| tap.low, |tap| tap.weights[0]), side(|tap| tap.high, |tap| tap.weights[1]));
        self.graph.op(Op::Add, &[&low, &high])
    }

    /// Sums the source positions that each output position covers, in their order. Where a position covers fewer than the
    /// others, the missing ones have a weight of 0.
    fn weighted_sum(&mut self, x: &str, axis: Axis, taps: &AreaTaps) -> String {
        let covered: Vec<(usize, &[f32])> = (0..taps.first.len()).map(|i| taps.of(i)).collect();
        let most = covered.iter().map(|(_, weights)| weights.len()).max().unwrap_or(0);
        let mut sum: Option<String> = None;
        for k in 0..most {
            let positions: Vec<usize> =
                covered.iter().map(|(first, weights)| first + k.min(weights.len() - 1)).collect();
            let weights: Vec<f32> = covered.iter().map(|(_, weights)| weights.get(k).copied().unwrap_or(0.0)).collect();
            let source = self.graph.gather(x, axis, &positions);
            let weights = self.graph.floats_along(axis, &weights);
            let product = self.graph.op(Op::Mul, &[&source, &weights]);
            sum = Some(match sum {
                Some(sum) => self.graph.op(Op::Add, &[&sum, &product]),
                None => product,
            });
        }
        sum.expect("every output position covers a source position")
    }

    fn colour(&mut self, colour: Colour, x: &str) -> String {
        if colour == Colour::Rgb {
            return x.into();
        }
        let channels = self.graph.split_channels(x);
        let [r, g, b] = channels.each_ref().map(String::as_str);
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
        self.graph.join_channels(&planes)
    }

    /// `x / 2^bits`, rounded half up.
    fn descale(&mut self, x: &str, bits: i32) -> String {
        let half = self.with(Op::Add, x, 2f32.powi(bits - 1));
        let scaled = self.with(Op::Mul, &half, 2f32.powi(-bits));
        self.graph.op(Op::Floor, &[&scaled])
    }

    fn clip(&mut self, x: &str) -> String {
        let (low, high) = (self.graph.number(0.0), self.graph.number(255.0));
        let clipped = self.graph.op(Op::Max, &[x, &low]);
        self.graph.op(Op::Min, &[&clipped, &high])
    }

    /// The weighted sum of the channels, divided by `2^bits` and rounded half up.
    fn luminance(&mut self, rgb: [&str; 3], weights: [f32; 3], bits: i32) -> String {
        let terms: Vec<String> = rgb.iter().zip(weights).map(|(x, weight)| self.with(Op::Mul, x, weight)).collect();
        let sum = self.graph.op(Op::Add, &[&terms[0], &terms[1]]);
        let sum = self.graph.op(Op::Add, &[&sum, &terms[2]]);
        self.descale(&sum, bits)
    }

    fn yuv(&mut self, [r, g, b]: [&str; 3]) -> [String; 3] {
        let y = self.luminance([r, g, b], [4899.0, 9617.0, 1868.0], 14);
        let mut chroma = |x: &str, weight: f32| {
            let difference = self.graph.op(Op::Sub, &[x, &y]);
            let scaled = self.with(Op::Mul, &difference, weight);
            let level = self.descale(&scaled, 14);
            let centred = self.with(Op::Add, &level, 128.0);
            self.clip(&centred)
        };
        let (u, v) = (chroma(b, 8061.0), chroma(r, 14369.0));
        [y, u, v]
    }

    fn extremes(&mut self, rgb: [&str; 3]) -> Extremes {
        let (max, min) = (self.graph.op(Op::Max, &rgb), self.graph.op(Op::Min, &rgb));
        let spread = self.graph.op(Op::Sub, &[&max, &min]);
        Extremes { max, min, spread }
    }

    /// Looks up each value of `x` in `table`.
    fn look_up(&mut self, table: &[i32], x: &str) -> String {
        let table: Vec<f32> = table.iter().map(|value| *value as f32).collect();
        let index = self.graph.to_integers(x);
        self.graph.look_up(&table, &index)
    }

    fn saturation(&mut self, max: &str, spread: &str) -> String {
        let reciprocal = self.look_up(&HSV.saturation, max);
        let product = self.graph.op(Op::Mul, &[spread, &reciprocal]);
        self.descale(&product, 12)
    }

    /// The element of `sectors` (red, green, blue) that belongs to the largest channel; of equal ones the first.
    fn by_largest(&mut self, [r, g]: [&str; 2], max: &str, [red, green, blue]: [String; 3]) -> String {
        let is_green = self.graph.op(Op::Equal, &[max, g]);
        let not_red = self.graph.op(Op::Where, &[&is_green, &green, &blue]);
        let is_red = self.graph.op(Op::Equal, &[max, r]);
        self.graph.op(Op::Where, &[&is_red, &red, &not_red])
    }

    /// Adds `turn` to negative values.
    fn wrap(&mut self, angle: &str, turn: f32) -> String {
        let zero = self.graph.number(0.0);
        let negative = self.graph.op(Op::Less, &[angle, &zero]);
        let turned = self.with(Op::Add, angle, turn);
        self.graph.op(Op::Where, &[&negative, &turned, angle])
    }

    fn hsv(&mut self, [r, g, b]: [&str; 3]) -> [String; 3] {
        let Extremes { max, spread, .. } = self.extremes([r, g, b]);
        let mut sector = |x: &str, y: &str, spreads: f32| {
            let difference = self.graph.op(Op::Sub, &[x, y]);
            let offset = self.with(Op::Mul, &spread, spreads);
            self.graph.op(Op::Add, &[&difference, &offset])
        };
        let sectors = [sector(g, b, 0.0), sector(b, r, 2.0), sector(r, g, 4.0)];
        let sector = self.by_largest([r, g], &max, sectors);
        let reciprocal = self.look_up(&HSV.hue, &spread);
        let product = self.graph.op(Op::Mul, &[&sector, &reciprocal]);
        let hue = self.descale(&product, 12);
        let hue = self.wrap(&hue, 180.0);
        let hue = self.clip(&hue);
        let saturation = self.saturation(&max, &spread);
        [hue, saturation, max]
    }

    fn hls(&mut self, rgb: [&str; 3]) -> [String; 3] {
        let rgb = rgb.map(|x| self.with(Op::Mul, x, 1.0 / 255.0));
        let [r, g, b] = rgb.each_ref().map(String::as_str);
        let Extremes { max, min, spread } = self.extremes([r, g, b]);
        let sum = self.graph.op(Op::Add, &[&max, &min]);
        let lightness = self.with(Op::Mul, &sum, 0.5);

        let (half, two) = (self.graph.number(0.5), self.graph.number(2.0));
        let is_dark = self.graph.op(Op::Less, &[&lightness, &half]);
        let rest = self.graph.op(Op::Sub, &[&two, &max]);
        let rest = self.graph.op(Op::Sub, &[&rest, &min]);
        let (dark, light) = (self.graph.op(Op::Div, &[&spread, &sum]), self.graph.op(Op::Div, &[&spread, &rest]));
        let saturation = self.graph.op(Op::Where, &[&is_dark, &dark, &light]);

        let sixty = self.graph.number(60.0);
        let step = self.graph.op(Op::Div, &[&sixty, &spread]);
        let mut sector = |x: &str, y: &str, offset_deg: f32| {
            let difference = self.graph.op(Op::Sub, &[x, y]);
            let angle = self.graph.op(Op::Mul, &[&difference, &step]);
            self.with(Op::Add, &angle, offset_deg)
        };
        let sectors = [sector(g, b, 0.0), sector(b, r, 120.0), sector(r, g, 240.0)];
        let hue_deg = self.by_largest([r, g], &max, sectors);
        let hue_deg = self.wrap(&hue_deg, 360.0);

        // Grey has neither: the divisions by 0 above are not looked at.
        let (least, zero) = (self.graph.number(f32::EPSILON), self.graph.number(0.0));
        let is_coloured = self.graph.op(Op::Greater, &[&spread, &least]);
        let mut level = |x: &str, scale: f32| {
            let scaled = self.with(Op::Mul, x, scale);
            self.graph.op(Op::Round, &[&scaled])
        };
        let (hue, lightness, saturation) = (level(&hue_deg, 0.5), level(&lightness, 255.0), level(&saturation, 255.0));
        [
            self.graph.op(Op::Where, &[&is_coloured, &hue, &zero]),
            lightness,
            self.graph.op(Op::Where, &[&is_coloured, &saturation, &zero]),
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
        let lightness = self.with(Op::Mul, &roots[1], L_SCALE as f32);
        let lightness = self.with(Op::Add, &lightness, L_SHIFT as f32);
        let lightness = self.descale(&lightness, 15);
        let mut opponent = |x: &str, y: &str, weight: f32| {
            let difference = self.graph.op(Op::Sub, &[x, y]);
            let scaled = self.with(Op::Mul, &difference, weight);
            // The centre is added last, so that no number passes 2²⁴.
            let level = self.descale(&scaled, 15);
            let centred = self.with(Op::Add, &level, 128.0);
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
