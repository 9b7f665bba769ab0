//! What the drive and the connections share: the newest frame, the trail, and the wheel.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::Instant;

use serde::Serialize;
use tungstenite::Bytes;

use super::controls::Wheel;
use super::messages::{Hello, RecentMoment, Request, State, TrailPoint, frame};
use super::playback::Playback;

/// Simulated time between two points of the trail, s.
const POINT_INTERVAL_S: f64 = 0.2;
/// Largest number of points of a trail: a quarter of an hour. Of a longer trail the older half is dropped.
const MAX_POINTS: usize = 4500;

/// Length of what the charts show, simulated s.
const RECENT_S: f64 = 20.0;

/// The newest frame, and the trail up to it.
#[derive(Debug, Default)]
struct Newest {
    number: u64,
    message: Bytes,
    trail_id: u64,
    trail: Vec<TrailPoint>,
    /// Simulated time of the last point, s.
    last_point_s: f64,
    /// The last seconds of the trail.
    recent: VecDeque<RecentMoment>,
}

/// What the drive and the connections share.
#[derive(Debug)]
pub(super) struct Hub {
    hello: Hello,
    /// The wheel, if a person may drive.
    wheel: Option<Mutex<Wheel>>,
    playback: Mutex<Playback>,
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
    trail: &'a [TrailPoint],
    recent: &'a VecDeque<RecentMoment>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // A thread that panicked can leave at most a wrong number or picture, which the next frame overwrites.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Hub {
    pub fn new(hello: Hello, by_hand: bool) -> Hub {
        Hub {
            hello,
            wheel: by_hand.then(Mutex::default),
            playback: Mutex::default(),
            newest: Mutex::default(),
            viewers: AtomicUsize::new(0),
            over: OnceLock::new(),
        }
    }

    pub fn viewers(&self) -> usize {
        self.viewers.load(Ordering::Relaxed)
    }

    /// Counts a viewer until the returned guard is dropped.
    pub fn enter(&self, id: u64) -> Viewer<'_> {
        self.viewers.fetch_add(1, Ordering::Relaxed);
        Viewer { hub: self, id }
    }

    /// The first message to connection `id`.
    pub fn opening(&self, id: u64) -> String {
        let newest = lock(&self.newest);
        let opening = Opening { id, hello: &self.hello, trail: &newest.trail, recent: &newest.recent };
        serde_json::to_string(&opening).expect("numbers, words and lists can be written as JSON")
    }

    /// Makes a frame the newest.
    pub fn publish(&self, state: &State, camera: &[u8], saliency: &[u8]) {
        let message = Bytes::from(frame(state, camera, saliency));
        let mut newest = lock(&self.newest);
        newest.number += 1;
        newest.message = message;
    }

    /// Adds the car's place to the trail.
    pub fn extend_trail(&self, state: &State) {
        let mut newest = lock(&self.newest);
        // Time that goes back begins another drive.
        if newest.trail_id != state.trail_id || state.time_s < newest.last_point_s || newest.trail.is_empty() {
            newest.trail.clear();
            newest.recent.clear();
            (newest.trail_id, newest.last_point_s) = (state.trail_id, f64::NEG_INFINITY);
        }
        let moment = RecentMoment(state.time_s, state.steering as f32, state.expert as f32, state.cte_m as f32);
        newest.recent.push_back(moment);
        while newest.recent.front().is_some_and(|first| first.0 < state.time_s - RECENT_S) {
            newest.recent.pop_front();
        }
        // The tolerance covers rounding: times are multiples of a step.
        if state.time_s - newest.last_point_s > POINT_INTERVAL_S - 1e-6 {
            if newest.trail.len() >= MAX_POINTS {
                newest.trail.drain(..MAX_POINTS / 2);
            }
            newest.last_point_s = state.time_s;
            newest.trail.push(TrailPoint(state.x as f32, state.y as f32, state.cte_m as f32));
        }
    }

    /// The newest frame and its number, if it is newer than frame `seen`.
    pub fn newer_than(&self, seen: u64) -> Option<(u64, Bytes)> {
        let newest = lock(&self.newest);
        (newest.number > seen).then(|| (newest.number, newest.message.clone()))
    }

    /// Handles a request of connection `id`.
    pub fn request(&self, id: u64, request: Request) {
        let mut playback = lock(&self.playback);
        match request {
            Request::Pause => (playback.paused, playback.hurried_trail) = (!playback.paused, None),
            Request::Rate { rate } => playback.set_rate(rate),
            Request::NextRun => {
                playback.hurried_trail = Some(lock(&self.newest).trail_id);
                playback.paused = false;
            }
            request => {
                if let Some(wheel) = &self.wheel {
                    lock(wheel).take(id, request, Instant::now());
                }
            }
        }
    }

    /// Time goes on, and no run is hurried.
    pub fn play(&self) {
        let mut playback = lock(&self.playback);
        (playback.paused, playback.hurried_trail) = (false, None);
    }

    /// How fast a watched drive is to be shown.
    pub fn playback(&self) -> Playback {
        *lock(&self.playback)
    }

    /// The wheel, locked, if a person may drive.
    pub fn wheel(&self) -> Option<MutexGuard<'_, Wheel>> {
        self.wheel.as_ref().map(lock)
    }

    /// Ends the page with these last words. Only the first call counts.
    pub fn end(&self, words: &str) {
        self.over.get_or_init(|| words.to_string());
    }

    /// The last words, if the end has come.
    pub fn over(&self) -> Option<&str> {
        self.over.get().map(String::as_str)
    }
}

