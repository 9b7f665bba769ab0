//! What the two servers, [`serve`](crate::serve) and [`live`](crate::live), and the
//! [simulator's client](crate::simulator_client) share: HTTP, the handshake of WebSocket, sockets, and a bounded set of
//! connections. Nothing here knows what is said.

pub(crate) mod connections;
pub(crate) mod handshake;
pub(crate) mod http;
pub(crate) mod socket;
