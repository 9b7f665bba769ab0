//! What is told to the person at the keyboard: what happened, what is wrong, and what to do about it.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use serde::Serialize;

use super::server::ServeEvent;
use crate::observer::Observer;
use crate::{Error, Result};

/// Each event may be reported once in this time on average.
const INTERVAL: Duration = Duration::from_secs(5);
/// Reports of one event that may come in a row before that.
const BURST: u32 = 5;

/// Something that is reported. Each has its own sentence with the remedy, and is repeated only now and then.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Event {
    /// A client connected.
    Connected,
    /// A client left.
    Disconnected,
    /// A client drives from now on.
    Drives,
    /// Nobody has connected.
    NobodyConnects,
    /// A request was refused.
    Refused,
    /// More connections than are kept.
    TooManyConnections,
    /// A client was too slow.
    TooSlow,
    /// Bytes that are no WebSocket frames, or frames that are too large.
    BrokenFrames,
    /// A message that is no Socket.IO.
    NotSocketIo,
    /// The browser version's protocol.
    PlainJson,
    /// An event with broken JSON.
    BrokenEvent,
    /// Connected, but no telemetry.
    NoTelemetry,
    /// Telemetry of the driven car stopped.
    Stale,
    /// Telemetry of a car that is not driven stopped.
    Silent,
    /// Telemetry without a picture.
    NoImage,
    /// Telemetry without a speed.
    NoSpeed,
    /// A picture that cannot be read.
    UnreadableImage,
    /// Another client drives.
    SeatTaken,
    /// Numbers with another decimal mark than a point.
    DecimalMark,
    /// A simulator of the second term.
    SecondTerm,
    /// A person drives.
    Override,
    /// The car ignores the throttle.
    ThrottleIgnored,
    /// A row could not be recorded in time.
    RecordingLags,
    /// A namespace other than `/`.
    Namespace,
    /// This program failed.
    Fault,
}

impl Event {
    /// What it means and what to do, if anything.
    fn remedy(self) -> Option<&'static str> {
        Some(match self {
            Event::Connected | Event::Disconnected | Event::Drives | Event::Refused => return None,
            Event::NobodyConnects => {
                "start the simulator on this machine and choose a track in AUTONOMOUS MODE; it connects to port 4567 of \
                 127.0.0.1 by itself. For a simulator on another machine or in a container give --host 0.0.0.0"
            }
            Event::TooManyConnections => "the oldest that does not drive is closed",
            Event::TooSlow => "closed; whoever connects has to send telemetry",
            Event::BrokenFrames => "closed; is this a WebSocket client, and is an image below 700 KB?",
            Event::NotSocketIo => "a Socket.IO client is expected, such as Udacity's simulator",
            Event::PlainJson => {
                "that is the protocol of the browser version of the simulator; use the desktop build, version 2 of 2/07/17 \
                 or later"
            }
            Event::BrokenEvent => {
                "expected is 42[\"telemetry\",{\"steering_angle\":…,\"throttle\":…,\"speed\":…,\"image\":…}]"
            }
            Event::NoTelemetry => {
                "choose AUTONOMOUS MODE (not TRAINING MODE); in the simulator's window no key may be held; builds before \
                 version 2 of 2/07/17 speak another protocol"
            }
            Event::Stale => {
                "the throttle is cut and telemetry asked for; is the simulator's window minimised, in a menu, or its machine \
                 overloaded?"
            }
            Event::Silent => {
                "it is asked for; is the simulator's window minimised, in a menu, or its machine overloaded?"
            }
            Event::NoImage => "the throttle is cut; use a simulator with a front camera",
            Event::NoSpeed => "the throttle is cut; the field `speed` in mph is needed to hold a speed",
            Event::UnreadableImage => {
                "the throttle is cut; a JPEG or PNG of at most 1920x1920 pixels in base64 is expected"
            }
            Event::SeatTaken => "it waits until that one leaves or is silent for more than 1 s",
            Event::DecimalMark => "commands are written in the same way, no change of the language is needed",
            Event::SecondTerm => "it gets numbers instead of strings",
            Event::Override => "release W and S to let the model drive",
            Event::ThrottleIgnored => {
                "is this the car's camera view with no key held? Other programs on port 4567 can answer in between: close them"
            }
            Event::RecordingLags => "the disk is too slow; frames are left out of the recording",
            Event::Fault => "please report it with what was sent",
            Event::Namespace => "connect without a namespace",
        })
    }
}

/// Whoever is told, and the error with which it ended that.
struct Observed<'a> {
    observer: &'a mut (dyn Observer<ServeEvent> + Send),
    error: Option<Error>,
}

/// The log.
pub struct Journal<'a> {
    observer: Mutex<Observed<'a>>,
    check: bool,
    entries: Mutex<BTreeMap<Event, Entry>>,
}

