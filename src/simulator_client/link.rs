//! The connection to the server, as the simulator's `SocketIOComponent` keeps it: one thread connects again and again and
//! reads, another one pings, and each of them writes.

use std::io::{self, BufReader};
use std::net::{Shutdown, TcpStream, ToSocketAddrs};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{JoinHandle, spawn};
use std::time::{Duration, Instant};

use super::frames::{FrameReader, FrameWriter, Incoming};
use super::handshake::shake_hands;
use super::reaction::{Reaction, Steer, react};
use super::server_url::ServerUrl;
use crate::text::excerpt;
use crate::udacity::NumberStyle;

/// Pause of both threads while there is nothing to do; also between attempts to connect, where the original has none.
const IDLE: Duration = Duration::from_millis(5);
/// Time between two checks for the answer to a ping.
const PONG_POLL: Duration = Duration::from_millis(200);
/// Pause after the answer to a ping.
const PING_INTERVAL: Duration = Duration::from_secs(25);
/// Longest time for connecting, for the handshake and for a write.
const MAX_IO_TIME: Duration = Duration::from_secs(10);
/// Longest time that the server has to close its side.
const MAX_CLOSING_TIME: Duration = Duration::from_secs(1);

/// Something that happened on the connection.
#[derive(Debug, PartialEq)]
pub enum LinkEvent {
    /// The WebSocket opened, or the server sent an open packet: one more telemetry is due.
    Open,
    /// A command, and when it had arrived.
    Steer(Steer, Instant),
    /// `manual`, and when it had arrived: one more telemetry is due.
    Manual(Instant),
    /// The connection ended, for this reason. The client connects again at once.
    Closed(String),
    /// There is no connection yet, for this reason. Sent again only when the reason changes.
    Unreachable(String),
}

/// A connection that opens again by itself.
pub struct ServerLink {
    shared: Arc<Shared>,
    events: Receiver<LinkEvent>,
    socket: JoinHandle<()>,
    pings: JoinHandle<()>,
}

/// What the threads share.
#[derive(Default)]
struct Shared {
    url: ServerUrl,
    writer: Mutex<Option<FrameWriter<TcpStream>>>,
    /// Whether the main loop has seen the connection. Pings wait for that.
    seen: AtomicBool,
    ponged: AtomicBool,
    connections: AtomicU64,
    stopped: Mutex<bool>,
    stop: Condvar,
}

impl ServerLink {
    /// Starts to connect to `url`. `seed` draws the masks of the frames.
    pub fn start(url: &ServerUrl, numbers: NumberStyle, seed: u64) -> ServerLink {
        let shared = Arc::new(Shared { url: url.clone(), ..Shared::default() });
        let (sender, events) = channel();
        let socket = {
            let shared = shared.clone();
            spawn(move || shared.run_socket(numbers, seed, &sender))
        };
        let pings = {
            let shared = shared.clone();
            spawn(move || shared.run_pings())
        };
        ServerLink { shared, events, socket, pings }
    }

    /// The next thing that happened, if any. The main loop calls this in every frame.
    pub fn poll(&self) -> Option<LinkEvent> {
        self.shared.seen.store(self.shared.writer().is_some(), Ordering::Relaxed);
        self.events.try_recv().ok()
    }

    /// Waits at most `limit` for something to happen.
    pub fn wait(&self, limit: Duration) -> Option<LinkEvent> {
        self.shared.seen.store(self.shared.writer().is_some(), Ordering::Relaxed);
        self.events.recv_timeout(limit).ok()
    }

    /// Sends a message. Without a connection the message is lost, as in the original.
    pub fn send(&self, text: &str) -> bool {
        self.shared.send(text)
    }

    /// Number of WebSocket connections so far.
    pub fn count(&self) -> u64 {
        self.shared.connections.load(Ordering::Relaxed)
    }

    /// Closes the connection as the simulator does when the application quits.
    pub fn quit(self) {
        // This comes first, so that the thread does not connect again when the server closes.
        self.shared.set_stopped();
        self.shared.send("41");
        self.shared.send("1");
        if let Some(writer) = self.shared.writer().as_mut() {
            // The server may be gone.
            let _ = writer.close(None);
        }
        let asked = Instant::now();
        while !self.socket.is_finished() && asked.elapsed() < MAX_CLOSING_TIME {
            std::thread::sleep(IDLE);
        }
        self.end();
    }

    /// Closes the connection as the simulator does when the scene changes: without a close frame.
    pub fn abort(self) {
        self.shared.set_stopped();
        self.end();
    }

    fn end(self) {
        self.shared.shut_down();
        for thread in [self.socket, self.pings] {
            if let Err(panic) = thread.join() {
                std::panic::resume_unwind(panic);
            }
        }
    }
}

impl Shared {
    /// The writer, locked. A panic of another thread does not end the connection.
    fn writer(&self) -> MutexGuard<'_, Option<FrameWriter<TcpStream>>> {
        self.writer.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn send(&self, text: &str) -> bool {
        let mut writer = self.writer();
        match writer.as_mut().map(|writer| (writer.text(text), writer.stream())) {
            Some((Ok(()), _)) => true,
            Some((Err(_), stream)) => {
                // The reading thread finds the end and connects again.
                let _ = stream.shutdown(Shutdown::Both);
                false
            }
            None => false,
        }
    }

    fn shut_down(&self) {
        if let Some(writer) = self.writer().as_ref() {
            // It may be closed already.
            let _ = writer.stream().shutdown(Shutdown::Both);
        }
    }

    fn set_stopped(&self) {
        *self.stopped.lock().unwrap_or_else(PoisonError::into_inner) = true;
        self.stop.notify_all();
    }

