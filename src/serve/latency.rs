//! Latencies of the answers, as a histogram.

use std::time::Duration;

/// Width of a bin, µs.
const BIN_US: u64 = 10;
/// Number of bins. The last one counts everything above 200 ms.
const BINS: usize = 20_000;

/// A histogram of durations in bins of 10 µs. Its size does not grow with the number of durations.
#[derive(Clone, Debug)]
pub struct Latencies {
    counts: Vec<u64>,
    total: u64,
    longest: Duration,
}

impl Default for Latencies {
    fn default() -> Self {
        Latencies { counts: vec![0; BINS], total: 0, longest: Duration::ZERO }
    }
}

impl Latencies {
    /// Adds a duration.
    pub fn add(&mut self, duration: Duration) {
        let bin = (duration.as_micros() as u64 / BIN_US).min(BINS as u64 - 1);
        self.counts[bin as usize] += 1;
        self.total += 1;
        self.longest = self.longest.max(duration);
    }

    /// Number of durations.
    pub fn total(&self) -> u64 {
        self.total
    }

    /// The longest, ms.
    pub fn longest_ms(&self) -> Option<f64> {
        (self.total > 0).then_some(self.longest.as_secs_f64() * 1e3)
    }

    /// The `quantile` of the durations, ms, rounded up to 10 µs.
    pub fn quantile_ms(&self, quantile: f64) -> Option<f64> {
        let rank = (quantile * self.total as f64).ceil().max(1.0) as u64;
        let mut below = 0;
        let bin = self.counts.iter().position(|count| {
            below += *count;
            below >= rank
        })?;
        if bin == BINS - 1 {
            return self.longest_ms();
        }
        Some((bin as u64 + 1) as f64 * BIN_US as f64 / 1e3)
    }

    /// Removes all durations.
    pub fn clear(&mut self) {
        self.counts.fill(0);
        (self.total, self.longest) = (0, Duration::ZERO);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_of_known_durations() {
        let mut latencies = Latencies::default();
        assert_eq!((latencies.quantile_ms(0.5), latencies.longest_ms()), (None, None));
        for us in 1..=1000 {
            latencies.add(Duration::from_micros(us * 2));
        }
        assert_eq!(latencies.total(), 1000);
        assert!((latencies.quantile_ms(0.5).unwrap() - 1.0).abs() <= 0.0101);
        assert!((latencies.quantile_ms(0.99).unwrap() - 1.98).abs() <= 0.0101);
        latencies.add(Duration::from_secs(3));
        assert_eq!((latencies.quantile_ms(1.0), latencies.longest_ms()), (Some(3000.0), Some(3000.0)));
        latencies.clear();
        assert_eq!(latencies.quantile_ms(0.5), None);
    }
}
