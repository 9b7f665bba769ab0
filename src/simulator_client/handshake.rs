//! The opening handshake (RFC 6455, section 4) with the headers and checks of websocket-sharp 1.0.

use std::io::{self, BufRead, Read, Write};

use tungstenite::handshake::client::generate_key;
use tungstenite::handshake::derive_accept_key;

use super::server_url::ServerUrl;
use crate::net::handshake::list_has;
use crate::text::excerpt;

/// Longest header of a response, bytes.
const MAX_HEADER_LEN: u64 = 8192;

/// Asks the server at `url` for a WebSocket and checks its response as websocket-sharp does.
///
/// # Errors
///
/// [`io::ErrorKind::InvalidData`] with the objection of websocket-sharp, or the error of the stream.
pub fn shake_hands(writer: &mut impl Write, reader: &mut (impl BufRead + ?Sized), url: &ServerUrl) -> io::Result<()> {
    let key = generate_key();
    writer.write_all(request(url, &key).as_bytes())?;
    check(&read_header(reader)?, &key).map_err(|objection| io::Error::new(io::ErrorKind::InvalidData, objection))
}

/// The request, header by header in websocket-sharp's order.
fn request(url: &ServerUrl, key: &str) -> String {
    let (host, path) = (url.host(), url.path());
    format!(
        "GET {path} HTTP/1.1\r\nUser-Agent: websocket-sharp/1.0\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\
         Host: {host}\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n"
    )
}

/// Reads up to the empty line and not one byte more.
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

/// Checks the response to a request with `key`. The error is the objection of websocket-sharp.
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
    let lists = |name: &str, word: &str| field(name).is_some_and(|list| list_has(&list, word));
    let upgraded = response.code == Some(101) && response.version == Some(1);
    if !(upgraded && lists("Upgrade", "websocket") && lists("Connection", "Upgrade")) {
        let (code, reason) = (response.code.unwrap_or(0), excerpt(response.reason.unwrap_or(""), 80));
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
}
