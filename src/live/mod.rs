//! Watching a drive in a browser, and driving by hand there.
//!
//! [`Live`] serves one page, which is part of the binary, to browsers on this machine. A WebSocket below it carries
//! [`messages`]: [`State`](messages::State) and pictures from here, [`Request`](messages::Request)s from there. A page asks for
//! each frame, so a slow one skips frames and slows nothing down.
//!
//! [`watch`] shows a closed-loop drive in real time; [`manual`] lets a person drive, with [`controls`] from the page, and
//! records it, with [`coverage`] of what is recorded so far.
//!
//! Whoever drives could be driven by other pages, so a request counts only if it comes from no other page: its `Host` must
//! be this machine (a name can be made to point here after a page was loaded), and the `Origin` of a WebSocket the same.

mod clock;
pub mod controls;
pub mod coverage;
mod hub;
pub mod manual;
pub mod messages;
mod server;
pub mod watch;

pub use manual::{ManualDrive, ManualSummary};
pub use server::{DEFAULT_PORT, Live};
pub use watch::Watch;
