//! Shows which parts of the picture excite the network: VisualBackProp (Bojarski et al. 2016, arXiv 1611.05418), the method of
//! NVIDIA's "Explaining How a Deep Neural Network Trained with End-to-End Learning Steers a Car" (2017, arXiv 1704.07911).
//!
//! The feature maps of each convolution, after its activation, are averaged over the channels; what is negative counts as 0.
//! From the last map down, each is spread to the size of the layer below by a transposed convolution with the kernel size,
//! stride and padding of the layer between (weights 1, no bias; pooling and resizing likewise) and multiplied with the map there. The map
//! that arrives at the input is scaled to [0, 1].
//!
//! It shows what *excites* the layers, not what the steering depends on: that is what [`crate::report::explain::counterfactual`] measures.

use ndarray::ArrayView3;

use crate::dataset::preprocess::Preprocessing;
use crate::engine::layers::{Family, ReceptiveField, Taps};
use crate::engine::network::Network;
use crate::error::{Error, Result};
use crate::picture::RgbImage;
use crate::pilot::Pilot;
use crate::report::charts::palette;

/// Largest share of the overlay's colour.
const OPACITY: f32 = 0.9;
/// Grey levels of the picture below the overlay are multiplied by this.
const DIMMED: f32 = 0.7;

/// Saliency of one picture after the other. All buffers are planned once: a picture allocates nothing.
#[derive(Clone, Debug)]
pub struct Saliency {
    steps: Vec<BackStep>,
    means: Vec<ChannelMean>,
    /// Height and width of the network's input.
    size: [usize; 2],
    map: Vec<f32>,
    spread: Vec<f32>,
    half_spread: Vec<f32>,
}

/// A layer's feature maps, averaged.
#[derive(Clone, Debug)]
struct ChannelMean {
    layer: usize,
    channels: usize,
    values: Vec<f32>,
}

/// What is done on the way from the last map to the input, in the order of the layers; gone through backwards.
#[derive(Clone, Debug)]
enum BackStep {
    /// Through a layer with windows.
    Spread([SpreadAxis; 2]),
    /// Through a layer that resizes.
    Resize([ResizedAxis; 2]),
    /// Multiply with this mean.
    Multiply(usize),
}

/// Receptive field of a layer along one axis: output `i` covers the `kernel` inputs from `i * stride - before` on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SpreadAxis {
    /// Inputs.
    pub from: usize,
    /// Outputs.
    pub to: usize,
    /// Inputs that an output covers.
    pub kernel: usize,
    /// Distance of neighbouring outputs, in inputs.
    pub stride: usize,
    /// Inputs before the first that the first output covers: padding if positive, what was cut off if negative.
    pub before: isize,
}

/// Receptive field along one axis of a layer that resizes `from` inputs.
#[derive(Clone, Debug)]
struct ResizedAxis {
    from: usize,
    taps: Taps,
}

/// Which inputs each output of an axis covers.
trait Coverage {
    /// Number of inputs and of outputs.
    fn sizes(&self) -> [usize; 2];
    /// The inputs that output `i` covers.
    fn covered(&self, i: usize) -> std::ops::Range<usize>;
}

impl Saliency {
    /// Plans the saliency of `network`.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] if the network has no convolution.
    pub fn new(network: &Network) -> Result<Saliency> {
        let (mut steps, mut means) = (Vec::new(), Vec::<ChannelMean>::new());
        let mut after_convolution = false;
        for (index, named) in network.layers().iter().enumerate() {
            let (input, output) = (named.layer.input(), named.layer.output());
            let axes = |kernel: [usize; 2], stride: [usize; 2], before: [isize; 2]| {
                let axis = |k: usize, from, to| SpreadAxis {
                    from,
                    to,
                    kernel: kernel[k],
                    stride: stride[k],
                    before: before[k],
                };
                BackStep::Spread([axis(0, input.h, output.h), axis(1, input.w, output.w)])
            };
            match named.spec.receptive_field(input) {
                ReceptiveField::Window { size, stride, before } => {
                    steps.push(axes(size, stride, before));
                    after_convolution = named.spec.family() == Family::Convolution;
                    if after_convolution {
                        means.push(ChannelMean {
                            layer: index,
                            channels: output.c,
                            values: vec![0.0; output.positions()],
                        });
                        steps.push(BackStep::Multiply(means.len() - 1));
                    }
                }
                ReceptiveField::Resized { to, method } => {
                    let axis = |from, to| ResizedAxis { from, taps: Taps::new(from, to, method) };
                    steps.push(BackStep::Resize([axis(input.h, to[0]), axis(input.w, to[1])]));
                    after_convolution = false;
                }
                // The map counts as it leaves the activation.
                ReceptiveField::Element => {
                    if let Some(mean) = means.last_mut().filter(|_| after_convolution) {
                        mean.layer = index;
                    }
                }
                ReceptiveField::All => break,
            }
        }
        // Beyond the last convolution nothing is multiplied, so nothing needs to be spread.
        let last = steps.iter().rposition(|step| matches!(step, BackStep::Multiply(_)));
        let last =
            last.ok_or_else(|| Error::Usage("the network has no convolution, so there is no saliency".into()))?;
        steps.truncate(last + 1);
        let input = network.input();
        let sides = steps.iter().filter_map(|step| match step {
            BackStep::Spread([down, across]) => Some(most_values(down, across)),
            BackStep::Resize([down, across]) => Some(most_values(down, across)),
            BackStep::Multiply(_) => None,
        });
        let largest = sides.max().unwrap_or(0).max(input.positions());
        let room = || Vec::with_capacity(largest);
        Ok(Saliency { steps, means, size: [input.h, input.w], map: room(), spread: room(), half_spread: room() })
    }

