//! Messages for the user: what happened, what is wrong, and what to do about it.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use serde::Serialize;

use super::server_event::ServeEvent;
use crate::observer::Observer;
use crate::text::escaped;
use crate::{Error, Result};

/// Average time between two reports of one kind of incident.
const INTERVAL: Duration = Duration::from_secs(5);
/// Reports of one kind that are shown at once before the limit applies.
const BURST: u32 = 5;

/// A kind of incident. Each has its own sentence with the remedy; a repetition is shown only now and then.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Incident {
    /// A client connected.
    Connected,
    /// A client left.
    Disconnected,
    /// A client gets the seat: it is driven from now on.
    Drives,
    /// No client has connected.
    NobodyConnects,
    /// A request was refused.
    Refused,
    /// There are more connections than the server keeps.
    TooManyConnections,
    /// A client let a time limit pass.
    TooSlow,
    /// Bytes that are no WebSocket frame, or a frame that is too large.
    BrokenFrames,
    /// A message that is no packet of Socket.IO.
    NotSocketIo,
    /// The protocol of the browser version of the simulator.
    PlainJson,
    /// An event with broken JSON.
    BrokenEvent,
    /// A client is connected and sends no telemetry.
    NoTelemetry,
    /// The driven client stopped sending telemetry.
    Stale,
    /// A client that is not driven stopped sending telemetry.
    Silent,
    /// Telemetry without a picture.
    NoImage,
    /// Telemetry without a speed.
    NoSpeed,
    /// A picture that cannot be read.
    UnreadableImage,
    /// Another client drives.
    SeatTaken,
    /// A client writes numbers with another decimal mark than a point.
    DecimalMark,
    /// A client is a simulator of the second term.
    SecondTerm,
    /// A person drives by hand.
    Override,
    /// A person drives from the server's page.
    CoDriver,
    /// The car does not follow the throttle.
    ThrottleIgnored,
    /// A row could not be recorded in time.
    RecordingLags,
    /// A client asks for a namespace other than `/`.
    Namespace,
    /// This program is at fault.
    Fault,
}

impl Incident {
    /// What the user can do, if anything.
    fn remedy(self) -> Option<&'static str> {
        Some(match self {
            Incident::Connected | Incident::Disconnected | Incident::Drives | Incident::Refused => return None,
            Incident::NobodyConnects => {
                "start the simulator on this machine and choose a track in AUTONOMOUS MODE; it connects to port 4567 of \
                 127.0.0.1 by itself. For a simulator on another machine or in a container give --host 0.0.0.0"
            }
            Incident::TooManyConnections => "the oldest that does not drive is closed",
            Incident::TooSlow => "closed; whoever connects has to send telemetry",
            Incident::BrokenFrames => "closed; is this a WebSocket client, and is an image below 700 KB?",
            Incident::NotSocketIo => "a Socket.IO client is expected, such as Udacity's simulator",
            Incident::PlainJson => {
                "that is the protocol of the browser version of the simulator; use the desktop build, version 2 of 2/07/17 \
                 or later"
            }
            Incident::BrokenEvent => {
                "expected is 42[\"telemetry\",{\"steering_angle\":…,\"throttle\":…,\"speed\":…,\"image\":…}]"
            }
            Incident::NoTelemetry => {
                "choose AUTONOMOUS MODE (not TRAINING MODE); in the simulator's window no key may be held; builds before \
                 version 2 of 2/07/17 speak another protocol"
            }
            Incident::Stale => {
                "the wheel is held, the throttle is cut and telemetry asked for; is the simulator's window minimised, in a menu, or its machine \
                 overloaded?"
            }
            Incident::Silent => {
                "it is asked for; is the simulator's window minimised, in a menu, or its machine overloaded?"
            }
            Incident::NoImage => {
                "the throttle is cut, and after 0.5 s the car brakes; use a simulator with a front camera"
            }
            Incident::NoSpeed => {
                "the throttle is cut, and after 0.5 s the car brakes; the field `speed` in mph is needed to hold a speed"
            }
            Incident::UnreadableImage => {
                "the wheel is held, the throttle is cut, and after 0.5 s the car brakes; a JPEG or PNG of at most 1920x1920 pixels in \
                 base64 is expected"
            }
            Incident::SeatTaken => "it waits until that one leaves or is silent for more than 1 s",
            Incident::DecimalMark => "commands are written in the same way, no change of the language is needed",
            Incident::SecondTerm => "it gets numbers instead of strings",
            Incident::Override => "release W and S to let the model drive",
            Incident::CoDriver => "release the keys to let the model drive",
            Incident::ThrottleIgnored => {
                "is this the car's camera view with no key held? Other programs on port 4567 can answer in between: close them"
            }
            Incident::RecordingLags => "the disk is too slow; frames are left out of the recording",
            Incident::Fault => "please report it with what was sent",
            Incident::Namespace => "connect without a namespace",
        })
    }
}

/// The observer, and the error with which it ended the log.
struct Observed<'a> {
    observer: &'a mut (dyn Observer<ServeEvent> + Send),
    error: Option<Error>,
}

/// The log. It escapes every line, so bytes of a client never reach the terminal raw.
pub struct Journal<'a> {
    observer: Mutex<Observed<'a>>,
    check: bool,
    entries: Mutex<BTreeMap<Incident, Entry>>,
}

