//! One client: its handshake ([`opening`]), its messages, its deadlines ([`deadlines`]) and its commands ([`driving`]).

mod deadlines;
mod driving;
mod opening;

use std::net::SocketAddr;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::Arc;
use std::time::{Duration, Instant};

use tungstenite::{Message, Utf8Bytes, WebSocket};

use self::opening::open;
use super::handshake::ClientInfo;
use super::helm::{FrameTime, Helm};
use super::journal::Incident;
use super::rate_limit::RateLimit;
use super::shared::Shared;
use super::tokens::Tokens;
use crate::net::connections::{Peer, Rank};
use crate::net::socket::{Socket, is_timeout};
use crate::text::excerpt;
use crate::udacity::{self, ClientPacket, Command, EngineVersion, NumberStyle, ProtocolError};

/// Longest message, bytes.
const MAX_MESSAGE_LEN: usize = 1 << 20;
/// Largest number of messages that the server reads at once before it answers the newest.
const MAX_BATCH: usize = 16;
/// Longest time that a client has to read the last messages.
const FAREWELL_TIME: Duration = Duration::from_millis(200);
/// Number of bad messages in a row after which the server closes a client that is not driven.
const MAX_FAULTS: u32 = 10;
/// Tick of a connection that waits for telemetry.
const QUICK_TICK: Duration = Duration::from_millis(10);
/// Tick of the other connections.
const SLOW_TICK: Duration = Duration::from_millis(200);

/// Why a connection ends.
#[derive(Debug)]
enum End {
    /// The client left, or this program ends.
    Closed,
    /// The client does something wrong.
    Fault(Incident, String),
    /// The stream failed.
    Broken(std::io::Error),
}

impl From<std::io::Error> for End {
    fn from(error: std::io::Error) -> End {
        End::Broken(error)
    }
}

impl From<tungstenite::Error> for End {
    fn from(error: tungstenite::Error) -> End {
        use tungstenite::error::ProtocolError::{ResetWithoutClosingHandshake, SendAfterClosing};
        match error {
            tungstenite::Error::ConnectionClosed | tungstenite::Error::AlreadyClosed => End::Closed,
            tungstenite::Error::Protocol(ResetWithoutClosingHandshake | SendAfterClosing) => End::Closed,
            tungstenite::Error::Io(error) => End::Broken(error),
            other => End::Fault(Incident::BrokenFrames, other.to_string()),
        }
    }
}

/// Serves one client until it leaves.
pub(super) fn serve(shared: &Shared, peer: &Arc<Peer>, address: SocketAddr) {
    let result = open(shared, peer, address).and_then(|mut connection| {
        // The driven car gets its last command even if this program is at fault.
        let result = catch_unwind(AssertUnwindSafe(|| connection.run()));
        connection.close();
        result.unwrap_or_else(|panic| resume_unwind(panic))
    });
    let journal = &shared.journal;
    match result {
        Ok(()) | Err(End::Closed) if peer.rank() == Rank::Unknown => {
            journal.step(format_args!("{address}: left before it had sent a request"));
        }
        Ok(()) | Err(End::Closed) => journal.report(Incident::Disconnected, format_args!("{address} left")),
        Err(End::Fault(incident, text)) => journal.report(incident, format_args!("{address}: {text}")),
        Err(End::Broken(error)) => journal.report(Incident::Disconnected, format_args!("{address} left: {error}")),
    }
}

/// A WebSocket and what the server knows of the client behind it.
struct Connection<'a, 'o> {
    shared: &'a Shared<'o>,
    peer: &'a Arc<Peer>,
    address: SocketAddr,
    websocket: WebSocket<Socket>,
    client: ClientInfo,
    /// Whether it got the handshake of Socket.IO. The simulator needs none.
    greeted: bool,
    opened: Instant,
    last_message: Instant,
    last_ping: Instant,
    /// Time of the last event that counts as telemetry.
    last_telemetry: Option<Instant>,
    /// Time of the last `manual` event that asked for telemetry after a silence.
    last_question: Instant,
    tokens: Tokens,
    /// Telemetry without an answer yet, and the arrival of its last byte.
    held: Option<(Utf8Bytes, Instant)>,
    /// Bad messages in a row.
    faults: u32,
    style: NumberStyle,
    helm: Helm,
    /// Limits what the server reads of a client that is not driven.
    rate_limit: RateLimit,
    /// Whether it waits because another client is driven.
    waits: bool,
    /// Whether the client waits for each answer, so that its simulated time counts.
    lockstep: bool,
    /// Whether a person drives by hand.
    overridden: bool,
    /// Whether the co-driver has the wheel.
    co_driven: bool,
    /// Whether the throttle was cut because telemetry is stale.
    cut: bool,
    /// Number of commands in a row with a strong throttle that the car does not follow.
    ignored: u32,
    /// Number of messages that `--check` has shown.
    shown: u32,
    image: Vec<u8>,
    reply: String,
}

