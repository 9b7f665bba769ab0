//! Open-loop measures: predicted against recorded steering.

use serde::Serialize;

/// A label counts as straight below this wheel angle, in degrees.
const STRAIGHT_DEG: f64 = 1.0;

/// Predicted and recorded steering of one row.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Prediction {
    /// Predicted steering.
    pub steering: f32,
    /// Recorded steering.
    pub label: f32,
    /// Index of the session, an unbroken drive, that the row belongs to.
    pub session: usize,
    /// Time in seconds; only differences within a session count.
    pub time_s: f64,
}

/// Measures of how well predictions fit labels. Angles are those of the front wheels, in degrees. A mean over nothing is
/// `None`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Metrics {
    /// Number of rows.
    pub rows: usize,
    /// Mean squared error, of the normalised steering.
    pub mse: f64,
    /// Mean absolute error.
    pub mae_deg: f64,
    /// Root of the mean squared error.
    pub rmse_deg: f64,
    /// Mean absolute error where the label is −1° or further left.
    pub mae_left_deg: Option<f64>,
    /// Mean absolute error where the label is less than 1° from zero.
    pub mae_straight_deg: Option<f64>,
    /// Mean absolute error where the label is 1° or further right.
    pub mae_right_deg: Option<f64>,
    /// Mean of prediction − label.
    pub bias_deg: f64,
    /// Share of the labels' variance that is explained: 1 − squared errors / squared deviations from the mean label.
    pub r2: Option<f64>,
    /// Pearson's correlation of predictions and labels: how well their ups and downs agree, whatever their scale.
    pub correlation: Option<f64>,
    /// Mean squared error ÷ mean squared label: 1 is as good as always predicting zero, smaller is better.
    pub relative_to_zero: Option<f64>,
    /// Root of the mean squared change of the predicted angle per second, between neighbouring rows of a session.
    pub whiteness_deg_s: Option<f64>,
}

impl Metrics {
    /// The measures of `predictions`, which are in the order of driving; `None` if there are none.
    pub fn of(predictions: &[Prediction], full_lock_deg: f64) -> Option<Metrics> {
        if predictions.is_empty() {
            return None;
        }
        let errors = || predictions.iter().map(|p| f64::from(p.steering) - f64::from(p.label));
        let labels = || predictions.iter().map(|p| f64::from(p.label));
        let mean_of = |values: &mut dyn Iterator<Item = f64>| {
            let (count, sum) = values.fold((0usize, 0.0), |(count, sum), value| (count + 1, sum + value));
            (count > 0).then(|| sum / count as f64)
        };
        let mean = |values: &mut dyn Iterator<Item = f64>| mean_of(values).unwrap_or(0.0);
        let mae_where = |wanted: &dyn Fn(f64) -> bool| {
            let chosen = errors().zip(labels()).filter(|(_, label)| wanted(label * full_lock_deg));
            mean_of(&mut chosen.map(|(error, _)| error.abs() * full_lock_deg))
        };
        let mse = mean(&mut errors().map(|e| e * e));
        let label_mean = mean(&mut labels());
        let label_variance = mean(&mut labels().map(|l| (l - label_mean).powi(2)));
        let label_square = mean(&mut labels().map(|l| l * l));
        let neighbours = predictions.windows(2).filter(|w| w[0].session == w[1].session && w[1].time_s > w[0].time_s);
        let rates =
            neighbours.map(|w| f64::from(w[1].steering - w[0].steering) * full_lock_deg / (w[1].time_s - w[0].time_s));
        Some(Metrics {
            rows: predictions.len(),
            mse,
            mae_deg: mean(&mut errors().map(f64::abs)) * full_lock_deg,
            rmse_deg: mse.sqrt() * full_lock_deg,
            mae_left_deg: mae_where(&|angle_deg| angle_deg <= -STRAIGHT_DEG),
            mae_straight_deg: mae_where(&|angle_deg| angle_deg.abs() < STRAIGHT_DEG),
            mae_right_deg: mae_where(&|angle_deg| angle_deg >= STRAIGHT_DEG),
            bias_deg: mean(&mut errors()) * full_lock_deg,
            r2: (label_variance > 0.0).then(|| 1.0 - mse / label_variance),
            correlation: correlation(predictions.iter().map(|p| (f64::from(p.steering), f64::from(p.label)))),
            relative_to_zero: (label_square > 0.0).then(|| mse / label_square),
            whiteness_deg_s: mean_of(&mut rates.map(|rate| rate * rate)).map(f64::sqrt),
        })
    }
}

/// Measures of an output beside the steering, in the unit of its pairs. A mean over nothing is `None`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct OutputMetrics {
    /// Number of rows.
    pub rows: usize,
    /// Mean absolute error.
    pub mae: f64,
    /// Root of the mean squared error.
    pub rmse: f64,
    /// Mean of prediction − label.
    pub bias: f64,
    /// Mean of the labels.
    pub label_mean: f64,
    /// Share of the labels' variance that is explained: 0 is as good as always predicting their mean.
    pub r2: Option<f64>,
    /// Pearson's correlation of predictions and labels.
    pub correlation: Option<f64>,
}

