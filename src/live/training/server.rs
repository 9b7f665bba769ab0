//! Answers the requests of the page.

use super::Desk;
use crate::net::connections::Peer;
use crate::net::http::{self, Head};
use crate::net::loopback;
use crate::text::escaped;

/// The whole page.
const PAGE: &str = include_str!("page.html");
/// Headers of every answer: nothing comes from elsewhere, and no other page may show this one in a frame.
const HEADERS: &str = "Content-Security-Policy: default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; \
    img-src data:; connect-src 'self'; frame-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'\r\n\
    X-Frame-Options: SAMEORIGIN\r\nX-Content-Type-Options: nosniff\r\nReferrer-Policy: no-referrer\r\n\
    Cross-Origin-Resource-Policy: same-origin\r\nCache-Control: no-store\r\n";

/// Answers one request. An error ends the connection; there is no one to tell.
pub(super) fn serve(peer: &Peer, port: u16, desk: &Desk) -> std::io::Result<()> {
    loopback::answer_request(peer, &|| desk.is_over(), |_, bytes| {
        Ok(Some(answer(&loopback::head(&bytes), port, desk).into_bytes()))
    })
}

/// The response to a request.
fn answer(head: &Head, port: u16, desk: &Desk) -> String {
    if let Some(refusal) = loopback::refusal(head, port) {
        return refusal;
    }
    let ok = |content_type: &str, body: &str| http::response("200 OK", content_type, HEADERS, body);
    let path = head.target.split('?').next().unwrap_or("");
    match (head.method, path) {
        ("GET", "/") => ok("text/html; charset=utf-8", PAGE),
        ("GET", "/state") => ok("application/json", &desk.state()),
        ("GET", "/report") => match desk.report() {
            Ok(html) => ok("text/html; charset=utf-8", &html),
            Err(error) => http::plain("500 Internal Server Error", &escaped(&error.to_string())),
        },
        ("GET", _) => http::plain("404 Not Found", "there is one page here, /"),
        _ => http::plain("405 Method Not Allowed\r\nAllow: GET", "only GET is understood here"),
    }
}
