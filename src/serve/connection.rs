//! One client: its handshake, its messages, its deadlines.

use std::io::{Read, Write};
use std::net::SocketAddr;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::Ordering;
use std::sync::{Arc, PoisonError};
use std::time::{Duration, Instant};

use data_encoding::BASE64;
use tungstenite::protocol::{Role, WebSocketConfig};
use tungstenite::{Message, Utf8Bytes, WebSocket};

use super::handshake::{Client, Verdict, examine};
use super::helm::{Clock, Helm};
use super::journal::Event;
use super::pace::Pace;
use super::protocol::{
    self, ClientPacket, Command, DecimalMark, EngineVersion, NumberStyle, PING_INTERVAL_MS, PING_TIMEOUT_MS,
    ProtocolError, Telemetry,
};
use super::recording::Queued;
use super::registry::{Peer, Stage};
use super::seat::Claim;
use super::server::Shared;
use super::socket::{Socket, is_timeout};
use super::tokens::Tokens;

/// Largest message, bytes.
const MAX_MESSAGE: usize = 1 << 20;
/// Largest height or width of an image, pixels.
const MAX_IMAGE_SIDE: usize = 1920;
/// Messages that are read at once before the newest is answered.
const MAX_BATCH: usize = 16;
/// Time for the whole request of a handshake.
const HANDSHAKE_TIME: Duration = Duration::from_secs(5);
/// Time that a client has to read the last words.
const FAREWELL: Duration = Duration::from_millis(200);
/// Time that an unknown client has for telemetry before it gets the handshake of Socket.IO.
const GREETING_TIME: Duration = Duration::from_millis(50);
/// Telemetry is stale after this time: the throttle is cut.
const STALE_TIME: Duration = Duration::from_millis(500);
/// Telemetry is asked for after this time without any, and again each time it passes.
const ASK_TIME: Duration = Duration::from_secs(1);
/// After this time a client without telemetry is talked about.
const MISSING_TIME: Duration = Duration::from_secs(5);
/// Bad messages in a row after which a client is closed that does not drive.
const MAX_FAULTS: u32 = 10;
/// A client that answers no ping, or never was of use, is given up after this time without a complete message.
const SILENCE_LIMIT: Duration = Duration::from_millis(PING_INTERVAL_MS + PING_TIMEOUT_MS);
/// Beat of a connection that waits for telemetry.
const QUICK_BEAT: Duration = Duration::from_millis(10);
/// Beat of one that has time.
const SLOW_BEAT: Duration = Duration::from_millis(200);
/// Throttle that must move a car.
const STRONG_THROTTLE: f32 = 0.2;
/// Commands with a strong throttle after which a car must show it.
const DEAF_AFTER: u32 = 40;

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

