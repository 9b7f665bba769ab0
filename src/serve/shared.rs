//! What the threads of a server share.

use std::sync::atomic::AtomicBool;
use std::sync::{Mutex, MutexGuard, PoisonError};

use super::co_driver::CoDriver;
use super::journal::Journal;
use super::options::ServerOptions;
use super::recording::Recorder;
use super::seat::Seat;
use super::statistics::Statistics;
use crate::net::connections::Connections;
use crate::observer::StopSignal;
use crate::pilot::Pilot;

/// What the threads of a server share.
pub(super) struct Shared<'a> {
    pub options: &'a ServerOptions,
    pub pilot: Mutex<Pilot>,
    pub seat: Seat,
    pub journal: Journal<'a>,
    pub co_driver: Option<&'a dyn CoDriver>,
    pub recorder: Option<Recorder>,
    pub recording_failed: AtomicBool,
    pub stop: &'a StopSignal,
    pub connections: Connections,
    pub statistics: Mutex<Statistics>,
}

impl Shared<'_> {
    /// The statistics, locked.
    pub fn statistics(&self) -> MutexGuard<'_, Statistics> {
        self.statistics.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
