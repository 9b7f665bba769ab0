//! A recording as a simulator: closed loop on recorded pictures.
//!
//! The car starts on the recorded path. A driver steers by the nearest recorded picture, warped to where the car is
//! ([`ViewWarp`](crate::geometry::ViewWarp)); a bicycle model moves the car; and when it is more than 1 m or 15 degrees off the path
//! it is put back, for which NVIDIA's 6 s are charged. So a model can be judged by driving without the simulator that the recording
//! was made with.
//!
//! What this cannot show: other traffic, what is hidden in the recorded view, and ground that is not flat. [`side_camera_check`]
//! measures on the recording's own side cameras how far the warp can be trusted.

mod fit;
mod log;
mod run;
mod side_cameras;
mod trust;
mod verdict;

pub use fit::{CameraFit, fit_camera};
pub use log::{Frames, ReplayLog};
pub use run::{
    DRIVE_HZ, MAX_OFFSET_M, MAX_TURN_DEG, ReplayFrame, ReplayMoment, ReplayOptions, ReplayRun, ReplaySummary, replay,
    replay_as_far, summarise,
};
pub use trust::{WarpCheck, side_camera_check};
pub use verdict::{RecordingVerdict, Side, SideVerdict, Stretch, judge, pieces};
