//! Driving Udacity's simulator: the server that its client connects to.
//!
//! [`protocol`] holds the messages of both sides, without any input or output.

pub mod client;
pub mod protocol;
