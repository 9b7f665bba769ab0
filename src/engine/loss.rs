//! Losses and the terms of smoothness: value and gradient.

use std::ops::Range;

use serde::{Deserialize, Serialize};

/// The function that training minimizes: a mean over the batch, as in Keras.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Loss {
    /// Mean of `(prediction − label)²`.
    MeanSquaredError {},
    /// Mean of the Huber loss (1964): `error² / 2` for `|error| ≤ delta`, else `delta · (|error| − delta / 2)`.
    Huber {
        /// The absolute error at which the square turns into a line, in units of the label.
        delta: f32,
    },
}

impl Default for Loss {
    fn default() -> Loss {
        Loss::MeanSquaredError {}
    }
}

impl Loss {
    /// Returns the **sum** of the losses of all predictions, and overwrites `gradient` with the derivative of that sum times
    /// `scale` (1 / batch size for the mean).
    ///
    /// # Panics
    ///
    /// Panics if the lengths differ.
    pub fn value_and_gradient(&self, predictions: &[f32], labels: &[f32], scale: f32, gradient: &mut [f32]) -> f64 {
        assert_eq!((predictions.len(), gradient.len()), (labels.len(), labels.len()));
        let mut sum = 0.0;
        for ((gradient, prediction), label) in gradient.iter_mut().zip(predictions).zip(labels) {
            let error = prediction - label;
            let (value, derivative) = match *self {
                Loss::MeanSquaredError {} => (error * error, 2.0 * error),
                Loss::Huber { delta } if error.abs() <= delta => (error * error / 2.0, error),
                Loss::Huber { delta } => (delta * (error.abs() - delta / 2.0), delta * error.signum()),
            };
            sum += f64::from(value);
            *gradient = derivative * scale;
        }
        sum
    }
}

impl Loss {
    /// As [`value_and_gradient`](Loss::value_and_gradient) for several outputs an image: predictions, labels and gradient are
    /// `[n][weights.len()]`, and the loss of output `k` counts `weights[k]` times.
    ///
    /// # Panics
    ///
    /// Panics if the lengths differ, or are no multiple of the number of outputs.
    pub fn weighted_value_and_gradient(
        &self,
        predictions: &[f32],
        labels: &[f32],
        weights: &[f32],
        scale: f32,
        gradient: &mut [f32],
    ) -> f64 {
        assert!(!weights.is_empty() && predictions.len().is_multiple_of(weights.len()), "an image is cut");
        assert_eq!((predictions.len(), gradient.len()), (labels.len(), labels.len()));
        let of_images = predictions.chunks_exact(weights.len()).zip(labels.chunks_exact(weights.len()));
        let mut sum = 0.0;
        for ((predictions, labels), gradient) in of_images.zip(gradient.chunks_exact_mut(weights.len())) {
            for (k, weight) in weights.iter().enumerate() {
                let of_output = k..k + 1;
                let (predictions, labels) = (&predictions[of_output.clone()], &labels[of_output.clone()]);
                let gradient = &mut gradient[of_output];
                sum += f64::from(*weight) * self.value_and_gradient(predictions, labels, scale * weight, gradient);
            }
        }
        sum
    }
}

/// The `[smoothness]` table of a recipe: terms of the loss that punish answers which differ where they should not (after CAPS,
/// Mysore et al. 2021). A wheel trembles by the differences between neighbouring frames, to which the mean squared error of single
/// frames is blind.
///
/// For the images a and b of a pair, with predictions f and labels y, the loss grows by
/// `weight · mean over the pairs of ((f_a − f_b) − (y_a − y_b))²`; of several outputs each has such a mean, times its weight in the
/// loss. Differences are compared with those of the labels, so a pair may
/// show different places, and a change that the labels ask for costs nothing.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Smoothness {
    /// Share of the images of a batch that stand in pairs, in (0, 1]; half of the pairs are spatial and half temporal if both have
    /// a weight.
    pub pairs_share: f64,
    /// Weight of the spatial term: each pair is an image twice, under two augmentations.
    pub spatial: f64,
    /// Weight of the temporal term: each pair is two neighbouring frames of a session, from one camera and under the same
    /// augmentation, as the light does not change between frames.
    pub temporal: f64,
}

