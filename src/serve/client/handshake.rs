//! The opening handshake (RFC 6455, section 4) with the words of websocket-sharp 1.0.

use std::fmt;
use std::io::{self, BufRead, Read, Write};
use std::str::FromStr;

use data_encoding::BASE64;
use tungstenite::handshake::derive_accept_key;

use crate::simulator::math::Rng;
use crate::{Error, Result};

/// Longest header of a response that is read.
const MAX_HEADER_LEN: u64 = 8192;

/// Where the server is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServerUrl {
    /// Host and port as they stand in the URL.
    authority: String,
    /// Path and query.
    path: String,
}

impl Default for ServerUrl {
    fn default() -> Self {
        ServerUrl::DEFAULT.parse().expect("the built-in address is one")
    }
}

impl ServerUrl {
    /// The address that is built into Udacity's simulator.
    pub const DEFAULT: &str = "ws://127.0.0.1:4567/socket.io/?EIO=4&transport=websocket";

    /// `host:port` to connect to.
    pub fn address(&self) -> String {
        let has_port = self.authority.rsplit_once(':').is_some_and(|(_, port)| port.parse::<u16>().is_ok());
        if has_port { self.authority.clone() } else { format!("{}:80", self.authority) }
    }
}

impl FromStr for ServerUrl {
    type Err = Error;

    fn from_str(text: &str) -> Result<ServerUrl> {
        let fail = |what: &str| Err(Error::Usage(format!("{text}: {what}; as in {}", ServerUrl::default())));
        let Some(rest) = text.strip_prefix("ws://") else {
            return fail("an address that begins with ws:// is meant");
        };
        let at = rest.find(['/', '?']).unwrap_or(rest.len());
        let (authority, path) = rest.split_at(at);
        if authority.is_empty() || authority.contains(['@', '#', ' ']) || path.contains(['#', ' ', '\r', '\n']) {
            return fail("no host and port, or something else than path and query behind them");
        }
        let path = match path {
            "" | "/" => ServerUrl::default().path,
            path if path.starts_with('?') => format!("/{path}"),
            path => path.into(),
        };
        Ok(ServerUrl { authority: authority.into(), path })
    }
}

impl fmt::Display for ServerUrl {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "ws://{}{}", self.authority, self.path)
    }
}

/// Asks the server at `url` to speak WebSocket and checks its answer, as websocket-sharp does.
///
/// # Errors
/// [`io::ErrorKind::InvalidData`] with what websocket-sharp objects to, or what the stream says.
pub fn shake_hands(
    writer: &mut impl Write,
    reader: &mut (impl BufRead + ?Sized),
    url: &ServerUrl,
    keys: &mut Rng,
) -> io::Result<()> {
    let mut nonce = [0; 16];
    nonce[..8].copy_from_slice(&keys.next_u64().to_be_bytes());
    nonce[8..].copy_from_slice(&keys.next_u64().to_be_bytes());
    let key = BASE64.encode(&nonce);
    writer.write_all(request(url, &key).as_bytes())?;
    check(&read_header(reader)?, &key).map_err(|objection| io::Error::new(io::ErrorKind::InvalidData, objection))
}

/// The request, header by header in websocket-sharp's order.
fn request(url: &ServerUrl, key: &str) -> String {
    let ServerUrl { authority, path } = url;
    let host = authority.strip_suffix(":80").unwrap_or(authority);
    format!(
        "GET {path} HTTP/1.1\r\nUser-Agent: websocket-sharp/1.0\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\
         Host: {host}\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n"
    )
}

/// Reads up to the empty line and not a byte further.
fn read_header(reader: &mut (impl BufRead + ?Sized)) -> io::Result<Vec<u8>> {
    let mut header = Vec::new();
    let mut limited = reader.take(MAX_HEADER_LEN);
    while !header.ends_with(b"\r\n\r\n") {
        if limited.read_until(b'\n', &mut header)? == 0 {
            let what = if limited.limit() == 0 { "a header of more than 8 KiB" } else { "no complete header" };
            return Err(io::Error::new(io::ErrorKind::InvalidData, format!("the server sent {what}")));
        }
    }
    Ok(header)
}

