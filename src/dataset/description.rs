//! What is said about a recording beside its log: on the command line, or in `steersman.toml` in its folder.
//!
//! Both have the same entries; the command line goes first, entry by entry. Unknown entries are errors.

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use super::store::{Kind, Store};
use crate::geometry::{CarGeometry, GeometryEntry};
use crate::text::excerpt;
use crate::{Error, Result};

/// Name of the file beside a log that holds a [`Description`].
pub const DESCRIPTION_FILE: &str = "steersman.toml";
/// A longer file is no description.
const MAX_BYTES: u64 = 1 << 20;
/// Rows a second that can be believed.
pub(crate) const HZ: std::ops::RangeInclusive<f64> = 0.1..=1000.0;

/// What is said about a recording. What is not said is found out, or assumed and reported.
///
/// ```toml
/// unit = "degrees"        # of the labels: lock, degrees, radians, servo, wheel-degrees, wheel-radians
/// full_lock_deg = 25.0    # the angle in that unit, in degrees, that is steering 1
/// hz = 30.0               # rows a second, where the recording has no times
/// labels = "user"         # of a tub: user (default) or pilot
/// exclude = [[41, 60]]    # rows that are left out: first and last line of the log, from 1
/// [columns]               # of a log with a header: number from 1, or name
/// steering = 4
/// center = "image"
/// [camera]                # mount, lens and car: a preset, and what differs from it
/// preset = "udacity"
/// roll_deg = 0.0
/// ```
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Description {
    /// Which column holds what.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub columns: BTreeMap<Column, ColumnRef>,
    /// Unit of the labels.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub unit: Option<Unit>,
    /// The angle that is steering 1, in degrees of what [`Description::unit`] measures.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub full_lock_deg: Option<f64>,
    /// Rows a second, where the recording has no plausible times.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hz: Option<f64>,
    /// Whose commands are the labels.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub labels: Option<Labels>,
    /// Rows that are left out: first and last line of the log, from 1, both included. Tubs have lists of their own: the deleted
    /// indexes of `manifest.json`, and `exclude.json` in format 1.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub exclude: Vec<[u32; 2]>,
    /// Camera and car.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub camera: Option<GeometryEntry>,
}

/// What a column of a log can hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Column {
    /// Picture of the centre camera.
    Center,
    /// Picture of the left camera.
    Left,
    /// Picture of the right camera.
    Right,
    /// The label.
    Steering,
    /// Throttle.
    Throttle,
    /// Brake.
    Brake,
    /// Speed, miles per hour.
    Speed,
}

impl Column {
    /// All columns, in the usual order of a log.
    pub const ALL: [Column; 7] =
        [Column::Center, Column::Left, Column::Right, Column::Steering, Column::Throttle, Column::Brake, Column::Speed];

    /// Name on the command line and in `steersman.toml`.
    pub fn name(self) -> &'static str {
        ["center", "left", "right", "steering", "throttle", "brake", "speed"][self as usize]
    }
}

/// A column, by its number from 1 or by its name in the header.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum ColumnRef {
    /// Number, from 1.
    Number(usize),
    /// Name in the header.
    Name(String),
}

/// Unit of steering labels. To the right is positive in all of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Unit {
    /// Shares of full lock, [-1, 1]: steersman's own.
    Lock,
    /// Degrees of the front wheels; 25 are full lock, as in Udacity's simulator.
    Degrees,
    /// Radians of the front wheels; 25 degrees are full lock.
    Radians,
    /// Degrees of a servo that stands at 90 when the wheels are straight; 45 to a side are full lock.
    Servo,
    /// Degrees of the steering wheel; 400 are full lock, 25 of the front wheels at a ratio of 16.
    WheelDegrees,
    /// Radians of the steering wheel; 400 degrees are full lock.
    WheelRadians,
}

impl Unit {
    /// All units.
    pub const ALL: [Unit; 6] =
        [Unit::Lock, Unit::Degrees, Unit::Radians, Unit::Servo, Unit::WheelDegrees, Unit::WheelRadians];

