//! How outputs and labels agree.

use serde::Serialize;

use crate::metrics::correlation;

/// Full lock is 1. Outputs of a steering beyond 1 exist, but hardly any beyond this.
const FAR: f64 = 2.0;

/// Outputs that all lie within a range of this size are the same for every picture, but for rounding.
const CONSTANT: f64 = 1e-3;

/// How well a network's outputs go with the labels.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Agreement {
    /// Number of frames.
    pub frames: usize,
    /// Outputs that are infinite or no number.
    pub not_finite: usize,
    /// Finite outputs beyond twice full lock.
    pub far: usize,
    /// Smallest and largest finite output; absent if there is none.
    pub range: Option<[f64; 2]>,
    /// Root of the mean squared difference of outputs and labels; absent if an output is not finite.
    pub error: Option<f64>,
    /// The line that leads from outputs to labels; absent if an output is not finite, or if all are the same.
    pub line: Option<Line>,
    /// Pearson's correlation of outputs and labels; absent as `line`.
    pub correlation: Option<f64>,
}

/// The line `gain · output + bias` that comes nearest to the labels, by least squares.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Line {
    /// Factor of the output; negative if the network steers to the other side.
    pub gain: f64,
    /// Added to that.
    pub bias: f64,
    /// Root of the mean squared difference that is left. It is the labels' standard deviation times √(1 − r²), r the correlation: a
    /// network that is mirrored, or gives degrees, has the same error as one that is not.
    pub error: f64,
}

impl Agreement {
    /// The agreement of `pairs` of output and label.
    pub fn of(pairs: &[(f64, f64)]) -> Agreement {
        let finite = || pairs.iter().map(|(output, _)| *output).filter(|output| output.is_finite());
        let range = finite()
            .fold(None, |range: Option<[f64; 2]>, x| Some(range.map_or([x, x], |[min, max]| [min.min(x), max.max(x)])));
        let not_finite = pairs.len() - finite().count();
        let usable = not_finite == 0 && !pairs.is_empty();
        let is_constant = range.is_none_or(|[min, max]| max - min < CONSTANT);
        let line = (usable && !is_constant).then(|| Line::through(pairs)).flatten();
        Agreement {
            frames: pairs.len(),
            not_finite,
            far: finite().filter(|output| output.abs() > FAR).count(),
            range,
            error: usable.then(|| root_mean_square(pairs, |output, label| output - label)),
            line,
            correlation: line.and_then(|_| correlation(pairs.iter().copied())),
        }
    }

    /// Whether the outputs are no steering under this preprocessing, and why.
    pub fn absurdity(&self) -> Option<String> {
        let frames = self.frames;
        match self.range {
            _ if self.not_finite > 0 => {
                Some(format!("{} of {frames} outputs are infinite or no number", self.not_finite))
            }
            Some([min, max]) if max - min < CONSTANT => {
                Some(format!("the output is about {min:.3} whatever the picture shows"))
            }
            Some([min, max]) if self.far * 20 > frames => Some(format!(
                "{} of {frames} outputs lie beyond {FAR} (from {min:.3} to {max:.3}), where 1 is full lock",
                self.far
            )),
            _ => None,
        }
    }
}

impl Line {
    fn through(pairs: &[(f64, f64)]) -> Option<Line> {
        let count = pairs.len() as f64;
        let mean = |of: fn(&(f64, f64)) -> f64| pairs.iter().map(of).sum::<f64>() / count;
        let (output_mean, label_mean) = (mean(|pair| pair.0), mean(|pair| pair.1));
        let (mut product, mut square) = (0.0, 0.0);
        for (output, label) in pairs {
            product += (output - output_mean) * (label - label_mean);
            square += (output - output_mean).powi(2);
        }
        let gain = product / square;
        let bias = label_mean - gain * output_mean;
        let error = root_mean_square(pairs, |output, label| gain * output + bias - label);
        (square > 0.0 && gain.is_finite()).then_some(Line { gain, bias, error })
    }

    /// What `--output-scale` has to be for outputs that were read with `read_with`, STRAIGHT and SPAN, so that they lie on the labels.
    pub fn output_scale(&self, [straight, span]: [f64; 2]) -> [f64; 2] {
        [straight - span * self.bias / self.gain, span / self.gain]
    }
}

