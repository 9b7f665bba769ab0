//! Finds the preprocessing that a network was trained with: under the right one, its predictions on a recording correlate
//! with the labels.
//!
//! The first round tries every colour space, crop and scaling on a few frames. The second round tries the best of these on
//! more frames, and with the other resize methods. Both prefer frames of bends: on a straight road all combinations give
//! nearly the same prediction.

use std::path::Path;

use ndarray::{ArrayView4, ArrayViewMut1};
use rayon::prelude::*;

use crate::dataset::colour::Colour;
use crate::dataset::preprocess::Preprocessing;
use crate::dataset::resize::Interpolation;
use crate::dataset::{Recording, View};
use crate::engine::layers::Family;
use crate::engine::network::{InferencePlan, Network, Parameters};
use crate::engine::tensor::Shape;
use crate::error::{Error, Result};
use crate::metrics::correlation;
use crate::picture::RgbImage;

/// Rows of Udacity's picture that well-known projects keep: first and end.
const CROPS: [[usize; 2]; 12] = [
    [0, 160],
    [30, 135],
    [32, 135],
    [40, 135],
    [40, 138],
    [50, 135],
    [50, 140],
    [56, 144],
    [60, 135],
    [60, 140],
    [63, 136],
    [70, 135],
];

/// Factor and offset that turn a grey level into an input value.
const SCALINGS: [(f64, f64); 4] = [(1.0, 0.0), (1.0 / 255.0, 0.0), (1.0 / 255.0, -0.5), (1.0 / 127.5, -1.0)];

const COLOURS: [Colour; 7] =
    [Colour::Rgb, Colour::Bgr, Colour::Yuv, Colour::YuvOld, Colour::Hsv, Colour::Hls, Colour::Lab];

const SINGLE_PLANES: [Colour; 2] = [Colour::Gray, Colour::Saturation];

/// Number of frames in the first and in the second round.
const FRAMES: [usize; 2] = [96, 480];

/// Number of combinations in the second round.
const FINALISTS: usize = 12;

/// Steering from which a frame counts as a bend: one degree of 25.
const TURNED: f32 = 0.04;

/// A preprocessing, and the correlation of the network's predictions with the labels under it.
#[derive(Clone, Debug, PartialEq)]
pub struct Candidate {
    /// The preprocessing.
    pub preprocessing: Preprocessing,
    /// Pearson's correlation of predictions and labels; absent if the predictions are all the same.
    pub correlation: Option<f64>,
}

/// Frames with their labels.
#[derive(Debug)]
pub struct Frames {
    images: Vec<RgbImage>,
    labels: Vec<f32>,
}

impl Frames {
    /// Picks frames of the centre camera for both rounds, spread over the recording. Two thirds of them are bends, if the
    /// recording has that many.
    ///
    /// # Errors
    ///
    /// [`Error::Data`] if no frame can be read or all labels are the same.
    pub fn of(recording: &Recording) -> Result<Frames> {
        let rows = || (0..recording.rows.len()).filter(|row| recording.row_has(*row, View::Centre));
        let is_turned = |row: &usize| recording.rows[*row].steering.abs() >= TURNED;
        let turned = spread(rows().filter(is_turned).collect(), FRAMES[1] * 2 / 3);
        let straight = spread(rows().filter(|row| !is_turned(row)).collect(), FRAMES[1] - FRAMES[1] * 2 / 3);
        let mut chosen = [turned, straight].concat();
        chosen.sort_unstable();
        let read = |row: usize| -> Option<(RgbImage, f32)> {
            let mut image = recording.picture(row, View::Centre)?;
            // All combinations begin by scaling the image to this size; so much of it is kept in memory.
            let whole = Preprocessing::default();
            if [image.height, image.width] != whole.source {
                let mut scaled = vec![0; whole.rgb_len()];
                whole.plan(image.height, image.width).ok()?.to_rgb_stage(&image.pixels, &mut scaled);
                image = RgbImage { height: whole.source[0], width: whole.source[1], pixels: scaled };
            }
            Some((image, recording.rows[row].steering))
        };
        let (images, labels): (Vec<RgbImage>, Vec<f32>) = chosen.into_par_iter().filter_map(read).unzip();
        if labels.iter().all(|label| Some(label) == labels.first()) {
            let message = format!("{} frames could be read, all with the same steering: nothing to fit", labels.len());
            return Err(Error::data(recording.path.as_path(), message));
        }
        Ok(Frames { images, labels })
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.labels.len()
    }

    /// Whether there is no frame.
    pub fn is_empty(&self) -> bool {
        self.labels.is_empty()
    }
}

/// At most `count` of `rows`, evenly spread.
fn spread(rows: Vec<usize>, count: usize) -> Vec<usize> {
    let count = count.min(rows.len());
    (0..count).map(|i| rows[i * rows.len() / count]).collect()
}

/// The combinations for a network: those of its input's size and number of planes.
pub fn combinations(network: &Network) -> Vec<Preprocessing> {
    let Shape { c, h, w } = network.input();
    let colours: &[Colour] = match c {
        3 => &COLOURS,
        1 => &SINGLE_PLANES,
        _ => &[],
    };
    // A network that scales by itself wants grey levels.
    let first = network.layers().iter().find(|layer| layer.spec.family() != Family::Rearrangement);
    let scales_itself = first.is_some_and(|layer| layer.spec.family() == Family::Normalization);
    let scalings = if scales_itself { &SCALINGS[..1] } else { &SCALINGS[..] };
    let mut all = Vec::new();
    for colour in colours {
        for rows in CROPS {
            for (scale, offset) in scalings {
                let (scale, offset) = (*scale, *offset);
                all.push(Preprocessing {
                    rows,
                    resize: [h, w],
                    colour: *colour,
                    scale,
                    offset,
                    ..Preprocessing::default()
                });
            }
        }
    }
    all
}

