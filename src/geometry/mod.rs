//! Where a camera sits and what follows from it: the path a recording was driven along, steering towards that path from
//! beside it, and the view from there.
//!
//! Vehicle coordinates: the origin lies on the ground below the middle of the rear axle, `right` and `ahead` in metres. Turns and
//! steering are positive to the right. World coordinates: x and y in metres, headings anticlockwise from x.
//!
//! All functions use the `libm` crate for angles, so the same recording gives the same bits on every machine.

/// Metres a second in a mile an hour. Logs give speeds in mph, as Udacity's simulator does.
pub const MPS_PER_MPH: f64 = 0.447_04;
/// Miles an hour in a metre a second.
pub const MPH_PER_MPS: f64 = 1.0 / MPS_PER_MPH;

pub mod camera;
pub mod driven_path;
pub mod view_warp;

pub use camera::{CarGeometry, GeometryEntry};
pub use driven_path::{DrivenPath, LookAhead, Offset, Pose};
pub use view_warp::{PixelGrid, ViewWarp};