#[derive(Debug, Default)]
struct Entry {
    count: u64,
    /// Not shown since the last that was.
    silent: u64,
    /// When the reports shown so far are used up.
    used_until: Option<Instant>,
}

impl Entry {
    /// Whether one more is shown at `now`.
    fn admit(&mut self, now: Instant) -> bool {
        self.count += 1;
        let used_until = self.used_until.map_or(now, |until| until.max(now)) + INTERVAL;
        let shown = used_until <= now + BURST * INTERVAL;
        if shown {
            self.used_until = Some(used_until);
        } else {
            self.silent += 1;
        }
        shown
    }
}

impl<'a> Journal<'a> {
    /// A log that `observer` is told; with `check` every step and message as well.
    pub fn new(observer: &'a mut (dyn Observer<ServeEvent> + Send), check: bool) -> Journal<'a> {
        Journal { observer: Mutex::new(Observed { observer, error: None }), check, entries: Mutex::default() }
    }

    fn tell(&self, event: ServeEvent) {
        let mut observed = self.observer.lock().unwrap_or_else(PoisonError::into_inner);
        if observed.error.is_none() {
            observed.error = observed.observer.observe(event).err();
        }
    }

    /// Tells how it goes.
    pub fn status(&self, text: String) {
        self.tell(ServeEvent::Status(text));
    }

    /// Whether the observer returned an error, and is told nothing more.
    pub fn failed(&self) -> bool {
        self.observer.lock().unwrap_or_else(PoisonError::into_inner).error.is_some()
    }

    /// Ends the log.
    ///
    /// # Errors
    ///
    /// The first that the observer returned.
    pub fn into_result(self) -> Result<()> {
        self.observer.into_inner().unwrap_or_else(PoisonError::into_inner).error.map_or(Ok(()), Err)
    }

    /// Reports `event`: `detail`, and the remedy. Not more often than every few seconds for each kind of event.
    pub fn report(&self, event: Event, detail: std::fmt::Arguments) {
        let now = Instant::now();
        let silent = {
            let mut entries = self.entries.lock().unwrap_or_else(PoisonError::into_inner);
            let entry = entries.entry(event).or_default();
            if !entry.admit(now) {
                return;
            }
            std::mem::take(&mut entry.silent)
        };
        let more = match silent {
            0 => String::new(),
            more => format!(" ({more} more like this before)"),
        };
        match event.remedy() {
            Some(remedy) => self.tell(ServeEvent::Line(format!("{detail}: {remedy}{more}"))),
            None => self.tell(ServeEvent::Line(format!("{detail}{more}"))),
        }
    }

    /// Shows a step of a connection, if every step is wanted.
    pub fn step(&self, text: std::fmt::Arguments) {
        if self.check {
            self.tell(ServeEvent::Line(text.to_string()));
        }
    }

    /// Whether every step is wanted.
    pub fn checks(&self) -> bool {
        self.check
    }

    /// How often each event happened.
    pub fn counts(&self) -> BTreeMap<Event, u64> {
        let entries = self.entries.lock().unwrap_or_else(PoisonError::into_inner);
        entries.iter().map(|(event, entry)| (*event, entry.count)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_of_one_event_is_a_few_lines_and_hides_no_other() {
        let mut lines = Vec::new();
        let mut observer = |event| {
            match event {
                ServeEvent::Line(text) => lines.push(text),
                ServeEvent::Status(_) => {}
            }
            Ok(())
        };
        let journal = Journal::new(&mut observer, false);
        for k in 0..1000 {
            journal.report(Event::UnreadableImage, format_args!("picture {k}"));
        }
        journal.report(Event::NoSpeed, format_args!("telemetry without a speed"));
        journal.step(format_args!("not shown"));
        assert_eq!(journal.counts()[&Event::UnreadableImage], 1000);
        assert!(!journal.failed() && journal.into_result().is_ok());
        assert_eq!(lines.len(), BURST as usize + 1, "{lines:?}");
        let (mut entry, now) = (Entry::default(), Instant::now());
        let shown = (0..6000).filter(|ms| entry.admit(now + Duration::from_millis(*ms * 10))).count();
        assert_eq!(shown as u32, BURST + 11, "in a minute");
        assert!(lines[0].starts_with("picture 0: the throttle is cut"), "{lines:?}");
    }

    #[test]
    fn an_observer_that_fails_is_told_nothing_more_and_its_error_is_kept() {
        let mut told = 0;
        let mut observer = |_| {
            told += 1;
            Err(Error::Interrupted)
        };
        let journal = Journal::new(&mut observer, true);
        (0..3).for_each(|k| journal.step(format_args!("step {k}")));
        assert!(journal.failed() && matches!(journal.into_result(), Err(Error::Interrupted)));
        assert_eq!(told, 1);
    }
}
