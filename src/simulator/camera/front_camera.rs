//! The front camera of a trial, with the light that its seed draws.

use crate::Result;
use crate::geometry::CarGeometry;
use crate::simulator::camera::foreign_car::Eye;
use crate::simulator::camera::jpeg;
use crate::simulator::camera::pinhole::{Mount, RgbFrame};
use crate::simulator::car::pose::BodyPose;
use crate::simulator::car::simulation::Simulation;
use crate::simulator::scenery::light::Variant;
use crate::simulator::track::Track;

/// Renders the frames that a driver sees. Keeps its buffers.
pub struct FrontCamera<'a> {
    track: &'a Track,
    variant: Variant,
    eye: Eye,
    decoded: RgbFrame,
    bytes: Vec<u8>,
}

impl<'a> FrontCamera<'a> {
    /// The camera of the trial `seed`.
    pub fn new(track: &'a Track, seed: u64) -> FrontCamera<'a> {
        FrontCamera::of_car(track, seed, None)
    }

    /// The same on `car`, for which there must be no [`trouble`](super::foreign_car::trouble).
    pub fn of_car(track: &'a Track, seed: u64, car: Option<&CarGeometry>) -> FrontCamera<'a> {
        let eye = Eye::new(car);
        FrontCamera {
            track,
            variant: Variant::new(track.world(), seed),
            decoded: RgbFrame::new(eye.size()),
            eye,
            bytes: Vec::new(),
        }
    }

    /// The frame in front of the car as the camera takes it, without the losses of JPEG.
    pub fn frame(&mut self, simulation: &Simulation) -> &RgbFrame {
        self.eye.see(self.track.world(), &self.variant, &simulation.body_pose(), Mount::Center)
    }

    /// The frame in front of the car, as JPEG.
    ///
    /// # Errors
    /// If the picture cannot be encoded.
    pub fn jpeg(&mut self, simulation: &Simulation) -> Result<&[u8]> {
        self.take(&simulation.body_pose())
    }

    fn take(&mut self, body: &BodyPose) -> Result<&[u8]> {
        let frame = self.eye.see(self.track.world(), &self.variant, body, Mount::Center);
        self.bytes.clear();
        jpeg::encode(frame, &mut self.bytes)?;
        Ok(&self.bytes)
    }

    /// The same frame, encoded as JPEG and decoded again.
    ///
    /// # Errors
    /// If the picture cannot be encoded or decoded.
    pub fn look(&mut self, simulation: &Simulation) -> Result<&RgbFrame> {
        self.look_from(&simulation.body_pose())
    }

    /// The same for a car whose body is at `body`.
    ///
    /// # Errors
    /// As [`look`](FrontCamera::look).
    pub fn look_from(&mut self, body: &BodyPose) -> Result<&RgbFrame> {
        self.take(body)?;
        jpeg::decode(&self.bytes, &mut self.decoded)?;
        Ok(&self.decoded)
    }
}