fn root_mean_square(pairs: &[(f64, f64)], of: impl Fn(f64, f64) -> f64) -> f64 {
    (pairs.iter().map(|(output, label)| of(*output, *label).powi(2)).sum::<f64>() / pairs.len() as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;

    /// Labels −0.4 to 0.4, and what `of` makes of them as an output.
    fn pairs(of: impl Fn(f64) -> f64) -> Vec<(f64, f64)> {
        (-4..5).map(|i| f64::from(i) / 10.0).map(|label| (of(label), label)).collect()
    }

    #[test]
    fn gain_and_bias_take_a_unit_away() {
        let degrees = Agreement::of(&pairs(|label| 90.0 + 45.0 * label));
        let line = degrees.line.unwrap();
        assert_relative_eq!(line.gain, 1.0 / 45.0, max_relative = 1e-9);
        assert_relative_eq!(line.bias, -2.0, max_relative = 1e-9);
        assert!(line.error < 1e-12 && degrees.error.unwrap() > 89.0);
        let [straight, span] = line.output_scale([0.0, 1.0]);
        assert_relative_eq!(straight, 90.0, max_relative = 1e-9);
        assert_relative_eq!(span, 45.0, max_relative = 1e-9);
        // Read as degrees around 80 with 30 to full lock: (90 + 45 label − 80) / 30.
        let half_right = Agreement::of(&pairs(|label| (10.0 + 45.0 * label) / 30.0)).line.unwrap();
        let [straight, span] = half_right.output_scale([80.0, 30.0]);
        assert_relative_eq!(straight, 90.0, max_relative = 1e-9);
        assert_relative_eq!(span, 45.0, max_relative = 1e-9);
    }

    #[test]
    fn a_mirrored_network_has_a_negative_gain_and_no_other_error() {
        let noisy = |sign: f64| Agreement::of(&pairs(|label| sign * (label + 0.1 * (label * 40.0).sin())));
        let (plain, mirrored) = (noisy(1.0), noisy(-1.0));
        assert!(plain.line.unwrap().gain > 0.5);
        assert_relative_eq!(mirrored.line.unwrap().gain, -plain.line.unwrap().gain);
        assert_relative_eq!(mirrored.line.unwrap().error, plain.line.unwrap().error);
        assert!(mirrored.error > plain.error && mirrored.correlation.unwrap() < -0.9);
    }

    #[test]
    fn the_error_left_is_what_the_correlation_leaves() {
        let agreement = Agreement::of(&pairs(|label| 3.0 * label + (label * 17.0).cos()));
        let r = agreement.correlation.unwrap();
        let deviation = (60.0f64 / 9.0 / 100.0).sqrt();
        assert_relative_eq!(agreement.line.unwrap().error, deviation * (1.0 - r * r).sqrt(), max_relative = 1e-9);
        // As it is, and not after gain and bias.
        let shifted = Agreement::of(&pairs(|label| label + 0.25));
        assert_relative_eq!(shifted.error.unwrap(), 0.25, max_relative = 1e-9);
    }

    #[test]
    fn what_is_no_steering_is_told() {
        let told = |of: &dyn Fn(f64) -> f64| Agreement::of(&pairs(of)).absurdity();
        assert_eq!(told(&|label| label * 1.5), None);
        // The rounding of a constant is no signal.
        let constant = told(&|label| 0.7 + 1e-5 * label).unwrap();
        assert!(constant.contains("about 0.700 whatever"), "{constant}");
        let far = told(&|label| 90.0 + 45.0 * label).unwrap();
        assert!(far.contains("9 of 9 outputs lie beyond 2 (from 72.000 to 108.000)"), "{far}");
        let nan = told(&|label| if label == 0.0 { f64::NAN } else { label }).unwrap();
        assert!(nan.contains("1 of 9 outputs are infinite or no number"), "{nan}");
        let broken = Agreement::of(&pairs(|label| label / 0.0));
        assert_eq!((broken.line, broken.correlation, broken.error, broken.range), (None, None, None, None));
        let rounding = Agreement::of(&pairs(|label| 0.5 + 1e-6 * label));
        assert_eq!((rounding.line, rounding.correlation), (None, None), "the same output everywhere, but for rounding");
    }
}
