//! A limit on what clients may send that do not drive, so that most of the machine is left for the one that does.

use std::time::{Duration, Instant};

/// Cost of a message, s.
const MESSAGE_S: f64 = 0.004;
/// Cost of a byte, s.
const BYTE_S: f64 = 1e-6;
/// Largest credit, s: enough for a handshake and the first telemetry.
const MAX_CREDIT_S: f64 = 0.5;

/// The credit of a connection in seconds. Each second of the clock adds one; messages and bytes cost some.
#[derive(Clone, Debug)]
pub(super) struct RateLimit {
    credit_s: f64,
    last: Instant,
}

impl RateLimit {
    /// For a connection that begins at `now`.
    pub fn new(now: Instant) -> RateLimit {
        RateLimit { credit_s: MAX_CREDIT_S, last: now }
    }

    /// Charges for what was read until `now`. Returns how long to pause before the next read.
    pub fn charge(&mut self, messages: usize, bytes: usize, now: Instant) -> Duration {
        let earned_s = now.duration_since(self.last).as_secs_f64();
        self.last = now;
        self.credit_s = (self.credit_s + earned_s).min(MAX_CREDIT_S);
        self.credit_s -= messages as f64 * MESSAGE_S + bytes as f64 * BYTE_S;
        Duration::from_secs_f64((-self.credit_s).max(0.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// How many messages of `bytes` are read in ten seconds.
    fn in_ten_seconds(bytes: usize) -> usize {
        let start = Instant::now();
        let (mut limit, mut now, mut messages) = (RateLimit::new(start), start, 0);
        while now < start + Duration::from_secs(10) {
            now += limit.charge(1, bytes, now);
            messages += 1;
        }
        messages
    }

    #[test]
    fn a_flood_is_slowed_down_and_telemetry_is_not() {
        assert!(in_ten_seconds(6) < 2700, "{}", in_ten_seconds(6));
        assert!(in_ten_seconds(1 << 20) < 12);
        // A simulator that waits for its turn sends 18 KB at 30 frames a second.
        let start = Instant::now();
        let mut limit = RateLimit::new(start);
        assert!((0..300).all(|k| limit.charge(1, 18_000, start + k * Duration::from_micros(33_333)).is_zero()));
    }
}
