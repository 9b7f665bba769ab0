//! Finds the preprocessing that a network was trained with: under the right one, its predictions on a recording go with the labels.
//!
//! The first round tries every colour space, crop and scaling on a few frames. The second round tries the best of these on
//! more frames, and with a blur and the other resize methods. Both prefer frames of bends: on a straight road all combinations give
//! nearly the same prediction.
//!
//! They are ranked by the error that is left after the best gain and bias ([`Line`]). So the right preprocessing is also found for a
//! network that gives degrees, or steers to the other side; gain and correlation tell which.

mod agreement;
mod candidates;

use std::path::Path;

use ndarray::{ArrayView4, ArrayViewMut1};
use rayon::prelude::*;

pub use self::agreement::{Agreement, Line};
pub use self::candidates::combinations;
use crate::dataset::preprocess::Preprocessing;
use crate::dataset::{Recording, View};
use crate::engine::network::{InferencePlan, Network, Parameters};
use crate::error::{Error, Result};
use crate::picture::RgbImage;

/// Number of frames in the first and in the second round.
const FRAMES: [usize; 2] = [96, 480];

/// Number of combinations in the second round, without the variants of the best.
const FINALISTS: usize = 12;

/// Number of combinations of which variants are tried.
const VARIED: usize = 3;

/// Steering from which a frame counts as a bend: one degree of 25.
const TURNED: f32 = 0.04;

/// Pixels of a picture that is kept in memory as it is.
const MAX_PIXELS: usize = 240 * 320;

/// A preprocessing, and how the network's outputs go with the labels under it.
#[derive(Clone, Debug, PartialEq)]
pub struct Candidate {
    /// The preprocessing.
    pub preprocessing: Preprocessing,
    /// How outputs and labels agree.
    pub agreement: Agreement,
}

/// Frames with their labels.
#[derive(Debug)]
pub struct Frames {
    /// Height and width of the images.
    source: [usize; 2],
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
        // The size of most pictures, unless it would fill the memory; others are scaled to it.
        let source = match recording.image_size {
            Some([height, width]) if height * width <= MAX_PIXELS => [height, width],
            _ => Preprocessing::default().source,
        };
        let whole = Preprocessing { source, rows: [0, source[0]], resize: source, ..Preprocessing::default() };
        let read = |row: usize| -> Option<(RgbImage, f32)> {
            let mut image = recording.picture(row, View::Centre)?;
            if [image.height, image.width] != source {
                let mut scaled = vec![0; whole.rgb_len()];
                whole.plan(image.height, image.width).ok()?.to_rgb_stage(&image.pixels, &mut scaled);
                image = RgbImage { height: source[0], width: source[1], pixels: scaled };
            }
            Some((image, recording.rows[row].steering))
        };
        let (images, labels): (Vec<RgbImage>, Vec<f32>) = chosen.into_par_iter().filter_map(read).unzip();
        if labels.iter().all(|label| Some(label) == labels.first()) {
            let message = format!("{} frames could be read, all with the same steering: nothing to fit", labels.len());
            return Err(Error::data(recording.path.as_path(), message));
        }
        Ok(Frames { source, images, labels })
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.labels.len()
    }

    /// Height and width of the images: the size that [`combinations`] starts from.
    pub fn source(&self) -> [usize; 2] {
        self.source
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
    let combinations = combinations(network, frames.source);
    if combinations.is_empty() {
        let c = network.input().c;
        return Err(Error::Usage(format!("no colour space has {c} planes: the preprocessing cannot be guessed")));
    }
    let judge = |all: Vec<Preprocessing>, frames_count: usize| -> Result<Vec<Candidate>> {
        let judged = all.into_par_iter().map(|preprocessing| {
            let agreement = judge(network, parameters, frames, frames_count, &preprocessing)?;
            Ok(Candidate { preprocessing, agreement })
        });
        let mut judged = judged.collect::<Result<Vec<_>>>()?;
        let error = |candidate: &Candidate| candidate.agreement.line.map_or(f64::INFINITY, |line| line.error);
        judged.sort_by(|a, b| error(a).total_cmp(&error(b)));
        Ok(judged)
    };
    let first = judge(combinations, FRAMES[0])?.into_iter().take(FINALISTS);
    let mut finalists: Vec<Preprocessing> = first.map(|candidate| candidate.preprocessing).collect();
    let varied = finalists.len().min(VARIED);
    finalists.extend(finalists[..varied].iter().flat_map(candidates::variants).collect::<Vec<_>>());
    finalists.extend(known.filter(|known| !finalists.contains(known)).cloned());
    judge(finalists, FRAMES[1])
}

