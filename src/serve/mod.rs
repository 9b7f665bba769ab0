//! Driving Udacity's simulator: the server that its client connects to.
//!
//! [`protocol`] and [`handshake`] hold what both sides say, without any input or output. [`Server`] listens; each
//! connection has a thread of its own, and one of them holds the [`seat`] and drives: image in, [`Pilot`], [`helm`], command
//! out. [`tokens`] keeps one question in flight, [`recording`] writes what was driven, [`journal`] says what is wrong.
//! [`client`] is the other side: the built-in simulator connecting as Udacity's does.
//!
//! A client is never trusted: the number of connections, the size and the time of a message are bounded, and only a client
//! that has shown a complete state of its car can drive it.
//!
//! ```no_run
//! use std::path::Path;
//! use steersman::observer::StopSignal;
//! use steersman::pilot::Pilot;
//! use steersman::serve::{ServeEvent, Server, ServerOptions};
//!
//! let pilot = Pilot::load(Path::new("runs/default-1/model.safetensors"))?;
//! let mut observer = |event| {
//!     if let ServeEvent::Line(text) = event {
//!         eprintln!("{text}");
//!     }
//!     Ok(())
//! };
//! let stop = StopSignal::default(); // requested from elsewhere, it ends the serving
//! let summary = Server::bind(ServerOptions::default())?.run(pilot, &mut observer, &stop)?;
//! println!("{} frames answered", summary.frames);
//! # Ok::<(), steersman::Error>(())
//! ```
//!
//! [`Pilot`]: crate::pilot::Pilot

pub mod client;
mod connection;
pub mod handshake;
pub mod helm;
pub mod journal;
mod latency;
mod pace;
pub mod protocol;
pub mod recording;
mod registry;
pub mod seat;
mod server;
pub(crate) mod socket;
pub mod tokens;

pub use helm::HelmOptions;
pub use latency::Latencies;
pub use server::{ServeEvent, Server, ServerOptions, Summary};
