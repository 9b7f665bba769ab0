//! The little of HTTP that the servers of this program speak: one request, one answer, or a WebSocket from there on.
//!
//! `httparse` reads requests and `tungstenite` speaks WebSocket; a server that owns its sockets can bound every wait and end
//! when it is told to, which the small HTTP servers there are do not allow once a connection has become a WebSocket.

use std::borrow::Cow;
use std::io::ErrorKind;
use std::net::{IpAddr, SocketAddr, TcpListener};

use tungstenite::handshake::derive_accept_key;

use crate::error::{Error, Result};

/// Longest request, bytes.
pub(crate) const MAX_HEAD: usize = 8 * 1024;
/// Most headers of a request.
pub(crate) const MAX_HEADERS: usize = 64;

/// A request without a body.
#[derive(Clone, Debug)]
pub(crate) struct Head<'a> {
    /// Bytes of the request.
    pub len: usize,
    pub method: &'a str,
    /// Path and query.
    pub target: &'a str,
    headers: Vec<(&'a str, &'a [u8])>,
}

/// What is no request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum BadHead {
    /// It has not ended within 8 KiB.
    TooLong,
    /// It is something else.
    NotHttp,
}

impl<'a> Head<'a> {
    /// Reads what has come of a request; `None` while it goes on.
    pub fn parse(bytes: &'a [u8]) -> Result<Option<Head<'a>>, BadHead> {
        let mut headers = [httparse::EMPTY_HEADER; MAX_HEADERS];
        let mut request = httparse::Request::new(&mut headers);
        match request.parse(bytes) {
            Ok(httparse::Status::Complete(len)) => Ok(Some(Head {
                len,
                method: request.method.unwrap_or(""),
                target: request.path.unwrap_or("/"),
                headers: request.headers.iter().map(|header| (header.name, header.value)).collect(),
            })),
            Ok(httparse::Status::Partial) if bytes.len() < MAX_HEAD => Ok(None),
            Ok(httparse::Status::Partial) => Err(BadHead::TooLong),
            Err(_) => Err(BadHead::NotHttp),
        }
    }

    fn bytes(&self, name: &str) -> Option<&'a [u8]> {
        self.headers.iter().find(|(known, _)| known.eq_ignore_ascii_case(name)).map(|(_, value)| *value)
    }

    /// A header that is text.
    pub fn header(&self, name: &str) -> Option<&'a str> {
        self.bytes(name).and_then(|value| std::str::from_utf8(value).ok()).map(str::trim)
    }

    /// The page that asks, if one does. One that is no text is still the origin of a page.
    pub fn origin(&self) -> Option<Cow<'a, str>> {
        self.bytes("origin").map(String::from_utf8_lossy)
    }

    /// Whether the request is to become a WebSocket.
    pub fn wants_websocket(&self) -> bool {
        let has_token = |name: &str, token: &str| {
            self.header(name).is_some_and(|value| value.split(',').any(|part| part.trim().eq_ignore_ascii_case(token)))
        };
        has_token("upgrade", "websocket") && has_token("connection", "upgrade")
    }

    /// The answer after which a WebSocket begins, without extension or subprotocol; or the status and the sentence of a
    /// refusal.
    pub fn accept_websocket(&self) -> Result<String, (&'static str, &'static str)> {
        if self.header("sec-websocket-version") != Some("13") {
            return Err(("426 Upgrade Required\r\nSec-WebSocket-Version: 13", "version 13 of WebSocket is expected"));
        }
        let Some(key) = self.header("sec-websocket-key").filter(|key| !key.is_empty()) else {
            return Err(("400 Bad Request", "the header Sec-WebSocket-Key is missing"));
        };
        Ok(format!(
            "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: {}\r\n\r\n",
            derive_accept_key(key.as_bytes())
        ))
    }
}

/// Whether the name in a `Host` header cannot be made to point elsewhere: `localhost` or an address made of digits.
pub(crate) fn is_fixed_name(host: &str) -> bool {
    let name = host.rsplit_once(':').map_or(host, |(name, _)| name);
    name == "localhost" || name.trim_matches(['[', ']']).parse::<IpAddr>().is_ok()
}

/// A whole answer of one sentence, after which the connection is closed.
pub(crate) fn plain(status: &str, sentence: &str) -> String {
    response(status, "text/plain; charset=utf-8", "", &format!("{sentence}\n"))
}

/// A whole answer, after which the connection is closed. `headers` are further ones, each with its line end.
pub(crate) fn response(status: &str, content_type: &str, headers: &str, body: &str) -> String {
    let len = body.len();
    format!(
        "HTTP/1.1 {status}\r\nContent-Type: {content_type}\r\nContent-Length: {len}\r\n{headers}Connection: close\r\n\r\n{body}"
    )
}

/// Listens at `address`; accepting does not wait. `in_use` says what to do if another program has the port.
///
/// # Errors
///
/// [`Error::System`] with the remedy if the address cannot be had.
pub(crate) fn listen(address: SocketAddr, in_use: &str) -> Result<TcpListener> {
    let listening = TcpListener::bind(address).and_then(|listener| {
        listener.set_nonblocking(true)?;
        Ok(listener)
    });
    listening.map_err(|error| {
        let remedy = match error.kind() {
            ErrorKind::AddrInUse => &format!("another program has this port: {in_use}"),
            ErrorKind::PermissionDenied => "give a --port of 1024 or more",
            ErrorKind::AddrNotAvailable => "give this machine's own address, or 0.0.0.0 for all",
            _ => "give another address or port",
        };
        Error::System(format!("cannot listen at {address}: {error}; {remedy}"))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_names_that_cannot_be_redirected_are_fixed() {
        for host in ["localhost", "localhost:4568", "127.0.0.1:4568", "[::1]:4568", "192.168.0.7"] {
            assert!(is_fixed_name(host), "{host}");
        }
        for host in ["", "evil.example:4568", "localhost.evil.example", "127.0.0.1.evil.example:80"] {
            assert!(!is_fixed_name(host), "{host}");
        }
    }

    #[test]
    fn a_request_is_read_whatever_the_case_of_its_headers() {
        let text =
            b"GET /a?b=c HTTP/1.1\r\nhOST: x\r\nUPGRADE: WebSocket\r\nConnection: keep-alive, Upgrade\r\n\r\nrest";
        let head = Head::parse(text).unwrap().unwrap();
        assert_eq!((head.method, head.target, head.len), ("GET", "/a?b=c", text.len() - 4));
        assert_eq!((head.header("Host"), head.header("Cookie")), (Some("x"), None));
        assert!(head.wants_websocket() && head.accept_websocket().unwrap_err().0.starts_with("426"));
        assert_eq!(Head::parse(b"\x16\x03\x01").unwrap_err(), BadHead::NotHttp);
    }
}
