//! A person beside the model: looks on, and takes the wheel when the model errs.

use std::time::Instant;

/// What a person does with wheel and pedals.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hands {
    /// The wheel.
    pub wheel: HandWheel,
    /// Throttle, [-1, 1], from the brake to the accelerator; `None` lets the server hold its speed.
    pub throttle: Option<f32>,
}

/// How a person steers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum HandWheel {
    /// With keys: -1 left, +1 right, 0 none, so that the wheel returns to the middle.
    Keys(f64),
    /// With mouse or gamepad: the steering, [-1, 1], + = right.
    At(f32),
}

/// A frame that was answered.
#[derive(Clone, Copy, Debug)]
pub struct AnsweredFrame<'a> {
    /// Time since the drive began, s: simulated time if the client keeps it, else the server's clock.
    pub time_s: f64,
    /// The picture as it arrived, encoded.
    pub image: &'a [u8],
    /// Steering of the model, [-1, 1], + = right.
    pub steering_of_model: f32,
    /// Steering that was sent, [-1, 1], + = right.
    pub steering: f32,
    /// Throttle that was sent, [-1, 1], from the brake to the accelerator.
    pub throttle: f32,
    /// Speed, mph.
    pub speed_mph: f64,
    /// Whether the command is a person's.
    pub by_user: bool,
}

/// Looks on while a server drives, and may take the wheel. The threads of all clients call it; only one client is driven at a
/// time. It must never wait: the car does.
pub trait CoDriver: Sync {
    /// What the person does at `now`; `None` while the model is to drive.
    fn hands(&self, now: Instant) -> Option<Hands>;

    /// Sees a frame that was answered, with `rows` of the recording written by a person so far.
    fn see(&self, frame: &AnsweredFrame, rows_by_user: Option<u64>);
}
