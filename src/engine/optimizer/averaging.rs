//! Averages of the weights over updates. The averaged network is evaluated and saved; training goes on with its own weights.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use steersman_kernels::Isa;
use steersman_kernels::update::move_towards;

use crate::engine::parameters::{CHUNK, Parameters};

/// The `averaging` entry of a recipe: which average of the weights becomes the model.
///
/// With `w_k` the weights after update `k`, and `n` averaged updates so far, both kinds are `a += share_n · (w − a)`, which begins
/// with `a = w` because `share_1 = 1`. Running statistics of batch normalisation are averaged in the same way, unless
/// `refit_batches` says otherwise.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum AveragingSpec {
    /// Exponential moving average, corrected for its short past as Adam's means are: `share_n = (1 − decay) / (1 − decayⁿ)`, so `a`
    /// is the mean of the weights where those of `m` updates ago count `decayᵐ`. The first weights have no more weight than that.
    Ema {
        /// Weight of the old average, in [0, 1). It looks back over `1 / (1 − decay)` updates.
        decay: f64,
        /// Share of all updates of the run (`epochs`, whether it stops early or not) before the average begins.
        #[serde(default)]
        from_share: f64,
        /// See [`refit_batches`](AveragingSpec::refit_batches).
        #[serde(default, skip_serializing_if = "is_zero")]
        refit_batches: u32,
    },
    /// Plain mean of the weights (Izmailov et al. 2018): `share_n = 1 / n`.
    Swa {
        /// As for `ema`.
        #[serde(default = "three_quarters")]
        from_share: f64,
        /// See [`refit_batches`](AveragingSpec::refit_batches).
        #[serde(default, skip_serializing_if = "is_zero")]
        refit_batches: u32,
    },
}

fn three_quarters() -> f64 {
    0.75
}

fn is_zero(batches: &u32) -> bool {
    *batches == 0
}

impl AveragingSpec {
    /// Share of all updates before the average begins.
    pub fn from_share(&self) -> f64 {
        match *self {
            AveragingSpec::Ema { from_share, .. } | AveragingSpec::Swa { from_share, .. } => from_share,
        }
    }

    /// If not 0, running statistics are not averaged: before each evaluation they go on from the latest ones over so many batches of
    /// the epoch (at most all of it) with the averaged weights, in training mode and without an update.
    pub fn refit_batches(&self) -> u32 {
        match *self {
            AveragingSpec::Ema { refit_batches, .. } | AveragingSpec::Swa { refit_batches, .. } => refit_batches,
        }
    }

    /// Checks the ranges of all numbers; the error names the first that is wrong.
    pub fn check(&self) -> Result<(), String> {
        if let AveragingSpec::Ema { decay, .. } = self
            && !(0.0..1.0).contains(decay)
        {
            return Err(format!("decay must lie in [0, 1), not be {decay}"));
        }
        match self.from_share() {
            share if (0.0..1.0).contains(&share) => Ok(()),
            share => Err(format!("from_share must lie in [0, 1), not be {share}")),
        }
    }

    /// How far the `n`-th averaged weights, counted from 1, move the average.
    fn share(&self, n: u64) -> f64 {
        match *self {
            AveragingSpec::Ema { decay, .. } => (1.0 - decay) / (1.0 - decay.powf(n as f64)),
            AveragingSpec::Swa { .. } => 1.0 / n as f64,
        }
    }
}

/// An average of the weights under way.
#[derive(Clone, Debug)]
pub struct WeightAverage {
    spec: AveragingSpec,
    /// Updates that are in the average.
    pub updates: u64,
    /// The average; before the first update anything.
    pub parameters: Parameters,
    isa: Isa,
}

impl WeightAverage {
    /// An average of nothing yet, of parameters like `parameters`.
    pub fn new(spec: AveragingSpec, parameters: &Parameters, isa: Isa) -> WeightAverage {
        WeightAverage { spec, updates: 0, parameters: parameters.clone(), isa }
    }

    /// What the recipe says of it.
    pub fn spec(&self) -> &AveragingSpec {
        &self.spec
    }

