//! The handshake that turns an HTTP connection into a WebSocket (RFC 6455, section 4).

use tungstenite::handshake::derive_accept_key;

use super::http::Head;

/// Whether the comma-separated list in a header's value has `token`, in whatever case.
pub(crate) fn list_has(value: &str, token: &str) -> bool {
    value.split(',').any(|item| item.trim().eq_ignore_ascii_case(token))
}

/// Whether the client asks for a WebSocket.
pub(crate) fn is_requested(head: &Head) -> bool {
    let has = |name: &str, token: &str| head.header(name).is_some_and(|value| list_has(value, token));
    has("upgrade", "websocket") && has("connection", "upgrade")
}

/// The response after which the WebSocket begins, without extension or subprotocol.
///
/// # Errors
///
/// The HTTP status of a refusal, and its sentence.
pub(crate) fn accept(head: &Head) -> Result<String, (&'static str, &'static str)> {
    if head.header("sec-websocket-version") != Some("13") {
        return Err(("426 Upgrade Required\r\nSec-WebSocket-Version: 13", "version 13 of WebSocket is expected"));
    }
    let Some(key) = head.header("sec-websocket-key").filter(|key| !key.is_empty()) else {
        return Err(("400 Bad Request", "the header Sec-WebSocket-Key is missing"));
    };
    Ok(format!(
        "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: {}\r\n\r\n",
        derive_accept_key(key.as_bytes())
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_needs_both_upgrade_headers_and_version_13() {
        let parse = |text: &'static str| Head::parse(text.as_bytes()).unwrap().unwrap();
        let plain = "GET / HTTP/1.1\r\nUPGRADE: WebSocket\r\n\r\n";
        assert!(!is_requested(&parse(plain)));
        let upgrade = "GET / HTTP/1.1\r\nUPGRADE: WebSocket\r\nConnection: keep-alive, Upgrade\r\n\r\n";
        assert!(is_requested(&parse(upgrade)));
        assert!(accept(&parse(upgrade)).unwrap_err().0.starts_with("426"));
    }
}
