//! Serves the page and its WebSocket, to this machine only.

use std::io::Write as _;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use tungstenite::protocol::{Role, WebSocketConfig};
use tungstenite::{Message, WebSocket};

use super::controls::Wheel;
use super::hub::Hub;
use super::messages::{Farewell, Hello, Request, State};
use super::playback::Playback;
use crate::error::{Error, Result};
use crate::net::connections::{Peer, Rank};
use crate::net::handshake;
use crate::net::http::{self, Head};
use crate::net::loopback::{self, Request as Received};
use crate::net::socket::{Socket, is_timeout};

/// Default port of the page.
pub const DEFAULT_PORT: u16 = 4568;
/// The whole page.
const PAGE: &str = include_str!("page.html");
/// The path of the WebSocket.
const SOCKET_PATH: &str = "/live";
/// Headers of the page. It loads nothing from elsewhere, and no other page may show it in a frame and click its buttons.
const HEADERS: &str = "Content-Security-Policy: default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; \
    img-src data:; connect-src 'self' ws://127.0.0.1:* ws://localhost:*; base-uri 'none'; form-action 'none'; \
    frame-ancestors 'none'\r\nX-Frame-Options: DENY\r\nX-Content-Type-Options: nosniff\r\nReferrer-Policy: no-referrer\r\n\
    Cache-Control: no-store\r\n";
/// Time without a request after which a page is idle, and makes room if there are too many connections.
const IDLE_TIME: Duration = Duration::from_secs(5);
/// Time that a browser has to read the last words.
const FAREWELL: Duration = Duration::from_millis(300);
/// Tick of a connection that waits for a frame: the longest delay of a frame.
const QUICK_TICK: Duration = Duration::from_millis(4);
/// Tick of the other connections.
const SLOW_TICK: Duration = Duration::from_millis(40);
/// Longest message of a page, bytes.
const MAX_MESSAGE: usize = 4096;

/// Serves a page in threads of its own until it is dropped.
#[derive(Debug)]
pub struct Live {
    hub: Arc<Hub>,
    address: SocketAddr,
    listener: Option<JoinHandle<()>>,
}

impl Live {
    /// Serves the page at `port` of the loopback address; 0 takes any free port. `by_hand` lets a person drive.
    ///
    /// # Errors
    ///
    /// [`Error::System`] with the remedy if the port cannot be had.
    pub fn start(port: u16, hello: Hello, by_hand: bool) -> Result<Live> {
        let in_use = "end it, or give another --port; 0 takes any free one";
        let listener = http::listen(SocketAddr::from((Ipv4Addr::LOCALHOST, port)), in_use)?;
        let fault = |e: std::io::Error| Error::System(format!("cannot serve the page: {e}"));
        let address = listener.local_addr().map_err(fault)?;
        let hub = Arc::new(Hub::new(hello, by_hand));
        let shared = hub.clone();
        let thread = std::thread::Builder::new().name("live".into());
        let listener = thread
            .spawn(move || {
                let (over, port) = (|| shared.over().is_some(), address.port());
                loopback::listen(&listener, &over, &|peer| serve(peer, port, &shared));
            })
            .map_err(fault)?;
        Ok(Live { hub, address, listener: Some(listener) })
    }

    /// The address to open in a browser.
    pub fn url(&self) -> String {
        format!("http://{}/", self.address)
    }

    /// Number of open pages.
    pub fn viewers(&self) -> usize {
        self.hub.viewers()
    }

    /// Adds the car's place to the trail. Cheap, and needed without a viewer, too: a late viewer gets the whole trail.
    pub fn extend_trail(&self, state: &State) {
        self.hub.extend_trail(state);
    }

    /// Shows a frame: the JPEG of the camera, and the JPEG of the same picture with saliency, or nothing.
    pub fn publish(&self, state: &State, camera_jpeg: &[u8], saliency_jpeg: &[u8]) {
        self.hub.publish(state, camera_jpeg, saliency_jpeg);
    }

