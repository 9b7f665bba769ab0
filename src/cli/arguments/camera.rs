//! `--camera`: the camera and the car of a preset.

use crate::error::{Error, Result};
use crate::geometry::CarGeometry;
use crate::simulator::camera_trouble;

/// The camera and the car of the preset `name`, which the simulator must be able to have.
pub(crate) fn camera_preset(name: &str) -> Result<CarGeometry> {
    let known = || CarGeometry::presets().map(|(name, _)| name).collect::<Vec<_>>().join(", ");
    let car = CarGeometry::preset(name)
        .ok_or_else(|| Error::Usage(format!("--camera {name}: there is no such camera; known are {}", known())))?;
    match camera_trouble(&car) {
        Some(trouble) => Err(Error::Usage(format!("--camera {name}: {trouble}"))),
        None => Ok(car),
    }
}
