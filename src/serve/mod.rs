//! The server that drives Udacity's simulator: the simulator connects to it, sends telemetry, and gets commands.
//!
//! [`Server`] listens; each connection has a thread of its own, and one of them holds the seat and drives: a picture
//! comes in, the [`Pilot`] steers, the helm makes the command. `tokens` keeps one telemetry in flight, `recording`
//! writes what was driven, `co_driver` lets a person take the wheel, `journal` tells the user what is wrong and what to do. The messages are those of
//! [`udacity`](crate::udacity).
//!
//! The server trusts no client: it bounds the number of connections, and the size and the time of each message, and it
//! drives only a client that has sent a complete state of its car.
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
//! let stop = StopSignal::default(); // a request from elsewhere ends the server
//! let summary = Server::bind(ServerOptions::default())?.run(pilot, None, &mut observer, &stop)?;
//! println!("{} frames answered", summary.frames);
//! # Ok::<(), steersman::Error>(())
//! ```
//!
//! [`Pilot`]: crate::pilot::Pilot

mod co_driver;
mod connection;
mod handshake;
mod helm;
mod journal;
mod latency;
mod options;
mod rate_limit;
mod recording;
mod seat;
mod server;
mod server_event;
mod shared;
mod statistics;
mod tokens;

pub use co_driver::{AnsweredFrame, CoDriver, HandWheel, Hands};
pub use helm::HelmOptions;
pub use journal::Incident;
pub use options::ServerOptions;
pub use recording::Recorded;
pub use server::Server;
pub use server_event::ServeEvent;
pub use statistics::Summary;
