//! Keeps one telemetry in flight.
//!
//! The simulator sends one telemetry when it connects, and one for each event it receives. A server that answers each
//! telemetry keeps all of them circulating; with several, it answers the same picture several times, and the later answers are
//! late. This module drops surplus telemetry until one circulates. It always answers the last one, because the car would
//! otherwise wait for ever.

use std::time::{Duration, Instant};

/// Longest time for which telemetry stays unanswered while another is expected.
pub const PATIENCE: Duration = Duration::from_millis(50);

/// Counts the telemetries that a client still has to send.
#[derive(Clone, Debug)]
pub struct Tokens {
    expected: u32,
    held_since: Option<Instant>,
}

impl Tokens {
    /// For a client that sends `expected` telemetries without being asked: the simulator sends 1.
    pub fn new(expected: u32) -> Tokens {
        Tokens { expected, held_since: None }
    }

    /// Counts an event that was sent: the client will answer it.
    pub fn sent(&mut self) {
        self.expected += 1;
        self.held_since = None;
    }

    /// Counts telemetry that arrived at `now`.
    pub fn received(&mut self, now: Instant) {
        self.expected = self.expected.saturating_sub(1);
        self.held_since.get_or_insert(now);
    }

    /// Whether to answer the newest telemetry now: no other is expected, or the expected one did not arrive in time. A client
    /// may lose telemetry, so after that time nothing more is expected.
    pub fn should_answer(&mut self, now: Instant) -> bool {
        match self.held_since {
            Some(_) if self.expected == 0 => true,
            Some(since) if now.duration_since(since) >= PATIENCE => {
                self.expected = 0;
                true
            }
            _ => false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FRAME: Duration = Duration::from_millis(16);

    #[test]
    fn one_question_in_flight_is_answered_at_once() {
        let mut tokens = Tokens::new(1);
        let now = Instant::now();
        assert!(!tokens.should_answer(now), "nothing has come");
        for frame in 0..100 {
            let now = now + frame * FRAME;
            tokens.received(now);
            assert!(tokens.should_answer(now));
            tokens.sent();
            assert!(!tokens.should_answer(now + 4 * FRAME), "each telemetry is answered once");
        }
    }

    #[test]
    fn of_three_in_flight_one_remains() {
        // As after drive.py's greeting: one for the connection, one for the open packet, one for the first command.
        let mut tokens = Tokens::new(1);
        tokens.sent();
        tokens.sent();
        let now = Instant::now();
        let mut in_flight = 3;
        let mut answered = 0;
        for frame in 0..20 {
            let now = now + frame * FRAME;
            tokens.received(now);
            in_flight -= 1;
            if tokens.should_answer(now) {
                tokens.sent();
                in_flight += 1;
                answered += 1;
            }
        }
        assert_eq!((in_flight, answered), (1, 18));
    }

    #[test]
    fn the_last_is_answered_even_if_others_were_lost() {
        let mut tokens = Tokens::new(1);
        tokens.sent();
        let now = Instant::now();
        tokens.received(now);
        assert!(!tokens.should_answer(now) && !tokens.should_answer(now + PATIENCE / 2));
        assert!(tokens.should_answer(now + PATIENCE));
        tokens.sent();
        // From now on nothing is missed any more.
        tokens.received(now + 2 * PATIENCE);
        assert!(tokens.should_answer(now + 2 * PATIENCE));
    }

    #[test]
    fn a_client_that_sends_of_its_own_accord_is_answered_each_time() {
        let mut tokens = Tokens::new(0);
        let now = Instant::now();
        for _ in 0..5 {
            tokens.received(now);
        }
        assert!(tokens.should_answer(now));
        tokens.sent();
        tokens.received(now + FRAME);
        assert!(tokens.should_answer(now + FRAME));
    }
}
