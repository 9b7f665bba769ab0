//! The built-in simulator as a client of a driving server, in the place of Udacity's. It sends the same bytes wherever a server
//! could tell the two apart, so a server can be tested without Unity.
//!
//! Udacity's simulator is a peculiar client: websocket-sharp 1.0 under a Socket.IO component that claims version 4 of
//! Engine.IO, speaks version 3, sends telemetry before the server asks, cuts long messages into frames of 1016 bytes, reads
//! numbers in the language of the machine, and loses its turn for ever if it cannot read a reply. The behaviour follows the
//! source in `udacity/self-driving-car-sim` (commit 7aeb57cf):
//!
//! - `frames` and `handshake`: websocket-sharp on the wire;
//! - `reaction`: what its decoders make of a reply, and which replies lose the turn or the connection;
//! - `link`: the connection that comes back by itself, with the threads that connect, read and ping;
//! - `scene`: the car, driven in real time or in lockstep with the replies.
//!
//! Telemetry circulates like a token: the client sends one when the connection opens, one for each open packet of Engine.IO,
//! and one for each `steer` and each `manual`. A server that answers each telemetry once keeps all tokens; a reply that the
//! client cannot read loses one.
//!
//! To imitate the client of another simulator, write a module beside this one, with a command in `cli/` and a line in `tests/rooms.rs`.
//! To let another simulator connect to the server, put its messages beside [`udacity`](crate::udacity) and its side of the talk into
//! `serve/connection/`.

mod frame_clock;
mod frames;
mod handshake;
mod link;
mod options;
mod reaction;
mod scene;
mod server_url;

pub use options::{ClientOptions, ClientReport, TimeMode};
pub use scene::{ClientEvent, drive};
pub use server_url::ServerUrl;
