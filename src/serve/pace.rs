//! How fast strangers may talk: whatever they send, most of the machine is left for the client that drives.

use std::time::{Duration, Instant};

/// What a message costs, s.
const MESSAGE_S: f64 = 0.004;
/// What a byte costs, s.
const BYTE_S: f64 = 1e-6;
/// What can be saved up, s: enough for a handshake and the first telemetry.
const MOST_CREDIT_S: f64 = 0.5;

/// Credit of a connection in seconds: each second brings one, messages cost some.
#[derive(Clone, Debug)]
pub(super) struct Pace {
    credit_s: f64,
    last: Instant,
}

impl Pace {
    /// For a connection that is new at `now`.
    pub fn new(now: Instant) -> Pace {
        Pace { credit_s: MOST_CREDIT_S, last: now }
    }

    /// Charges for what was read until `now`; returns how long to pause before the next.
    pub fn charge(&mut self, messages: usize, bytes: usize, now: Instant) -> Duration {
        let earned_s = now.duration_since(self.last).as_secs_f64();
        self.last = now;
        self.credit_s = (self.credit_s + earned_s).min(MOST_CREDIT_S);
        self.credit_s -= messages as f64 * MESSAGE_S + bytes as f64 * BYTE_S;
        Duration::from_secs_f64((-self.credit_s).max(0.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Messages of `bytes` that come through in ten seconds.
    fn in_ten_seconds(bytes: usize) -> usize {
        let start = Instant::now();
        let (mut pace, mut now, mut messages) = (Pace::new(start), start, 0);
        while now < start + Duration::from_secs(10) {
            now += pace.charge(1, bytes, now);
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
        let mut pace = Pace::new(start);
        assert!((0..300).all(|k| pace.charge(1, 18_000, start + k * Duration::from_micros(33_333)).is_zero()));
    }
}