    /// How fast the pages want a watched drive to be shown.
    pub(super) fn playback(&self) -> Playback {
        self.hub.playback()
    }

    /// Time goes on, and no run is hurried.
    pub(super) fn play(&self) {
        self.hub.play();
    }

    /// Calls `look` with the wheel, if a person may drive.
    pub(crate) fn with_wheel<T>(&self, look: impl FnOnce(&mut Wheel) -> T) -> Option<T> {
        self.hub.wheel().map(|mut wheel| look(&mut wheel))
    }

    /// Tells every page how the drive ended, and closes the connections.
    pub fn finish(mut self, words: &str) {
        self.close(words);
    }

    fn close(&mut self, words: &str) {
        self.hub.end(words);
        if let Some(listener) = self.listener.take() {
            // A panic is an end, too.
            let _ = listener.join();
        }
    }
}

impl Drop for Live {
    fn drop(&mut self) {
        self.close("The program has ended.");
    }
}

/// Answers one request. An error ends the connection; there is no one to tell.
fn serve(peer: &Peer, port: u16, hub: &Hub) -> std::io::Result<()> {
    let mut socket = Socket::new(peer.stream.try_clone()?, SLOW_TICK)?;
    let (bytes, answer) = match loopback::read_request(&mut socket, &|| hub.over().is_some())? {
        None => return Ok(()),
        Some(Received::Bad(response)) => (Vec::new(), Answer::Say(response)),
        Some(Received::Head(bytes)) => {
            let answer = Head::parse(&bytes).ok().flatten().map(|head| answer(&head, port));
            (bytes, answer.expect("it was read as a whole request"))
        }
    };
    match answer {
        Answer::Say(response) => {
            socket.write_all(response.as_bytes())?;
            socket.finish(FAREWELL);
        }
        Answer::Open { response, len } => {
            socket.write_all(response.as_bytes())?;
            peer.set_rank(Rank::WebSocket);
            show(socket, bytes[len..].to_vec(), peer, hub);
        }
    }
    Ok(())
}

/// The answer to a request.
enum Answer {
    /// The whole response, after which the connection closes.
    Say(String),
    /// A WebSocket after the `len` bytes of the request.
    Open { response: String, len: usize },
}

fn answer(head: &Head, port: u16) -> Answer {
    let refuse = |status: &str, sentence: &str| Answer::Say(http::plain(status, sentence));
    let host = match loopback::own_host(head, port) {
        Ok(host) => host,
        Err(response) => return Answer::Say(response),
    };
    let path = head.target.split('?').next().unwrap_or("");
    if path != "/" && path != SOCKET_PATH {
        return refuse("404 Not Found", "there is one page here, /");
    }
    if head.method != "GET" {
        return refuse("405 Method Not Allowed\r\nAllow: GET", "only GET is understood here");
    }
    if path == "/" {
        return Answer::Say(http::response("200 OK", "text/html; charset=utf-8", HEADERS, PAGE));
    }
    if !loopback::is_own_page(head, host) {
        return refuse("403 Forbidden", "only the page that is served here may connect");
    }
    if !handshake::is_requested(head) {
        return refuse("426 Upgrade Required\r\nUpgrade: websocket", "a WebSocket is expected here");
    }
    match handshake::accept(head) {
        Ok(response) => Answer::Open { response, len: head.len },
        Err((status, sentence)) => refuse(status, sentence),
    }
}

/// Shows the drive to one page until the drive or the page ends.
fn show(socket: Socket, rest: Vec<u8>, peer: &Peer, hub: &Hub) {
    let config = WebSocketConfig::default()
        .read_buffer_size(MAX_MESSAGE)
        .write_buffer_size(0)
        .max_message_size(Some(MAX_MESSAGE))
        .max_frame_size(Some(MAX_MESSAGE));
    let mut socket = WebSocket::from_partially_read(socket, rest, Role::Server, Some(config));
    let viewer = hub.enter(peer.id);
    // An error means that the page is gone.
    let shown = frames(&mut socket, peer, hub);
    drop(viewer);
    if shown.is_ok()
        && let Some(words) = hub.over()
    {
        let farewell = Farewell { over: words.into() };
        let text = serde_json::to_string(&farewell).expect("a sentence can be written as JSON");
        let _ = socket.send(Message::text(text));
    }
    let _ = socket.close(None);
    let _ = socket.flush();
    socket.get_mut().finish(FAREWELL);
}

