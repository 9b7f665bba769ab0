//! The connections there are: never more than a fixed number.

use std::net::{Shutdown, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// How far a connection has come; who has come less far makes room first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub(super) enum Stage {
    /// Has sent no complete request.
    Opening = 0,
    /// Is a WebSocket.
    Open = 1,
    /// Has shown complete telemetry.
    Trusted = 2,
}

/// A connection as others see it.
#[derive(Debug)]
pub(super) struct Peer {
    pub id: u64,
    pub stream: Arc<TcpStream>,
    stage: AtomicU8,
    closing: AtomicBool,
}

impl Peer {
    pub fn stage(&self) -> Stage {
        match self.stage.load(Ordering::Relaxed) {
            0 => Stage::Opening,
            1 => Stage::Open,
            _ => Stage::Trusted,
        }
    }

    /// Whether it has to make room.
    pub fn is_closing(&self) -> bool {
        self.closing.load(Ordering::Relaxed)
    }

    pub fn set_stage(&self, stage: Stage) {
        self.stage.store(stage as u8, Ordering::Relaxed);
    }
}

/// All connections.
#[derive(Debug)]
pub(super) struct Registry {
    most: usize,
    peers: Mutex<Vec<Arc<Peer>>>,
    left: Condvar,
}

impl Registry {
    /// For at most `most` connections.
    pub fn new(most: usize) -> Registry {
        Registry { most, peers: Mutex::default(), left: Condvar::new() }
    }

    /// Adds a connection. If there are too many, the oldest of those that have come least far is closed and waited for, up
    /// to `patience`; `None` if there is no room then. Also says whether one had to be closed.
    pub fn add(&self, id: u64, stream: &Arc<TcpStream>, patience: Duration) -> (Option<Arc<Peer>>, bool) {
        let deadline = Instant::now() + patience;
        let mut peers = self.peers.lock().unwrap_or_else(PoisonError::into_inner);
        let full = peers.len() >= self.most;
        if full {
            // The first of equals is the oldest.
            let Some(victim) =
                peers.iter().filter(|peer| peer.stage() < Stage::Trusted).min_by_key(|peer| peer.stage())
            else {
                return (None, false);
            };
            victim.closing.store(true, Ordering::Relaxed);
            // It may be closed already.
            let _ = victim.stream.shutdown(Shutdown::Both);
            while peers.len() >= self.most {
                let left = deadline.saturating_duration_since(Instant::now());
                if left.is_zero() {
                    return (None, true);
                }
                peers = self.left.wait_timeout(peers, left).unwrap_or_else(PoisonError::into_inner).0;
            }
        }
        let peer = Arc::new(Peer {
            id,
            stream: stream.clone(),
            stage: AtomicU8::new(Stage::Opening as u8),
            closing: AtomicBool::new(false),
        });
        peers.push(peer.clone());
        (Some(peer), full)
    }

    /// Removes a connection that has ended.
    pub fn remove(&self, id: u64) {
        let mut peers = self.peers.lock().unwrap_or_else(PoisonError::into_inner);
        peers.retain(|peer| peer.id != id);
        self.left.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Read;
    use std::net::TcpListener;

    #[test]
    fn the_oldest_that_has_come_least_far_makes_room() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let stream = || Arc::new(TcpStream::connect(listener.local_addr().unwrap()).unwrap());
        let registry = Registry::new(3);
        let patience = Duration::from_millis(1);
        let peers: Vec<_> = (0..3).map(|id| registry.add(id, &stream(), patience).0.unwrap()).collect();
        peers[0].set_stage(Stage::Trusted);
        peers[1].set_stage(Stage::Open);
        // Nobody leaves in time: no room, but 2 was told to.
        let (none, closed) = registry.add(3, &stream(), patience);
        assert!(none.is_none() && closed);
        assert!(peers[2].is_closing() && !peers[1].is_closing());
        assert_eq!((&*peers[2].stream).read(&mut [0]).unwrap(), 0);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                std::thread::sleep(Duration::from_millis(20));
                registry.remove(2);
            });
            assert!(registry.add(4, &stream(), Duration::from_secs(60)).0.is_some());
        });
        assert_eq!(registry.peers.lock().unwrap().len(), 3);
        for peer in &peers {
            peer.set_stage(Stage::Trusted);
        }
        registry.remove(4);
        let last = registry.add(5, &stream(), patience).0.unwrap();
        last.set_stage(Stage::Trusted);
        assert!(registry.add(6, &stream(), patience).0.is_none(), "who has driven is not closed for a newcomer");
    }
}