impl Connection<'_, '_> {
    fn run(&mut self) -> Result<(), End> {
        let mut batch = Vec::with_capacity(MAX_BATCH);
        loop {
            if self.shared.stop.requested() {
                return Ok(());
            }
            self.websocket.get_mut().begin_tick();
            let mut messages = 1;
            if let Some(message) = self.read()? {
                let (mut bytes, mut end) = (message.0.len(), Ok(()));
                batch.push(message);
                // Reads all complete messages: of several telemetries the server answers only the newest.
                self.websocket.get_mut().set_waiting(false)?;
                while batch.len() < MAX_BATCH && bytes < MAX_MESSAGE_LEN {
                    match self.read() {
                        Ok(Some(message)) => {
                            bytes += message.0.len();
                            batch.push(message);
                        }
                        Ok(None) => break,
                        // The messages before it are still served.
                        Err(error) => {
                            end = Err(error);
                            break;
                        }
                    }
                }
                self.websocket.get_mut().set_waiting(true)?;
                messages = batch.len();
                self.handle(&mut batch)?;
                end?;
            }
            self.after_tick()?;
            let bytes = self.websocket.get_mut().take_count();
            if bytes > 0 && self.peer.rank() != Rank::InUse {
                self.rest(messages, bytes);
            }
        }
    }

