//! The connection as the simulator's `SocketIOComponent` keeps it: one thread connects, again and again, and reads; another
//! pings; whoever has something to say writes.

use std::io::{self, BufReader};
use std::net::{Shutdown, TcpStream, ToSocketAddrs};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{JoinHandle, spawn};
use std::time::{Duration, Instant};

use super::frames::{FrameReader, FrameWriter, Incoming};
use super::handshake::{ServerUrl, shake_hands};
use super::reaction::{Numbers, Reaction, Steer, react};
use crate::simulator::math::Rng;

/// Pause of both threads while there is nothing to do; also between attempts to connect, where the original has none.
const IDLE: Duration = Duration::from_millis(5);
/// How often the answer to a ping is looked for.
const PONG_POLL: Duration = Duration::from_millis(200);
/// Pause after the answer to a ping.
const PING_INTERVAL: Duration = Duration::from_secs(25);
/// Longest time for connecting, for the handshake and for a write.
const IO_LIMIT: Duration = Duration::from_secs(10);
/// How long the server has for its half of closing.
const CLOSING_LIMIT: Duration = Duration::from_secs(1);

/// What happened on the connection, for the main loop.
#[derive(Debug, PartialEq)]
pub enum Event {
    /// The WebSocket opened, or the server sent an open packet: one more telemetry is due.
    Open,
    /// A command, and when it had arrived.
    Steer(Steer, Instant),
    /// `manual`, and when it had arrived: one more telemetry is due.
    Manual(Instant),
    /// The connection is gone, and is tried again at once. Why it ended.
    Closed(String),
    /// There is no connection yet, for this reason; told again only when the reason changes.
    Unreachable(String),
}

/// A connection that comes back by itself.
pub struct Connection {
    link: Arc<Link>,
    events: Receiver<Event>,
    socket: JoinHandle<()>,
    pings: JoinHandle<()>,
}

/// What the threads share.
#[derive(Default)]
struct Link {
    url: ServerUrl,
    writer: Mutex<Option<FrameWriter<TcpStream>>>,
    /// Whether the main loop has seen the connection; pings wait for that.
    seen: AtomicBool,
    ponged: AtomicBool,
    connections: AtomicU64,
    stopped: Mutex<bool>,
    stop: Condvar,
}

impl Connection {
    /// Starts to connect to `url`. `seed` draws keys and masks.
    pub fn start(url: &ServerUrl, numbers: Numbers, seed: u64) -> Connection {
        let link = Arc::new(Link { url: url.clone(), ..Link::default() });
        let (sender, events) = channel();
        let socket = {
            let link = link.clone();
            spawn(move || link.run_socket(numbers, seed, &sender))
        };
        let pings = {
            let link = link.clone();
            spawn(move || link.run_pings())
        };
        Connection { link, events, socket, pings }
    }

    /// What has happened, if something has; to be called in every frame.
    pub fn poll(&self) -> Option<Event> {
        self.link.seen.store(self.link.writer().is_some(), Ordering::Relaxed);
        self.events.try_recv().ok()
    }

    /// Waits at most `limit` for something to happen.
    pub fn wait(&self, limit: Duration) -> Option<Event> {
        self.link.seen.store(self.link.writer().is_some(), Ordering::Relaxed);
        self.events.recv_timeout(limit).ok()
    }

    /// Sends a message. Without a connection, or when it breaks, the message is lost, as it is in the original.
    pub fn send(&self, text: &str) -> bool {
        self.link.send(text)
    }

    /// WebSocket connections so far.
    pub fn count(&self) -> u64 {
        self.link.connections.load(Ordering::Relaxed)
    }

    /// Ends it as the simulator does when the application quits.
    pub fn quit(self) {
        // First, so that nobody connects anew when the server closes at the first word.
        self.link.set_stopped();
        self.link.send("41");
        self.link.send("1");
        if let Some(writer) = self.link.writer().as_mut() {
            // A server that is gone need not be told.
            let _ = writer.close(None);
        }
        let asked = Instant::now();
        while !self.socket.is_finished() && asked.elapsed() < CLOSING_LIMIT {
            std::thread::sleep(IDLE);
        }
        self.end();
    }

    /// Ends it as the simulator does when the scene changes: without a word.
    pub fn abort(self) {
        self.link.set_stopped();
        self.end();
    }

    fn end(self) {
        self.link.shut_down();
        for thread in [self.socket, self.pings] {
            if let Err(panic) = thread.join() {
                std::panic::resume_unwind(panic);
            }
        }
    }
}

impl Link {
    /// A thread that panicked with the lock is no reason to lose the connection.
    fn writer(&self) -> MutexGuard<'_, Option<FrameWriter<TcpStream>>> {
        self.writer.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn send(&self, text: &str) -> bool {
        let mut writer = self.writer();
        match writer.as_mut().map(|writer| (writer.text(text), writer.stream())) {
            Some((Ok(()), _)) => true,
            Some((Err(_), stream)) => {
                // The reading thread finds the end and connects anew.
                let _ = stream.shutdown(Shutdown::Both);
                false
            }
            None => false,
        }
    }

