//! Reads the HTTP request that opens a WebSocket, and accepts it or refuses it with one sentence that names the remedy.

use crate::net::handshake;
use crate::net::http::{self, BadHead, Head, is_fixed_name};
use crate::text::excerpt;
use crate::udacity::EngineVersion;

/// What to do with a client after what it has sent so far.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Wait for the rest of the request.
    Incomplete,
    /// Send `response`; frames follow after the first `head_len` bytes.
    Accept {
        /// The whole HTTP response.
        response: String,
        /// Length of the request.
        head_len: usize,
        /// Who connects.
        client: ClientInfo,
    },
    /// Send `response` and close.
    Refuse {
        /// The whole HTTP response.
        response: String,
        /// The sentence in it.
        reason: String,
    },
}

/// Who connects.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ClientInfo {
    /// The `User-Agent`, empty if it has none.
    pub agent: String,
    /// Version of Engine.IO that it claims.
    pub version: EngineVersion,
}

impl ClientInfo {
    /// Whether this is the WebSocket library of Udacity's simulator, which needs no Engine.IO handshake.
    pub fn is_simulator(&self) -> bool {
        self.agent.starts_with("websocket-sharp")
    }
}

/// Reads the part of a request that has arrived. Web pages of `allowed_origins` may connect; `*` allows all.
pub fn examine(head: &[u8], allowed_origins: &[String]) -> Verdict {
    let request = match Head::parse(head) {
        Ok(Some(request)) => request,
        Ok(None) => return Verdict::Incomplete,
        Err(BadHead::TooLong) => {
            return refuse("431 Request Header Fields Too Large", "the request is longer than 8 KiB");
        }
        Err(BadHead::NotHttp) if head.first() == Some(&0x16) => {
            return refuse("400 Bad Request", "this is TLS; connect with ws:// instead of wss://");
        }
        Err(BadHead::NotHttp) => {
            return refuse("400 Bad Request", "this is no HTTP request; a Socket.IO client is expected");
        }
    };
    let query = request.target.split_once('?').map_or("", |(_, query)| query);
    let parameter = |name: &str| query.split('&').find_map(|pair| pair.strip_prefix(name)?.strip_prefix('='));

    if parameter("transport") == Some("polling") {
        return refuse(
            "400 Bad Request",
            "only WebSocket is spoken here: connect with transports=['websocket'] instead of polling",
        );
    }
    if request.method != "GET" || !handshake::is_requested(&request) {
        return refuse(
            "400 Bad Request",
            "a WebSocket is expected here: start the simulator in autonomous mode, or connect a Socket.IO client with transports=['websocket']",
        );
    }
    let origin = request.origin();
    if let Some(origin) = origin.as_deref().map(str::trim)
        && !is_allowed(origin, request.header("host").unwrap_or(""), allowed_origins)
    {
        return refuse(
            "403 Forbidden",
            &format!("web pages of {} may not connect; --allow-origin allows it", excerpt(origin, SHOWN)),
        );
    }
    // No extension and no subprotocol: the simulator closes the connection if it is offered one.
    let response = match handshake::accept(&request) {
        Ok(response) => response,
        Err((status, reason)) => return refuse(status, reason),
    };
    let version = if parameter("EIO") == Some("4") { EngineVersion::V4 } else { EngineVersion::V3 };
    let agent = excerpt(request.header("user-agent").unwrap_or(""), SHOWN);
    Verdict::Accept { response, head_len: request.len, client: ClientInfo { agent, version } }
}

/// Whether a page of `origin` may connect. Some libraries name the server itself as the origin. No page can do that: this
/// server has no pages, and no one can make an address of digits point to another machine.
fn is_allowed(origin: &str, host: &str, allowed: &[String]) -> bool {
    let own = is_fixed_name(host) && origin.strip_prefix("http://") == Some(host);
    own || allowed.iter().any(|allowed| allowed == "*" || allowed.trim_end_matches('/') == origin)
}

/// Characters of a header's value that are shown to a person.
const SHOWN: usize = 80;

