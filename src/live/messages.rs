//! The messages between the page and the program.
//!
//! The page sends [`Request`]s as JSON text. The program sends one [`Hello`] as JSON text, a binary message for each frame that
//! the page asked for (see [`frame`]), and at the end a [`Farewell`].

use serde::{Deserialize, Serialize};

use super::coverage::Shares;
use super::playback::Playback;
use crate::report::charts::map;
use crate::report::charts::palette::{self, heat_hex};
use crate::simulator::car::dynamics::MAX_STEER_DEG;
use crate::simulator::car::expert::pursuit;
use crate::simulator::car::speed::telemetry_mph;
use crate::simulator::trial::outcome::Failure;
use crate::simulator::{Simulation, Track};

/// A request of the page.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum Request {
    /// The next frame.
    Next,
    /// The input. The page sends it whenever it changes, and several times per second.
    Controls(Input),
    /// Take the wheel, even if another page holds it.
    Take,
    /// Release the wheel.
    Leave,
    /// Begin to record, or pause.
    Record,
    /// Hold the accelerator, or release it.
    Cruise,
    /// Take the last seconds out of the recording.
    Erase,
    /// Put the car back onto the middle of the road, standing.
    PutBack,
    /// The same, facing the other way.
    TurnRound,
    /// End the drive and finish the recording.
    Finish,
    /// Let the time of a watched drive stand still, or go on.
    Pause,
    /// How fast it goes.
    Rate {
        /// Simulated seconds a second.
        rate: f64,
    },
    /// Drive on to the end of this run without showing it in real time.
    NextRun,
}

/// Keys, mouse and gamepad. Values out of range count as the nearest value in range.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Input {
    /// Keys of the wheel: -1 left, +1 right, 0 none.
    #[serde(default)]
    pub steer: f64,
    /// Keys of the pedals: -1 brake, +1 accelerator, 0 none.
    #[serde(default)]
    pub pedal: f64,
    /// Wheel of the mouse or gamepad, [-1, 1], + = right. It takes precedence over the keys.
    #[serde(default)]
    pub wheel: Option<f64>,
    /// Pedals of the gamepad, [-1, 1], from the brake to the accelerator. They take precedence over the keys.
    #[serde(default)]
    pub pedals: Option<f64>,
}

/// What stays the same during a drive.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Hello {
    /// `watch`, `manual` or `beside`: beside the model of a server.
    pub mode: &'static str,
    /// Who steers, or where the recording goes.
    pub subject: String,
    /// The track.
    pub track: String,
    /// Whether the track is held out: training must not see it.
    pub held_out: bool,
    /// Length of a lap, m.
    pub lap_m: f64,
    /// Right and left edge of the road, closed: east and north, m.
    pub edges: Vec<Vec<[f64; 2]>>,
    /// Wheel angle at steering 1, deg.
    pub full_lock_deg: f64,
    /// Colours of the trail by its distance from the line, from 0 to the range that covers it.
    pub heat: Vec<String>,
    /// Distances from the line that may have the last colour, m.
    pub ranges_m: [f64; 5],
    /// Colours of the model, or of who drives, and of the expert.
    pub palette: [&'static str; 2],
    /// Colours that saliency adds, from nothing to most.
    pub saliency: Vec<String>,
}

impl Hello {
    /// The greeting for a drive on `track`.
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
            ranges_m: map::RANGES_M,
            palette: [palette::MODEL, palette::REFERENCE],
            saliency: (0..=8).map(|k| palette::saliency_hex(f64::from(k) / 8.0)).collect(),
        }
    }

    /// The greeting for a drive beside `driver`, the model of a server: the place of the car is not known.
    pub fn beside(driver: String) -> Hello {
        Hello {
            mode: "beside",
            subject: driver,
            full_lock_deg: MAX_STEER_DEG,
            palette: [palette::MODEL, palette::REFERENCE],
            ..Hello::default()
        }
    }
}

/// The result of a run that is over.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RunResult {
    /// Which one, as in `run 2 of 5 (seed 2), without help`.
    pub run: String,
    /// Whole laps driven.
    pub laps: usize,
    /// Why it ended early.
    pub failure: Option<Failure>,
    /// How often the car was put back.
    pub put_back: usize,
    /// Simulated time, s.
    pub time_s: f64,
    /// Mean distance from the line, m.
    pub cte_mean_m: f64,
}

/// A point of the trail.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TrailPoint(
    /// East, m.
    pub f32,
    /// North, m.
    pub f32,
    /// Cross-track error, m.
    pub f32,
);

/// A moment of the last seconds, from which the charts are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct RecentMoment(
    /// Simulated time, s.
    pub f64,
    /// Steering, [-1, 1], + = right.
    pub f32,
    /// That of the expert.
    pub f32,
    /// Cross-track error, m.
    pub f32,
);

/// The car at the moment of a frame.
#[derive(Clone, Debug, Default, Serialize)]
pub struct State {
    /// Title of the run.
    pub title: String,
    /// Number of the trail. When it changes, the car was put elsewhere, and the page begins a new trail.
    pub trail_id: u64,
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
    /// Steering of the expert at this place, or, beside the model of a server, of the model; [-1, 1], + = right.
    pub expert: f64,
    /// Throttle, [-1, 1], from the brake to the accelerator.
    pub throttle: f64,
    /// Speed, mph.
    pub speed_mph: f64,
    /// Cross-track error, m, + = right as driven.
    pub cte_m: f64,
    /// Laps driven. The number falls when the car drives back.
    pub laps: f64,
    /// Number of wheels off the road.
    pub wheels_off: usize,
    /// How often the car was put back on this trail.
    pub put_back: usize,
    /// State of the recording, when a person drives.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub manual: Option<Manual>,
    /// Who has the wheel, beside the model of a server.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub takeover: Option<Takeover>,
    /// Results of the last runs that are over.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub results: Vec<RunResult>,
    /// How fast a watched drive is shown.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub playback: Option<Playback>,
}

impl State {
    /// The state of the car. The caller adds steering, throttle and title.
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

/// State of a drive by hand.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Manual {
    /// Connection that holds the wheel.
    pub driver: Option<u64>,
    /// Whether rows are being recorded.
    pub recording: bool,
    /// Whether the accelerator is held.
    pub cruise: bool,
    /// What just happened.
    pub notice: String,
    /// What the recording covers.
    #[serde(flatten)]
    pub coverage: Shares,
    /// What to do next, the most important first.
    pub advice: Vec<String>,
}

/// Who has the wheel of a car that a server drives.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Takeover {
    /// Connection that may steer.
    pub driver: Option<u64>,
    /// Whether the command is the person's.
    pub by_user: bool,
    /// Rows recorded so far in which the person steered; `None` without a recording.
    pub rows: Option<u64>,
}

/// The last message.
#[derive(Clone, Debug, Serialize)]
pub struct Farewell {
    /// How the drive ended.
    pub over: String,
}

/// The message of a frame: the length of the [`State`] in bytes (u32, little endian), the state as JSON, the length of the
/// camera's JPEG (the same), the JPEG, and the JPEG of the same picture with its saliency, or nothing.
pub fn frame(state: &State, camera_jpeg: &[u8], saliency_jpeg: &[u8]) -> Vec<u8> {
    let json = serde_json::to_vec(state).expect("numbers, words and lists can be written as JSON");
    let mut message = Vec::with_capacity(8 + json.len() + camera_jpeg.len() + saliency_jpeg.len());
    for part in [&json[..], camera_jpeg] {
        message.extend((part.len() as u32).to_le_bytes());
        message.extend(part);
    }
    message.extend(saliency_jpeg);
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