    /// Height and width of the map: those of the network's input.
    pub fn size(&self) -> [usize; 2] {
        self.size
    }

    /// The saliency of the last picture, in [0, 1], row by row. Empty before the first.
    pub fn map(&self) -> &[f32] {
        &self.map
    }

    /// Steers as [`Pilot::steer`] does, and computes the saliency on the way.
    ///
    /// # Errors
    ///
    /// As [`Pilot::steer`].
    pub fn steer(&mut self, pilot: &mut Pilot, image: ArrayView3<u8>) -> Result<f32> {
        let means = &mut self.means;
        let steering = pilot.steer_observed(image, &mut |layer, output| {
            if let Some(mean) = means.iter_mut().find(|mean| mean.layer == layer) {
                mean.take(output);
            }
        })?;
        self.propagate();
        Ok(steering)
    }

    fn propagate(&mut self) {
        self.map.clear();
        for step in self.steps.iter().rev() {
            match step {
                BackStep::Multiply(k) => {
                    let values = &self.means[*k].values;
                    if self.map.is_empty() {
                        self.map.extend_from_slice(values);
                    } else {
                        self.map.iter_mut().zip(values).for_each(|(map, value)| *map *= value);
                    }
                    // Only relations count, and products of many maps would leave the range of f32.
                    let most = self.map.iter().copied().fold(0.0, f32::max);
                    if most > 0.0 {
                        self.map.iter_mut().for_each(|value| *value /= most);
                    }
                }
                BackStep::Spread([down, across]) => {
                    spread(&self.map, down, across, &mut self.half_spread, &mut self.spread);
                    std::mem::swap(&mut self.map, &mut self.spread);
                }
                BackStep::Resize([down, across]) => {
                    spread(&self.map, down, across, &mut self.half_spread, &mut self.spread);
                    std::mem::swap(&mut self.map, &mut self.spread);
                }
            }
        }
        let (low, high) = self.map.iter().fold((f32::INFINITY, 0.0f32), |(low, high), v| (low.min(*v), high.max(*v)));
        let range = high - low;
        self.map.iter_mut().for_each(|value| *value = if range > 0.0 { (*value - low) / range } else { 0.0 });
    }

    /// Turns the rows of `image` that the network sees to grey, and colours what excited it as
    /// [`palette::saliency`] says. Rows that are cut off keep their colours.
    /// `preprocessing` is the network's own. Before the first picture nothing is changed.
    pub fn overlay(&self, preprocessing: &Preprocessing, image: &mut RgbImage) {
        let ([map_h, map_w], [first, end]) = (self.size, preprocessing.rows);
        if self.map.is_empty() {
            return;
        }
        let at = |row: usize, column: usize| self.map[row.min(map_h - 1) * map_w + column.min(map_w - 1)];
        let rows_per_px = preprocessing.source[0] as f32 / image.height as f32;
        for row in 0..image.height {
            let source = (row as f32 + 0.5) * rows_per_px;
            if !(first as f32..end as f32).contains(&source) {
                continue;
            }
            let y = ((source - first as f32) / (end - first) as f32 * map_h as f32 - 0.5).max(0.0);
            for column in 0..image.width {
                let x = ((column as f32 + 0.5) / image.width as f32 * map_w as f32 - 0.5).max(0.0);
                let ((i, j), (t, u)) = ((y as usize, x as usize), (y.fract(), x.fract()));
                let upper = at(i, j) * (1.0 - u) + at(i, j + 1) * u;
                let lower = at(i + 1, j) * (1.0 - u) + at(i + 1, j + 1) * u;
                let value = upper * (1.0 - t) + lower * t;
                let (share, colour) = (OPACITY * value.powf(0.7), palette::saliency(f64::from(value)));
                let [r, g, b] = image.pixel(row, column).map(f32::from);
                let grey = DIMMED * (0.299 * r + 0.587 * g + 0.114 * b);
                let mixed = |k: usize| grey * (1.0 - share) + f32::from(colour[k]) * share;
                image.set_pixel(row, column, std::array::from_fn(|k| mixed(k).round() as u8));
            }
        }
    }
}

