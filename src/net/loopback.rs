//! What the servers of pages for this machine share: connections in threads, whole requests, and who may ask.

use std::io::{Read as _, Write as _};
use std::net::{Shutdown, TcpListener};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::connections::{Connections, Peer};
use super::http::{self, BadHead, Head};
use super::socket::{Socket, is_timeout};

/// Largest number of open connections.
const MAX_CONNECTIONS: usize = 32;
/// Longest time that a new connection waits until another has made room.
const ROOM_PATIENCE: Duration = Duration::from_millis(100);
/// Longest time for a whole request.
pub(crate) const MAX_REQUEST_TIME: Duration = Duration::from_secs(5);
/// Time that a browser has to read the last bytes.
const FAREWELL: Duration = Duration::from_millis(300);
/// Longest time that a read blocks.
const TICK: Duration = Duration::from_millis(40);
/// Pause between two checks of the listener.
const LISTEN_PAUSE: Duration = Duration::from_millis(5);
/// Stack of a connection's thread, bytes.
const STACK: usize = 1 << 20;

/// Accepts connections until `over`, has each served by `serve` in a thread of its own, and waits until they have ended.
pub(crate) fn listen(
    listener: &TcpListener,
    over: &(dyn Fn() -> bool + Sync),
    serve: &(dyn Fn(&Peer) -> std::io::Result<()> + Sync),
) {
    let connections = Connections::new(MAX_CONNECTIONS);
    std::thread::scope(|scope| {
        let mut id = 0;
        while !over() {
            let Ok((stream, _)) = listener.accept() else {
                // No client, or the connection is gone already, or the process has no file handle left.
                std::thread::sleep(LISTEN_PAUSE);
                continue;
            };
            id += 1;
            // A connection without room is dropped, and so closed.
            let (Some(peer), _) = connections.add(id, &Arc::new(stream), ROOM_PATIENCE) else { continue };
            let connections = &connections;
            let thread = std::thread::Builder::new().name(format!("viewer {id}")).stack_size(STACK);
            let serve = move || {
                // The browser opens another connection if this one fails.
                let _ = catch_unwind(AssertUnwindSafe(|| serve(&peer)));
                // It may be closed already.
                let _ = peer.stream.shutdown(Shutdown::Both);
                connections.remove(id);
            };
            if thread.spawn_scoped(scope, serve).is_err() {
                connections.remove(id);
            }
        }
    });
}

/// Answers one request of a browser: `respond` is given the socket and the bytes that begin with the head of the request, and makes the
/// response, or none if the client has gone.
pub(crate) fn answer_request(
    peer: &Peer,
    over: &dyn Fn() -> bool,
    respond: impl FnOnce(&mut Socket, Vec<u8>) -> std::io::Result<Option<Vec<u8>>>,
) -> std::io::Result<()> {
    let mut socket = Socket::new(peer.stream.try_clone()?, TICK)?;
    let response = match read_request(&mut socket, over)? {
        None => None,
        Some(Request::Bad(response)) => Some(response.into_bytes()),
        Some(Request::Head(bytes)) => respond(&mut socket, bytes)?,
    };
    if let Some(response) = response {
        socket.write_all(&response)?;
        socket.finish(FAREWELL);
    }
    Ok(())
}

/// The head of a request that [`answer_request`] has read.
pub(crate) fn head(bytes: &[u8]) -> Head<'_> {
    Head::parse(bytes).ok().flatten().expect("it was read as a whole request")
}

/// The response to a request that another site or another page makes; `None` to those of the page that is served at `port`.
pub(crate) fn refusal(head: &Head, port: u16) -> Option<String> {
    match own_host(head, port) {
        Err(response) => Some(response),
        Ok(host) if is_own_page(head, host) => None,
        Ok(_) => Some(http::plain("403 Forbidden", "only the page that is served here may ask")),
    }
}

/// What a client has sent.
pub(crate) enum Request {
    /// Bytes that begin with the whole head of a request.
    Head(Vec<u8>),
    /// Something else; the response to it.
    Bad(String),
}

/// Reads the head of a request. `None` if the client has gone, or takes too long, or it is over.
pub(crate) fn read_request(socket: &mut Socket, over: &dyn Fn() -> bool) -> std::io::Result<Option<Request>> {
    let began = Instant::now();
    let mut bytes = Vec::with_capacity(1024);
    while began.elapsed() < MAX_REQUEST_TIME && !over() {
        let mut chunk = [0; 1024];
        socket.begin_tick();
        match socket.read(&mut chunk) {
            Ok(0) => return Ok(None),
            Ok(len) => bytes.extend_from_slice(&chunk[..len]),
            Err(error) if is_timeout(&error) => continue,
            Err(error) => return Err(error),
        }
        match Head::parse(&bytes) {
            Ok(None) => {}
            Ok(Some(_)) => return Ok(Some(Request::Head(bytes))),
            Err(BadHead::TooLong) => {
                let sentence = "the request is longer than 8 KiB";
                return Ok(Some(Request::Bad(http::plain("431 Request Header Fields Too Large", sentence))));
            }
            Err(BadHead::NotHttp) => {
                return Ok(Some(Request::Bad(http::plain("400 Bad Request", "this is no HTTP request"))));
            }
        }
    }
    Ok(None)
}

/// The `Host` of a request to this machine at `port`. Another one is a site that lets its name point here.
///
/// # Errors
///
/// The response that refuses it.
pub(crate) fn own_host<'a>(head: &Head<'a>, port: u16) -> Result<&'a str, String> {
    let mut own = vec![format!("127.0.0.1:{port}"), format!("localhost:{port}")];
    if port == 80 {
        // Browsers leave port 80 out.
        own.extend(["127.0.0.1".into(), "localhost".into()]);
    }
    let is_own = |host: &&str| own.iter().any(|own| own.eq_ignore_ascii_case(host));
    head.header("host")
        .filter(is_own)
        .ok_or_else(|| http::plain("403 Forbidden", &format!("this page is served as http://{}/ only", own[0])))
}

/// Whether the page that asks, if a page does, is the one that is served at `host`.
pub(crate) fn is_own_page(head: &Head, host: &str) -> bool {
    head.origin().is_none_or(|origin| origin.trim() == format!("http://{host}"))
}
