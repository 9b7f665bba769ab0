//! What the drive and the connections share.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::Instant;

use serde::Serialize;
use tungstenite::Bytes;

use super::controls::Wheel;
use super::messages::{Hello, Request, State, Trace, frame};

/// Simulated time between points of the way on the map, s.
const TRACE_S: f64 = 0.2;
/// Points kept of a way: a quarter of an hour. Of a longer one the older half is forgotten.
const MOST_TRACES: usize = 4500;

/// The newest frame, and the way up to it.
#[derive(Debug, Default)]
struct Newest {
    number: u64,
    message: Bytes,
    way: u64,
    traces: Vec<Trace>,
    /// Time of the last trace, s.
    traced_s: f64,
}

/// See the module.
#[derive(Debug)]
pub(super) struct Hub {
    hello: Hello,
    /// Present where a person may drive.
    wheel: Option<Mutex<Wheel>>,
    newest: Mutex<Newest>,
    viewers: AtomicUsize,
    over: OnceLock<String>,
}

/// The first message to a page.
#[derive(Serialize)]
struct Opening<'a> {
    id: u64,
    #[serde(flatten)]
    hello: &'a Hello,
    trail: &'a [Trace],
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Whatever a thread left behind that panicked, it is a number or a picture, and the next overwrites it.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Hub {
    pub fn new(hello: Hello, by_hand: bool) -> Hub {
        Hub {
            hello,
            wheel: by_hand.then(Mutex::default),
            newest: Mutex::default(),
            viewers: AtomicUsize::new(0),
            over: OnceLock::new(),
        }
    }

    pub fn viewers(&self) -> usize {
        self.viewers.load(Ordering::Relaxed)
    }

    /// Counts a viewer until what is returned is dropped.
    pub fn enter(&self, id: u64) -> Viewer<'_> {
        self.viewers.fetch_add(1, Ordering::Relaxed);
        Viewer { hub: self, id }
    }

    /// The first message to connection `id`.
    pub fn opening(&self, id: u64) -> String {
        let newest = lock(&self.newest);
        let opening = Opening { id, hello: &self.hello, trail: &newest.traces };
        serde_json::to_string(&opening).expect("numbers, words and lists can be written as JSON")
    }

    /// Makes a frame the newest. Pictures are asked for only if somebody looks on.
    pub fn publish(&self, state: &State, camera: &[u8], saliency: &[u8]) {
        let message = Bytes::from(frame(state, camera, saliency));
        let mut newest = lock(&self.newest);
        newest.number += 1;
        newest.message = message;
    }

    /// Draws the way on, whether or not somebody looks on.
    pub fn trace(&self, state: &State) {
        let mut newest = lock(&self.newest);
        // Time that runs backwards is another drive's.
        if newest.way != state.way || state.time_s < newest.traced_s || newest.traces.is_empty() {
            newest.traces.clear();
            (newest.way, newest.traced_s) = (state.way, f64::NEG_INFINITY);
        }
        // Times are multiples of a step, but for rounding.
        if state.time_s - newest.traced_s > TRACE_S - 1e-6 {
            if newest.traces.len() >= MOST_TRACES {
                newest.traces.drain(..MOST_TRACES / 2);
            }
            newest.traced_s = state.time_s;
            newest.traces.push(Trace(state.x as f32, state.y as f32, state.cte_m as f32));
        }
    }

    /// The newest frame and its number, if it is newer than frame `seen`.
    pub fn newer_than(&self, seen: u64) -> Option<(u64, Bytes)> {
        let newest = lock(&self.newest);
        (newest.number > seen).then(|| (newest.number, newest.message.clone()))
    }

    /// Takes a request of connection `id`.
    pub fn request(&self, id: u64, request: Request) {
        if let Some(wheel) = &self.wheel {
            lock(wheel).take(id, request, Instant::now());
        }
    }

    /// The wheel, where a person may drive.
    pub fn wheel(&self) -> Option<MutexGuard<'_, Wheel>> {
        self.wheel.as_ref().map(lock)
    }

    /// Ends everything, with these last words; the first count.
    pub fn end(&self, words: &str) {
        self.over.get_or_init(|| words.to_string());
    }

    /// The last words, when they are said.
    pub fn over(&self) -> Option<&str> {
        self.over.get().map(String::as_str)
    }
}

/// Somebody who looks on.
pub(super) struct Viewer<'a> {
    hub: &'a Hub,
    id: u64,
}

impl Drop for Viewer<'_> {
    fn drop(&mut self) {
        self.hub.viewers.fetch_sub(1, Ordering::Relaxed);
        if let Some(mut wheel) = self.hub.wheel() {
            wheel.leave(self.id);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_late_viewer_sees_the_way_so_far_and_a_new_way_begins_clean() {
        let hub = Hub::new(Hello::default(), false);
        let state = |way, time_s| State { way, time_s, x: time_s, ..State::default() };
        for k in 0..200 {
            hub.trace(&state(0, f64::from(k) * 0.05));
        }
        let trail = |hub: &Hub| serde_json::from_str::<serde_json::Value>(&hub.opening(7)).unwrap()["trail"].clone();
        assert_eq!(trail(&hub).as_array().unwrap().len(), 50);
        hub.trace(&state(1, 3.0));
        assert_eq!(trail(&hub), serde_json::json!([[3.0, 0.0, 0.0]]));
        for k in 0..20_000 {
            hub.trace(&state(2, f64::from(k)));
        }
        let all = trail(&hub);
        let all = all.as_array().unwrap();
        assert!((MOST_TRACES / 2..=MOST_TRACES).contains(&all.len()), "{}", all.len());
        let next = |k: usize| all[k + 1][0].as_f64().unwrap() - all[k][0].as_f64().unwrap();
        assert!((0..all.len() - 1).all(|k| next(k) == next(0)), "no gaps: pages do not draw across them");
        hub.trace(&state(2, 1.0));
        assert_eq!(trail(&hub).as_array().unwrap().len(), 1, "another drive");
    }

    #[test]
    fn viewers_get_the_newest_frame_once_and_are_counted() {
        let hub = Hub::new(Hello::default(), true);
        assert!(hub.newer_than(0).is_none());
        for _ in 0..3 {
            hub.publish(&State::default(), b"a", b"b");
        }
        let (number, _) = hub.newer_than(0).unwrap();
        assert_eq!(number, 3);
        assert!(hub.newer_than(3).is_none());
        let viewer = hub.enter(4);
        hub.request(4, Request::Take);
        assert_eq!((hub.viewers(), hub.wheel().unwrap().holder(Instant::now())), (1, Some(4)));
        drop(viewer);
        assert_eq!((hub.viewers(), hub.wheel().unwrap().holder(Instant::now())), (0, None));
    }
}