    /// Name on the command line and in `steersman.toml`.
    pub fn name(self) -> &'static str {
        ["lock", "degrees", "radians", "servo", "wheel-degrees", "wheel-radians"][self as usize]
    }

    /// The angle in degrees that is full lock, unless told otherwise.
    pub fn full_lock_deg(self) -> f64 {
        match self {
            Unit::Lock | Unit::Degrees | Unit::Radians => 25.0,
            Unit::Servo => 45.0,
            Unit::WheelDegrees | Unit::WheelRadians => 400.0,
        }
    }

    /// `label` as a share of full lock, which is `full_lock_deg`.
    pub fn to_lock(self, label: f64, full_lock_deg: f64) -> f64 {
        match self {
            Unit::Lock => label,
            Unit::Degrees | Unit::WheelDegrees => label / full_lock_deg,
            Unit::Radians | Unit::WheelRadians => label.to_degrees() / full_lock_deg,
            Unit::Servo => (label - 90.0) / full_lock_deg,
        }
    }

    /// What a person would call it.
    pub fn text(self) -> &'static str {
        match self {
            Unit::Lock => "shares of full lock",
            Unit::Degrees => "degrees of the front wheels",
            Unit::Radians => "radians of the front wheels",
            Unit::Servo => "degrees of a servo with its centre at 90",
            Unit::WheelDegrees => "degrees of the steering wheel",
            Unit::WheelRadians => "radians of the steering wheel",
        }
    }

    /// The units that labels between `min` and `max`, with half of them below `median`, may be in, the likeliest first; some are
    /// not in [-1, 1]. Which of several it is depends on how sharp the bends were.
    pub(crate) fn likely(min: f64, median: f64, max: f64) -> &'static [Unit] {
        let reach = max.max(-min);
        if min >= 0.0 && max <= 180.0 && (60.0..=120.0).contains(&median) {
            &[Unit::Servo]
        } else if reach <= std::f64::consts::FRAC_PI_2 {
            &[Unit::Radians, Unit::Degrees, Unit::WheelRadians]
        } else if reach <= 10.0 {
            &[Unit::Degrees, Unit::WheelRadians]
        } else if reach <= 60.0 {
            &[Unit::Degrees, Unit::WheelDegrees]
        } else {
            &[Unit::WheelDegrees]
        }
    }

    /// The angle of the front wheels that `label` means, in degrees to either side, if full lock is the usual one.
    pub(crate) fn front_wheels_deg(self, label: f64) -> f64 {
        25.0 * self.to_lock(label, self.full_lock_deg()).abs()
    }
}

/// Whose commands in a tub are the labels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Labels {
    /// Those of the person who drove; records that a pilot drove are left out.
    #[default]
    User,
    /// Those of the pilot; records without its command are left out.
    Pilot,
}

impl FromStr for Unit {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let names = Unit::ALL.map(Unit::name).join(", ");
        Unit::ALL.into_iter().find(|unit| unit.name() == text).ok_or_else(|| format!("the units are {names}"))
    }
}

impl FromStr for Labels {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "user" => Ok(Labels::User),
            "pilot" => Ok(Labels::Pilot),
            _ => Err("the labels are those of the user, or of the pilot".into()),
        }
    }
}

impl fmt::Display for Unit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Reads `steering=3,center=image`.
///
/// # Errors
/// What is wrong, and what would be right.
pub fn parse_columns(text: &str) -> Result<BTreeMap<Column, ColumnRef>, String> {
    let names = Column::ALL.map(Column::name).join(", ");
    let mut columns = BTreeMap::new();
    for part in text.split(',').map(str::trim).filter(|part| !part.is_empty()) {
        let wrong = || format!("\"{}\": write COLUMN=NUMBER or COLUMN=NAME with {names}", excerpt(part, 40));
        let (name, value) = part.split_once('=').ok_or_else(wrong)?;
        let name = name.trim();
        let column = Column::ALL.into_iter().find(|column| column.name() == name);
        let column = column.or((name == "centre").then_some(Column::Center)).ok_or_else(wrong)?;
        let value = value.trim();
        let reference = match value.parse() {
            Ok(0) => return Err("columns count from 1".into()),
            Ok(number) => ColumnRef::Number(number),
            Err(_) if value.is_empty() => return Err(wrong()),
            Err(_) => ColumnRef::Name(value.to_owned()),
        };
        columns.insert(column, reference);
    }
    Ok(columns)
}

impl Description {
    /// As it stands in `steersman.toml`.
    ///
    /// # Errors
    /// [`Error::Fault`] if it cannot be written as TOML.
    pub fn to_toml(&self) -> Result<String> {
        toml::to_string(self).map_err(|e| Error::Fault(format!("cannot be written as TOML: {e}")))
    }

    /// Whether nothing is said.
    pub fn is_empty(&self) -> bool {
        *self == Description::default()
    }

    /// These entries, and those of `other` where there is none here.
    pub fn or(mut self, other: Description) -> Description {
        let Description { columns, unit, full_lock_deg, hz, labels, exclude, camera } = other;
        for (column, reference) in columns {
            self.columns.entry(column).or_insert(reference);
        }
        Description {
            columns: self.columns,
            unit: self.unit.or(unit),
            full_lock_deg: self.full_lock_deg.or(full_lock_deg),
            hz: self.hz.or(hz),
            labels: self.labels.or(labels),
            exclude: self.exclude.into_iter().chain(exclude).collect(),
            camera: self.camera.or(camera),
        }
    }

