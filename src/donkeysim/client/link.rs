//! The connection to the simulator: lines in, one message for each write out.

use std::io::{ErrorKind, Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::time::{Duration, Instant};

use super::telemetry::{ServerMessage, parse};
use crate::{Error, Result};

/// Longest message of the simulator, bytes. A picture of 640x480 as PNG has less than a quarter of it.
pub const MAX_MESSAGE_BYTES: usize = 4 << 20;
/// Longest time for connecting.
const CONNECT_PATIENCE: Duration = Duration::from_secs(5);
/// Longest time that the simulator may take to accept what is sent.
const SEND_PATIENCE: Duration = Duration::from_secs(3);
/// Shortest time between two messages: the simulator takes what arrives at once for one message.
const SEND_PAUSE: Duration = Duration::from_millis(15);

/// A connection to the simulator.
#[derive(Debug)]
pub(super) struct Link {
    stream: TcpStream,
    /// Where it leads, for errors.
    place: String,
    /// What has arrived; the next message begins at `start`, and up to `searched` there is no end of a line.
    bytes: Vec<u8>,
    start: usize,
    searched: usize,
    /// Messages so far, for errors.
    count: u64,
    last_send: Option<Instant>,
}

impl Link {
    /// Connects to `server`, `HOST:PORT`.
    ///
    /// # Errors
    ///
    /// [`Error::Connection`] with the remedy.
    pub fn connect(server: &str) -> Result<Link> {
        let fail = |why: std::io::Error| {
            let remedy = match why.kind() {
                ErrorKind::ConnectionRefused => {
                    "nobody listens there: start DonkeySim first (its window says the port, usually 9091), or \
                     `steersman sim --as donkeysim --track lake` in its place"
                }
                ErrorKind::TimedOut => "nobody answers there; check host and port, and firewalls between the machines",
                _ => "check host and port, as in --donkeysim 127.0.0.1:9091",
            };
            Error::Connection(format!("{server}: {why}: {remedy}"))
        };
        let mut error = ErrorKind::AddrNotAvailable.into();
        for address in server.to_socket_addrs().map_err(fail)? {
            let connected = TcpStream::connect_timeout(&address, CONNECT_PATIENCE).and_then(|stream| {
                stream.set_nodelay(true)?;
                stream.set_write_timeout(Some(SEND_PATIENCE))?;
                Ok(stream)
            });
            match connected {
                Ok(stream) => {
                    return Ok(Link {
                        stream,
                        place: server.into(),
                        bytes: Vec::new(),
                        start: 0,
                        searched: 0,
                        count: 0,
                        last_send: None,
                    });
                }
                Err(failed) => error = failed,
            }
        }
        Err(fail(error))
    }

    /// An error of this connection.
    pub fn error(&self, what: impl std::fmt::Display) -> Error {
        Error::Connection(format!("{}: {what}", self.place))
    }

    /// Sends one message, some time after the one before.
    ///
    /// # Errors
    ///
    /// [`Error::Connection`] if the simulator is gone or takes nothing.
    pub fn send(&mut self, message: &str) -> Result<()> {
        if let Some(last) = self.last_send {
            std::thread::sleep(SEND_PAUSE.saturating_sub(last.elapsed()));
        }
        let sent = self.stream.write_all(message.as_bytes());
        self.last_send = Some(Instant::now());
        sent.map_err(|why| match why.kind() {
            ErrorKind::WouldBlock | ErrorKind::TimedOut => {
                self.error("the simulator takes nothing any more; is it paused or hung?")
            }
            _ => self.gone(),
        })
    }

    fn gone(&self) -> Error {
        self.error("the simulator has closed the connection; is its window closed, or its scene left?")
    }

    /// The next message, for which it waits at most `wait`.
    ///
    /// # Errors
    ///
    /// [`Error::Connection`] if the connection ends, or something arrives that is no message.
    pub fn receive(&mut self, wait: Duration) -> Result<Option<ServerMessage>> {
        if let Some(message) = self.next()? {
            return Ok(Some(message));
        }
        let wait = wait.max(Duration::from_millis(1));
        let setting = self.stream.set_nonblocking(false).and_then(|()| self.stream.set_read_timeout(Some(wait)));
        setting.map_err(|why| self.error(why))?;
        self.read()?;
        self.next()
    }

    /// The next message, if it has arrived already.
    ///
    /// # Errors
    ///
    /// As [`receive`](Link::receive).
    pub fn receive_arrived(&mut self) -> Result<Option<ServerMessage>> {
        if let Some(message) = self.next()? {
            return Ok(Some(message));
        }
        self.stream.set_nonblocking(true).map_err(|why| self.error(why))?;
        let read = self.read();
        self.stream.set_nonblocking(false).map_err(|why| self.error(why))?;
        read?;
        self.next()
    }

    /// Reads once.
    fn read(&mut self) -> Result<()> {
        let mut buffer = [0; 1 << 16];
        match self.stream.read(&mut buffer) {
            Ok(0) => Err(self.gone()),
            Ok(len) => {
                self.bytes.extend_from_slice(&buffer[..len]);
                Ok(())
            }
            Err(why) if matches!(why.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted) => {
                Ok(())
            }
            Err(_) => Err(self.gone()),
        }
    }

    /// The next whole message in what has arrived.
    fn next(&mut self) -> Result<Option<ServerMessage>> {
        loop {
            let Some(len) = self.bytes[self.searched..].iter().position(|byte| *byte == b'\n') else {
                self.searched = self.bytes.len();
                // What was read already is dropped before more arrives.
                self.bytes.drain(..self.start);
                (self.searched, self.start) = (self.searched - self.start, 0);
                if self.bytes.len() > MAX_MESSAGE_BYTES {
                    let message = format!("message {} has more than {} MiB", self.count + 1, MAX_MESSAGE_BYTES >> 20);
                    return Err(self.no_simulator(&message));
                }
                return Ok(None);
            };
            let (begin, end) = (self.start, self.searched + len);
            (self.start, self.searched) = (end + 1, end + 1);
            let line = self.bytes[begin..end].trim_ascii();
            if line.is_empty() {
                continue;
            }
            self.count += 1;
            return match parse(line) {
                Ok(message) => Ok(Some(message)),
                Err(what) => Err(self.no_simulator(&format!("message {} is {what}", self.count))),
            };
        }
    }

    fn no_simulator(&self, what: &str) -> Error {
        self.error(format!("{what}; is this DonkeySim? It speaks JSON, one object a line, usually at port 9091"))
    }
}
