//! Simulated time that keeps step with the clock.

use std::time::{Duration, Instant};

/// Time lost beyond this is not made up for, s: the drive would be in a hurry.
const MOST_BEHIND_S: f64 = 0.25;

/// When a simulated time is now.
#[derive(Clone, Copy, Debug)]
pub(super) struct Clock {
    began: Instant,
}

impl Clock {
    /// Simulated time begins at `now`.
    pub fn start(now: Instant) -> Clock {
        Clock { began: now }
    }

    /// How long it is from `now` until `time_s`. Who is far behind is forgiven the rest.
    pub fn until(&mut self, time_s: f64, now: Instant) -> Duration {
        let due = self.began + Duration::from_secs_f64(time_s);
        let behind = now.saturating_duration_since(due);
        if behind.as_secs_f64() > MOST_BEHIND_S {
            self.began += behind;
        }
        due.saturating_duration_since(now)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_little_time_is_made_up_for_and_much_is_forgiven() {
        let start = Instant::now();
        let at = |s: f64| start + Duration::from_secs_f64(s);
        let mut clock = Clock::start(start);
        assert_eq!(clock.until(1.0, at(0.25)), Duration::from_millis(750));
        assert_eq!(clock.until(1.0, at(1.2)), Duration::ZERO);
        assert_eq!(clock.until(1.5, at(1.2)), Duration::from_millis(300));
        // The process was stopped for a minute: time goes on from here.
        assert_eq!(clock.until(2.0, at(62.0)), Duration::ZERO);
        assert_eq!(clock.until(2.5, at(62.0)), Duration::from_millis(500));
    }
}
