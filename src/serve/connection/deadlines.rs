//! The deadlines of a connection: greeting, pings, and what follows silence.

use std::time::{Duration, Instant};

use super::{Connection, End, QUICK_TICK, SLOW_TICK, session_id};
use crate::net::connections::Rank;
use crate::serve::journal::Incident;
use crate::udacity::{self, EngineVersion, PING_INTERVAL_MS, PING_TIMEOUT_MS};

/// Time without telemetry after which an unknown client gets the handshake of Socket.IO.
const GREETING_TIME: Duration = Duration::from_millis(50);
/// Age at which telemetry is stale, and the throttle is cut.
const STALE_TIME: Duration = Duration::from_millis(500);
/// Time without telemetry after which the server asks for it, again and again.
const ASK_TIME: Duration = Duration::from_secs(1);
/// Time without telemetry after which the server tells the user.
const MISSING_TIME: Duration = Duration::from_secs(5);
/// Longest time without a complete message, for a client that is not driven or does not answer pings.
const MAX_SILENCE: Duration = Duration::from_millis(PING_INTERVAL_MS + PING_TIMEOUT_MS);

impl Connection<'_, '_> {
    /// Does what is due after each tick, apart from messages.
    pub(super) fn after_tick(&mut self) -> Result<(), End> {
        if let Some((text, came)) = self.held.take() {
            if self.may_answer() {
                // The time that it waited for another client to leave counts neither as latency nor as silence.
                let now = Instant::now();
                let came = if self.waits { now } else { came };
                self.last_telemetry = Some(now);
                if let Ok(packet) = udacity::parse(&text) {
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
            // A client that waits for its answer or for another client to leave is not silent.
            Some(_) if self.lockstep || self.held.is_some() => {}
            Some(last) => {
                let silent = now.saturating_duration_since(last);
                if self.peer.rank() == Rank::InUse && !self.overridden {
                    self.watch(silent, now)?;
                } else {
                    self.ask_again(silent, now, Incident::Silent)?;
                }
            }
        }
        let quick = self.peer.rank() == Rank::InUse
            || self.held.is_some()
            || now.duration_since(self.opened) < 4 * GREETING_TIME;
        self.websocket.get_mut().set_tick(if quick { QUICK_TICK } else { SLOW_TICK })?;
        Ok(())
    }

    /// Sends the handshake of Socket.IO to a client that seems to wait for it.
    fn greet(&mut self, now: Instant) -> Result<(), End> {
        if !self.greeted && now.duration_since(self.opened) >= GREETING_TIME {
            self.greeted = true;
            let version = self.client.version;
            let sid = session_id(self.peer.id);
            self.send(|out| udacity::print_open(out, version, &sid))?;
            if version == EngineVersion::V3 {
                self.send(|out| udacity::print_connected(out, version, &sid))?;
            }
            self.last_ping = now;
        }
        Ok(())
    }

    /// Sends the pings of Engine.IO 4 and closes silent clients. In the other protocols the client pings, so every real client
    /// completes a message now and then.
    fn keep_alive(&mut self, now: Instant) -> Result<(), End> {
        let silent = now.duration_since(self.last_message) > MAX_SILENCE;
        if silent && self.peer.rank() != Rank::InUse {
            let text = format!("no complete message for {} s", MAX_SILENCE.as_secs());
            return Err(End::Fault(Incident::TooSlow, text));
        }
        if !self.greeted || self.client.version == EngineVersion::V3 {
            return Ok(());
        }
        if now.duration_since(self.last_ping) >= Duration::from_millis(PING_INTERVAL_MS) {
            self.last_ping = now;
            self.send(|out| out.push('2'))?;
        }
        if silent {
            return Err(End::Fault(Incident::TooSlow, "no answer to pings".into()));
        }
        Ok(())
    }

    /// Asks a simulator without telemetry for it, and tells the user.
    fn miss_telemetry(&mut self, now: Instant) -> Result<(), End> {
        let silent = now.duration_since(self.opened);
        if self.client.is_simulator() && silent >= ASK_TIME && now.duration_since(self.last_question) >= ASK_TIME {
            self.last_question = now;
            self.ask()?;
        }
        if silent >= MISSING_TIME {
            let text = format_args!("{}: connected for {} s, but no telemetry", self.address, silent.as_secs());
            self.shared.journal.report(Incident::NoTelemetry, text);
        }
        Ok(())
    }

    /// Cuts the throttle if the driven client has been silent for too long, and asks for telemetry.
    fn watch(&mut self, silent: Duration, now: Instant) -> Result<(), End> {
        if silent < STALE_TIME {
            return Ok(());
        }
        if !self.cut {
            self.cut = true;
            self.last_question = now;
            let text = format_args!("{}: no telemetry for {:.1} s", self.address, silent.as_secs_f64());
            self.shared.journal.report(Incident::Stale, text);
            // The client may read no further command, so this one must not drive it backwards.
            let command = self.helm.cut_throttle();
            return self.steer(command);
        }
        self.ask_again(silent, now, Incident::Stale)
    }

    /// Asks a client for telemetry, now and then, when it has been silent for `silent`.
    fn ask_again(&mut self, silent: Duration, now: Instant, incident: Incident) -> Result<(), End> {
        if silent < ASK_TIME || now.duration_since(self.last_question) < ASK_TIME {
            return Ok(());
        }
        self.last_question = now;
        let text = format_args!("{}: no telemetry for {:.0} s", self.address, silent.as_secs_f64());
        self.shared.journal.report(incident, text);
        self.ask()
    }
}