fn refuse(status: &str, reason: &str) -> Verdict {
    let response = http::plain(status, reason);
    Verdict::Refuse { response, reason: reason.into() }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIMULATOR: &str = "GET /socket.io/?EIO=4&transport=websocket HTTP/1.1\r\nUser-Agent: websocket-sharp/1.0\r\n\
        Upgrade: websocket\r\nConnection: Upgrade\r\nHost: 127.0.0.1:4567\r\n\
        Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n";

    fn refusal(request: &str) -> (String, String) {
        match examine(request.as_bytes(), &[]) {
            Verdict::Refuse { response, reason } => {
                assert!(response.ends_with(&format!("\r\n\r\n{reason}\n")));
                (response.split_whitespace().nth(1).unwrap().into(), reason)
            }
            other => panic!("{other:?}"),
        }
    }

    fn with(line: &str) -> String {
        SIMULATOR.replace("Upgrade: websocket\r\n", &format!("Upgrade: websocket\r\n{line}\r\n"))
    }

    #[test]
    fn the_simulator_is_accepted_without_extensions() {
        let mut bytes = SIMULATOR.as_bytes().to_vec();
        bytes.extend(b"\x81");
        let Verdict::Accept { response, head_len, client } = examine(&bytes, &[]) else { panic!("refused") };
        // Key and answer are the example of RFC 6455, section 1.3.
        assert!(response.contains("Sec-WebSocket-Accept: s3pPLMBiTxaQ9kYGzzhZRbK+xOo=\r\n\r\n"));
        assert!(!response.contains("Extensions") && !response.contains("Protocol:"));
        assert_eq!(head_len, SIMULATOR.len());
        assert!(client.is_simulator() && client.version == EngineVersion::V4);
    }

    #[test]
    fn part_of_a_request_is_waited_for_but_not_without_end() {
        for end in 0..SIMULATOR.len() {
            assert_eq!(examine(&SIMULATOR.as_bytes()[..end], &[]), Verdict::Incomplete, "{end}");
        }
        let endless = format!("GET / HTTP/1.1\r\nX: {}", "x".repeat(http::MAX_HEAD_LEN));
        assert_eq!(refusal(&endless).0, "431");
    }

    #[test]
    fn polling_gets_a_sentence_with_the_remedy() {
        let (status, reason) = refusal("GET /socket.io/?transport=polling&EIO=4&t=1 HTTP/1.1\r\nHost: x\r\n\r\n");
        assert_eq!(status, "400");
        assert!(reason.contains("transports=['websocket']"), "{reason}");
        assert_eq!(refusal("POST /socket.io/?EIO=3&transport=polling HTTP/1.1\r\nHost: x\r\n\r\n").0, "400");
        assert!(refusal("GET / HTTP/1.1\r\nHost: x\r\n\r\n").1.contains("autonomous mode"));
    }

    #[test]
    fn web_pages_are_refused_unless_allowed() {
        let page = with("Origin: https://evil.example");
        assert_eq!(refusal(&page).0, "403");
        let allow = |origin: &str| matches!(examine(page.as_bytes(), &[origin.into()]), Verdict::Accept { .. });
        assert!(allow("https://evil.example") && allow("https://evil.example/") && allow("*"));
        assert!(!allow("https://good.example"));
        // A name can be made to point here after the page was loaded; an address cannot.
        let rebound = with("Origin: http://evil.example:4567").replace("127.0.0.1", "evil.example");
        assert_eq!(refusal(&rebound).0, "403");
        let library = with("Origin: http://127.0.0.1:4567");
        assert!(matches!(examine(library.as_bytes(), &[]), Verdict::Accept { .. }));
        assert_eq!(refusal(&with("Origin: http://127.0.0.1:8080")).0, "403");
        assert_eq!(refusal(&with("Origin: null")).0, "403");
        let mut no_text = with("Origin: #").into_bytes();
        no_text.iter_mut().filter(|byte| **byte == b'#').for_each(|byte| *byte = 0xff);
        assert!(matches!(examine(&no_text, &[]), Verdict::Refuse { response, .. } if response.contains(" 403 ")));
    }

    #[test]
    fn what_is_no_web_socket_of_version_13_is_refused() {
        assert_eq!(refusal(&SIMULATOR.replace("Version: 13", "Version: 8")).0, "426");
        assert_eq!(refusal(&SIMULATOR.replace("Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n", "")).0, "400");
        assert!(refusal("\u{16}\u{3}\u{1}").1.contains("ws://"));
        assert!(refusal("\0\0\0\0").1.contains("no HTTP"));
    }

    #[test]
    fn the_version_of_ordinary_clients_is_known_by_the_query() {
        let v3 = SIMULATOR.replace("EIO=4", "EIO=3").replace("websocket-sharp/1.0", "python");
        let Verdict::Accept { client, .. } = examine(v3.as_bytes(), &[]) else { panic!("refused") };
        assert!(!client.is_simulator() && client.version == EngineVersion::V3);
    }
}
