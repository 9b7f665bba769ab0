//! The pose of the car's body, on which the cameras are mounted.

use crate::simulator::math::Vec3;

/// The body of the car in the world: where it stands and its axes (unit, perpendicular).
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct BodyPose {
    /// Middle of the car, on the ground.
    pub origin: Vec3,
    /// Forward.
    pub forward: Vec3,
    /// To the right.
    pub right: Vec3,
    /// Up from the roof.
    pub up: Vec3,
}
