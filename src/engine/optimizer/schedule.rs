//! Learning-rate schedules.

use serde::{Deserialize, Serialize};

/// How the learning rate changes over a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScheduleSpec {
    /// The rate after the warm-up.
    #[serde(default)]
    pub shape: Schedule,
    /// Number of updates of the warm-up: update k (from 1) has the fraction `k / warmup_updates` of the rate.
    #[serde(default)]
    pub warmup_updates: u64,
}

/// The learning rate as a multiple of the optimizer's.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Schedule {
    /// Always 1.
    Constant {},
    /// `1 / (1 + decay_per_update · updates)`, which Keras 1 calls `decay`. It is no weight decay.
    TimeDecay {
        /// Growth of the divisor with each update.
        decay_per_update: f64,
    },
    /// Half a cosine from 1 at the start to `final_fraction` at the end of the last epoch.
    Cosine {
        /// Fraction at the end of the last epoch.
        #[serde(default)]
        final_fraction: f64,
    },
    /// Times `factor` whenever the validation loss has not fallen for `patience_epochs`.
    ReduceOnPlateau {
        /// Multiplies the rate.
        factor: f64,
        /// Epochs without a new lowest validation loss before the rate falls.
        patience_epochs: u32,
        /// The rate does not fall below this fraction.
        #[serde(default)]
        min_fraction: f64,
    },
}

impl Default for Schedule {
    fn default() -> Schedule {
        Schedule::Constant {}
    }
}

/// State of [`Schedule::ReduceOnPlateau`] between epochs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Plateau {
    fraction: f64,
    lowest: Option<f64>,
    epochs_since: u32,
}

impl Default for Plateau {
    fn default() -> Plateau {
        Plateau { fraction: 1.0, lowest: None, epochs_since: 0 }
    }
}

impl ScheduleSpec {
    /// The multiple for the update that follows `updates` earlier ones, in a run of `total_updates`.
    pub fn fraction(&self, updates: u64, total_updates: u64, plateau: &Plateau) -> f64 {
        let warmup = match self.warmup_updates {
            0 => 1.0,
            warmup => ((updates + 1) as f64 / warmup as f64).min(1.0),
        };
        let shape = match self.shape {
            Schedule::Constant {} => 1.0,
            Schedule::TimeDecay { decay_per_update } => 1.0 / (1.0 + decay_per_update * updates as f64),
            Schedule::Cosine { final_fraction } => {
                let progress = (updates as f64 / total_updates.max(1) as f64).min(1.0);
                final_fraction + (1.0 - final_fraction) * (1.0 + (std::f64::consts::PI * progress).cos()) / 2.0
            }
            Schedule::ReduceOnPlateau { .. } => plateau.fraction,
        };
        warmup * shape
    }

    /// Updates the plateau with the validation loss of an epoch.
    pub fn end_epoch(&self, validation_loss: f64, plateau: &mut Plateau) {
        let Schedule::ReduceOnPlateau { factor, patience_epochs, min_fraction } = self.shape else { return };
        if plateau.lowest.is_none_or(|lowest| validation_loss < lowest) {
            plateau.lowest = Some(validation_loss);
            plateau.epochs_since = 0;
            return;
        }
        plateau.epochs_since += 1;
        if plateau.epochs_since >= patience_epochs {
            plateau.fraction = (plateau.fraction * factor).max(min_fraction);
            plateau.epochs_since = 0;
        }
    }

    /// Checks the ranges of all numbers; the error names the first that is wrong.
    pub fn check(&self) -> Result<(), String> {
        let fraction = |name: &str, value: f64| match (0.0..=1.0).contains(&value) {
            true => Ok(()),
            false => Err(format!("{name} must lie in [0, 1], not be {value}")),
        };
        match self.shape {
            Schedule::Constant {} => Ok(()),
            Schedule::TimeDecay { decay_per_update } if decay_per_update.is_finite() && decay_per_update >= 0.0 => {
                Ok(())
            }
            Schedule::TimeDecay { decay_per_update } => {
                Err(format!("decay_per_update must not be negative or infinite, but is {decay_per_update}"))
            }
            Schedule::Cosine { final_fraction } => fraction("final_fraction", final_fraction),
            Schedule::ReduceOnPlateau { factor, min_fraction, .. } => {
                fraction("factor", factor).and(fraction("min_fraction", min_fraction))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fractions(shape: Schedule, warmup_updates: u64, updates: &[u64]) -> Vec<f64> {
        let spec = ScheduleSpec { shape, warmup_updates };
        updates.iter().map(|&u| spec.fraction(u, 100, &Plateau::default())).collect()
    }

    #[test]
    fn time_decay_is_that_of_keras_1_and_starts_at_the_full_rate() {
        let decay = Schedule::TimeDecay { decay_per_update: 1e-7 };
        assert_eq!(fractions(decay, 0, &[0, 2980]), [1.0, 1.0 / (1.0 + 2980e-7)]);
    }

    #[test]
    fn cosine_goes_from_one_to_the_final_fraction() {
        let cosine = Schedule::Cosine { final_fraction: 0.1 };
        approx::assert_relative_eq!(fractions(cosine, 0, &[0, 50, 100, 120])[..], [1.0, 0.55, 0.1, 0.1]);
    }

    #[test]
    fn warm_up_rises_in_a_line_and_reaches_the_full_rate() {
        assert_eq!(fractions(Schedule::Constant {}, 4, &[0, 1, 3, 4]), [0.25, 0.5, 1.0, 1.0]);
    }

    #[test]
    fn a_plateau_lowers_the_rate_until_the_limit() {
        let shape = Schedule::ReduceOnPlateau { factor: 0.5, patience_epochs: 2, min_fraction: 0.3 };
        let spec = ScheduleSpec { shape, warmup_updates: 0 };
        let mut plateau = Plateau::default();
        let seen: Vec<f64> = [1.0, 0.9, 0.95, 0.9, 0.8, 0.8, 0.8, 0.8, 0.8]
            .iter()
            .map(|loss| {
                spec.end_epoch(*loss, &mut plateau);
                spec.fraction(0, 1, &plateau)
            })
            .collect();
        assert_eq!(seen, [1.0, 1.0, 1.0, 0.5, 0.5, 0.5, 0.3, 0.3, 0.3]);
    }
}
