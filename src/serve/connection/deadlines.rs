//! What is due on a connection apart from messages: greetings, pings, and what follows silence.

use std::time::{Duration, Instant};

use super::{Connection, End, QUICK_BEAT, SLOW_BEAT, session_id};
use crate::serve::journal::Event;
use crate::serve::protocol::{self, EngineVersion, PING_INTERVAL_MS, PING_TIMEOUT_MS};
use crate::serve::registry::Stage;

/// Time that an unknown client has for telemetry before it gets the handshake of Socket.IO.
const GREETING_TIME: Duration = Duration::from_millis(50);
/// Telemetry is stale after this time: the throttle is cut.
const STALE_TIME: Duration = Duration::from_millis(500);
/// Telemetry is asked for after this time without any, and again each time it passes.
const ASK_TIME: Duration = Duration::from_secs(1);
/// After this time a client without telemetry is talked about.
const MISSING_TIME: Duration = Duration::from_secs(5);
/// A client that answers no ping, or never was of use, is given up after this time without a complete message.
const SILENCE_LIMIT: Duration = Duration::from_millis(PING_INTERVAL_MS + PING_TIMEOUT_MS);

impl Connection<'_, '_> {
    /// What is due apart from messages.
    pub(super) fn after_beat(&mut self) -> Result<(), End> {
        if let Some((text, came)) = self.held.take() {
            if self.may_answer() {
                // Waiting for another client to leave is no delay of the answer, and no silence of this one.
                let now = Instant::now();
                let came = if self.waits { now } else { came };
                self.last_telemetry = Some(now);
                if let Ok(packet) = protocol::parse(&text) {
                    self.answer(packet, came)?;
                }
            } else {
                self.held = Some((text, came));
            }
        }
        let now = Instant::now();
        if !self.client.is_simulator() && self.last_telemetry.is_none() {
            self.greet(now)?;
        }
        self.keep_alive(now)?;
        match self.last_telemetry {
            None => self.miss_telemetry(now)?,
            // A client that waits for its answer or for another to leave is not silent.
            Some(_) if self.lockstep || self.held.is_some() => {}
            Some(last) => {
                let silent = now.saturating_duration_since(last);
                if self.peer.stage() == Stage::Trusted && !self.overridden {
                    self.watch(silent, now)?;
                } else {
                    self.ask_again(silent, now, Event::Silent)?;
                }
            }
        }
        let quick = self.peer.stage() == Stage::Trusted
            || self.held.is_some()
            || now.duration_since(self.opened) < 4 * GREETING_TIME;
        self.websocket.get_mut().set_beat(if quick { QUICK_BEAT } else { SLOW_BEAT })?;
        Ok(())
    }

    /// The handshake of Socket.IO for a client that seems to wait for it.
    fn greet(&mut self, now: Instant) -> Result<(), End> {
        if !self.greeted && now.duration_since(self.opened) >= GREETING_TIME {
            self.greeted = true;
            let version = self.client.version;
            let sid = session_id(self.peer.id);
            self.send(|out| protocol::print_open(out, version, &sid))?;
            if version == EngineVersion::V3 {
                self.send(|out| protocol::print_connected(out, version, &sid))?;
            }
            self.last_ping = now;
        }
        Ok(())
    }

    /// Pings of Engine.IO 4 come from the server; whoever drives by another protocol pings by itself. So a stranger that
    /// completes no message for as long as that is nobody.
    fn keep_alive(&mut self, now: Instant) -> Result<(), End> {
        let silent = now.duration_since(self.last_message) > SILENCE_LIMIT;
        if silent && self.peer.stage() != Stage::Trusted {
            let text = format!("no complete message for {} s", SILENCE_LIMIT.as_secs());
            return Err(End::Fault(Event::TooSlow, text));
        }
        if !self.greeted || self.client.version == EngineVersion::V3 {
            return Ok(());
        }
        if now.duration_since(self.last_ping) >= Duration::from_millis(PING_INTERVAL_MS) {
            self.last_ping = now;
            self.send(|out| out.push('2'))?;
        }
        if silent {
            return Err(End::Fault(Event::TooSlow, "no answer to pings".into()));
        }
        Ok(())
    }

    /// A client without telemetry is asked for it, if it is a simulator, and talked about.
    fn miss_telemetry(&mut self, now: Instant) -> Result<(), End> {
        let silent = now.duration_since(self.opened);
        if self.client.is_simulator() && silent >= ASK_TIME && now.duration_since(self.last_question) >= ASK_TIME {
            self.last_question = now;
            self.ask()?;
        }
        if silent >= MISSING_TIME {
            let text = format_args!("{}: connected for {} s, but no telemetry", self.address, silent.as_secs());
            self.shared.journal.report(Event::NoTelemetry, text);
        }
        Ok(())
    }

    /// The driven client has been silent for `silent`.
    fn watch(&mut self, silent: Duration, now: Instant) -> Result<(), End> {
        if silent < STALE_TIME {
            return Ok(());
        }
        if !self.cut {
            self.cut = true;
            self.last_question = now;
            let text = format_args!("{}: no telemetry for {:.1} s", self.address, silent.as_secs_f64());
            self.shared.journal.report(Event::Stale, text);
            let command = self.helm.cut_throttle();
            return self.steer(command);
        }
        self.ask_again(silent, now, Event::Stale)
    }

    /// Asks a client that has been silent for `silent`, now and then.
    fn ask_again(&mut self, silent: Duration, now: Instant, event: Event) -> Result<(), End> {
        if silent < ASK_TIME || now.duration_since(self.last_question) < ASK_TIME {
            return Ok(());
        }
        self.last_question = now;
        let text = format_args!("{}: no telemetry for {:.0} s", self.address, silent.as_secs_f64());
        self.shared.journal.report(event, text);
        self.ask()
    }
}