    /// Sleeps, at most until the client stops. Whether to go on.
    fn sleep(&self, time: Duration) -> bool {
        let stopped = self.stopped.lock().unwrap_or_else(PoisonError::into_inner);
        let waited = self.stop.wait_timeout_while(stopped, time, |stopped| !*stopped);
        !*waited.unwrap_or_else(PoisonError::into_inner).0
    }

    /// Connects whenever there is no connection.
    fn run_socket(&self, numbers: NumberStyle, seed: u64, events: &Sender<LinkEvent>) {
        let mut unreachable = String::new();
        // Sending fails only when the main loop has ended, and then this thread ends, too.
        let tell = |event| drop(events.send(event));
        while self.sleep(Duration::ZERO) {
            match self.connect(seed) {
                Ok(mut reader) => {
                    unreachable.clear();
                    self.connections.fetch_add(1, Ordering::Relaxed);
                    tell(LinkEvent::Open);
                    let why = self.receive(&mut reader, numbers, &tell);
                    self.shut_down();
                    *self.writer() = None;
                    tell(LinkEvent::Closed(why));
                }
                Err(e) => {
                    let reason = e.to_string();
                    if reason != unreachable {
                        unreachable = reason;
                        tell(LinkEvent::Unreachable(unreachable.clone()));
                    }
                    self.sleep(IDLE);
                }
            }
        }
    }

    /// Connects to the first address of the host that accepts: `localhost` may be `::1` and `127.0.0.1`.
    fn reach(&self) -> io::Result<TcpStream> {
        let mut error = io::Error::other("the host has no address");
        for address in self.url.address().to_socket_addrs()? {
            match TcpStream::connect_timeout(&address, MAX_IO_TIME) {
                Ok(stream) => return Ok(stream),
                Err(failed) => error = failed,
            }
            if !self.sleep(Duration::ZERO) {
                break;
            }
        }
        Err(error)
    }

    fn connect(&self, seed: u64) -> io::Result<FrameReader<BufReader<TcpStream>>> {
        // Nagle's algorithm stays on: websocket-sharp does not turn it off.
        let mut stream = self.reach()?;
        stream.set_write_timeout(Some(MAX_IO_TIME))?;
        stream.set_read_timeout(Some(MAX_IO_TIME))?;
        let mut reader = BufReader::new(stream.try_clone()?);
        shake_hands(&mut stream, &mut reader, &self.url)?;
        stream.set_read_timeout(None)?;
        *self.writer() = Some(FrameWriter::new(stream, seed ^ self.connections.load(Ordering::Relaxed)));
        // A stop before that line found no stream to shut down.
        if self.sleep(Duration::ZERO) { Ok(FrameReader::new(reader)) } else { Err(io::ErrorKind::Interrupted.into()) }
    }

    /// Reads until the connection ends. Returns the reason.
    fn receive(
        &self,
        reader: &mut FrameReader<BufReader<TcpStream>>,
        numbers: NumberStyle,
        tell: &impl Fn(LinkEvent),
    ) -> String {
        loop {
            let text = match reader.read() {
                Ok(Incoming::Text(text)) => text,
                Ok(Incoming::Ping(payload)) => {
                    // The next read finds a broken connection.
                    let _ = self.writer().as_mut().map(|writer| writer.pong(&payload));
                    continue;
                }
                Ok(Incoming::Pong) => continue,
                Ok(Incoming::Binary) => return "the server sent a binary message".into(),
                Ok(Incoming::Close(code)) => {
                    let _ = self.writer().as_mut().map(|writer| writer.close(code));
                    let code = code.map_or(String::new(), |code| format!(" with code {code}"));
                    return format!("the server closed the connection{code}");
                }
                Err(e) if e.kind() == io::ErrorKind::UnexpectedEof => return "the connection ended".into(),
                Err(e) => {
                    if e.kind() == io::ErrorKind::InvalidData {
                        const PROTOCOL_ERROR: u16 = 1002;
                        let _ = self.writer().as_mut().map(|writer| writer.close(Some(PROTOCOL_ERROR)));
                    }
                    return e.to_string();
                }
            };
            let arrived = Instant::now();
            match react(&text, numbers) {
                Ok(Reaction::Ignored) => {}
                Ok(Reaction::Ping) => drop(self.send("3")),
                Ok(Reaction::Pong) => self.ponged.store(true, Ordering::Relaxed),
                Ok(Reaction::Open) => tell(LinkEvent::Open),
                Ok(Reaction::Steer(steer)) => tell(LinkEvent::Steer(steer, arrived)),
                Ok(Reaction::Manual) => tell(LinkEvent::Manual(arrived)),
                Err(why) => {
                    let start = excerpt(&text, 60);
                    return format!("closed with 1006, because the server sent {why}: \"{start}\"");
                }
            }
        }
    }

    /// Pings when the main loop has seen a connection, and 25 s after each pong.
    fn run_pings(&self) {
        while self.sleep(Duration::ZERO) {
            if !self.seen.load(Ordering::Relaxed) {
                self.sleep(IDLE);
                continue;
            }
            self.ponged.store(false, Ordering::Relaxed);
            self.send("2");
            // The original waits 60,000 seconds, because of a wrong unit: a missing pong blocks this thread for ever.
            while self.writer().is_some() && !self.ponged.load(Ordering::Relaxed) {
                if !self.sleep(PONG_POLL) {
                    return;
                }
            }
            if !self.ponged.load(Ordering::Relaxed)
                && let Some(writer) = self.writer().as_mut()
            {
                // The connection dropped while the pong was due. The original closes the present connection.
                let _ = writer.close(None);
            }
            self.sleep(PING_INTERVAL);
        }
    }
}
