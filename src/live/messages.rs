//! What the page and the program tell each other.
//!
//! From the page come [`Request`]s as JSON text. To it goes one [`Hello`] as JSON text, then for each frame that it asked for a
//! binary message, see [`frame`], and at last a [`Farewell`].

use serde::{Deserialize, Serialize};

use super::coverage::Shares;
use crate::report::charts::map;
use crate::report::charts::palette::heat_hex;
use crate::simulator::car::dynamics::MAX_STEER_DEG;
use crate::simulator::car::expert::pursuit;
use crate::simulator::car::speed::telemetry_mph;
use crate::simulator::{Simulation, Track};

/// What the page asks for.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum Request {
    /// The next frame.
    Next,
    /// What is pressed; sent whenever it changes, and several times a second.
    Controls(Input),
    /// Take the wheel, whoever has it.
    Take,
    /// Let go of the wheel.
    Leave,
    /// Begin to record, or pause.
    Record,
    /// Hold the accelerator, or let go.
    Cruise,
    /// Put the car back onto the middle of the road, standing.
    PutBack,
    /// The same, facing the other way.
    TurnRound,
    /// End the drive and finish the recording.
    Finish,
}

/// Keys, mouse and gamepad. What is out of range counts as the nearest that is not.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Input {
    /// Keys of the wheel: -1 left, +1 right, 0 none.
    #[serde(default)]
    pub steer: f64,
    /// Keys of the pedals: -1 brake, +1 accelerator, 0 none.
    #[serde(default)]
    pub pedal: f64,
    /// Where mouse or gamepad hold the wheel, [-1, 1], + = right; they win over keys.
    #[serde(default)]
    pub wheel: Option<f64>,
    /// Where the gamepad holds the pedals, [-1, 1], from the brake to the accelerator; it wins over keys.
    #[serde(default)]
    pub pedals: Option<f64>,
}

/// What does not change during a drive.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Hello {
    /// `watch` or `manual`.
    pub mode: &'static str,
    /// Who steers, or where the recording goes.
    pub subject: String,
    /// The track.
    pub track: String,
    /// Whether training must not see it.
    pub held_out: bool,
    /// Length of a lap, m.
    pub lap_m: f64,
    /// Right and left edge of the road, closed: east and north, m.
    pub edges: Vec<Vec<[f64; 2]>>,
    /// Wheel angle at steering 1, deg.
    pub full_lock_deg: f64,
    /// Colours of a way by its distance from the line, from none to `darkest_m`.
    pub heat: Vec<String>,
    /// Distance from the line of the last colour, m.
    pub darkest_m: f64,
}

impl Hello {
    /// What a page is told of a drive on `track`.
    pub fn new(mode: &'static str, subject: String, track: &Track) -> Hello {
        Hello {
            mode,
            subject,
            track: track.name().into(),
            held_out: track.held_out(),
            lap_m: track.length_m,
            edges: map::edges(track),
            full_lock_deg: MAX_STEER_DEG,
            heat: (0..map::COLOURS).map(|step| heat_hex(map::step_share(step))).collect(),
            darkest_m: map::DARKEST_M,
        }
    }
}

/// A point of the way so far.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Trace(
    /// East, m.
    pub f32,
    /// North, m.
    pub f32,
    /// Cross-track error, m.
    pub f32,
);

/// The car at the moment of a frame.
#[derive(Clone, Debug, Default, Serialize)]
pub struct State {
    /// What is driven, in words.
    pub title: String,
    /// Counts the ways: where it changes, the car was put elsewhere and a new way begins on a clean map.
    pub way: u64,
    /// Simulated time, s.
    pub time_s: f64,
    /// East, m.
    pub x: f64,
    /// North, m.
    pub y: f64,
    /// Direction, unit vector: east and north.
    pub heading: [f64; 2],
    /// Steering, [-1, 1], + = right.
    pub steering: f64,
    /// What the expert would steer here.
    pub expert: f64,
    /// [-1, 1], from the brake to the accelerator.
    pub throttle: f64,
    /// Speed, mph.
    pub speed_mph: f64,
    /// Cross-track error, m, + = right as driven.
    pub cte_m: f64,
    /// Laps driven; they fall when the car goes back.
    pub laps: f64,
    /// Wheels off the road.
    pub wheels_off: usize,
    /// Times the car was put back on this way.
    pub put_back: usize,
    /// Driving by hand: what there is to know about the recording.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub manual: Option<Manual>,
}

impl State {
    /// The car as it stands; steering, throttle and titles are for whoever knows them.
    pub fn of(simulation: &Simulation) -> State {
        let car = &simulation.car;
        State {
            time_s: simulation.time_s(),
            x: car.x,
            y: car.y,
            heading: [car.hx, car.hy],
            expert: pursuit(simulation),
            speed_mph: telemetry_mph(car.speed_mps),
            cte_m: simulation.cte_m(),
            laps: simulation.progress_m / simulation.track.length_m,
            wheels_off: simulation.wheels_off,
            ..State::default()
        }
    }
}

/// How driving by hand goes.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Manual {
    /// Connection that has the wheel.
    pub driver: Option<u64>,
    /// Rows are being recorded.
    pub recording: bool,
    /// The accelerator is held.
    pub cruise: bool,
    /// What just happened, in words.
    pub notice: String,
    /// What was recorded.
    #[serde(flatten)]
    pub coverage: Shares,
    /// What to do next, the weightiest first.
    pub advice: Vec<String>,
}

/// The end.
#[derive(Clone, Debug, Serialize)]
pub struct Farewell {
    /// How it ended, in words.
    pub over: String,
}

/// The message of a frame: the length of a JSON [`State`] as 4 bytes (little endian), the JSON, the length of the camera's
/// JPEG likewise, the JPEG, and for the rest a JPEG of the same picture with its saliency, if there is one.
pub fn frame(state: &State, camera: &[u8], saliency: &[u8]) -> Vec<u8> {
    let json = serde_json::to_vec(state).expect("numbers, words and lists can be written as JSON");
    let mut message = Vec::with_capacity(8 + json.len() + camera.len() + saliency.len());
    for part in [&json[..], camera] {
        message.extend((part.len() as u32).to_le_bytes());
        message.extend(part);
    }
    message.extend(saliency);
    message
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_are_read_and_others_refused() {
        let read = |text: &str| serde_json::from_str::<Request>(text);
        assert_eq!(read(r#"{"type":"next"}"#).unwrap(), Request::Next);
        assert_eq!(read(r#"{"type":"put_back"}"#).unwrap(), Request::PutBack);
        let input = Input { steer: -1.0, wheel: Some(0.25), ..Input::default() };
        let text = r#"{"type":"controls","steer":-1,"pedal":0,"wheel":0.25,"pedals":null}"#;
        assert_eq!(read(text).unwrap(), Request::Controls(input));
        for bad in ["", "{}", r#"{"type":"fly"}"#, r#"{"type":"controls","steer":"left"}"#] {
            assert!(read(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn the_parts_of_a_frame_can_be_told_apart() {
        let bytes = frame(&State { speed_mph: 12.5, ..State::default() }, b"camera", b"more");
        let len = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
        let json: serde_json::Value = serde_json::from_slice(&bytes[4..4 + len(0)]).unwrap();
        assert_eq!(json["speed_mph"], 12.5);
        let at = 4 + len(0);
        assert_eq!((&bytes[at + 4..at + 4 + len(at)], &bytes[at + 4 + len(at)..]), (&b"camera"[..], &b"more"[..]));
    }
}
