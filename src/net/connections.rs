//! The open connections of a server: never more than a fixed number.

use std::net::{Shutdown, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// What a connection has shown of itself. Where there are too many, the lowest rank makes room first, the highest never.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub(crate) enum Rank {
    /// It has sent no complete request.
    Unknown = 0,
    /// It is a WebSocket.
    WebSocket = 1,
    /// It is in use: the server has seen what only a real client sends.
    InUse = 2,
}

/// A connection as the other threads see it.
#[derive(Debug)]
pub(crate) struct Peer {
    /// Number of the connection, from 1.
    pub id: u64,
    /// Its stream.
    pub stream: Arc<TcpStream>,
    rank: AtomicU8,
    must_close: AtomicBool,
}

impl Peer {
    /// Its rank.
    pub fn rank(&self) -> Rank {
        match self.rank.load(Ordering::Relaxed) {
            0 => Rank::Unknown,
            1 => Rank::WebSocket,
            _ => Rank::InUse,
        }
    }

    /// Whether it was told to make room.
    pub fn must_close(&self) -> bool {
        self.must_close.load(Ordering::Relaxed)
    }

    /// Changes its rank.
    pub fn set_rank(&self, rank: Rank) {
        self.rank.store(rank as u8, Ordering::Relaxed);
    }
}

/// All connections of a server.
#[derive(Debug)]
pub(crate) struct Connections {
    max: usize,
    peers: Mutex<Vec<Arc<Peer>>>,
    one_left: Condvar,
}

impl Connections {
    /// For at most `max` connections.
    pub fn new(max: usize) -> Connections {
        Connections { max, peers: Mutex::default(), one_left: Condvar::new() }
    }

    fn lock(&self) -> MutexGuard<'_, Vec<Arc<Peer>>> {
        self.peers.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a connection. If there are too many, this closes the oldest of the lowest rank and waits up to `patience` for
    /// its end. Returns the new connection, or `None` if there is no room, and whether another was closed.
    pub fn add(&self, id: u64, stream: &Arc<TcpStream>, patience: Duration) -> (Option<Arc<Peer>>, bool) {
        let deadline = Instant::now() + patience;
        let mut peers = self.lock();
        let full = peers.len() >= self.max;
        if full {
            // The first of equals is the oldest.
            let Some(victim) = peers.iter().filter(|peer| peer.rank() < Rank::InUse).min_by_key(|peer| peer.rank())
            else {
                return (None, false);
            };
            victim.must_close.store(true, Ordering::Relaxed);
            // It may be closed already.
            let _ = victim.stream.shutdown(Shutdown::Both);
            while peers.len() >= self.max {
                let left = deadline.saturating_duration_since(Instant::now());
                if left.is_zero() {
                    return (None, true);
                }
                peers = self.one_left.wait_timeout(peers, left).unwrap_or_else(PoisonError::into_inner).0;
            }
        }
        let peer = Arc::new(Peer {
            id,
            stream: stream.clone(),
            rank: AtomicU8::new(Rank::Unknown as u8),
            must_close: AtomicBool::new(false),
        });
        peers.push(peer.clone());
        (Some(peer), full)
    }

    /// Removes a connection that has ended.
    pub fn remove(&self, id: u64) {
        self.lock().retain(|peer| peer.id != id);
        self.one_left.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Read;
    use std::net::TcpListener;

    #[test]
    fn the_oldest_of_the_lowest_rank_makes_room() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let stream = || Arc::new(TcpStream::connect(listener.local_addr().unwrap()).unwrap());
        let connections = Connections::new(3);
        let patience = Duration::from_millis(1);
        let peers: Vec<_> = (0..3).map(|id| connections.add(id, &stream(), patience).0.unwrap()).collect();
        peers[0].set_rank(Rank::InUse);
        peers[1].set_rank(Rank::WebSocket);
        // Nobody leaves in time: there is no room, but 2 was told to leave.
        let (none, closed) = connections.add(3, &stream(), patience);
        assert!(none.is_none() && closed);
        assert!(peers[2].must_close() && !peers[1].must_close());
        assert_eq!((&*peers[2].stream).read(&mut [0]).unwrap(), 0);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                std::thread::sleep(Duration::from_millis(20));
                connections.remove(2);
            });
            assert!(connections.add(4, &stream(), Duration::from_secs(60)).0.is_some());
        });
        assert_eq!(connections.peers.lock().unwrap().len(), 3);
        for peer in &peers {
            peer.set_rank(Rank::InUse);
        }
        connections.remove(4);
        let last = connections.add(5, &stream(), patience).0.unwrap();
        last.set_rank(Rank::InUse);
        assert!(connections.add(6, &stream(), patience).0.is_none(), "a connection in use stays");
    }
}