#[derive(Debug, Default)]
struct Entry {
    count: u64,
    /// Reports left out since the last one that was shown.
    left_out: u64,
    /// Time until which the reports shown so far use up the limit.
    used_until: Option<Instant>,
}

impl Entry {
    /// Counts a report at `now`. Whether it is shown.
    fn admit(&mut self, now: Instant) -> bool {
        self.count += 1;
        let used_until = self.used_until.map_or(now, |until| until.max(now)) + INTERVAL;
        let shown = used_until <= now + BURST * INTERVAL;
        if shown {
            self.used_until = Some(used_until);
        } else {
            self.left_out += 1;
        }
        shown
    }
}

impl<'a> Journal<'a> {
    /// A log that tells `observer`; with `check` it also tells every step and message.
    pub fn new(observer: &'a mut (dyn Observer<ServeEvent> + Send), check: bool) -> Journal<'a> {
        Journal { observer: Mutex::new(Observed { observer, error: None }), check, entries: Mutex::default() }
    }

    fn tell(&self, event: ServeEvent) {
        let mut observed = self.observer.lock().unwrap_or_else(PoisonError::into_inner);
        if observed.error.is_none() {
            observed.error = observed.observer.observe(event).err();
        }
    }

    /// Shows the status line.
    pub fn status(&self, text: String) {
        self.tell(ServeEvent::Status(text));
    }

    /// Whether the observer has returned an error. It then gets no more events.
    pub fn failed(&self) -> bool {
        self.observer.lock().unwrap_or_else(PoisonError::into_inner).error.is_some()
    }

    /// Ends the log.
    ///
    /// # Errors
    ///
    /// The first error of the observer.
    pub fn into_result(self) -> Result<()> {
        self.observer.into_inner().unwrap_or_else(PoisonError::into_inner).error.map_or(Ok(()), Err)
    }

    /// Shows `detail` and the remedy of `incident`, and limits how often it does so for each kind.
    pub fn report(&self, incident: Incident, detail: std::fmt::Arguments) {
        let now = Instant::now();
        let left_out = {
            let mut entries = self.entries.lock().unwrap_or_else(PoisonError::into_inner);
            let entry = entries.entry(incident).or_default();
            if !entry.admit(now) {
                return;
            }
            std::mem::take(&mut entry.left_out)
        };
        let more = match left_out {
            0 => String::new(),
            more => format!(" ({more} more like this before)"),
        };
        match incident.remedy() {
            Some(remedy) => self.line(&format!("{detail}: {remedy}{more}")),
            None => self.line(&format!("{detail}{more}")),
        }
    }

    /// Shows a step of a connection if `check` is on.
    pub fn step(&self, text: std::fmt::Arguments) {
        if self.check {
            self.line(&text.to_string());
        }
    }

    fn line(&self, text: &str) {
        self.tell(ServeEvent::Line(escaped(text).into_owned()));
    }

    /// Whether `check` is on.
    pub fn checks(&self) -> bool {
        self.check
    }

    /// How often each kind of incident happened.
    pub fn counts(&self) -> BTreeMap<Incident, u64> {
        let entries = self.entries.lock().unwrap_or_else(PoisonError::into_inner);
        entries.iter().map(|(incident, entry)| (*incident, entry.count)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The lines of `work` on a log.
    fn lines_of(check: bool, work: impl FnOnce(&Journal)) -> Vec<String> {
        let mut lines = Vec::new();
        let mut observer = |event| {
            match event {
                ServeEvent::Line(text) => lines.push(text),
                ServeEvent::Status(_) => {}
            }
            Ok(())
        };
        let journal = Journal::new(&mut observer, check);
        work(&journal);
        assert!(!journal.failed() && journal.into_result().is_ok());
        lines
    }

    #[test]
    fn a_flood_of_one_incident_is_a_few_lines_and_hides_no_other() {
        let lines = lines_of(false, |journal| {
            for k in 0..1000 {
                journal.report(Incident::UnreadableImage, format_args!("picture {k}"));
            }
            journal.report(Incident::NoSpeed, format_args!("telemetry without a speed"));
            journal.step(format_args!("not shown"));
            assert_eq!(journal.counts()[&Incident::UnreadableImage], 1000);
        });
        assert_eq!(lines.len(), BURST as usize + 1, "{lines:?}");
        assert!(lines[0].starts_with("picture 0: "), "{lines:?}");
        let (mut entry, now) = (Entry::default(), Instant::now());
        let shown = (0..6000).filter(|ms| entry.admit(now + Duration::from_millis(*ms * 10))).count();
        assert_eq!(shown as u32, BURST + 11, "in a minute");
    }

    #[test]
    fn bytes_of_a_client_never_reach_the_terminal_raw() {
        let lines = lines_of(true, |journal| {
            journal.report(Incident::NotSocketIo, format_args!("a packet \u{1b}[2J\u{9b}31m\u{202e}"));
            journal.step(format_args!("a step \r\n\u{7}"));
        });
        assert!(lines[0].starts_with("a packet \\u{1b}[2J\\u{9b}31m\\u{202e}: "), "{lines:?}");
        assert_eq!(lines[1], "a step \\r\\n\\u{7}");
    }

    #[test]
    fn an_observer_that_fails_gets_no_more_events_and_its_error_is_kept() {
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