/// Reads the request and answers it.
fn open<'a>(shared: &'a Shared, peer: &'a Arc<Peer>, address: SocketAddr) -> Result<Connection<'a>, End> {
    let journal = &shared.journal;
    journal.step(format_args!("{address}: TCP connection"));
    let mut socket = Socket::new(peer.stream.try_clone()?, SLOW_BEAT)?;
    let began = Instant::now();
    let mut head = Vec::with_capacity(1024);
    let (response, head_len, client) = loop {
        let mut chunk = [0; 1024];
        socket.begin_beat();
        match socket.read(&mut chunk) {
            Ok(0) => return Err(End::Closed),
            Ok(len) => head.extend_from_slice(&chunk[..len]),
            Err(error) if is_timeout(&error) => {}
            Err(error) => return Err(error.into()),
        }
        if shared.stop.load(Ordering::Relaxed) {
            return Err(End::Closed);
        }
        match examine(&head, &shared.options.allowed_origins) {
            Verdict::Incomplete if began.elapsed() > HANDSHAKE_TIME => {
                let text = format!("no complete request within {} s", HANDSHAKE_TIME.as_secs());
                return Err(End::Fault(Event::TooSlow, text));
            }
            Verdict::Incomplete => {}
            Verdict::Refuse { response, reason } => {
                show_request(shared, address, &head);
                journal.step(format_args!("{address} < {}", response.lines().next().unwrap_or("")));
                socket.write_all(response.as_bytes())?;
                socket.finish(FAREWELL);
                return Err(End::Fault(Event::Refused, format!("refused, {reason}")));
            }
            Verdict::Accept { response, head_len, client } => break (response, head_len, client),
        }
    };
    show_request(shared, address, &head[..head_len]);
    journal.step(format_args!("{address} < {}", response.lines().next().unwrap_or("")));
    socket.write_all(response.as_bytes())?;
    peer.set_stage(Stage::Open);
    let who = match &client {
        client if client.is_simulator() => "Udacity's simulator",
        client if client.agent.is_empty() => "a client without a name",
        client => &client.agent,
    };
    journal.report(Event::Connected, format_args!("{address}: {who} connected"));
    if client.is_simulator() {
        journal.step(format_args!("{address}: needs no Socket.IO handshake; its first telemetry comes by itself"));
    }
    socket.set_beat(QUICK_BEAT)?;
    let config = WebSocketConfig::default()
        .read_buffer_size(32 * 1024)
        .write_buffer_size(0)
        .max_write_buffer_size(64 * 1024)
        .max_message_size(Some(MAX_MESSAGE))
        .max_frame_size(Some(MAX_MESSAGE));
    let rest = head[head_len..].to_vec();
    let websocket = WebSocket::from_partially_read(socket, rest, Role::Server, Some(config));
    let now = Instant::now();
    Ok(Connection {
        shared,
        peer,
        address,
        websocket,
        tokens: Tokens::new(u32::from(client.is_simulator())),
        client,
        greeted: false,
        opened: now,
        last_message: now,
        last_ping: now,
        last_telemetry: None,
        last_question: now,
        held: None,
        faults: 0,
        style: NumberStyle::default(),
        helm: Helm::new(shared.options.helm),
        waits: false,
        pace: Pace::new(now),
        lockstep: false,
        overridden: false,
        cut: false,
        deaf: 0,
        shown: 0,
        image: Vec::new(),
        reply: String::new(),
    })
}

fn show_request(shared: &Shared, address: SocketAddr, head: &[u8]) {
    if shared.journal.checks() {
        for line in String::from_utf8_lossy(head).lines().filter(|line| !line.is_empty()).take(20) {
            let line: String = line.chars().filter(|c| !c.is_control()).take(160).collect();
            shared.journal.step(format_args!("{address} > {line}"));
        }
    }
}

/// A WebSocket and what is known of the client behind it.
struct Connection<'a> {
    shared: &'a Shared<'a>,
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