impl ChannelMean {
    /// Averages feature maps `[c][h][w]` over the channels; negative values count as 0.
    fn take(&mut self, output: &[f32]) {
        let positions = self.values.len();
        self.values.fill(0.0);
        for channel in output.chunks_exact(positions).take(self.channels) {
            self.values.iter_mut().zip(channel).for_each(|(sum, value)| *sum += value.max(0.0));
        }
        self.values.iter_mut().for_each(|sum| *sum /= self.channels as f32);
    }
}

/// The most values of a map on the way through both axes.
fn most_values(down: &impl Coverage, across: &impl Coverage) -> usize {
    let most = |[from, to]: [usize; 2]| from.max(to);
    most(down.sizes()) * most(across.sizes())
}

/// Transposed convolution of `map` with ones: each output is added to the inputs that it covers, first down into `half`, then
/// across into `out`.
fn spread(map: &[f32], down: &impl Coverage, across: &impl Coverage, half: &mut Vec<f32>, out: &mut Vec<f32>) {
    let ([from_h, to_h], [from_w, to_w]) = (down.sizes(), across.sizes());
    half.clear();
    half.resize(from_h * to_w, 0.0);
    for i in 0..to_h {
        for target in down.covered(i) {
            let (row, below) = (&map[i * to_w..][..to_w], &mut half[target * to_w..][..to_w]);
            below.iter_mut().zip(row).for_each(|(sum, value)| *sum += value);
        }
    }
    out.clear();
    out.resize(from_h * from_w, 0.0);
    for row in 0..from_h {
        let below = &mut out[row * from_w..][..from_w];
        for j in 0..to_w {
            let value = half[row * to_w + j];
            across.covered(j).for_each(|target| below[target] += value);
        }
    }
}

impl Coverage for ResizedAxis {
    fn sizes(&self) -> [usize; 2] {
        [self.from, self.taps.outputs()]
    }

    fn covered(&self, i: usize) -> std::ops::Range<usize> {
        self.taps.seen(i)
    }
}

impl Coverage for SpreadAxis {
    fn sizes(&self) -> [usize; 2] {
        [self.from, self.to]
    }

    fn covered(&self, i: usize) -> std::ops::Range<usize> {
        let begin = (i * self.stride) as isize - self.before;
        let inside = |at: isize| at.clamp(0, self.from as isize) as usize;
        inside(begin)..inside(begin + self.kernel as isize)
    }
}

#[cfg(test)]
mod tests {
    use ndarray::Array3;

    use super::*;
    use crate::engine::layers::ResizeMethod;
    use crate::model_file::{Model, TrainingRecord};
    use crate::recipe::{Recipe, SHIPPED};
    use steersman_kernels::Isa;

    /// The definition, written out: sums over all pairs of input and output.
    fn spread_directly(map: &[f32], down: SpreadAxis, across: SpreadAxis) -> Vec<f32> {
        let mut out = vec![0.0; down.from * across.from];
        for y in 0..down.from as isize {
            for x in 0..across.from as isize {
                for i in 0..down.to {
                    for j in 0..across.to {
                        let (k, l) = (
                            y + down.before - (i * down.stride) as isize,
                            x + across.before - (j * across.stride) as isize,
                        );
                        if (0..down.kernel as isize).contains(&k) && (0..across.kernel as isize).contains(&l) {
                            out[y as usize * across.from + x as usize] += map[i * across.to + j];
                        }
                    }
                }
            }
        }
        out
    }

    #[test]
    fn spreading_is_the_transposed_convolution_with_ones() {
        let axis = |from, to, kernel, stride, before| SpreadAxis { from, to, kernel, stride, before };
        for (down, across) in [
            (axis(9, 7, 3, 1, 0), axis(11, 4, 5, 2, 0)),
            (axis(8, 4, 3, 2, 0), axis(8, 8, 3, 1, 1)),
            (axis(9, 4, 2, 2, 0), axis(10, 6, 1, 1, -2)),
            (axis(6, 3, 2, 2, 0), axis(7, 4, 3, 2, 1)),
        ] {
            let map: Vec<f32> = (0..down.to * across.to).map(|i| ((i * 37 + 11) % 17) as f32).collect();
            let (mut half, mut out) = (Vec::new(), Vec::new());
            spread(&map, &down, &across, &mut half, &mut out);
            assert_eq!(out, spread_directly(&map, down, across), "{down:?} {across:?}");
        }
    }

