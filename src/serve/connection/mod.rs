//! One client: its handshake ([`opening`]), its messages, its deadlines ([`deadlines`]) and how it is driven ([`driving`]).

mod deadlines;
mod driving;
mod opening;

use std::net::SocketAddr;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::Arc;
use std::time::{Duration, Instant};

use tungstenite::{Message, Utf8Bytes, WebSocket};

use self::opening::open;
use super::handshake::Client;
use super::helm::Helm;
use super::journal::Event;
use super::pace::Pace;
use super::protocol::{self, ClientPacket, Command, EngineVersion, NumberStyle, ProtocolError};
use super::registry::{Peer, Stage};
use super::server::Shared;
use super::socket::{Socket, is_timeout};
use super::tokens::Tokens;

/// Largest message, bytes.
const MAX_MESSAGE: usize = 1 << 20;
/// Messages that are read at once before the newest is answered.
const MAX_BATCH: usize = 16;
/// Time that a client has to read the last words.
const FAREWELL: Duration = Duration::from_millis(200);
/// Bad messages in a row after which a client is closed that does not drive.
const MAX_FAULTS: u32 = 10;
/// Beat of a connection that waits for telemetry.
const QUICK_BEAT: Duration = Duration::from_millis(10);
/// Beat of one that has time.
const SLOW_BEAT: Duration = Duration::from_millis(200);

/// Why a connection ends.
#[derive(Debug)]
enum End {
    /// The client left, or this program ends.
    Closed,
    /// Something is wrong with it.
    Fault(Event, String),
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
            other => End::Fault(Event::BrokenFrames, other.to_string()),
        }
    }
}

/// Serves one client until it leaves.
pub(super) fn serve(shared: &Shared, peer: &Arc<Peer>, address: SocketAddr) {
    let result = open(shared, peer, address).and_then(|mut connection| {
        // The driven car gets its last words even if this program fails.
        let result = catch_unwind(AssertUnwindSafe(|| connection.run()));
        connection.part();
        result.unwrap_or_else(|panic| resume_unwind(panic))
    });
    let journal = &shared.journal;
    match result {
        Ok(()) | Err(End::Closed) if peer.stage() == Stage::Opening => {
            journal.step(format_args!("{address}: left before it had sent a request"));
        }
        Ok(()) | Err(End::Closed) => journal.report(Event::Disconnected, format_args!("{address} left")),
        Err(End::Fault(event, text)) => journal.report(event, format_args!("{address}: {text}")),
        Err(End::Broken(error)) => journal.report(Event::Disconnected, format_args!("{address} left: {error}")),
    }
}

