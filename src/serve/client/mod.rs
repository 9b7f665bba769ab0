//! The built-in simulator in the place of Udacity's: its WebSocket client, byte for byte where a server could tell.
//!
//! Udacity's simulator is the client of the pair, and a peculiar one: websocket-sharp 1.0 under a Socket.IO component
//! that claims version 4 of Engine.IO, speaks version 3, sends telemetry before anybody asked, cuts long messages into frames
//! of 1016 bytes, reads numbers in the language of the machine, and forgets a turn for ever when a reply displeases it. What
//! was read of it in `udacity/self-driving-car-sim` (commit 7aeb57cf) is done here in the same way, so that a server can be
//! tried without Unity:
//!
//! - `frames` and `handshake`: websocket-sharp on the wire;
//! - `reaction`: what its decoders make of a reply, and which replies lose the turn or the connection;
//! - `connection`: the threads that connect, read and ping;
//! - `scene`: the car in front, by the clock or in lockstep with the replies.
//!
//! Telemetry goes round like a token: one on opening, one for each open packet of Engine.IO, one for each `steer` and each
//! `manual`. A server that answers each telemetry once keeps one token for each of these; a reply that cannot be read loses it.

mod connection;
mod frames;
mod handshake;
mod reaction;
mod scene;

pub use handshake::ServerUrl;
pub use reaction::Numbers;
pub use scene::{ClientEvent, ClientOptions, ClientReport, Pace, drive};
