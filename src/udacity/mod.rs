//! The messages between Udacity's simulator and the program that drives it: text in, text out, no sockets.
//!
//! Each message is one WebSocket text: an Engine.IO digit (`0` open, `1` close, `2` ping, `3` pong, `4` message), and in a
//! message a Socket.IO digit (`0` connect, `1` disconnect, `2` event) with JSON behind it. The simulator sends
//!
//! ```text
//! 42["telemetry",{"steering_angle":"0.0000","throttle":"0.0000","speed":"0.4380","image":"/9j/4AAQ…"}]
//! 42["telemetry",null]          while somebody holds W or S
//! 2                             ping
//! ```
//!
//! and understands
//!
//! ```text
//! 42["steer",{"steering_angle":"-0.0312","throttle":"0.25"}]
//! 42["manual",{}]               asks for telemetry, changes nothing
//! 3                             pong
//! ```
//!
//! Two traps of its parser decide the form of replies. It reads the numbers of a command from JSON *strings* (the simulators of
//! the second term from JSON *numbers*), and it reads and writes them in the language of the machine, where `0.25` may mean
//! 25: see [`DecimalMark`]. Ordinary Socket.IO clients wait for a handshake that the simulator does not need: see
//! [`EngineVersion`].

mod number;
mod packet;
mod reply;
mod telemetry;
#[cfg(test)]
mod tests;

pub use number::{DecimalMark, NumberStyle};
pub(crate) use packet::{ClientPacket, ProtocolError, parse};
pub(crate) use reply::{
    Command, print_ack, print_connected, print_manual, print_namespace_refused, print_open, print_steer,
};
pub(crate) use telemetry::{Readings, Telemetry, print_telemetry};

/// Port that the simulator connects to.
pub const DEFAULT_PORT: u16 = 4567;

/// The version of Engine.IO that an ordinary client speaks.
///
/// The simulator claims version 4, speaks version 3, and needs the handshake of neither.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EngineVersion {
    /// Socket.IO 1 and 2: the server connects the client to `/` at once, and the client pings.
    V3,
    /// Socket.IO 3 and later: the client asks to be connected, and the server pings.
    V4,
}

/// Time between pings, ms.
pub(crate) const PING_INTERVAL_MS: u64 = 25_000;
/// Time beyond the interval after which a client of version 4 gives up without a ping, ms.
pub(crate) const PING_TIMEOUT_MS: u64 = 20_000;
