//! Shows a drive in a browser, and lets a person drive there.
//!
//! [`Live`] serves one page, which is part of the binary, to browsers on this machine. A WebSocket carries the
//! messages: the program sends the [`State`] and pictures, the page sends requests. The page asks for each frame, so a slow
//! page skips frames and delays nothing.
//!
//! [`Watch`] shows a closed-loop drive in real time, or as fast as the page asks, [`WatchRecording`] one on recorded pictures. [`ManualDrive`] lets a person
//! drive with the page and records the drive; [`Shares`] says what the recording covers so far. [`CoDriverPage`] shows what a
//! server drives, and a person corrects the model there. [`training::TrainingPage`] shows a training.
//!
//! A page of another site must not drive the car. So the `Host` of a request must be this machine (a site can let its name
//! point here after its page was loaded), and the `Origin` of a WebSocket must be the same.

mod co_driver_page;
mod controls;
mod coverage;
mod hub;
mod manual;
mod messages;
mod playback;
mod real_time;
mod server;
pub mod training;
mod watch;
mod watch_recording;

pub use co_driver_page::CoDriverPage;
pub use coverage::Shares;
pub use manual::{ManualDrive, ManualSummary};
pub use messages::{Hello, Manual, RunResult, State, Takeover, TrailPoint};
pub use playback::Playback;
pub use server::{DEFAULT_PORT, Live};
pub use watch::Watch;
pub use watch_recording::WatchRecording;