/// Tries all combinations for the network and ranks the best, best first; `known` is ranked among them.
///
/// # Errors
///
/// [`Error::Usage`] if the network's input has neither one nor three planes.
pub fn rank(
    network: &Network,
    parameters: &Parameters,
    frames: &Frames,
    known: Option<&Preprocessing>,
) -> Result<Vec<Candidate>> {
    let combinations = combinations(network);
    if combinations.is_empty() {
        let c = network.input().c;
        return Err(Error::Usage(format!("no colour space has {c} planes: the preprocessing cannot be guessed")));
    }
    let judge = |all: Vec<Preprocessing>, frames_count: usize| -> Result<Vec<Candidate>> {
        let judged = all.into_par_iter().map(|preprocessing| {
            let correlation = judge(network, parameters, frames, frames_count, &preprocessing)?;
            Ok(Candidate { preprocessing, correlation })
        });
        let mut judged = judged.collect::<Result<Vec<_>>>()?;
        let value = |candidate: &Candidate| candidate.correlation.unwrap_or(f64::NEG_INFINITY);
        judged.sort_by(|a, b| value(b).total_cmp(&value(a)));
        Ok(judged)
    };
    let mut finalists: Vec<Preprocessing> =
        judge(combinations, FRAMES[0])?.into_iter().take(FINALISTS).map(|candidate| candidate.preprocessing).collect();
    let best_two: Vec<Preprocessing> = finalists.iter().take(2).cloned().collect();
    for best in best_two {
        finalists.push(Preprocessing { interpolation: Interpolation::Area, ..best.clone() });
        if !matches!(best.colour, Colour::Rgb | Colour::Bgr) {
            finalists.push(Preprocessing { interpolation: Interpolation::Area, colour_first: true, ..best });
        }
    }
    finalists.extend(known.filter(|known| !finalists.contains(known)).cloned());
    judge(finalists, FRAMES[1])
}

/// Correlation of predictions and labels under `preprocessing`, over about `count` frames.
fn judge(
    network: &Network,
    parameters: &Parameters,
    frames: &Frames,
    count: usize,
    preprocessing: &Preprocessing,
) -> Result<Option<f64>> {
    let [height, width] = preprocessing.source;
    let mut preprocessor = preprocessing.plan(height, width)?;
    let mut plan = InferencePlan::new(network, 1);
    let mut planes = vec![0; preprocessing.output_len()];
    let mut input = vec![0.0; preprocessing.output_len()];
    let mut outputs = vec![0.0; network.output().len()];
    let mut pairs = Vec::new();
    for index in spread((0..frames.len()).collect(), count) {
        preprocessor.apply(&frames.images[index].pixels, &mut planes);
        preprocessing.to_input(&planes, &mut input);
        let x = ArrayView4::from_shape(network.input().batch(1), &input).expect("an image of the input's shape");
        plan.run(network, parameters, x, ArrayViewMut1::from(&mut outputs));
        pairs.push((f64::from(outputs[0]), f64::from(frames.labels[index])));
    }
    Ok(correlation(pairs.into_iter()))
}

/// The table as it goes into a TOML file.
///
/// # Errors
///
/// [`Error::Data`] if a number is larger than TOML can hold.
pub fn to_toml(place: &Path, preprocessing: &Preprocessing) -> Result<String> {
    toml::to_string(preprocessing).map_err(|e| Error::data(place, e.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use steersman_kernels::Isa;

    #[test]
    fn rows_are_spread_evenly() {
        assert_eq!(spread((0..10).collect(), 4), [0, 2, 5, 7]);
        assert_eq!(spread(vec![3, 9], 4), [3, 9]);
        assert!(spread(vec![], 4).is_empty());
    }

    /// A network that looks for one colour: the mean of the first plane of the input, right half minus left half.
    #[test]
    fn the_colour_space_that_the_labels_follow_wins() {
        let layers = [
            crate::engine::layers::ScaleSpec { factor: 1.0 / 255.0, offset: 0.0 }.into(),
            crate::engine::layers::DenseSpec { units: 1, init: Default::default() }.into(),
        ];
        let network = Network::new(Shape::new(3, 4, 8), &layers, Isa::PORTABLE).unwrap();
        let mut parameters = network.initialize(1);
        parameters.values.fill(0.0);
        for i in 0..32 {
            parameters.values[i] = if i % 8 < 4 { -0.1 } else { 0.1 };
        }
        // The label is how blue one side is; red stands anywhere.
        let (mut images, mut labels) = (Vec::new(), Vec::new());
        for i in 0..60u8 {
            let (blue, red) = (i % 2 == 0, (i / 2) % 2 == 0);
            let level = 20 + 3 * i;
            let pixel =
                |x: usize| [if (x < 160) == red { 200 } else { 0 }, 90, if (x < 160) == blue { 0 } else { level }];
            let pixels = (0..160 * 320).flat_map(|place| pixel(place % 320)).collect();
            images.push(RgbImage { height: 160, width: 320, pixels });
            labels.push(f32::from(level) / 400.0 * if blue { 1.0 } else { -1.0 });
        }
        let ranking = rank(&network, &parameters, &Frames { images, labels }, None).unwrap();
        assert_eq!(ranking[0].preprocessing.colour, Colour::Bgr);
        assert!(ranking[0].correlation.unwrap() > 0.95);
        assert_eq!(combinations(&network).len(), COLOURS.len() * CROPS.len(), "it scales by itself");
    }
}