    /// Checks the numbers.
    ///
    /// # Errors
    /// What is wrong, naming the entry.
    pub fn validate(&self) -> Result<(), String> {
        if self.hz.is_some_and(|hz| !HZ.contains(&hz)) {
            return Err(format!("hz: must be {} to {}", HZ.start(), HZ.end()));
        }
        if self.full_lock_deg.is_some_and(|angle| !(1.0..=2000.0).contains(&angle)) {
            return Err("full_lock_deg: must be 1 to 2000".into());
        }
        if let Some([first, last]) = self.exclude.iter().find(|[first, last]| *first == 0 || first > last) {
            return Err(format!("exclude: [{first}, {last}] is no range: first and last line of the log, from 1"));
        }
        if let Some(camera) = &self.camera {
            camera.resolve(CarGeometry::USUAL).map_err(|error| error.to_string())?;
        }
        if self.columns.values().any(|reference| *reference == ColumnRef::Number(0)) {
            return Err("columns: they count from 1".into());
        }
        Ok(())
    }

    /// What `steersman.toml` in `folder` says; nothing without one.
    pub(crate) fn beside(store: &Store, folder: &Path) -> Result<Description> {
        let path = folder.join(DESCRIPTION_FILE);
        if store.kind(&path) == Kind::Nothing {
            return Ok(Description::default());
        }
        let text = store.read_text(&path, MAX_BYTES).map_err(Error::io(&path))?;
        let description: Description =
            toml::from_str(&text).map_err(|e| Error::data(&path, e.to_string().trim_end()))?;
        description.validate().map_err(|message| Error::data(&path, message))?;
        Ok(description)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_goes_before_the_file_entry_by_entry() {
        let file: Description =
            toml::from_str("unit = 'servo'\nhz = 30.0\n[columns]\nsteering = 4\ncenter = 'image'").unwrap();
        let said = Description {
            hz: Some(15.0),
            columns: parse_columns("steering=2, speed=v").unwrap(),
            ..Default::default()
        };
        let both = said.or(file);
        assert_eq!((both.unit, both.hz), (Some(Unit::Servo), Some(15.0)));
        assert_eq!(both.columns[&Column::Steering], ColumnRef::Number(2));
        assert_eq!(both.columns[&Column::Center], ColumnRef::Name("image".into()));
        let again: Description = toml::from_str(&toml::to_string(&both).unwrap()).unwrap();
        assert_eq!(again, both);
        for wrong in ["exclude = [[0, 4]]", "exclude = [[7, 6]]"] {
            assert!(toml::from_str::<Description>(wrong).unwrap().validate().is_err(), "{wrong}");
        }
        for wrong in ["unit = 'furlongs'", "speed = 3", "hz = 'fast'"] {
            assert!(toml::from_str::<Description>(wrong).is_err(), "{wrong}");
        }
        let mount: Description = toml::from_str("[camera]\npreset = 'udacity-straight'\nheight_m = 1.4").unwrap();
        assert_eq!(mount.validate(), Ok(()));
        let unknown: Description = toml::from_str("[camera]\npreset = 'tank'").unwrap();
        assert!(unknown.validate().unwrap_err().contains("known are udacity"), "{:?}", unknown.validate());
        assert!(Description { hz: Some(0.0), ..Default::default() }.validate().is_err());
        for wrong in ["steering", "steering=", "wheel=3", "steering=0"] {
            assert!(parse_columns(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn units_become_shares_of_full_lock() {
        for (unit, label, share) in [
            (Unit::Lock, -0.5, -0.5),
            (Unit::Degrees, 12.5, 0.5),
            (Unit::Radians, 12.5f64.to_radians(), 0.5),
            (Unit::Servo, 45.0, -1.0),
            (Unit::WheelDegrees, 100.0, 0.25),
            (Unit::WheelRadians, -100f64.to_radians(), -0.25),
        ] {
            assert!((unit.to_lock(label, unit.full_lock_deg()) - share).abs() < 1e-12, "{unit}");
            assert_eq!(unit.name().parse(), Ok(unit));
        }
    }

    #[test]
    fn the_likely_unit_is_told_by_range_and_median() {
        assert_eq!(Unit::likely(-17.0, 0.0, 25.0), [Unit::Degrees, Unit::WheelDegrees]);
        assert_eq!(Unit::likely(55.0, 90.0, 130.0), [Unit::Servo]);
        // A straight road in degrees, or sharp bends in radians.
        assert_eq!(Unit::likely(-0.4, 0.0, 1.3), [Unit::Radians, Unit::Degrees, Unit::WheelRadians]);
        assert_eq!(Unit::likely(-7.0, 0.0, 6.5), [Unit::Degrees, Unit::WheelRadians]);
        assert_eq!(Unit::likely(-300.0, 0.0, 90.0), [Unit::WheelDegrees]);
        assert!((Unit::WheelDegrees.front_wheels_deg(-160.0) - 10.0).abs() < 1e-9);
    }
}
