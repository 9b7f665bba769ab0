//! How long work tells what happens, and how it is stopped.
//!
//! Every function that works for long takes one [`Observer`] of its room's events: [`TrainingEvent`], [`DriveEvent`],
//! [`JobEvent`], [`ServeEvent`], [`ClientEvent`], or plain [`Progress`]. A closure from an event to `Result<()>` is an
//! observer, and an error that the observer returns ends the work.
//!
//! A [`StopSignal`] asks from outside, for instance from the handler of Ctrl-C. Work that saves something to go on with, or
//! that waits for others, takes the signal itself: training, the main job, the server, a manual drive. All other work is
//! stopped by its observer, which returns the result of [`StopSignal::check`].
//!
//! ```
//! use steersman::observer::{Observer, Progress, StopSignal};
//! use steersman::{Error, Result};
//!
//! fn work(observer: &mut dyn Observer<Progress>) -> Result<()> {
//!     (1..=4).try_for_each(|k| observer.observe(Progress(k as f64 / 4.0)))
//! }
//!
//! let (stop, mut seen) = (StopSignal::default(), Vec::new());
//! let ended = work(&mut |Progress(share)| {
//!     seen.push(share);
//!     if share == 0.5 {
//!         stop.request();
//!     }
//!     stop.check()
//! });
//! assert!(matches!(ended, Err(Error::Interrupted)) && seen == [0.25, 0.5]);
//! ```
//!
//! [`TrainingEvent`]: crate::training::TrainingEvent
//! [`DriveEvent`]: crate::simulator::DriveEvent
//! [`JobEvent`]: crate::main_job::job::JobEvent
//! [`ServeEvent`]: crate::serve::ServeEvent
//! [`ClientEvent`]: crate::simulator_client::ClientEvent

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use crate::{Error, Result};

/// Is told the events `E` of a piece of work while it goes on.
pub trait Observer<E> {
    /// Takes notice of `event`.
    ///
    /// # Errors
    ///
    /// An error ends the work and becomes its result; [`Error::Interrupted`] is for whoever only wants it to stop.
    fn observe(&mut self, event: E) -> Result<()>;
}

impl<E, F: FnMut(E) -> Result<()>> Observer<E> for F {
    fn observe(&mut self, event: E) -> Result<()> {
        self(event)
    }
}

/// An observer that ignores every event.
#[derive(Clone, Copy, Debug, Default)]
pub struct Unobserved;

impl<E> Observer<E> for Unobserved {
    fn observe(&mut self, _: E) -> Result<()> {
        Ok(())
    }
}

/// The event that this share of the work is done, 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress(pub f64);

/// A request to stop. All clones are the same signal; once requested it stays requested.
#[derive(Clone, Debug, Default)]
pub struct StopSignal(Arc<AtomicBool>);

impl StopSignal {
    /// Asks to stop; `true` if that was asked before.
    pub fn request(&self) -> bool {
        self.0.swap(true, Ordering::Relaxed)
    }

    /// Whether somebody has asked to stop.
    pub fn requested(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }

    /// For an observer that stops its work.
    ///
    /// # Errors
    ///
    /// [`Error::Interrupted`] if somebody has asked to stop.
    pub fn check(&self) -> Result<()> {
        if self.requested() { Err(Error::Interrupted) } else { Ok(()) }
    }
}

/// Counts items that several threads finish, and tells an observer the share.
pub struct Tally<'a> {
    total: usize,
    state: Mutex<(usize, &'a mut (dyn Observer<Progress> + Send))>,
}

impl<'a> Tally<'a> {
    /// Of `total` items none is done.
    pub fn new(total: usize, observer: &'a mut (dyn Observer<Progress> + Send)) -> Tally<'a> {
        Tally { total, state: Mutex::new((0, observer)) }
    }

    /// Counts `items` more.
    ///
    /// # Errors
    ///
    /// The observer's own.
    pub fn add(&self, items: usize) -> Result<()> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let (done, observer) = &mut *state;
        *done += items;
        observer.observe(Progress(*done as f64 / self.total as f64))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clone_of_a_stop_signal_is_the_same_signal() {
        let stop = StopSignal::default();
        let clone = stop.clone();
        assert!(!clone.requested() && clone.check().is_ok());
        assert!(!stop.request() && clone.requested() && clone.request());
        assert!(matches!(clone.check(), Err(Error::Interrupted)));
    }

    #[test]
    fn a_tally_tells_the_share_of_its_items() {
        let mut seen = Vec::new();
        let mut observer = |Progress(share)| {
            seen.push(share);
            Ok(())
        };
        let tally = Tally::new(4, &mut observer);
        assert!(tally.add(1).is_ok() && tally.add(3).is_ok());
        assert_eq!(seen, [0.25, 1.0]);
    }
}
