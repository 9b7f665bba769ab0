//! `--throttle`: whether the model has a say in the throttle.

use clap::ValueEnum;

use crate::error::{Error, Result};
use crate::pilot::Pilot;

/// Who gives the throttle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Throttle {
    /// A controller that holds a speed
    Hold,
    /// The model, by its output `throttle` or `speed`
    Model,
}

impl Throttle {
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
