//! Shows a drive in a browser, and lets a person drive there.
//!
//! [`Live`] serves one page, which is part of the binary, to browsers on this machine. A WebSocket carries the
//! [`messages`]: the program sends the [`State`](messages::State) and pictures, the page sends
//! [`Request`](messages::Request)s. The page asks for each frame, so a slow page skips frames and delays nothing.
//!
//! [`watch`] shows a closed-loop drive in real time; [`manual`] lets a person drive, with [`controls`] from the page, and
//! records it, with [`coverage`] of what is recorded so far.
//!
//! A page of another site must not drive the car. So the `Host` of a request must be this machine (a site can let its name
//! point here after its page was loaded), and the `Origin` of a WebSocket must be the same.

pub mod controls;
pub mod coverage;
mod hub;
pub mod manual;
pub mod messages;
mod real_time;
mod server;
pub mod watch;

pub use manual::{ManualDrive, ManualSummary};
pub use server::{DEFAULT_PORT, Live};
pub use watch::Watch;