/// Sends a frame whenever the page has asked for one and there is a new one.
fn frames(socket: &mut WebSocket<Socket>, peer: &Peer, hub: &Hub) -> tungstenite::Result<()> {
    socket.send(Message::text(hub.opening(peer.id)))?;
    let (mut seen, mut wanted, mut last_request) = (0, false, None);
    while hub.over().is_none() {
        socket.get_mut().set_tick(if wanted { QUICK_TICK } else { SLOW_TICK })?;
        socket.get_mut().begin_tick();
        match socket.read() {
            Ok(Message::Text(text)) => {
                match serde_json::from_str(&text) {
                    Ok(Request::Next) => wanted = true,
                    Ok(request) => hub.request(peer.id, request),
                    Err(_) => return Err(tungstenite::Error::ConnectionClosed),
                }
                last_request = Some(Instant::now());
            }
            Ok(Message::Close(_)) => return Err(tungstenite::Error::ConnectionClosed),
            Ok(_) => {}
            Err(tungstenite::Error::Io(error)) if is_timeout(&error) => {}
            Err(error) => return Err(error),
        }
        let in_use = wanted || last_request.is_some_and(|last: Instant| last.elapsed() < IDLE_TIME);
        peer.set_rank(if in_use { Rank::InUse } else { Rank::WebSocket });
        if wanted && let Some((number, message)) = hub.newer_than(seen) {
            socket.send(Message::Binary(message))?;
            (seen, wanted) = (number, false);
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn status(request: &str) -> u16 {
        let head = Head::parse(request.as_bytes()).unwrap().unwrap();
        let (Answer::Say(response) | Answer::Open { response, .. }) = answer(&head, 4568);
        response.split(' ').nth(1).unwrap().parse().unwrap()
    }

    #[test]
    fn the_page_loads_nothing_from_elsewhere() {
        assert!(PAGE.starts_with("<!doctype html>"));
        for elsewhere in ["http:", "https:", "src=\"", "@import", "url("] {
            assert!(!PAGE.contains(elsewhere), "{elsewhere}");
        }
    }

    #[test]
    fn only_the_own_page_of_this_machine_is_answered() {
        let get = |path: &str, host: &str| status(&format!("GET {path} HTTP/1.1\r\nHost: {host}\r\n\r\n"));
        assert_eq!((get("/", "127.0.0.1:4568"), get("/?x=1", "LOCALHOST:4568")), (200, 200));
        for host in ["evil.example:4568", "127.0.0.1", "127.0.0.1:80", "localhost.evil.example:4568", ""] {
            assert_eq!(get("/", host), 403, "{host}");
        }
        assert_eq!(status("GET / HTTP/1.1\r\n\r\n"), 403);
        assert_eq!((get("/../etc/passwd", "localhost:4568"), get("/live", "localhost:4568")), (404, 426));
        assert_eq!(status("POST / HTTP/1.1\r\nHost: localhost:4568\r\n\r\n"), 405);
        let socket = |origin: &str| {
            status(&format!(
                "GET /live HTTP/1.1\r\nHost: localhost:4568\r\n{origin}Upgrade: websocket\r\nConnection: Upgrade\r\n\
                 Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
            ))
        };
        assert_eq!((socket(""), socket("Origin: http://localhost:4568\r\n")), (101, 101));
        for origin in ["null", "http://evil.example", "http://127.0.0.1:4568", "https://localhost:4568"] {
            assert_eq!(socket(&format!("Origin: {origin}\r\n")), 403, "{origin}");
        }
    }
}
