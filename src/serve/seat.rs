//! The seat: which connection is driven. One at a time has it.

use std::net::{Shutdown, TcpStream};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// A connection that is silent for longer can lose the seat.
pub const SILENCE: Duration = Duration::from_secs(1);

/// The seat, empty or with its holder.
#[derive(Debug, Default)]
pub struct Seat(Mutex<Option<Holder>>);

#[derive(Debug)]
struct Holder {
    id: u64,
    heard: Instant,
    stream: Arc<TcpStream>,
}

/// The answer to a claim.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Claim {
    /// The connection had the seat already.
    Kept,
    /// The connection has the seat from now on.
    Taken,
    /// Another connection has it.
    Refused,
}

impl Seat {
    /// Whether a claim of `id` would succeed at `now`.
    pub fn is_open_to(&self, id: u64, now: Instant) -> bool {
        self.lock().as_ref().is_none_or(|holder| holder.admits(id, now))
    }

    /// Claims the seat at `now` for connection `id`, which has just sent a complete state of its car. A holder that was silent
    /// for more than [`SILENCE`] loses the seat, and this closes its connection.
    pub fn claim(&self, id: u64, stream: &Arc<TcpStream>, now: Instant) -> Claim {
        let mut seat = self.lock();
        match &mut *seat {
            Some(holder) if holder.id == id => {
                holder.heard = now;
                Claim::Kept
            }
            Some(holder) if !holder.admits(id, now) => Claim::Refused,
            other => {
                if let Some(holder) = other {
                    // It may be closed already.
                    let _ = holder.stream.shutdown(Shutdown::Both);
                }
                *other = Some(Holder { id, heard: now, stream: stream.clone() });
                Claim::Taken
            }
        }
    }

    /// Whether `id` has the seat. If so, this counts as a sign of life at `now`.
    pub fn is_held_by(&self, id: u64, now: Instant) -> bool {
        match &mut *self.lock() {
            Some(holder) if holder.id == id => {
                holder.heard = now;
                true
            }
            _ => false,
        }
    }

    /// Gives the seat up, if `id` has it.
    pub fn leave(&self, id: u64) {
        let mut seat = self.lock();
        if seat.as_ref().is_some_and(|holder| holder.id == id) {
            *seat = None;
        }
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Option<Holder>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Holder {
    fn admits(&self, id: u64, now: Instant) -> bool {
        self.id == id || now.duration_since(self.heard) > SILENCE
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Read;
    use std::net::TcpListener;

    #[test]
    fn only_a_silent_holder_loses_the_seat_and_its_connection() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let mut client = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        let first = Arc::new(listener.accept().unwrap().0);
        let second = Arc::new(TcpStream::connect(listener.local_addr().unwrap()).unwrap());
        let (seat, now) = (Seat::default(), Instant::now());
        assert!(seat.is_open_to(2, now));
        assert_eq!(seat.claim(1, &first, now), Claim::Taken);
        assert_eq!(seat.claim(1, &first, now + SILENCE), Claim::Kept);
        assert!(!seat.is_open_to(2, now + 2 * SILENCE));
        assert_eq!(seat.claim(2, &second, now + 2 * SILENCE), Claim::Refused);
        let later = now + 2 * SILENCE + Duration::from_millis(1);
        assert_eq!(seat.claim(2, &second, later), Claim::Taken);
        assert_eq!(client.read(&mut [0; 8]).unwrap(), 0, "the first connection is closed");
        assert!(!seat.is_held_by(1, later) && seat.is_held_by(2, later));
        seat.leave(1);
        assert!(seat.is_held_by(2, later));
        seat.leave(2);
        assert_eq!(seat.claim(3, &first, later), Claim::Taken);
    }
}
