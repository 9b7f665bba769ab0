//! `--throttle`: whether the model has a say in the throttle.

use clap::ValueEnum;

use crate::error::{Error, Result};
use crate::pilot::Pilot;
use crate::simulator::Speed;

/// Who gives the throttle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Throttle {
    /// A controller that holds a speed
    Hold,
    /// The model, by its output `throttle` or `speed`
    Model,
}

impl Throttle {
    /// The speed that is aimed at if the user asks for `speed`.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] for a model that is to give the throttle and a speed that is to be found for it.
    pub fn aimed_at(self, speed: Option<Speed>) -> Result<Speed> {
        match (self, speed) {
            (Throttle::Hold, speed) => Ok(speed.unwrap_or(Speed::Fixed(20.0))),
            (Throttle::Model, None) => Ok(Speed::Driver(30.0)),
            (Throttle::Model, Some(Speed::Fixed(mph))) => Ok(Speed::Driver(mph)),
            (Throttle::Model, Some(_)) => Err(Error::Usage(
                "--throttle model does not go with --speed auto: give the highest speed in mph".into(),
            )),
        }
    }

    /// Checks that the model called `name` has such an output if it is to give the throttle.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] with a remedy.
    pub fn check(self, pilot: &Pilot, name: &str) -> Result<()> {
        if self == Throttle::Hold || pilot.has_pace() {
            return Ok(());
        }
        Err(Error::Usage(format!(
            "--throttle model: {name} gives the steering alone; leave it out to hold a speed, or train a recipe whose `outputs` \
             have `throttle` or `speed`"
        )))
    }
}