    /// Pauses the reading from a client that has used up its credit.
    fn rest(&mut self, messages: usize, bytes: usize) {
        /// Longest time until the pause notices that the connection has to end.
        const STEP: Duration = Duration::from_millis(5);
        let now = Instant::now();
        let until = now + self.rate_limit.charge(messages, bytes, now);
        while !self.shared.stop.requested() && !self.peer.must_close() {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return;
            }
            std::thread::sleep(left.min(STEP));
        }
    }

    /// The next complete text message; `None` if none has arrived within the tick.
    fn read(&mut self) -> Result<Option<(Utf8Bytes, Instant)>, End> {
        match self.websocket.read() {
            Ok(Message::Text(text)) => {
                self.last_message = Instant::now();
                Ok(Some((text, self.websocket.get_ref().last_byte())))
            }
            Ok(Message::Close(_)) => Err(End::Closed),
            Ok(Message::Binary(_)) => {
                self.fault(Incident::NotSocketIo, format_args!("a binary message")).map(|()| None)
            }
            // The next read answers a ping. The return lets the caller check the deadlines, however many pings arrive.
            Ok(_) => Ok(None),
            Err(tungstenite::Error::Io(error)) if is_timeout(&error) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// Handles messages in their order, and answers only the newest telemetry.
    fn handle(&mut self, batch: &mut Vec<(Utf8Bytes, Instant)>) -> Result<(), End> {
        let newest = {
            let mut packets: Vec<_> = batch.iter().map(|(text, _)| udacity::parse(text)).collect();
            let is_state = |packet: &Result<ClientPacket, ProtocolError>| {
                matches!(packet, Ok(ClientPacket::Telemetry(..) | ClientPacket::Manual(_)))
            };
            let newest = packets.iter().rposition(is_state);
            for (at, packet) in packets.iter_mut().enumerate() {
                let (text, came) = &batch[at];
                self.show('>', text);
                if is_state(packet) {
                    self.tokens.received(*came);
                    self.last_telemetry = Some(*came);
                    self.acknowledge(packet)?;
                    if self.held.take().is_some() {
                        self.shared.statistics().superseded += 1;
                    }
                    if Some(at) != newest {
                        self.shared.statistics().superseded += 1;
                    }
                } else {
                    self.other(packet)?;
                }
            }
            match newest {
                Some(at) if self.may_answer() => {
                    if let Ok(packet) = packets.swap_remove(at) {
                        self.answer(packet, batch[at].1)?;
                    }
                    None
                }
                other => other,
            }
        };
        if let Some(at) = newest {
            self.held = Some(batch.swap_remove(at));
        }
        batch.clear();
        Ok(())
    }

    /// Whether the newest telemetry can be answered now: no other is expected, and no other client is driven.
    fn may_answer(&mut self) -> bool {
        let now = Instant::now();
        if !self.tokens.should_answer(now) {
            return false;
        }
        let open = self.shared.seat.is_open_to(self.peer.id, now);
        if !open && !std::mem::replace(&mut self.waits, true) {
            self.shared.journal.report(
                Incident::SeatTaken,
                format_args!("{} has sent telemetry, but another client drives", self.address),
            );
        }
        open
    }

    /// Handles everything but telemetry.
    fn other(&mut self, packet: &Result<ClientPacket, ProtocolError>) -> Result<(), End> {
        match packet {
            Ok(ClientPacket::Close) => Err(End::Closed),
            Ok(ClientPacket::Ping(payload)) => self.send(|out| {
                out.push('3');
                out.push_str(payload);
            }),
            Ok(ClientPacket::Connect { namespace }) => {
                let version = self.client.version;
                if *namespace != "/" {
                    let text = format_args!("{}: wants the namespace \"{}\"", self.address, excerpt(namespace, SHOWN));
                    self.shared.journal.report(Incident::Namespace, text);
                    return self.send(|out| udacity::print_namespace_refused(out, version, namespace));
                }
                // The simulator never asks; a client of Socket.IO 2 is connected without asking.
                if self.greeted && version == EngineVersion::V4 {
                    let sid = session_id(self.peer.id);
                    self.send(|out| udacity::print_connected(out, version, &sid))?;
                }
                Ok(())
            }
            Ok(ClientPacket::OtherEvent { name, ack }) => {
                let text =
                    format_args!("{}: the event \"{}\" is not known and ignored", self.address, excerpt(name, SHOWN));
                self.shared.journal.step(text);
                match ack {
                    Some(ack) => self.send(|out| udacity::print_ack(out, *ack)),
                    None => Ok(()),
                }
            }
            Ok(_) => Ok(()),
            Err(error) => {
                let incident = match error {
                    ProtocolError::NotEngineIo(_) => Incident::NotSocketIo,
                    ProtocolError::PlainJson(_) => Incident::PlainJson,
                    ProtocolError::Event(_) => Incident::BrokenEvent,
                };
                self.fault(incident, format_args!("{error}"))?;
                // It may have been telemetry for which the client waits for an answer.
                if incident == Incident::BrokenEvent {
                    self.answer_blind(FrameTime::Arrival(Instant::now()), None)
                } else {
                    Ok(())
                }
            }
        }
    }

    fn acknowledge(&mut self, packet: &Result<ClientPacket, ProtocolError>) -> Result<(), End> {
        match packet {
            Ok(ClientPacket::Telemetry(_, Some(ack)) | ClientPacket::Manual(Some(ack))) => {
                self.send(|out| udacity::print_ack(out, *ack))
            }
            _ => Ok(()),
        }
    }

    /// Counts and reports a bad message.
    fn fault(&mut self, incident: Incident, text: std::fmt::Arguments) -> Result<(), End> {
        self.faults += 1;
        if self.faults >= MAX_FAULTS && self.peer.rank() != Rank::InUse {
            return Err(End::Fault(incident, format!("{MAX_FAULTS} bad messages in a row, the last {text}; closed")));
        }
        self.shared.journal.report(incident, format_args!("{}: {text}", self.address));
        Ok(())
    }

    /// Cuts the throttle of a driven car, because nobody drives it from now on, and closes the connection.
    fn close(&mut self) {
        let now = Instant::now();
        if self.shared.seat.is_held_by(self.peer.id, now) && !self.overridden {
            let command = self.helm.cut_throttle();
            // The client may be gone.
            let _ = self.steer(command);
        }
        let _ = self.websocket.close(None);
        self.websocket.get_mut().finish(FAREWELL_TIME);
    }

    fn steer(&mut self, command: Command) -> Result<(), End> {
        self.tokens.sent();
        let style = self.style;
        self.send(|out| udacity::print_steer(out, command, style))
    }

    fn ask(&mut self) -> Result<(), End> {
        self.tokens.sent();
        self.send(udacity::print_manual)
    }

    fn send(&mut self, print: impl FnOnce(&mut String)) -> Result<(), End> {
        self.reply.clear();
        print(&mut self.reply);
        let sent = self.websocket.send(Message::text(self.reply.as_str()));
        if self.shared.journal.checks() {
            let reply = std::mem::take(&mut self.reply);
            self.show('<', &reply);
            self.reply = reply;
        }
        sent.map_err(End::from)
    }

    /// With `--check`, shows the first messages in full number and then one of many.
    fn show(&mut self, direction: char, text: &str) {
        /// Number of messages that are all shown.
        const ALL: u32 = 20;
        /// After those, one message of this many is shown.
        const EVERY: u32 = 200;
        if !self.shared.journal.checks() {
            return;
        }
        self.shown += 1;
        if self.shown <= ALL || self.shown.is_multiple_of(EVERY) {
            let more = if text.len() > SHOWN { format!(" ({} bytes)", text.len()) } else { String::new() };
            let shown = excerpt(text, SHOWN);
            self.shared.journal.step(format_args!("{} {direction} {shown}{more}", self.address));
        }
        if self.shown == ALL {
            self.shared.journal.step(format_args!("{}: from here on one message in {EVERY} is shown", self.address));
        }
    }
}

/// Name of the session of connection `id`. The name of another session gives no access to it.
fn session_id(id: u64) -> String {
    format!("{id:020x}")
}

/// Characters of a message that are shown to a person.
const SHOWN: usize = 120;
