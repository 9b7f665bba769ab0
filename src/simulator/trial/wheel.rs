//! Who sits at the wheel, where any rank may have to put them there.

use serde::{Deserialize, Serialize};

use crate::cluster::message::{Message, join, split_first};
use crate::geometry::CarGeometry;
use crate::pilot::Pilot;
use crate::simulator::trial::driver::{Driver, Expert, InCar, Zero};
use crate::{Error, Result};

/// Who steers.
#[derive(Clone, Debug)]
pub enum Wheel {
    /// The simulator's expert.
    Expert,
    /// Nobody.
    Zero,
    /// A model.
    Model(Box<Pilot>),
    /// A model that looks through the camera of another car.
    InCar(Box<Pilot>, CarGeometry),
}

impl Wheel {
    /// A fresh driver.
    pub fn driver(&self) -> Box<dyn Driver> {
        match self {
            Wheel::Expert => Box::new(Expert),
            Wheel::Zero => Box::new(Zero),
            Wheel::Model(pilot) => pilot.clone(),
            Wheel::InCar(pilot, car) => Box::new(InCar { driver: Pilot::clone(pilot), car: car.clone() }),
        }
    }

    /// The model that steers, if it is one.
    pub fn pilot(&self) -> Option<&Pilot> {
        match self {
            Wheel::Model(pilot) | Wheel::InCar(pilot, _) => Some(pilot),
            Wheel::Expert | Wheel::Zero => None,
        }
    }

    /// Held-out tracks that the driver was trained on nevertheless.
    pub fn trained_on_held_out(&self) -> &[String] {
        self.pilot().map_or(&[], Pilot::trained_on_held_out)
    }
}

/// What a [`Wheel`] is called in a message; the model follows.
#[derive(Serialize, Deserialize)]
enum Name {
    Expert,
    Zero,
    Model,
    InCar(CarGeometry),
}

impl Message for Wheel {
    fn to_bytes(&self) -> Result<Vec<u8>> {
        let name = match self {
            Wheel::Expert => Name::Expert,
            Wheel::Zero => Name::Zero,
            Wheel::Model(_) => Name::Model,
            Wheel::InCar(_, car) => Name::InCar(car.clone()),
        };
        let model = self.pilot().map(Message::to_bytes).transpose()?;
        Ok(join([name.to_bytes()?].into_iter().chain(model)))
    }

    fn of_bytes(bytes: &[u8]) -> Result<Wheel> {
        let ([name], model) = split_first::<1>(bytes)?;
        let pilot = || match model.first() {
            Some(model) => Pilot::of_bytes(model).map(Box::new),
            None => Err(Error::Fault("a message of another rank lacks the model".into())),
        };
        Ok(match Name::of_bytes(name)? {
            Name::Expert => Wheel::Expert,
            Name::Zero => Wheel::Zero,
            Name::Model => Wheel::Model(pilot()?),
            Name::InCar(car) => Wheel::InCar(pilot()?, car),
        })
    }
}
