//! A slowly varying disturbance of the steering.

use crate::simulator::math::Rng;

/// Correlation time of the disturbance, s.
const CORRELATION_S: f64 = 0.5;

/// First-order autoregressive noise with zero mean.
#[derive(Clone, Debug)]
pub struct SteeringNoise {
    rng: Rng,
    strength: f64,
    value: f64,
}

impl SteeringNoise {
    /// The disturbance of trial `seed` with standard deviation `strength`, in units of the steering.
    pub fn new(seed: u64, strength: f64) -> SteeringNoise {
        SteeringNoise { rng: Rng::new(seed, "steering noise"), strength, value: 0.0 }
    }

    /// The disturbance `dt_s` (less than half a second) after the last one.
    pub fn next(&mut self, dt_s: f64) -> f64 {
        if self.strength == 0.0 {
            return 0.0;
        }
        let keep = 1.0 - dt_s / CORRELATION_S;
        self.value = keep * self.value + (1.0 - keep * keep).sqrt() * self.strength * self.rng.normal();
        self.value
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn strength_is_the_standard_deviation_and_neighbours_are_alike() {
        let mut noise = SteeringNoise::new(5, 0.2);
        let values: Vec<f64> = (0..40_000).map(|_| noise.next(0.05)).collect();
        let mean_square = |v: &mut dyn Iterator<Item = f64>| {
            let (sum, n) = v.fold((0.0, 0), |(s, n), x| (s + x * x, n + 1));
            sum / n as f64
        };
        let variance = mean_square(&mut values.iter().copied());
        let steps = mean_square(&mut values.windows(2).map(|w| w[1] - w[0]));
        assert!((variance.sqrt() - 0.2).abs() < 0.02, "{variance}");
        assert!(steps < 0.3 * variance);
        assert_eq!(SteeringNoise::new(5, 0.0).next(0.05), 0.0);
    }
}
