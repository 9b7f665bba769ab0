//! What the servers, [`serve`](crate::serve), [`live`](crate::live) and [`coach`](crate::coach), and the
//! [simulator's client](crate::simulator_client) share: HTTP, the handshake of WebSocket, sockets, and a bounded set of
//! connections. Nothing here knows what is said.

pub(crate) mod connections;
pub(crate) mod handshake;
pub(crate) mod http;
#[cfg(feature = "live")]
pub(crate) mod loopback;
pub(crate) mod socket;