    fn shut_down(&self) {
        if let Some(writer) = self.writer().as_ref() {
            // Closed already is as good.
            let _ = writer.stream().shutdown(Shutdown::Both);
        }
    }

    fn set_stopped(&self) {
        *self.stopped.lock().unwrap_or_else(PoisonError::into_inner) = true;
        self.stop.notify_all();
    }

    /// Sleeps, unless it is time to stop. Whether to go on.
    fn sleep(&self, time: Duration) -> bool {
        let stopped = self.stopped.lock().unwrap_or_else(PoisonError::into_inner);
        let waited = self.stop.wait_timeout_while(stopped, time, |stopped| !*stopped);
        !*waited.unwrap_or_else(PoisonError::into_inner).0
    }

    /// Connects whenever there is no connection.
    fn run_socket(&self, numbers: Numbers, seed: u64, events: &Sender<Event>) {
        let mut keys = Rng::new(seed, "websocket keys");
        let mut unreachable = String::new();
        // Whoever listens has gone when sending fails, and then this thread is about to be stopped.
        let tell = |event| drop(events.send(event));
        while self.sleep(Duration::ZERO) {
            match self.connect(&mut keys) {
                Ok(mut reader) => {
                    unreachable.clear();
                    self.connections.fetch_add(1, Ordering::Relaxed);
                    tell(Event::Open);
                    let why = self.receive(&mut reader, numbers, &tell);
                    self.shut_down();
                    *self.writer() = None;
                    tell(Event::Closed(why));
                }
                Err(e) => {
                    let reason = e.to_string();
                    if reason != unreachable {
                        unreachable = reason;
                        tell(Event::Unreachable(unreachable.clone()));
                    }
                    self.sleep(IDLE);
                }
            }
        }
    }

    /// The first address of the host at which somebody listens: `localhost` may be `::1` before it is `127.0.0.1`.
    fn reach(&self) -> io::Result<TcpStream> {
        let mut error = io::Error::other("the host has no address");
        for address in self.url.address().to_socket_addrs()? {
            match TcpStream::connect_timeout(&address, IO_LIMIT) {
                Ok(stream) => return Ok(stream),
                Err(failed) => error = failed,
            }
            if !self.sleep(Duration::ZERO) {
                break;
            }
        }
        Err(error)
    }

    fn connect(&self, keys: &mut Rng) -> io::Result<FrameReader<BufReader<TcpStream>>> {
        // Nagle's algorithm stays on: websocket-sharp does not turn it off.
        let mut stream = self.reach()?;
        stream.set_write_timeout(Some(IO_LIMIT))?;
        stream.set_read_timeout(Some(IO_LIMIT))?;
        let mut reader = BufReader::new(stream.try_clone()?);
        shake_hands(&mut stream, &mut reader, &self.url, keys)?;
        stream.set_read_timeout(None)?;
        *self.writer() = Some(FrameWriter::new(stream, keys.next_u64()));
        // Whoever stopped this before that line found nothing to shut down.
        if self.sleep(Duration::ZERO) { Ok(FrameReader::new(reader)) } else { Err(io::ErrorKind::Interrupted.into()) }
    }

    /// Reads until the connection ends; why it did.
    fn receive(
        &self,
        reader: &mut FrameReader<BufReader<TcpStream>>,
        numbers: Numbers,
        tell: &impl Fn(Event),
    ) -> String {
        loop {
            let text = match reader.read() {
                Ok(Incoming::Text(text)) => text,
                Ok(Incoming::Ping(payload)) => {
                    // A broken connection is found by the next read.
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
                Ok(Reaction::Open) => tell(Event::Open),
                Ok(Reaction::Steer(steer)) => tell(Event::Steer(steer, arrived)),
                Ok(Reaction::Manual) => tell(Event::Manual(arrived)),
                Err(why) => {
                    let start: String = text.chars().take(60).collect();
                    return format!("closed with 1006, because the server sent {why}: {start:?}");
                }
            }
        }
    }

    /// Pings once the main loop has seen a connection, and 25 s after each pong.
    fn run_pings(&self) {
        while self.sleep(Duration::ZERO) {
            if !self.seen.load(Ordering::Relaxed) {
                self.sleep(IDLE);
                continue;
            }
            self.ponged.store(false, Ordering::Relaxed);
            self.send("2");
            // The original's time limit is 60,000 seconds by a slip of units; a missing pong blocks this thread for good.
            while self.writer().is_some() && !self.ponged.load(Ordering::Relaxed) {
                if !self.sleep(PONG_POLL) {
                    return;
                }
            }
            if !self.ponged.load(Ordering::Relaxed)
                && let Some(writer) = self.writer().as_mut()
            {
                // The connection dropped while the pong was due: the original closes whatever there is now.
                let _ = writer.close(None);
            }
            self.sleep(PING_INTERVAL);
        }
    }
}