impl OutputMetrics {
    /// The measures of `pairs` of prediction and label; `None` if there are none.
    pub fn of(pairs: &[(f64, f64)]) -> Option<OutputMetrics> {
        let count = pairs.len() as f64;
        let mean = |of: &dyn Fn(f64, f64) -> f64| {
            pairs.iter().map(|(prediction, label)| of(*prediction, *label)).sum::<f64>() / count
        };
        let mse = mean(&|prediction, label| (prediction - label).powi(2));
        let label_mean = mean(&|_, label| label);
        let label_variance = mean(&|_, label| (label - label_mean).powi(2));
        (!pairs.is_empty()).then(|| OutputMetrics {
            rows: pairs.len(),
            mae: mean(&|prediction, label| (prediction - label).abs()),
            rmse: mse.sqrt(),
            bias: mean(&|prediction, label| prediction - label),
            label_mean,
            r2: (label_variance > 0.0).then(|| 1.0 - mse / label_variance),
            correlation: correlation(pairs.iter().copied()),
        })
    }
}

/// Pearson's correlation of pairs; absent where one side is always the same, or there are no pairs.
pub fn correlation(pairs: impl Iterator<Item = (f64, f64)> + Clone) -> Option<f64> {
    let count = pairs.clone().count() as f64;
    let (sum_a, sum_b) = pairs.clone().fold((0.0, 0.0), |(a, b), pair| (a + pair.0, b + pair.1));
    let (mean_a, mean_b) = (sum_a / count, sum_b / count);
    let [ab, aa, bb] = pairs.fold([0.0; 3], |[ab, aa, bb], (a, b)| {
        let (a, b) = (a - mean_a, b - mean_b);
        [ab + a * b, aa + a * a, bb + b * b]
    });
    // Also false for what is no number.
    (aa > 0.0 && bb > 0.0).then(|| ab / (aa * bb).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;

    fn predictions(values: &[(f32, f32, usize, f64)]) -> Vec<Prediction> {
        let prediction = |&(steering, label, session, time_s)| Prediction { steering, label, session, time_s };
        values.iter().map(prediction).collect()
    }

    #[test]
    fn every_measure_has_its_definition() {
        // Labels in degrees: −10, 0.5, 10, 0; predictions −5, 0.5, 10, 5.
        let rows = predictions(&[(-0.2, -0.4, 0, 0.0), (0.02, 0.02, 0, 0.1), (0.4, 0.4, 0, 0.2), (0.2, 0.0, 1, 0.3)]);
        let m = Metrics::of(&rows, 25.0).unwrap();
        assert_eq!(m.rows, 4);
        assert_relative_eq!(m.mse, 0.02, max_relative = 1e-6);
        assert_relative_eq!(m.mae_deg, 2.5, max_relative = 1e-6);
        assert_relative_eq!(m.rmse_deg, 0.02f64.sqrt() * 25.0, max_relative = 1e-6);
        assert_relative_eq!(m.mae_left_deg.unwrap(), 5.0, max_relative = 1e-6);
        assert_relative_eq!(m.mae_straight_deg.unwrap(), 2.5, max_relative = 1e-6);
        assert_relative_eq!(m.mae_right_deg.unwrap(), 0.0);
        assert_relative_eq!(m.bias_deg, 2.5, max_relative = 1e-6);
        let squares = 0.16 + 0.0004 + 0.16;
        assert_relative_eq!(m.relative_to_zero.unwrap(), 0.08 / squares, max_relative = 1e-6);
        let variance = squares / 4.0 - 0.005f64.powi(2);
        assert_relative_eq!(m.r2.unwrap(), 1.0 - 0.02 / variance, max_relative = 1e-6);
        // Deviations from the means 0.105 and 0.005.
        let products = (-0.305 * -0.405) + (-0.085 * 0.015) + (0.295 * 0.395) + (0.095 * -0.005);
        let (a, b): (f64, f64) = (0.093025 + 0.007225 + 0.087025 + 0.009025, 0.164025 + 0.000225 + 0.156025 + 0.000025);
        assert_relative_eq!(m.correlation.unwrap(), products / (a * b).sqrt(), max_relative = 1e-6);
        // 5.5° and 9.5° within 0.1 s each; the last row is another session.
        assert_relative_eq!(
            m.whiteness_deg_s.unwrap(),
            ((55f64.powi(2) + 95f64.powi(2)) / 2.0).sqrt(),
            max_relative = 1e-5
        );
    }

    #[test]
    fn the_measures_of_another_output_have_their_definitions() {
        let m = OutputMetrics::of(&[(0.5, 0.25), (0.5, 1.0), (0.0, 0.25)]).unwrap();
        assert_eq!((m.rows, m.mae, m.label_mean), (3, 1.0 / 3.0, 0.5));
        assert_relative_eq!(m.rmse, (0.375f64 / 3.0).sqrt());
        assert_relative_eq!(m.bias, -0.5 / 3.0);
        assert_relative_eq!(m.r2.unwrap(), 1.0 - 0.125 / 0.125);
        assert_relative_eq!(m.correlation.unwrap(), 0.5);
        assert_eq!(OutputMetrics::of(&[]), None);
        assert_eq!(OutputMetrics::of(&[(1.0, 0.5)]).unwrap().r2, None);
    }

    #[test]
    fn means_over_nothing_are_absent() {
        assert_eq!(Metrics::of(&[], 25.0), None);
        let m = Metrics::of(&predictions(&[(0.1, 0.0, 0, 0.0)]), 25.0).unwrap();
        assert_eq!((m.mae_left_deg, m.r2, m.relative_to_zero, m.whiteness_deg_s), (None, None, None, None));
        assert_eq!(m.correlation, None);
    }
}