/// What websocket-sharp objects to in the response to a request with `key`.
fn check(header: &[u8], key: &str) -> Result<(), String> {
    let mut fields = [httparse::EMPTY_HEADER; 64];
    let mut response = httparse::Response::new(&mut fields);
    if let Err(e) = response.parse(header) {
        return Err(format!("the server does not speak HTTP: {e}"));
    }
    let field = |name: &str| {
        let field = response.headers.iter().find(|field| field.name.eq_ignore_ascii_case(name))?;
        Some(String::from_utf8_lossy(field.value).into_owned())
    };
    let lists = |name: &str, word: &str| {
        field(name).is_some_and(|list| list.split(',').any(|item| item.trim().eq_ignore_ascii_case(word)))
    };
    let upgraded = response.code == Some(101) && response.version == Some(1);
    if !(upgraded && lists("Upgrade", "websocket") && lists("Connection", "Upgrade")) {
        let (code, reason) = (response.code.unwrap_or(0), response.reason.unwrap_or(""));
        return Err(format!("the server does not switch to WebSocket: {code} {reason}"));
    }
    if field("Sec-WebSocket-Accept") != Some(derive_accept_key(key.as_bytes())) {
        return Err("the server's Sec-WebSocket-Accept is wrong or missing".into());
    }
    if field("Sec-WebSocket-Protocol").is_some() {
        return Err("the server chose a Sec-WebSocket-Protocol, and none was offered".into());
    }
    if field("Sec-WebSocket-Extensions").is_some_and(|list| !list.is_empty()) {
        return Err("the server chose Sec-WebSocket-Extensions, and none was offered".into());
    }
    if field("Sec-WebSocket-Version").is_some_and(|version| version != "13") {
        return Err("the server's Sec-WebSocket-Version is not 13".into());
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The example of RFC 6455, section 1.3.
    const KEY: &str = "dGhlIHNhbXBsZSBub25jZQ==";
    const ACCEPTED: &str = "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\
         Sec-WebSocket-Accept: s3pPLMBiTxaQ9kYGzzhZRbK+xOo=\r\n";

    #[test]
    fn the_request_has_the_lines_of_websocket_sharp_in_its_order() {
        assert_eq!(
            request(&ServerUrl::default(), KEY),
            "GET /socket.io/?EIO=4&transport=websocket HTTP/1.1\r\n\
             User-Agent: websocket-sharp/1.0\r\n\
             Upgrade: websocket\r\n\
             Connection: Upgrade\r\n\
             Host: 127.0.0.1:4567\r\n\
             Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\
             Sec-WebSocket-Version: 13\r\n\r\n"
        );
    }

    #[test]
    fn responses_are_checked_as_websocket_sharp_checks_them() {
        let answer = |more: &str| check(format!("{ACCEPTED}{more}\r\n").as_bytes(), KEY);
        assert_eq!(answer(""), Ok(()));
        assert_eq!(answer("Server: x\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Extensions:\r\n"), Ok(()));
        for (more, objection) in [
            ("Sec-WebSocket-Extensions: permessage-deflate\r\n", "Extensions"),
            ("Sec-WebSocket-Protocol: x\r\n", "Protocol"),
            ("Sec-WebSocket-Version: 8\r\n", "Version"),
        ] {
            assert!(answer(more).unwrap_err().contains(objection), "{more}");
        }
        let refused = check(ACCEPTED.replace("s3p", "S3p").as_bytes(), KEY);
        assert!(refused.is_err());
        let refused = check(b"HTTP/1.1 400 Bad Request\r\n\r\n", KEY).unwrap_err();
        assert!(refused.contains("400 Bad Request"), "{refused}");
        assert!(check(b"SSH-2.0-x\r\n\r\n", KEY).is_err());
    }

    #[test]
    fn nothing_behind_the_header_is_swallowed_and_endless_headers_are_refused() {
        let mut stream = &b"HTTP/1.1 101 x\r\n\r\n\x81\x013"[..];
        assert!(read_header(&mut stream).is_ok());
        assert_eq!(stream, b"\x81\x013");
        let mut endless = io::BufReader::new(io::repeat(b'x'));
        assert!(read_header(&mut endless).unwrap_err().to_string().contains("8 KiB"));
        assert!(read_header(&mut &b"HTTP/1.1 101"[..]).unwrap_err().to_string().contains("no complete header"));
    }

    #[test]
    fn addresses() {
        for (text, address, shown) in [
            ("ws://127.0.0.1:4567", "127.0.0.1:4567", "ws://127.0.0.1:4567/socket.io/?EIO=4&transport=websocket"),
            ("ws://host:9/?EIO=3", "host:9", "ws://host:9/?EIO=3"),
            ("ws://host/x", "host:80", "ws://host/x"),
            ("ws://[::1]:7?y", "[::1]:7", "ws://[::1]:7/?y"),
        ] {
            let url: ServerUrl = text.parse().unwrap();
            assert_eq!((url.address().as_str(), url.to_string().as_str()), (address, shown));
        }
        for bad in ["127.0.0.1:4567", "http://x", "ws://", "ws:///x", "ws://a b", "ws://x/\r\ny"] {
            assert!(bad.parse::<ServerUrl>().unwrap_err().to_string().contains("as in ws://127.0.0.1:4567"), "{bad}");
        }
    }
}