/// A WebSocket and what is known of the client behind it.
struct Connection<'a, 'o> {
    shared: &'a Shared<'o>,
    peer: &'a Arc<Peer>,
    address: SocketAddr,
    websocket: WebSocket<Socket>,
    client: Client,
    /// Whether it got the handshake of Socket.IO; the simulator does without.
    greeted: bool,
    opened: Instant,
    last_message: Instant,
    last_ping: Instant,
    /// When the last event came that counts as telemetry.
    last_telemetry: Option<Instant>,
    /// When telemetry was last asked for, without telemetry to answer.
    last_question: Instant,
    tokens: Tokens,
    /// Telemetry that is not answered yet, and when its last byte came.
    held: Option<(Utf8Bytes, Instant)>,
    /// Bad messages in a row.
    faults: u32,
    style: NumberStyle,
    helm: Helm,
    /// How much of a stranger's messages is read.
    pace: Pace,
    /// Was told that another drives.
    waits: bool,
    /// The client waits for each answer: its clock counts, and the server's has no meaning for it.
    lockstep: bool,
    /// A person drives.
    overridden: bool,
    /// The throttle was cut.
    cut: bool,
    /// Commands in a row with a strong throttle that the car does not show.
    deaf: u32,
    /// Messages shown by `--check`.
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
            self.websocket.get_mut().begin_beat();
            let mut messages = 1;
            if let Some(message) = self.read()? {
                let (mut bytes, mut end) = (message.0.len(), Ok(()));
                batch.push(message);
                // Whatever else is complete already: of several telemetries only the newest is answered.
                self.websocket.get_mut().set_waiting(false)?;
                while batch.len() < MAX_BATCH && bytes < MAX_MESSAGE {
                    match self.read() {
                        Ok(Some(message)) => {
                            bytes += message.0.len();
                            batch.push(message);
                        }
                        Ok(None) => break,
                        // What came before it is still served.
                        Err(error) => {
                            end = Err(error);
                            break;
                        }
                    }
                }
                self.websocket.get_mut().set_waiting(true)?;
                messages = batch.len();
                self.take(&mut batch)?;
                end?;
            }
            self.after_beat()?;
            let bytes = self.websocket.get_mut().take_count();
            if bytes > 0 && self.peer.stage() != Stage::Trusted {
                self.rest(messages, bytes);
            }
        }
    }

    /// Lets a stranger wait who has sent so much.
    fn rest(&mut self, messages: usize, bytes: usize) {
        /// Time in which it is noticed that the connection has to end.
        const STEP: Duration = Duration::from_millis(5);
        let now = Instant::now();
        let until = now + self.pace.charge(messages, bytes, now);
        while !self.shared.stop.requested() && !self.peer.is_closing() {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return;
            }
            std::thread::sleep(left.min(STEP));
        }
    }

    /// The next complete text message; `None` if none has come within the beat.
    fn read(&mut self) -> Result<Option<(Utf8Bytes, Instant)>, End> {
        match self.websocket.read() {
            Ok(Message::Text(text)) => {
                self.last_message = Instant::now();
                Ok(Some((text, self.websocket.get_ref().last_byte())))
            }
            Ok(Message::Close(_)) => Err(End::Closed),
            Ok(Message::Binary(_)) => self.fault(Event::NotSocketIo, format_args!("a binary message")).map(|()| None),
            // Answered by the next read. Returning lets deadlines be looked after, however many come.
            Ok(_) => Ok(None),
            Err(tungstenite::Error::Io(error)) if is_timeout(&error) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// Serves messages in their order, but of all telemetry only the newest.
    fn take(&mut self, batch: &mut Vec<(Utf8Bytes, Instant)>) -> Result<(), End> {
        let newest = {
            let mut packets: Vec<_> = batch.iter().map(|(text, _)| protocol::parse(text)).collect();
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

    /// Whether the newest telemetry can be answered now: no better is on its way, and no other client drives.
    fn may_answer(&mut self) -> bool {
        let now = Instant::now();
        if !self.tokens.should_answer(now) {
            return false;
        }
        let open = self.shared.seat.is_open_to(self.peer.id, now);
        if !open && !std::mem::replace(&mut self.waits, true) {
            self.shared.journal.report(
                Event::SeatTaken,
                format_args!("{} has sent telemetry, but another client drives", self.address),
            );
        }
        open
    }

    /// Everything but telemetry.
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
                    let text = format_args!("{}: wants the namespace {:?}", self.address, start(namespace));
                    self.shared.journal.report(Event::Namespace, text);
                    return self.send(|out| protocol::print_namespace_refused(out, version, namespace));
                }
                // The simulator never asks; Socket.IO 2 was connected without being asked.
                if self.greeted && version == EngineVersion::V4 {
                    let sid = session_id(self.peer.id);
                    self.send(|out| protocol::print_connected(out, version, &sid))?;
                }
                Ok(())
            }
            Ok(ClientPacket::OtherEvent { name, ack }) => {
                let text = format_args!("{}: the event {:?} is not known and ignored", self.address, start(name));
                self.shared.journal.step(text);
                match ack {
                    Some(ack) => self.send(|out| protocol::print_ack(out, *ack)),
                    None => Ok(()),
                }
            }
            Ok(_) => Ok(()),
            Err(error) => {
                let event = match error {
                    ProtocolError::NotEngineIo(_) => Event::NotSocketIo,
                    ProtocolError::PlainJson(_) => Event::PlainJson,
                    ProtocolError::Event(_) => Event::BrokenEvent,
                };
                self.fault(event, format_args!("{error}"))?;
                // It may have been telemetry, and the client waits.
                if event == Event::BrokenEvent { self.answer_blind() } else { Ok(()) }
            }
        }
    }

    fn acknowledge(&mut self, packet: &Result<ClientPacket, ProtocolError>) -> Result<(), End> {
        match packet {
            Ok(ClientPacket::Telemetry(_, Some(ack)) | ClientPacket::Manual(Some(ack))) => {
                self.send(|out| protocol::print_ack(out, *ack))
            }
            _ => Ok(()),
        }
    }

    /// Counts and reports a bad message.
    fn fault(&mut self, event: Event, text: std::fmt::Arguments) -> Result<(), End> {
        self.faults += 1;
        if self.faults >= MAX_FAULTS && self.peer.stage() != Stage::Trusted {
            return Err(End::Fault(event, format!("{MAX_FAULTS} bad messages in a row, the last {text}; closed")));
        }
        self.shared.journal.report(event, format_args!("{}: {text}", self.address));
        Ok(())
    }

    /// The last words to a driven car: nobody is at the wheel from now on.
    fn part(&mut self) {
        let now = Instant::now();
        if self.shared.seat.is_held_by(self.peer.id, now) && !self.overridden {
            let command = self.helm.cut_throttle();
            // The client may be gone.
            let _ = self.steer(command);
        }
        let _ = self.websocket.close(None);
        self.websocket.get_mut().finish(FAREWELL);
    }

    fn steer(&mut self, command: Command) -> Result<(), End> {
        self.tokens.sent();
        let style = self.style;
        self.send(|out| protocol::print_steer(out, command, style))
    }

    fn ask(&mut self) -> Result<(), End> {
        self.tokens.sent();
        self.send(protocol::print_manual)
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

    /// Shows the first messages to those who check, and then some.
    fn show(&mut self, direction: char, text: &str) {
        /// Messages that are all shown.
        const ALL: u32 = 20;
        /// After those, one of so many.
        const EVERY: u32 = 200;
        if !self.shared.journal.checks() {
            return;
        }
        self.shown += 1;
        if self.shown <= ALL || self.shown.is_multiple_of(EVERY) {
            let shown = start(text);
            let rest = text.len() - shown.len();
            // What a terminal would obey is not for it.
            let shown: String = shown.chars().map(|c| if c.is_control() { '\u{fffd}' } else { c }).collect();
            let more = if rest > 0 { format!("… ({rest} bytes more)") } else { String::new() };
            self.shared.journal.step(format_args!("{} {direction} {shown}{more}", self.address));
        }
        if self.shown == ALL {
            self.shared.journal.step(format_args!("{}: from here on one message in {EVERY} is shown", self.address));
        }
    }
}

/// Name of a session. Nothing can be done with the name of another's.
fn session_id(id: u64) -> String {
    format!("{id:020x}")
}

/// The start of a text.
fn start(text: &str) -> &str {
    let mut end = text.len().min(120);
    while !text.is_char_boundary(end) {
        end -= 1;
    }
    &text[..end]
}