impl Default for Smoothness {
    fn default() -> Smoothness {
        Smoothness { pairs_share: 0.5, spatial: 0.0, temporal: 0.0 }
    }
}

impl Smoothness {
    /// Whether no term has a weight: batches hold no pairs.
    pub fn is_off(&self) -> bool {
        self.spatial == 0.0 && self.temporal == 0.0
    }

    /// The pairs of a full batch of `batch` images.
    pub fn pairs(&self, batch: usize) -> Pairs {
        let all = if self.is_off() { 0 } else { (batch as f64 * self.pairs_share / 2.0) as usize };
        let temporal = match (self.spatial > 0.0, self.temporal > 0.0) {
            (true, true) => all / 2,
            (_, temporal) => all * usize::from(temporal),
        };
        Pairs { spatial: all - temporal, temporal }
    }

    /// Checks the ranges of all numbers for batches of `batch` images; the error names the first that is wrong.
    pub fn check(&self, batch: usize) -> Result<(), String> {
        for (name, weight) in [("spatial", self.spatial), ("temporal", self.temporal)] {
            if !(weight.is_finite() && weight >= 0.0) {
                return Err(format!("{name} must not be negative or infinite, but is {weight}"));
            }
        }
        if !(self.pairs_share > 0.0 && self.pairs_share <= 1.0) {
            return Err(format!("pairs_share must lie in (0, 1], not be {}", self.pairs_share));
        }
        let (Pairs { spatial, temporal }, wanted) = (self.pairs(batch), [self.spatial, self.temporal]);
        if (spatial == 0 && wanted[0] > 0.0) || (temporal == 0 && wanted[1] > 0.0) {
            return Err(format!("pairs_share {} of a batch of {batch} leaves no pair for a term", self.pairs_share));
        }
        Ok(())
    }
}

/// The pairs in a batch: its first images, (0, 1), (2, 3) and so on. The spatial pairs come first, then the temporal ones.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Pairs {
    /// Number of spatial pairs.
    pub spatial: usize,
    /// Number of temporal pairs.
    pub temporal: usize,
}

impl Pairs {
    /// Number of images that stand in pairs.
    pub fn images(&self) -> usize {
        2 * (self.spatial + self.temporal)
    }
}

/// The smoothness terms of one batch.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PairTerms {
    pairs: Pairs,
    /// Weights of the spatial and of the temporal term.
    weights: [f64; 2],
}

impl PairTerms {
    /// The terms of a batch that holds `pairs`.
    pub fn new(smoothness: &Smoothness, pairs: Pairs) -> PairTerms {
        PairTerms { pairs, weights: [smoothness.spatial, smoothness.temporal] }
    }

    /// Number of images that stand in pairs.
    pub fn images(&self) -> usize {
        self.pairs.images()
    }