/// Counts an open page, and releases its wheel at the end.
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
    fn a_late_viewer_sees_the_trail_so_far_and_a_new_trail_begins_empty() {
        let hub = Hub::new(Hello::default(), false);
        let state = |trail_id, time_s| State { trail_id, time_s, x: time_s, ..State::default() };
        for k in 0..200 {
            hub.extend_trail(&state(0, f64::from(k) * 0.05));
        }
        let trail = |hub: &Hub| serde_json::from_str::<serde_json::Value>(&hub.opening(7)).unwrap()["trail"].clone();
        assert_eq!(trail(&hub).as_array().unwrap().len(), 50);
        hub.extend_trail(&state(0, 25.0));
        let opening: serde_json::Value = serde_json::from_str(&hub.opening(7)).unwrap();
        let recent = opening["recent"].as_array().unwrap();
        assert_eq!((&recent[0][0], &recent.last().unwrap()[0]), (&serde_json::json!(5.0), &serde_json::json!(25.0)));
        hub.extend_trail(&state(1, 3.0));
        assert_eq!(trail(&hub), serde_json::json!([[3.0, 0.0, 0.0]]));
        for k in 0..20_000 {
            hub.extend_trail(&state(2, f64::from(k)));
        }
        let all = trail(&hub);
        let all = all.as_array().unwrap();
        assert!((MAX_POINTS / 2..=MAX_POINTS).contains(&all.len()), "{}", all.len());
        let next = |k: usize| all[k + 1][0].as_f64().unwrap() - all[k][0].as_f64().unwrap();
        assert!((0..all.len() - 1).all(|k| next(k) == next(0)), "no gaps: pages do not draw across them");
        hub.extend_trail(&state(2, 1.0));
        assert_eq!(trail(&hub).as_array().unwrap().len(), 1, "another drive");
    }

    #[test]
    fn every_viewer_can_pause_and_hurry_the_run_that_is_shown() {
        let hub = Hub::new(Hello::default(), false);
        hub.extend_trail(&State { trail_id: 3, ..State::default() });
        hub.request(1, Request::Pause);
        hub.request(2, Request::Rate { rate: 100.0 });
        assert_eq!(hub.playback(), Playback { paused: true, rate: 16.0, hurried_trail: None });
        hub.request(1, Request::NextRun);
        assert_eq!(hub.playback(), Playback { paused: false, rate: 16.0, hurried_trail: Some(3) });
        hub.request(2, Request::Pause);
        assert_eq!(hub.playback(), Playback { paused: true, rate: 16.0, hurried_trail: None });
        hub.play();
        assert!(!hub.playback().paused);
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
