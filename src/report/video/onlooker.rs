//! A model that looks at the pictures of a video.

use std::time::{Duration, Instant};

use crate::error::Result;
use crate::picture::RgbImage;
use crate::pilot::Pilot;
use crate::report::explain::saliency::Saliency;

/// A model that looks at the pictures of a video.
pub struct Onlooker {
    pilot: Pilot,
    saliency: Option<Saliency>,
}

impl Onlooker {
    /// Steers beside the driver; with `saliency` it also colours what excites it.
    ///
    /// # Errors
    ///
    /// As [`Saliency::new`].
    pub fn new(pilot: Pilot, saliency: bool) -> Result<Onlooker> {
        let saliency = saliency.then(|| Saliency::new(pilot.network())).transpose()?;
        Ok(Onlooker { pilot, saliency })
    }

    /// Whether it colours the pictures.
    pub fn colours(&self) -> bool {
        self.saliency.is_some()
    }

    /// Angle of the front wheels at steering 1, degrees, of the car that the model was made for.
    pub fn full_lock_deg(&self) -> f64 {
        self.pilot.recipe().full_lock_deg
    }

    /// What the model steers, in degrees of the front wheels, + = right, and how long it took. The picture is coloured if that
    /// was asked for.
    ///
    /// # Errors
    ///
    /// As [`Pilot::steer`].
    pub fn look(&mut self, picture: &mut RgbImage) -> Result<(f64, Duration)> {
        let Onlooker { pilot, saliency } = self;
        let asked = Instant::now();
        let steering = pilot.steer(picture.view())?;
        let answered_in = asked.elapsed();
        if let Some(saliency) = saliency {
            saliency.steer(pilot, picture.view())?;
            saliency.overlay(&pilot.recipe().preprocessing, picture);
        }
        Ok((f64::from(steering) * pilot.recipe().full_lock_deg, answered_in))
    }
}