    /// Takes in the parameters after update number `update` (from 1) of `updates_in_all`, unless the average begins later.
    /// Allocates nothing inside a rayon pool.
    ///
    /// # Panics
    ///
    /// Panics if `now` has other lengths than the average.
    pub fn take_in(&mut self, now: &Parameters, update: u64, updates_in_all: u64) {
        if update <= (self.spec.from_share() * updates_in_all as f64) as u64 {
            return;
        }
        self.updates += 1;
        let Parameters { values, statistics } = &mut self.parameters;
        if self.updates == 1 {
            values.copy_from_slice(&now.values);
            statistics.copy_from_slice(&now.statistics);
            return;
        }
        assert_eq!(values.len(), now.values.len(), "the average of another network");
        let (isa, share) = (self.isa, self.spec.share(self.updates) as f32);
        let chunks = values.par_chunks_mut(CHUNK).zip(now.values.par_chunks(CHUNK));
        chunks.for_each(|(average, now)| move_towards(isa, share, average, now));
        move_towards(isa, share, statistics, &now.statistics);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parameters(value: f32) -> Parameters {
        Parameters { values: vec![value; 2 * CHUNK + 3], statistics: vec![-value; 5] }
    }

    /// The average of the weights 1, 2, … `updates`, taken of a run of `in_all` updates.
    fn average(spec: AveragingSpec, updates: u64, in_all: u64) -> WeightAverage {
        let mut average = WeightAverage::new(spec, &parameters(f32::NAN), Isa::best());
        (1..=updates).for_each(|update| average.take_in(&parameters(update as f32), update, in_all));
        average
    }

    fn close(average: &WeightAverage, expected: f64) {
        let Parameters { values, statistics } = &average.parameters;
        for value in values.iter().chain(&statistics.iter().map(|s| -s).collect::<Vec<_>>()) {
            approx::assert_relative_eq!(f64::from(*value), expected, max_relative = 1e-6);
        }
    }

    #[test]
    fn an_ema_is_the_weighted_mean_with_no_bias_towards_its_beginning() {
        let spec = AveragingSpec::Ema { decay: 0.9, from_share: 0.0, refit_batches: 0 };
        for updates in [1, 2, 7, 40] {
            let weights: Vec<f64> = (1..=updates).map(|k| 0.9f64.powi((updates - k) as i32)).collect();
            let sum: f64 = weights.iter().zip(1..).map(|(weight, k)| weight * f64::from(k)).sum();
            close(&average(spec, updates, 40), sum / weights.iter().sum::<f64>());
        }
    }

    #[test]
    fn swa_is_the_plain_mean_of_the_last_share() {
        let spec = AveragingSpec::Swa { from_share: 0.75, refit_batches: 0 };
        // Of 10 updates the last three: 0.75 · 10 = 7.5 lie before, rounded down.
        assert_eq!(average(spec, 7, 10).updates, 0);
        let whole = average(spec, 10, 10);
        assert_eq!(whole.updates, 3);
        close(&whole, 9.0);
    }

    #[test]
    fn weights_that_rest_are_their_own_average_to_the_bit() {
        let mut average =
            WeightAverage::new(AveragingSpec::Swa { from_share: 0.0, refit_batches: 0 }, &parameters(0.0), Isa::best());
        let rest = parameters(0.1);
        (1..=9).for_each(|update| average.take_in(&rest, update, 9));
        assert_eq!(average.parameters, rest);
    }

    #[test]
    fn threads_do_not_change_the_average() {
        let spec = AveragingSpec::Ema { decay: 0.99, from_share: 0.0, refit_batches: 0 };
        let with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| average(spec, 9, 9).parameters)
        };
        assert_eq!(with(1), with(3));
    }

    #[test]
    fn wrong_numbers_are_errors() {
        let ema = |decay, from_share| AveragingSpec::Ema { decay, from_share, refit_batches: 0 }.check();
        assert!(ema(0.999, 0.0).is_ok());
        assert!(ema(1.0, 0.0).unwrap_err().contains("decay"));
        assert!(ema(f64::NAN, 0.0).is_err());
        assert!(ema(0.9, 1.0).unwrap_err().contains("from_share"));
    }
}
