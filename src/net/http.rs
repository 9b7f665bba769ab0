//! The part of HTTP that the servers of this program need: one request and one response, or a WebSocket after the request.
//!
//! `httparse` reads requests and `tungstenite` speaks WebSocket. The servers own their sockets, so they can bound every wait
//! and stop at once. Small HTTP server libraries do not allow that for a connection that has become a WebSocket.

use std::borrow::Cow;
use std::io::ErrorKind;
use std::net::{IpAddr, SocketAddr, TcpListener};

use crate::error::{Error, Result};

/// Longest head of a request, bytes.
pub(crate) const MAX_HEAD_LEN: usize = 8 * 1024;
/// Largest number of headers of a request.
pub(crate) const MAX_HEADERS: usize = 64;

/// A request without a body.
#[derive(Clone, Debug)]
pub(crate) struct Head<'a> {
    /// Length of the request, bytes.
    pub len: usize,
    pub method: &'a str,
    /// Path and query.
    pub target: &'a str,
    headers: Vec<(&'a str, &'a [u8])>,
}

/// Why bytes are no request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum BadHead {
    /// It has not ended within 8 KiB.
    TooLong,
    /// It is something else.
    NotHttp,
}

impl<'a> Head<'a> {
    /// Reads the part of a request that has arrived; `None` while it is incomplete.
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
            Ok(httparse::Status::Partial) if bytes.len() < MAX_HEAD_LEN => Ok(None),
            Ok(httparse::Status::Partial) => Err(BadHead::TooLong),
            Err(_) => Err(BadHead::NotHttp),
        }
    }

    fn bytes(&self, name: &str) -> Option<&'a [u8]> {
        self.headers.iter().find(|(known, _)| known.eq_ignore_ascii_case(name)).map(|(_, value)| *value)
    }

    /// The value of a header, if it is text.
    pub fn header(&self, name: &str) -> Option<&'a str> {
        self.bytes(name).and_then(|value| std::str::from_utf8(value).ok()).map(str::trim)
    }

    /// The origin of the page that asks, if a page does. An origin that is no text still belongs to a page.
    pub fn origin(&self) -> Option<Cow<'a, str>> {
        self.bytes("origin").map(String::from_utf8_lossy)
    }
}

/// Whether no one can let the name in a `Host` header point elsewhere: it is `localhost` or an address of digits.
pub(crate) fn is_fixed_name(host: &str) -> bool {
    let name = host.rsplit_once(':').map_or(host, |(name, _)| name);
    name == "localhost" || name.trim_matches(['[', ']']).parse::<IpAddr>().is_ok()
}

/// A whole response of one sentence, after which the server closes the connection.
pub(crate) fn plain(status: &str, sentence: &str) -> String {
    response(status, "text/plain; charset=utf-8", "", &format!("{sentence}\n"))
}

/// A whole response, after which the server closes the connection. `headers` are further headers, each with its line end.
pub(crate) fn response(status: &str, content_type: &str, headers: &str, body: &str) -> String {
    head_of_response(status, content_type, headers, body.len()) + body
}

/// As [`response`], for a body that is no text.
pub(crate) fn response_of_bytes(status: &str, content_type: &str, headers: &str, body: &[u8]) -> Vec<u8> {
    [head_of_response(status, content_type, headers, body.len()).as_bytes(), body].concat()
}

fn head_of_response(status: &str, content_type: &str, headers: &str, len: usize) -> String {
    format!(
        "HTTP/1.1 {status}\r\nContent-Type: {content_type}\r\nContent-Length: {len}\r\n{headers}Connection: close\r\n\r\n"
    )
}

/// Listens at `address` without blocking. `in_use` is the remedy if another program has the port.
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
        assert_eq!(Head::parse(b"\x16\x03\x01").unwrap_err(), BadHead::NotHttp);
    }
}