    #[test]
    fn a_resized_map_spreads_to_what_it_was_made_of() {
        let axis = |from, to, method| ResizedAxis { from, taps: Taps::new(from, to, method) };
        let (mut half, mut out) = (Vec::new(), Vec::new());
        // Rows 0 and 1, 2, 3 and 4 of five; columns 0 and 3 of five.
        let (down, across) = (axis(5, 3, ResizeMethod::Bilinear), axis(5, 2, ResizeMethod::Nearest));
        spread(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0], &down, &across, &mut half, &mut out);
        let row = |left: f32, right: f32| [0.0, left, 0.0, right, 0.0];
        assert_eq!(out, [row(1.0, 2.0), row(1.0, 2.0), row(3.0, 4.0), row(5.0, 6.0), row(5.0, 6.0)].concat());
    }

    fn pilot(name: &str) -> Pilot {
        let recipe = Recipe::find(name, &[]).unwrap();
        let parameters = recipe.network(Isa::best()).unwrap().initialize(1);
        let model = Model { recipe, parameters, record: TrainingRecord::default(), training_rows: vec![] };
        Pilot::new(model, Isa::best()).unwrap()
    }

    fn picture() -> Array3<u8> {
        let bytes = (0..160 * 320 * 3usize).map(|i| (i.wrapping_mul(2_654_435_761) >> 13) as u8).collect();
        Array3::from_shape_vec((160, 320, 3), bytes).unwrap()
    }

    #[test]
    fn the_saliency_of_lenet_is_that_of_a_direct_computation() {
        let mut pilot = pilot("lenet");
        let mut saliency = Saliency::new(pilot.network()).unwrap();
        let mut seen = Vec::new();
        let steering =
            pilot.steer_observed(picture().view(), &mut |layer, output| seen.push((layer, output.to_vec()))).unwrap();
        assert_eq!(saliency.steer(&mut pilot, picture().view()).unwrap(), steering);
        // Layers: scale, conv 3x3, ELU, pool 4x4, conv 3x3, ELU, pool, …
        let mean = |layer: usize, positions: usize| -> Vec<f32> {
            let output = &seen.iter().find(|(index, _)| *index == layer).unwrap().1;
            let channels = output.len() / positions;
            (0..positions)
                .map(|p| (0..channels).map(|c| output[c * positions + p].max(0.0)).sum::<f32>() / channels as f32)
                .collect()
        };
        let valid =
            |from: usize, to: usize, kernel: usize, stride: usize| SpreadAxis { from, to, kernel, stride, before: 0 };
        let (first, second) = (mean(2, 62 * 62), mean(5, 13 * 13));
        let up = spread_directly(&second, valid(15, 13, 3, 1), valid(15, 13, 3, 1));
        let up = spread_directly(&up, valid(62, 15, 4, 4), valid(62, 15, 4, 4));
        let product: Vec<f32> = up.iter().zip(&first).map(|(a, b)| a * b).collect();
        let map = spread_directly(&product, valid(64, 62, 3, 1), valid(64, 62, 3, 1));
        let (low, high) = map.iter().fold((f32::INFINITY, 0.0f32), |(l, h), v| (l.min(*v), h.max(*v)));
        assert_eq!(saliency.size(), [64, 64]);
        for (found, expected) in saliency.map().iter().zip(&map) {
            assert!((found - (expected - low) / (high - low)).abs() < 1e-5, "{found} {expected}");
        }
    }

    #[test]
    fn every_recipe_has_a_saliency_in_its_range_that_colours_only_kept_rows() {
        for (name, _) in SHIPPED {
            let mut pilot = pilot(name);
            let mut saliency = Saliency::new(pilot.network()).unwrap();
            let before = pilot.steer(picture().view()).unwrap();
            assert_eq!(saliency.steer(&mut pilot, picture().view()).unwrap(), before, "{name}");
            let [h, w] = saliency.size();
            assert_eq!(saliency.map().len(), h * w, "{name}");
            assert!(saliency.map().iter().all(|v| (0.0..=1.0).contains(v)) && saliency.map().contains(&1.0), "{name}");
            let original = RgbImage { height: 160, width: 320, pixels: picture().into_raw_vec_and_offset().0 };
            let mut image = original.clone();
            saliency.overlay(&pilot.recipe().preprocessing, &mut image);
            let first = pilot.recipe().preprocessing.rows[0] * 320 * 3;
            assert_eq!(image.pixels[..first], original.pixels[..first], "{name}");
            assert_ne!(image, original, "{name}");
        }
    }

    #[test]
    fn a_network_without_convolution_has_none() {
        let network = Network::new(
            crate::engine::tensor::Shape::new(1, 4, 4),
            &[crate::engine::layers::FlattenSpec {}.into()],
            Isa::PORTABLE,
        )
        .unwrap();
        assert!(Saliency::new(&network).unwrap_err().to_string().contains("no convolution"));
    }
}
