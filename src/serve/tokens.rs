//! Keeping one question in flight.
//!
//! The simulator sends one telemetry for each event it receives, and one when it connects. So whoever answers each telemetry
//! keeps as many of them circulating as there are, and several mean that the same picture is answered several times, the
//! later ones late. Surplus telemetry is dropped here, until one circulates; the last is always answered, because the car
//! would otherwise wait for ever.

use std::time::{Duration, Instant};

/// How long telemetry is kept unanswered when another is expected.
pub const PATIENCE: Duration = Duration::from_millis(50);

/// Telemetry that a client owes us.
#[derive(Clone, Debug)]
pub struct Tokens {
    expected: u32,
    held_since: Option<Instant>,
}

impl Tokens {
    /// For a client that sends `expected` telemetries of its own accord: the simulator sends 1.
    pub fn new(expected: u32) -> Tokens {
        Tokens { expected, held_since: None }
    }

    /// An event was sent, which the client will answer.
    pub fn sent(&mut self) {
        self.expected += 1;
        self.held_since = None;
    }

    /// Telemetry came at `now`.
    pub fn received(&mut self, now: Instant) {
        self.expected = self.expected.saturating_sub(1);
        self.held_since.get_or_insert(now);
    }

    /// Whether the newest telemetry should be answered now: nothing better is on its way, or it did not come in time. Clients
    /// may lose telemetry, so what is missing then is no longer expected.
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
