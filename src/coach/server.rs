//! Answers the requests of the page.

use std::io::Read as _;
use std::time::Instant;

use super::desk::{Desk, LeftOut, Refusal};
use crate::dataset::View;
use crate::net::connections::Peer;
use crate::net::http::{self, Head};
use crate::net::loopback::{self, MAX_REQUEST_TIME};
use crate::net::socket::{Socket, is_timeout};

/// The whole page.
const PAGE: &str = include_str!("page.html");
/// Headers of every answer. The page loads nothing from elsewhere; no other page may show it in a frame and click its buttons, nor
/// show its pictures.
const HEADERS: &str = "Content-Security-Policy: default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; \
    img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'\r\n\
    X-Frame-Options: DENY\r\nX-Content-Type-Options: nosniff\r\nReferrer-Policy: no-referrer\r\n\
    Cross-Origin-Resource-Policy: same-origin\r\nCache-Control: no-store\r\n";
/// Longest body of a request: 100,000 single rows.
const MAX_BODY: usize = 4 << 20;

/// Answers one request. An error ends the connection; there is no one to tell.
pub(super) fn serve(peer: &Peer, port: u16, desk: &Desk) -> std::io::Result<()> {
    loopback::answer_request(peer, &|| desk.is_over(), |socket, mut bytes| {
        let head_len = loopback::head(&bytes).len;
        let wanted = loopback::head(&bytes).header("content-length").and_then(|len| len.parse().ok()).unwrap_or(0);
        if wanted > MAX_BODY {
            return Ok(Some(http::plain("413 Content Too Large", "the request is too long").into_bytes()));
        }
        let is_whole = read_body(socket, &mut bytes, head_len + wanted)?;
        Ok(is_whole.then(|| answer(&loopback::head(&bytes), &bytes[head_len..head_len + wanted], port, desk)))
    })
}

/// Reads until `bytes` are `len` long; `false` if that takes too long, or the client has gone.
fn read_body(socket: &mut Socket, bytes: &mut Vec<u8>, len: usize) -> std::io::Result<bool> {
    let began = Instant::now();
    while bytes.len() < len {
        if began.elapsed() > MAX_REQUEST_TIME {
            return Ok(false);
        }
        let mut chunk = [0; 1 << 14];
        socket.begin_tick();
        match socket.read(&mut chunk) {
            Ok(0) => return Ok(false),
            Ok(read) => bytes.extend_from_slice(&chunk[..read]),
            Err(error) if is_timeout(&error) => {}
            Err(error) => return Err(error),
        }
    }
    Ok(true)
}

/// The response to a request.
fn answer(head: &Head, body: &[u8], port: u16, desk: &Desk) -> Vec<u8> {
    if let Some(refusal) = loopback::refusal(head, port) {
        return refusal.into_bytes();
    }
    let (path, query) = head.target.split_once('?').unwrap_or((head.target, ""));
    match (head.method, path) {
        ("GET", "/") => ok("text/html; charset=utf-8", PAGE.as_bytes()),
        ("GET", "/about") => ok("application/json", desk.about().as_bytes()),
        ("GET", "/columns") => ok("application/octet-stream", &desk.columns()),
        ("GET", "/answers") => ok("application/octet-stream", &desk.answers()),
        ("GET", "/suspicious") => ok("application/json", desk.suspicious().as_bytes()),
        ("GET", "/left-out") => ok("application/json", desk.left_out_rows().as_bytes()),
        ("GET", "/picture") => picture(query, desk),
        ("POST", "/left-out") => leave_out(head, body, desk),
        ("GET" | "POST", _) => http::plain("404 Not Found", "there is one page here, /").into_bytes(),
        _ => http::plain("405 Method Not Allowed\r\nAllow: GET, POST", "only GET and POST are understood here")
            .into_bytes(),
    }
}

fn ok(content_type: &str, body: &[u8]) -> Vec<u8> {
    http::response_of_bytes("200 OK", content_type, HEADERS, body)
}

/// `row=N&camera=centre`.
fn picture(query: &str, desk: &Desk) -> Vec<u8> {
    let value = |key: &str| query.split('&').find_map(|part| part.strip_prefix(key)?.strip_prefix('='));
    let row = value("row").and_then(|row| row.parse().ok());
    let view = View::ALL.into_iter().find(|view| Some(view.name()) == value("camera"));
    let (Some(row), Some(view)) = (row, view) else {
        return http::plain("400 Bad Request", "row=NUMBER and camera=centre, left or right are needed").into_bytes();
    };
    let bytes = desk.picture(row, view).unwrap_or_default();
    // Only what browsers know as a picture is handed on.
    let content_type = match &bytes[..] {
        [0xff, 0xd8, 0xff, ..] => "image/jpeg",
        [0x89, b'P', b'N', b'G', ..] => "image/png",
        _ => return http::plain("404 Not Found", "there is no such picture, or it cannot be read").into_bytes(),
    };
    ok(content_type, &bytes)
}

fn leave_out(head: &Head, body: &[u8], desk: &Desk) -> Vec<u8> {
    let is_json = head.header("content-type").is_some_and(|kind| kind.starts_with("application/json"));
    // A form of another site can neither say where it comes from nor send JSON.
    if head.origin().is_none() || !is_json {
        return http::plain("403 Forbidden", "only the page that is served here may change anything").into_bytes();
    }
    let Ok(wanted) = serde_json::from_slice::<LeftOut>(body) else {
        return http::plain("400 Bad Request", "revision and stretches are needed").into_bytes();
    };
    match desk.leave_out(&wanted) {
        Ok(told) => ok("application/json", told.as_bytes()),
        Err(Refusal::Stale) => {
            http::plain("409 Conflict", "another page has changed the rows since: reload this one").into_bytes()
        }
        Err(Refusal::Wrong) => http::plain("400 Bad Request", "there are no such rows").into_bytes(),
        Err(Refusal::Failed(error)) => {
            let sentence = crate::text::escaped(&error.to_string()).to_string();
            http::plain("500 Internal Server Error", &sentence).into_bytes()
        }
    }
}