/// How outputs and labels agree under `preprocessing`, over about `count` frames.
fn judge(
    network: &Network,
    parameters: &Parameters,
    frames: &Frames,
    count: usize,
    preprocessing: &Preprocessing,
) -> Result<Agreement> {
    let [height, width] = frames.source;
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
    Ok(Agreement::of(&pairs))
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
    use crate::dataset::colour::Colour;
    use crate::engine::layers::{DenseSpec, ScaleSpec};
    use crate::engine::tensor::Shape;
    use steersman_kernels::Isa;

    #[test]
    fn rows_are_spread_evenly() {
        assert_eq!(spread((0..10).collect(), 4), [0, 2, 5, 7]);
        assert_eq!(spread(vec![3, 9], 4), [3, 9]);
        assert!(spread(vec![], 4).is_empty());
    }

    /// A network that looks for one colour: the mean of the first plane of the input, right half minus left half.
    fn blue_seeker() -> (Network, Parameters) {
        let layers = [
            ScaleSpec { factor: 1.0 / 255.0, offset: 0.0 }.into(),
            DenseSpec { units: 1, init: Default::default() }.into(),
        ];
        let network = Network::new(Shape::new(3, 4, 8), &layers, Isa::PORTABLE).unwrap();
        let mut parameters = network.initialize(1);
        parameters.values.fill(0.0);
        for i in 0..32 {
            parameters.values[i] = if i % 8 < 4 { -0.1 } else { 0.1 };
        }
        (network, parameters)
    }

    /// The label is how blue one side is; red stands anywhere.
    fn blue_frames() -> Frames {
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
        Frames { source: [160, 320], images, labels }
    }

    #[test]
    fn the_colour_space_that_the_labels_follow_wins() {
        let (network, parameters) = blue_seeker();
        let ranking = rank(&network, &parameters, &blue_frames(), None).unwrap();
        assert_eq!(ranking[0].preprocessing.colour, Colour::Bgr);
        assert!(ranking[0].agreement.correlation.unwrap() > 0.95);
        assert!(ranking.iter().any(|candidate| candidate.preprocessing.blur));
        let errors: Vec<f64> = ranking.iter().filter_map(|found| Some(found.agreement.line?.error)).collect();
        assert!(errors.is_sorted() && errors[0] < 0.1 * errors[errors.len() - 1], "{errors:?}");
    }

    /// By correlation alone the right colours of a mirrored network are the last of all.
    #[test]
    fn a_mirrored_network_in_degrees_is_recognised() {
        let (network, mut parameters) = blue_seeker();
        parameters.values.iter_mut().for_each(|weight| *weight *= -45.0);
        parameters.values[96] = 90.0;
        let ranking = rank(&network, &parameters, &blue_frames(), None).unwrap();
        let best = &ranking[0];
        assert_eq!(best.preprocessing.colour, Colour::Bgr);
        assert!(best.agreement.correlation.unwrap() < -0.95);
        assert!(best.agreement.absurdity().unwrap().contains("lie beyond 2"));
        let [straight, span] = best.agreement.line.unwrap().output_scale([0.0, 1.0]);
        assert!((straight - 90.0).abs() < 1.0 && span < 0.0, "{straight}, {span}");
    }

    #[test]
    fn a_broken_network_is_ranked_and_not_recommended() {
        let (network, mut parameters) = blue_seeker();
        parameters.values[96] = f32::NAN;
        let ranking = rank(&network, &parameters, &blue_frames(), None).unwrap();
        assert!(ranking.iter().all(|candidate| candidate.agreement.line.is_none()));
        assert!(ranking[0].agreement.absurdity().unwrap().contains("60 of 60 outputs are infinite or no number"));
    }

    #[test]
    fn small_pictures_keep_their_size_and_large_ones_do_not() {
        let frames = |height: usize, width: usize| {
            let folder = tempfile::tempdir().unwrap();
            let mut log = String::from("center,left,right,steering,throttle,brake,speed\n");
            for row in 0..4u8 {
                let name = format!("center_2026_01_01_00_00_0{row}_000.png");
                let level = image::Rgb([50 * row; 3]);
                image::RgbImage::from_pixel(width as u32, height as u32, level)
                    .save(folder.path().join(&name))
                    .unwrap();
                log += &format!("{name},,,{},0,0,9\n", f32::from(row) / 10.0);
            }
            std::fs::write(folder.path().join("driving_log.csv"), log).unwrap();
            Frames::of(&crate::dataset::load(folder.path()).unwrap()).unwrap()
        };
        let small = frames(120, 160);
        assert_eq!((small.len(), small.source(), small.images[3].pixels.len()), (4, [120, 160], 120 * 160 * 3));
        assert_eq!((small.images[3].pixels[777], small.labels[3]), (150, 0.3));
        assert_eq!(frames(480, 640).source(), [160, 320]);
    }
}
