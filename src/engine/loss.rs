//! Losses: value and gradient.

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
}
