//! One row of a log.

use crate::simulator::car::pose::BodyPose;

/// One row of the log before its pictures are taken.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Sample {
    /// Simulated time, s.
    pub time_s: f64,
    /// The car.
    pub body: BodyPose,
    /// Label: steering, [-1, 1], + = right.
    pub steering: f64,
    /// Throttle, 0 to 1.
    pub throttle: f64,
    /// Brake, 0 to 1.
    pub brake: f64,
    /// Speed, mph.
    pub speed_mph: f64,
}
