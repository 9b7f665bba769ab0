//! How sure a result is: intervals and paired tests.

use serde::Serialize;

use crate::simulator::math::Rng;

/// Wilson's interval (1927) with 95 % confidence for a share of which `successes` of `trials` were seen.
///
/// `(c ± z sqrt(p (1 - p) / n + z² / 4 n²)) / (1 + z² / n)` with `c = p + z² / 2 n`, `z = 1.96`. No trials: (0, 1).
pub fn wilson_interval(successes: usize, trials: usize) -> (f64, f64) {
    if trials == 0 {
        return (0.0, 1.0);
    }
    const Z: f64 = 1.959_963_985;
    let (n, p) = (trials as f64, successes as f64 / trials as f64);
    let middle = p + Z * Z / (2.0 * n);
    let half = Z * (p * (1.0 - p) / n + Z * Z / (4.0 * n * n)).sqrt();
    let scale = 1.0 + Z * Z / n;
    (((middle - half) / scale).max(0.0), ((middle + half) / scale).min(1.0))
}

/// Whether B differs from A by more than chance, from pairs with the same seed.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PairedTest {
    /// What was compared, with its unit.
    pub measure: String,
    /// Mean over the pairs for A.
    pub mean_a: f64,
    /// Mean over the pairs for B.
    pub mean_b: f64,
    /// Share of all ways to swap A and B within pairs that differ at least as much; two-sided.
    pub p_value: f64,
}

impl PairedTest {
    /// Compares paired values by the sign-flip permutation test: exact up to 14 pairs that differ, else by 20,000 random
    /// flips with a fixed seed.
    pub fn new(measure: &str, a: &[f64], b: &[f64]) -> PairedTest {
        let differences: Vec<f64> = a.iter().zip(b).map(|(a, b)| b - a).filter(|d| *d != 0.0).collect();
        let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len().max(1) as f64;
        let seen = differences.iter().sum::<f64>().abs() * (1.0 - 1e-12);
        let n = differences.len();
        let flipped = |flips: u64| -> f64 {
            differences.iter().enumerate().map(|(i, d)| if flips >> (i % 64) & 1 == 1 { -d } else { *d }).sum()
        };
        let p_value = if n <= 14 {
            let extreme = (0..1u64 << n).filter(|f| flipped(*f).abs() >= seen).count();
            extreme as f64 / (1u64 << n) as f64
        } else {
            const FLIPS: usize = 20_000;
            let mut rng = Rng::new(n as u64, "permutations");
            let extreme = (0..FLIPS).filter(|_| {
                let sum: f64 = differences.iter().map(|d| if rng.unit() < 0.5 { -d } else { *d }).sum();
                sum.abs() >= seen
            });
            (extreme.count() + 1) as f64 / (FLIPS + 1) as f64
        };
        PairedTest { measure: measure.to_string(), mean_a: mean(a), mean_b: mean(b), p_value }
    }

    /// Whether chance alone would show such a difference in fewer than 1 of 20 comparisons.
    pub fn significant(&self) -> bool {
        self.p_value < 0.05
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wilson_matches_published_values() {
        // Newcombe (1998), table I: 81 of 263 gives 0.2553 to 0.3662, 0 of 20 gives 0 to 0.1611.
        let (low, high) = wilson_interval(81, 263);
        assert!((low - 0.2553).abs() < 1e-4 && (high - 0.3662).abs() < 1e-4, "{low} {high}");
        let (low, high) = wilson_interval(0, 20);
        assert!(low == 0.0 && (high - 0.1611).abs() < 1e-4, "{high}");
    }

    #[test]
    fn paired_test_is_exact_for_few_pairs() {
        // Five pairs, all in one direction: 2 of 32 sign patterns are as extreme.
        let test = PairedTest::new("x", &[0.0; 5], &[1.0, 2.0, 3.0, 4.0, 5.0]);
        assert_eq!(test.p_value, 2.0 / 32.0);
        assert!(!test.significant());
        assert_eq!(PairedTest::new("x", &[1.0, 2.0], &[1.0, 2.0]).p_value, 1.0);
        let many = PairedTest::new("x", &[0.0; 30], &[0.5; 30]);
        assert!(many.significant() && many.mean_b == 0.5);
        let noise: Vec<f64> = (0..30).map(|k| if k % 2 == 0 { 1.0 } else { -1.0 }).collect();
        assert!(!PairedTest::new("x", &[0.0; 30], &noise).significant());
    }
}