    /// Returns what the pairs among the images `images` of the batch add to the mean loss, and adds its derivative to `gradient`.
    /// `predictions`, `labels` and `gradient` are those of `images`, `outputs` each. `output_weights` are those of the outputs in the
    /// loss; without any, each counts 1 / `outputs`.
    ///
    /// # Panics
    ///
    /// Panics if the lengths differ, or if `images` cuts a pair.
    pub fn add(
        &self,
        images: Range<usize>,
        outputs: usize,
        output_weights: &[f32],
        predictions: &[f32],
        labels: &[f32],
        gradient: &mut [f32],
    ) -> f64 {
        assert!(output_weights.is_empty() || output_weights.len() == outputs, "a weight for each output");
        let len = images.len() * outputs;
        assert_eq!((predictions.len(), labels.len(), gradient.len()), (len, len, len));
        let Pairs { spatial, temporal } = self.pairs;
        let mut sum = 0.0;
        for (of, count, weight) in
            [(0..2 * spatial, spatial, self.weights[0]), (2 * spatial..self.images(), temporal, self.weights[1])]
        {
            let (from, to) = (of.start.max(images.start), of.end.min(images.end));
            if from >= to {
                continue;
            }
            assert!(from.is_multiple_of(2) && to.is_multiple_of(2), "a pair of images {from} to {to} is cut");
            for pair in (from..to).step_by(2) {
                let (a, b) = ((pair - images.start) * outputs, (pair + 1 - images.start) * outputs);
                for output in 0..outputs {
                    let scale = match output_weights.get(output) {
                        None => weight / (count * outputs) as f64,
                        Some(of_output) => weight * f64::from(*of_output) / count as f64,
                    };
                    let (a, b) = (a + output, b + output);
                    let difference = (predictions[a] - predictions[b]) - (labels[a] - labels[b]);
                    sum += scale * f64::from(difference * difference);
                    let slope = (2.0 * scale) as f32 * difference;
                    gradient[a] += slope;
                    gradient[b] -= slope;
                }
            }
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_those_of_the_formulas() {
        let (predictions, labels, mut gradient) = ([1.0, -3.0], [0.5, 0.0], [f32::NAN; 2]);
        let mse = Loss::MeanSquaredError {}.value_and_gradient(&predictions, &labels, 0.5, &mut gradient);
        assert_eq!((mse, gradient), (0.25 + 9.0, [0.5, -3.0]));
        let huber = Loss::Huber { delta: 1.0 }.value_and_gradient(&predictions, &labels, 1.0, &mut gradient);
        assert_eq!((huber, gradient), (0.125 + 2.5, [0.5, -1.0]));
    }

    #[test]
    fn gradients_are_the_slopes_of_the_values() {
        for loss in [Loss::MeanSquaredError {}, Loss::Huber { delta: 0.5 }] {
            for prediction in [-1.7f32, -0.4, 0.1, 0.45, 2.0] {
                let value = |p: f32| loss.value_and_gradient(&[p], &[0.2], 1.0, &mut [0.0]);
                let (up, down) = (prediction + 1e-3, prediction - 1e-3);
                let slope = (value(up) - value(down)) / f64::from(up - down);
                let mut gradient = [0.0];
                loss.value_and_gradient(&[prediction], &[0.2], 1.0, &mut gradient);
                assert!((slope - f64::from(gradient[0])).abs() <= 2e-3, "{loss:?} at {prediction}");
            }
        }
    }

    #[test]
    fn outputs_count_by_their_weights() {
        // Errors 0.5 and −3 of the first image, 1 and 0 of the second.
        let (predictions, labels) = ([1.0, -3.0, 2.0, 0.5], [0.5, 0.0, 1.0, 0.5]);
        let mut gradient = [f32::NAN; 4];
        let loss = Loss::MeanSquaredError {};
        let value = loss.weighted_value_and_gradient(&predictions, &labels, &[1.0, 0.25], 0.5, &mut gradient);
        assert_eq!((value, gradient), (0.25 + 0.25 * 9.0 + 1.0, [0.5, -0.75, 1.0, 0.0]));
        // One output of weight 1 has the bits of the plain loss.
        let (mut plain, mut weighted) = ([f32::NAN; 4], [f32::NAN; 4]);
        for loss in [loss, Loss::Huber { delta: 0.7 }] {
            let values = [
                loss.value_and_gradient(&predictions, &labels, 0.3, &mut plain),
                loss.weighted_value_and_gradient(&predictions, &labels, &[1.0], 0.3, &mut weighted),
            ];
            assert_eq!((values[0].to_bits(), plain), (values[1].to_bits(), weighted));
        }
    }

    #[test]
    fn pairs_share_the_batch() {
        let of = |spatial, temporal| Smoothness { spatial, temporal, ..Smoothness::default() };
        assert_eq!(of(0.0, 0.0).pairs(64), Pairs::default());
        assert_eq!(of(1.0, 0.0).pairs(64), Pairs { spatial: 16, temporal: 0 });
        assert_eq!(of(0.0, 1.0).pairs(64), Pairs { spatial: 0, temporal: 16 });
        assert_eq!(of(1.0, 1.0).pairs(70), Pairs { spatial: 9, temporal: 8 });
        assert!(of(1.0, 1.0).check(64).is_ok() && of(0.0, 0.0).check(1).is_ok());
        assert!(of(1.0, 1.0).check(4).unwrap_err().contains("leaves no pair"));
        assert!(of(-1.0, 0.0).check(64).unwrap_err().contains("spatial"));
        assert!(Smoothness { pairs_share: 0.0, ..of(1.0, 0.0) }.check(64).unwrap_err().contains("pairs_share"));
    }

    /// Six images of two outputs: a spatial pair, a temporal pair, two single ones.
    #[test]
    fn the_terms_are_those_of_the_formula_and_gradients_their_slopes() {
        let terms = PairTerms::new(
            &Smoothness { pairs_share: 0.5, spatial: 3.0, temporal: 5.0 },
            Pairs { spatial: 1, temporal: 1 },
        );
        let labels = [0.5, 0.0, 0.25, 1.0, 0.0, 0.0, -1.0, 0.5, 9.0, 9.0, 9.0, 9.0];
        let predictions = [1.0, 2.0, 0.25, 1.5, 0.0, 1.0, 1.0, 0.5, 1.0, 2.0, 3.0, 4.0];
        let mut gradient = [1.0; 12];
        let value = terms.add(0..6, 2, &[], &predictions, &labels, &mut gradient);
        // Differences of the predictions less those of the labels: 0.75 − 0.25, 0.5 + 1; then −1 − 1, 0.5 + 0.5.
        let expected = 3.0 * (0.25 + 2.25) / 2.0 + 5.0 * (4.0 + 1.0) / 2.0;
        assert!((value - expected).abs() < 1e-12, "{value} is not {expected}");
        for at in 0..12 {
            let shifted = |by: f32| {
                let mut predictions = predictions;
                predictions[at] += by;
                terms.add(0..6, 2, &[], &predictions, &labels, &mut [0.0; 12])
            };
            let slope = (shifted(0.125) - shifted(-0.125)) / 0.25;
            assert!((slope - f64::from(gradient[at] - 1.0)).abs() < 1e-5, "{at}: {slope}, {}", gradient[at]);
        }
        assert_eq!(gradient[8..], [1.0; 4], "single images have no part in it");
        // The same, shard by shard.
        let mut parts = [1.0; 12];
        let sum: f64 = [0..2, 2..6]
            .into_iter()
            .map(|images| {
                let of = images.start * 2..images.end * 2;
                terms.add(images, 2, &[], &predictions[of.clone()], &labels[of.clone()], &mut parts[of])
            })
            .sum();
        assert_eq!((sum, parts), (value, gradient));
        // The outputs weigh 2 and 0.25 instead of 1/2 each.
        let mut weighted = [0.0; 12];
        let value = terms.add(0..6, 2, &[2.0, 0.25], &predictions, &labels, &mut weighted);
        let expected = 3.0 * (2.0 * 0.25 + 0.25 * 2.25) + 5.0 * (2.0 * 4.0 + 0.25 * 1.0);
        assert!((value - expected).abs() < 1e-12, "{value} is not {expected}");
        for (at, (weighted, plain)) in weighted.iter().zip(gradient).enumerate() {
            let times = [4.0, 0.5][at % 2];
            assert!((weighted - times * (plain - 1.0)).abs() < 1e-5, "{at}: {weighted}, {plain}");
        }
    }

    #[test]
    #[should_panic(expected = "is cut")]
    fn a_pair_that_is_cut_is_a_mistake() {
        let terms =
            PairTerms::new(&Smoothness { spatial: 1.0, ..Smoothness::default() }, Pairs { spatial: 2, temporal: 0 });
        terms.add(0..3, 1, &[], &[0.0; 3], &[0.0; 3], &mut [0.0; 3]);
    }
}
