//! The client of DonkeySim: a model drives its car.
//!
//! Written from the protocol as the sources of simulator and `gym_donkeycar` have it, and tested against
//! [our stand-in](crate::donkeysim) in its strict mode; the real program was not at hand.
//!
//! `telemetry` reads what the simulator sends, `link` has the socket, `run` measures, `drive` goes from the menu to the last run.

mod drive;
mod link;
mod options;
mod run;
mod telemetry;

pub use drive::{DonkeyDriver, DonkeyFrame, drive};
pub use link::MAX_MESSAGE_BYTES;
pub use options::{CAMERA_SETTINGS, DonkeyDrive, DonkeyDriveOptions, DonkeyDriveSummary};
pub use telemetry::{ServerMessage, Telemetry};