impl Connection<'_> {
    fn run(&mut self) -> Result<(), End> {
        let mut batch = Vec::with_capacity(MAX_BATCH);
        loop {
            if self.shared.stop.load(Ordering::Relaxed) {
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
        while !self.shared.stop.load(Ordering::Relaxed) && !self.peer.is_closing() {
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

    /// What is due apart from messages.
    fn after_beat(&mut self) -> Result<(), End> {
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

    /// Answers the newest telemetry, whose last byte came at `came`.
    fn answer(&mut self, packet: ClientPacket, came: Instant) -> Result<(), End> {
        let telemetry = match packet {
            ClientPacket::Telemetry(telemetry, _) => telemetry,
            _ => return self.let_person_drive(came),
        };
        self.learn_style(&telemetry);
        if self.overridden {
            self.overridden = false;
            self.shared.journal.step(format_args!("{}: the model drives again", self.address));
        }
        let Some(image) = &telemetry.image else {
            return self.bad_telemetry(Event::NoImage, format_args!("telemetry without an image"));
        };
        let Some(speed_mph) = telemetry.speed_mph else {
            return self.bad_telemetry(Event::NoSpeed, format_args!("telemetry without a speed"));
        };
        let steering = match self.look(image) {
            Ok(steering) => steering,
            Err(text) => return self.bad_telemetry(Event::UnreadableImage, format_args!("{text}")),
        };
        match self.shared.seat.claim(self.peer.id, &self.peer.stream, Instant::now()) {
            Claim::Kept => {}
            Claim::Taken => {
                self.peer.set_stage(Stage::Trusted);
                self.waits = false;
                self.shared.journal.report(Event::Drives, format_args!("{} is driven", self.address));
            }
            // Another was faster; this client's token is kept by asking for its next telemetry.
            Claim::Refused => return self.ask(),
        }
        self.faults = 0;
        self.lockstep = telemetry.time_s.is_some();
        let clock = telemetry.time_s.map_or(Clock::Arrival(came), Clock::Simulated);
        let command = self.helm.command(steering, speed_mph, clock);
        self.steer(command)?;
        self.cut = false;
        self.shared.statistics().answered(came, Instant::now(), command, speed_mph);
        self.check_obedience(&telemetry, command);
        if let Some(recorder) = &self.shared.recorder {
            match recorder.push(clock, &self.image, command, speed_mph) {
                Queued::Yes => {}
                Queued::Dropped => {
                    self.shared.journal.report(Event::RecordingLags, format_args!("a frame could not be recorded"));
                }
                Queued::Failed => self.shared.recording_failed.store(true, Ordering::Relaxed),
            }
        }
        Ok(())
    }

    /// What the model says to an image in base64.
    fn look(&mut self, image: &str) -> Result<f32, String> {
        let len = BASE64.decode_len(image.len()).map_err(|_| "an image whose base64 is incomplete".to_string())?;
        self.image.resize(len, 0);
        let len = BASE64
            .decode_mut(image.as_bytes(), &mut self.image)
            .map_err(|partial| format!("an image that is not base64: {}", partial.error))?;
        self.image.truncate(len);
        let mut pilot = self.shared.pilot.lock().unwrap_or_else(PoisonError::into_inner);
        pilot
            .steer_encoded_within(&self.image, MAX_IMAGE_SIDE)
            .map_err(|error| format!("an image that cannot be used: {error}"))
    }

    fn learn_style(&mut self, telemetry: &Telemetry) {
        let style = telemetry.number_style();
        if style == self.style {
            return;
        }
        self.style = style;
        match style {
            NumberStyle::Numbers => {
                let text = format_args!("{}: a simulator of the second term (it sends `cte`)", self.address);
                self.shared.journal.report(Event::SecondTerm, text);
            }
            NumberStyle::Strings(mark) if mark != DecimalMark::DOT => {
                let text = format_args!("{}: writes numbers with the decimal mark `{}`", self.address, mark.char());
                self.shared.journal.report(Event::DecimalMark, text);
            }
            NumberStyle::Strings(_) => {}
        }
    }

    fn let_person_drive(&mut self, came: Instant) -> Result<(), End> {
        if !self.overridden {
            self.overridden = true;
            self.shared.journal.report(Event::Override, format_args!("{}: a person drives", self.address));
        }
        self.shared.seat.is_held_by(self.peer.id, came);
        self.helm.release();
        (self.deaf, self.cut) = (0, false);
        self.ask()
    }

    /// Telemetry by which nobody can drive.
    fn bad_telemetry(&mut self, event: Event, text: std::fmt::Arguments) -> Result<(), End> {
        self.fault(event, text)?;
        self.answer_blind()
    }

    /// Answers telemetry that could not be used: the driving client gets its throttle cut, another is asked again, so that
    /// the car does not wait for ever.
    fn answer_blind(&mut self) -> Result<(), End> {
        if self.shared.seat.is_held_by(self.peer.id, Instant::now()) {
            let command = self.helm.cut_throttle();
            self.steer(command)
        } else {
            self.ask()
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

    /// Says so if the car shows none of the throttle it was given.
    fn check_obedience(&mut self, telemetry: &Telemetry, command: Command) {
        let shows_none = telemetry.throttle.is_some_and(|throttle| throttle == 0.0);
        let deaf =
            shows_none && command.throttle >= STRONG_THROTTLE && telemetry.speed_mph.is_some_and(|mph| mph < 1.0);
        self.deaf = if deaf { self.deaf + 1 } else { 0 };
        if self.deaf >= DEAF_AFTER {
            self.deaf = 0;
            let text = format_args!("{}: was given throttle {DEAF_AFTER} times and shows none", self.address);
            self.shared.journal.report(Event::ThrottleIgnored, text);
        }
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
