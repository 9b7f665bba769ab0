//! The clock of the rendered frames, as Unity keeps it.

use std::time::{Duration, Instant};

use crate::simulator::car::dynamics::STEP_S;

/// Longest simulated time that one frame adds (Unity's maximum allowed timestep), s.
const MAX_PER_FRAME_S: f64 = 1.0 / 3.0;
/// Says how much simulated time is due, and when the next frame is.
pub(super) struct FrameClock {
    frame_s: f64,
    last: Instant,
    next: Instant,
    /// Simulated time that is due, s.
    owed_s: f64,
}

impl FrameClock {
    /// A clock of `fps` frames a second.
    pub fn new(fps: f64) -> FrameClock {
        let now = Instant::now();
        FrameClock { frame_s: 1.0 / fps, last: now, next: now, owed_s: 0.0 }
    }

    /// Begins a frame. Returns the time since the last one, s.
    pub fn frame(&mut self) -> f64 {
        let now = Instant::now();
        let passed_s = (now - self.last).as_secs_f64();
        self.owed_s += passed_s.min(MAX_PER_FRAME_S);
        self.last = now;
        passed_s
    }

    /// Whether a step of the simulation is due. If so, the next call counts from the end of that step.
    pub fn step_is_due(&mut self) -> bool {
        let due = self.owed_s >= STEP_S;
        self.owed_s -= if due { STEP_S } else { 0.0 };
        due
    }

    /// Sleeps until the next frame. It does not make up for late frames.
    pub fn sleep(&mut self) {
        self.next += Duration::from_secs_f64(self.frame_s);
        let now = Instant::now();
        match self.next.checked_duration_since(now) {
            Some(left) => std::thread::sleep(left),
            None => self.next = now,
        }
    }
}
