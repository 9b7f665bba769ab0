//! A server that says what a test tells it to say, in the place of `serve`.

use std::net::{TcpListener, TcpStream};
use std::thread::JoinHandle;
use std::time::Duration;

use tungstenite::{Message, WebSocket};

/// Longest silence of a client that a test waits for. Long, because the machine may stand still for a while.
pub const SILENCE: Duration = Duration::from_secs(150);

/// The server's end of a connection.
pub struct Peer(WebSocket<TcpStream>);

impl Peer {
    /// Accepts a client.
    pub fn accept(listener: &TcpListener) -> Peer {
        let (stream, _) = listener.accept().unwrap();
        stream.set_read_timeout(Some(SILENCE)).unwrap();
        stream.set_nodelay(true).unwrap();
        Peer(tungstenite::accept(stream).unwrap())
    }

    /// Sends a text.
    pub fn send(&mut self, text: &str) {
        self.0.send(Message::text(text)).unwrap();
    }

    /// The next text, without those that begin as `skip` says; `None` at the end of the connection.
    pub fn next_but(&mut self, skip: &str) -> Option<String> {
        loop {
            match self.0.read() {
                Ok(Message::Text(text)) if skip.is_empty() || !text.starts_with(skip) => return Some(text.to_string()),
                Ok(Message::Text(_) | Message::Ping(_) | Message::Pong(_)) => {}
                Ok(Message::Close(_)) | Err(tungstenite::Error::ConnectionClosed | tungstenite::Error::Protocol(_)) => {
                    return None;
                }
                Err(tungstenite::Error::Io(e)) if e.kind() == std::io::ErrorKind::ConnectionReset => return None,
                other => panic!("{other:?}"),
            }
        }
    }

    /// The next text that is no ping.
    pub fn next(&mut self) -> Option<String> {
        self.next_but("2")
    }

    /// The stream below.
    pub fn stream(&self) -> &TcpStream {
        self.0.get_ref()
    }
}

/// Runs `serve` in a thread with a listener on a free port of loopback. The port, and the thread to be joined.
pub fn start<T: Send + 'static>(serve: impl FnOnce(TcpListener) -> T + Send + 'static) -> (u16, JoinHandle<T>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    (port, std::thread::spawn(move || serve(listener)))
}
