//! Holds simulated time to the clock.

use std::time::{Duration, Instant};

/// Longest delay that the drive makes up for, s.
const MAX_BEHIND_S: f64 = 0.25;

/// Maps simulated time to the clock.
#[derive(Clone, Copy, Debug)]
pub(super) struct RealTime {
    began: Instant,
}

impl RealTime {
    /// Simulated time 0 is `now`.
    pub fn start(now: Instant) -> RealTime {
        RealTime { began: now }
    }

    /// The time from `now` until the simulated time `time_s`. A longer delay than 0.25 s moves the start instead.
    pub fn until(&mut self, time_s: f64, now: Instant) -> Duration {
        let due = self.began + Duration::from_secs_f64(time_s);
        let behind = now.saturating_duration_since(due);
        if behind.as_secs_f64() > MAX_BEHIND_S {
            self.began += behind;
        }
        due.saturating_duration_since(now)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_short_delay_is_made_up_for_and_a_long_one_is_not() {
        let start = Instant::now();
        let at = |s: f64| start + Duration::from_secs_f64(s);
        let mut real_time = RealTime::start(start);
        assert_eq!(real_time.until(1.0, at(0.25)), Duration::from_millis(750));
        assert_eq!(real_time.until(1.0, at(1.2)), Duration::ZERO);
        assert_eq!(real_time.until(1.5, at(1.2)), Duration::from_millis(300));
        // The process was suspended for a minute: time goes on from here.
        assert_eq!(real_time.until(2.0, at(62.0)), Duration::ZERO);
        assert_eq!(real_time.until(2.5, at(62.0)), Duration::from_millis(500));
    }
}
