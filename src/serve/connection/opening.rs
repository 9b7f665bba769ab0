//! The handshake of a connection: reads its request and answers it.

use std::io::{Read, Write};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use tungstenite::WebSocket;
use tungstenite::protocol::{Role, WebSocketConfig};

use super::{Connection, End, FAREWELL_TIME, MAX_MESSAGE_LEN, QUICK_TICK, SLOW_TICK};
use crate::net::connections::{Peer, Rank};
use crate::net::socket::{Socket, is_timeout};
use crate::serve::handshake::{Verdict, examine};
use crate::serve::helm::Helm;
use crate::serve::journal::Incident;
use crate::serve::rate_limit::RateLimit;
use crate::serve::shared::Shared;
use crate::serve::tokens::Tokens;
use crate::text::excerpt;
use crate::udacity::NumberStyle;

/// Longest time for the request of a handshake.
const HANDSHAKE_LIMIT: Duration = Duration::from_secs(5);

/// Reads the request and answers it.
pub(super) fn open<'a, 'o>(
    shared: &'a Shared<'o>,
    peer: &'a Arc<Peer>,
    address: SocketAddr,
) -> Result<Connection<'a, 'o>, End> {
    let journal = &shared.journal;
    journal.step(format_args!("{address}: TCP connection"));
    let mut socket = Socket::new(peer.stream.try_clone()?, SLOW_TICK)?;
    let began = Instant::now();
    let mut head = Vec::with_capacity(1024);
    let (response, head_len, client) = loop {
        let mut chunk = [0; 1024];
        socket.begin_tick();
        match socket.read(&mut chunk) {
            Ok(0) => return Err(End::Closed),
            Ok(len) => head.extend_from_slice(&chunk[..len]),
            Err(error) if is_timeout(&error) => {}
            Err(error) => return Err(error.into()),
        }
        if shared.stop.requested() {
            return Err(End::Closed);
        }
        match examine(&head, &shared.options.allowed_origins) {
            Verdict::Incomplete if began.elapsed() > HANDSHAKE_LIMIT => {
                let text = format!("no complete request within {} s", HANDSHAKE_LIMIT.as_secs());
                return Err(End::Fault(Incident::TooSlow, text));
            }
            Verdict::Incomplete => {}
            Verdict::Refuse { response, reason } => {
                show_request(shared, address, &head);
                journal.step(format_args!("{address} < {}", response.lines().next().unwrap_or("")));
                socket.write_all(response.as_bytes())?;
                socket.finish(FAREWELL_TIME);
                return Err(End::Fault(Incident::Refused, format!("refused, {reason}")));
            }
            Verdict::Accept { response, head_len, client } => break (response, head_len, client),
        }
    };
    show_request(shared, address, &head[..head_len]);
    journal.step(format_args!("{address} < {}", response.lines().next().unwrap_or("")));
    socket.write_all(response.as_bytes())?;
    peer.set_rank(Rank::WebSocket);
    let who = match &client {
        client if client.is_simulator() => "Udacity's simulator",
        client if client.agent.is_empty() => "a client without a name",
        client => &client.agent,
    };
    journal.report(Incident::Connected, format_args!("{address}: {who} connected"));
    if client.is_simulator() {
        journal.step(format_args!("{address}: needs no Socket.IO handshake; its first telemetry comes by itself"));
    }
    socket.set_tick(QUICK_TICK)?;
    let config = WebSocketConfig::default()
        .read_buffer_size(32 * 1024)
        .write_buffer_size(0)
        .max_write_buffer_size(64 * 1024)
        .max_message_size(Some(MAX_MESSAGE_LEN))
        .max_frame_size(Some(MAX_MESSAGE_LEN));
    let rest = head[head_len..].to_vec();
    let websocket = WebSocket::from_partially_read(socket, rest, Role::Server, Some(config));
    let now = Instant::now();
    Ok(Connection {
        shared,
        peer,
        address,
        websocket,
        tokens: Tokens::new(u32::from(client.is_simulator())),
        client,
        greeted: false,
        opened: now,
        last_message: now,
        last_ping: now,
        last_telemetry: None,
        last_question: now,
        held: None,
        faults: 0,
        style: NumberStyle::default(),
        helm: Helm::new(shared.options.helm),
        waits: false,
        rate_limit: RateLimit::new(now),
        lockstep: false,
        overridden: false,
        co_driven: false,
        cut: false,
        ignored: 0,
        shown: 0,
        image: Vec::new(),
        reply: String::new(),
    })
}

fn show_request(shared: &Shared, address: SocketAddr, head: &[u8]) {
    if shared.journal.checks() {
        for line in String::from_utf8_lossy(head).lines().filter(|line| !line.is_empty()).take(20) {
            let line = excerpt(line, 160);
            shared.journal.step(format_args!("{address} > {line}"));
        }
    }
}
