//! The server that drives Udacity's simulator: the simulator connects to it, sends telemetry, and gets commands.
//!
//! [`Server`] listens; each connection has a thread of its own, and one of them holds the [`seat`] and drives: a picture
//! comes in, the [`Pilot`] steers, the [`helm`] makes the command. [`tokens`] keeps one telemetry in flight, [`recording`]
//! writes what was driven, [`journal`] tells the user what is wrong and what to do. The messages are those of
//! [`udacity`](crate::udacity).
//!
//! The server trusts no client: it bounds the number of connections, and the size and the time of each message, and it
//! drives only a client that has sent a complete state of its car.
//!
//! ```no_run
//! use std::{path::Path, sync::atomic::AtomicBool};
//! use steersman::pilot::Pilot;
//! use steersman::serve::{Console, Server, ServerOptions};
//!
//! struct Terminal;
//! impl Console for Terminal {
//!     fn line(&self, text: &str) {
//!         eprintln!("{text}");
//!     }
//!     fn status(&self, _: &str) {}
//! }
//!
//! let pilot = Pilot::load(Path::new("runs/default-1/model.safetensors"))?;
//! let stop = AtomicBool::new(false);
//! let summary = Server::bind(ServerOptions::default())?.run(pilot, &Terminal, &stop)?;
//! println!("{} frames answered", summary.frames);
//! # Ok::<(), steersman::Error>(())
//! ```
//!
//! [`Pilot`]: crate::pilot::Pilot

mod connection;
mod console;
mod handshake;
mod helm;
mod journal;
mod latency;
mod options;
mod rate_limit;
mod recording;
mod seat;
mod server;
mod shared;
mod statistics;
mod tokens;

pub use console::Console;
pub use helm::HelmOptions;
pub use journal::Incident;
pub use options::ServerOptions;
pub use recording::Recorded;
pub use server::Server;
pub use statistics::Summary;
