//! How fast a watched drive is shown: with pauses, slower or faster, and without waiting for its end.

use std::time::{Duration, Instant};

use serde::Serialize;

use super::real_time::RealTime;

/// Simulated seconds a second: the slowest and the fastest.
const RATES: [f64; 2] = [0.25, 16.0];

/// What the pages have asked for. Whoever watches shares it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Playback {
    /// Whether time stands still.
    pub paused: bool,
    /// Simulated seconds a second.
    pub rate: f64,
    /// The run with this trail is driven on without being waited for.
    #[serde(skip)]
    pub hurried_trail: Option<u64>,
}

impl Default for Playback {
    fn default() -> Self {
        Playback { paused: false, rate: 1.0, hurried_trail: None }
    }
}

impl Playback {
    /// Sets the rate to the nearest that is possible; what is no number changes nothing.
    pub fn set_rate(&mut self, rate: f64) {
        if !rate.is_nan() {
            self.rate = rate.clamp(RATES[0], RATES[1]);
        }
    }
}

/// The clock of a drive that pages can pause and hurry.
#[derive(Clone, Copy, Debug)]
pub(super) struct PlaybackClock {
    real_time: RealTime,
    rate: f64,
    /// Simulated time at which the rate began to hold, s.
    from_s: f64,
}

impl PlaybackClock {
    /// Simulated time 0 is `now`.
    pub fn start(now: Instant) -> PlaybackClock {
        PlaybackClock { real_time: RealTime::start(now), rate: 1.0, from_s: 0.0 }
    }

    /// The time from `now` until the run with trail `trail_id` reaches the simulated time `time_s`; `None` while it is paused.
    pub fn until(&mut self, time_s: f64, trail_id: u64, playback: &Playback, now: Instant) -> Option<Duration> {
        if playback.hurried_trail == Some(trail_id) {
            (self.real_time, self.from_s) = (RealTime::start(now), time_s);
            return Some(Duration::ZERO);
        }
        if playback.paused || playback.rate != self.rate {
            // From here on time goes on, or goes on at another rate.
            (self.real_time, self.from_s, self.rate) = (RealTime::start(now), time_s, playback.rate);
        }
        (!playback.paused).then(|| self.real_time.until((time_s - self.from_s) / self.rate, now))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_can_be_stopped_stretched_and_skipped() {
        let start = Instant::now();
        let at = |s: f64| start + Duration::from_secs_f64(s);
        let ms = |ms| Some(Duration::from_millis(ms));
        let mut clock = PlaybackClock::start(start);
        let mut playback = Playback::default();
        assert_eq!(clock.until(1.0, 1, &playback, at(0.75)), ms(250));
        playback.paused = true;
        assert_eq!(clock.until(1.0, 1, &playback, at(0.8)), None);
        assert_eq!(clock.until(1.0, 1, &playback, at(60.0)), None);
        playback.paused = false;
        assert_eq!(clock.until(1.0, 1, &playback, at(60.0)), ms(0));
        assert_eq!(clock.until(1.5, 1, &playback, at(60.1)), ms(400), "nothing is made up for");
        playback.set_rate(4.0);
        assert_eq!(clock.until(1.5, 1, &playback, at(60.1)), ms(0));
        assert_eq!(clock.until(3.5, 1, &playback, at(60.1)), ms(500));
        playback.hurried_trail = Some(1);
        assert_eq!(clock.until(99.0, 1, &playback, at(60.2)), ms(0));
        assert_eq!(clock.until(100.0, 2, &playback, at(60.2)), ms(250), "the next run is shown again");
        playback.set_rate(f64::NAN);
        assert_eq!(playback.rate, 4.0);
        playback.set_rate(1e9);
        assert_eq!(playback.rate, 16.0);
    }
}
