//! Telemetry: the state of the car that a client sends with each picture.

use std::borrow::Cow;

use serde::Deserialize;
use serde::de::{Deserializer, IgnoredAny};

use super::number::{DecimalMark, Number, NumberStyle, print_decimal, push};

/// One state of the client's car. Fields that the client did not send are `None`.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Telemetry<'a> {
    /// Angle of the wheels, degrees, + = right. Commands are in [-1, 1] instead.
    pub steering_deg: Option<f64>,
    /// Accelerator, 0 to 1.
    pub throttle: Option<f64>,
    /// Speed, mph.
    pub speed_mph: Option<f64>,
    /// Distance from the line, m. Only the simulators of the second term send it.
    pub cte_m: Option<f64>,
    /// Simulated time, s. Only a client that waits for each reply sends it.
    pub time_s: Option<f64>,
    /// Whether a person steers, and the picture goes on. Udacity's simulator sends no picture then.
    pub by_user: bool,
    /// A JPEG image in base64.
    pub image: Option<Cow<'a, str>>,
    /// The decimal mark, if a number showed it.
    pub mark: Option<DecimalMark>,
}

impl Telemetry<'_> {
    /// The form of numbers that this client reads.
    pub fn number_style(&self) -> NumberStyle {
        match self.cte_m {
            Some(_) => NumberStyle::Json,
            None => NumberStyle::Strings(self.mark.unwrap_or(DecimalMark::DOT)),
        }
    }
}

/// A string, borrowed unless it has escapes.
#[derive(Deserialize)]
pub(super) struct Text<'a>(#[serde(borrow)] pub Cow<'a, str>);

/// The fields of telemetry in the JSON, in any order; there may be others.
#[derive(Default, Deserialize)]
#[serde(expecting = "the fields of telemetry, or null", default)]
pub(super) struct Fields<'a> {
    steering_angle: Number,
    throttle: Number,
    speed: Number,
    cte: Number,
    #[serde(rename = "steersman_lockstep_s", deserialize_with = "number_or_nothing")]
    lockstep_s: Number,
    #[serde(rename = "steersman_mode", deserialize_with = "is_user")]
    by_user: bool,
    #[serde(borrow)]
    image: Option<Text<'a>>,
}

impl<'a> From<Fields<'a>> for Telemetry<'a> {
    fn from(fields: Fields<'a>) -> Telemetry<'a> {
        let Fields { steering_angle, throttle, speed, cte, lockstep_s, by_user, image } = fields;
        Telemetry {
            steering_deg: steering_angle.value,
            throttle: throttle.value,
            speed_mph: speed.value,
            cte_m: cte.value,
            time_s: lockstep_s.value,
            by_user,
            image: image.map(|Text(image)| image),
            mark: speed.mark.or(steering_angle.mark).or(throttle.mark),
        }
    }
}

/// Reads a number. Anything else is no error, because simulators do not have this field.
fn number_or_nothing<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Number, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged)]
    enum Anything {
        Number(Number),
        Other(IgnoredAny),
    }
    Ok(match Anything::deserialize(deserializer)? {
        Anything::Number(number) => number,
        Anything::Other(IgnoredAny) => Number::default(),
    })
}

/// Whether the text is `user`. Anything else is no error, because simulators do not have this field.
fn is_user<'de, D: Deserializer<'de>>(deserializer: D) -> Result<bool, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged)]
    enum Anything {
        Text(String),
        Other(IgnoredAny),
    }
    Ok(matches!(Anything::deserialize(deserializer)?, Anything::Text(text) if text == "user"))
}

/// The content of a telemetry that a client writes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Readings<'a> {
    /// Angle of the wheels, degrees, + = right.
    pub steering_deg: f64,
    /// Accelerator, 0 to 1.
    pub throttle: f64,
    /// Speed, mph.
    pub speed_mph: f64,
    /// Distance from the line, m, for the simulators of the second term.
    pub cte_m: Option<f64>,
    /// Simulated time, s, if the client waits for each reply.
    pub time_s: Option<f64>,
    /// Whether a person steers.
    pub by_user: bool,
    /// A JPEG image in base64.
    pub image: &'a str,
}

/// Appends a `telemetry` event as the simulator writes it: all numbers as strings with four decimals, in the order and
/// language of the original. The original has no field for the simulated time. `steersman_lockstep_s`, a name that no other
/// simulator sends, stands behind, in the shortest decimal form with a point; then `steersman_mode` if a person steers.
pub(crate) fn print_telemetry(out: &mut String, readings: &Readings, mark: DecimalMark) {
    out.push_str("42[\"telemetry\",{");
    let mut field = |name: &str, value: f64| {
        push(out, format_args!("\"{name}\":\""));
        // .NET's Framework and Mono print no minus before a number that is rounded to zero.
        let value = if value.abs() < 0.000_05 { 0.0 } else { value };
        print_decimal(out, format_args!("{value:.4}"), mark);
        out.push_str("\",");
    };
    field("steering_angle", readings.steering_deg);
    field("throttle", readings.throttle);
    field("speed", readings.speed_mph);
    if let Some(cte_m) = readings.cte_m {
        field("cte", cte_m);
    }
    push(out, format_args!("\"image\":\"{}\"", readings.image));
    if let Some(time_s) = readings.time_s {
        push(out, format_args!(",\"steersman_lockstep_s\":\"{time_s}\""));
    }
    if readings.by_user {
        out.push_str(",\"steersman_mode\":\"user\"");
    }
    out.push_str("}]");
}
