//! How the client drives, and what it reports.

use super::server_url::ServerUrl;
use crate::simulator::trial::outcome::Trial;
use crate::udacity::{DecimalMark, NumberStyle};
use crate::{Error, Result};

/// How simulated time passes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TimeMode {
    /// As in `drive`: 20 frames for each simulated second, and time stands still until the reply to each.
    Lockstep,
    /// Time passes with the clock.
    RealTime {
        /// Frames per second.
        fps: f64,
    },
}

/// How the client drives.
#[derive(Clone, Debug)]
pub struct ClientOptions {
    /// Address of the server.
    pub url: ServerUrl,
    /// Laps to drive.
    pub laps: usize,
    /// Seed of the start and the light, as in `drive`.
    pub seed: u64,
    /// Speed at the start, mph. Unity's car starts at 0; `drive` starts at the speed to hold.
    pub start_mph: f64,
    /// How simulated time passes.
    pub time_mode: TimeMode,
    /// How the simulator writes and reads numbers: strings with a decimal mark, or JSON numbers (second term).
    pub numbers: NumberStyle,
    /// Start and end of driving by hand with W held, s of simulated time.
    pub manual_s: Option<(f64, f64)>,
    /// Whether somebody takes the wheel when the car is far from the line, and gives it back near it. Telemetry with its picture goes
    /// on, and says so.
    pub correct: bool,
    /// Simulated time at which the scene is left and entered again, s. The connection ends without a close frame, and the car
    /// starts anew.
    pub scene_change_s: Option<f64>,
    /// Number of answered telemetries after which to stop.
    pub frames: Option<u64>,
    /// Longest time without a reply, s.
    pub patience_s: f64,
}

impl Default for ClientOptions {
    fn default() -> Self {
        ClientOptions {
            url: ServerUrl::default(),
            laps: 1,
            seed: 1,
            start_mph: 20.0,
            time_mode: TimeMode::RealTime { fps: 60.0 },
            numbers: NumberStyle::Strings(DecimalMark::DOT),
            manual_s: None,
            correct: false,
            scene_change_s: None,
            frames: None,
            patience_s: 30.0,
        }
    }
}

/// What happened during the drive.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ClientReport {
    /// The run since the scene was last entered.
    pub run: Trial,
    /// Frames, each of which can send telemetry.
    pub frames: u64,
    /// Telemetries sent with a picture.
    pub telemetries: u64,
    /// Of these, telemetries while somebody corrected the car.
    pub corrected_telemetries: u64,
    /// Telemetries sent as `null` while a person drove by hand.
    pub manual_telemetries: u64,
    /// Commands that could be read.
    pub commands: u64,
    /// `manual` events in reply to `null`.
    pub manuals: u64,
    /// Other `manual` events: the server asked for telemetry.
    pub questions: u64,
    /// Commands that could not be read. Each lost a token.
    pub tokens_lost: u64,
    /// Number of WebSocket connections.
    pub connections: u64,
    /// Time from the first connection to the end, s.
    pub wall_s: f64,
    /// Times from telemetry to its reply, ms, in ascending order.
    pub round_trips_ms: Vec<f64>,
}

impl ClientOptions {
    /// Checks the options.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] with the range of the option that is wrong.
    pub(super) fn check(&self) -> Result<()> {
        let fail = |message: String| Err(Error::Usage(message));
        if self.laps == 0 {
            return fail("laps must be at least 1".into());
        }
        if !(0.0..=30.0).contains(&self.start_mph) {
            return fail(format!("a start at {} mph: the car drives 0 to 30 mph", self.start_mph));
        }
        if let TimeMode::RealTime { fps } = self.time_mode
            && !(1.0..=1000.0).contains(&fps)
        {
            return fail(format!("{fps} frames a second: 1 to 1000 can be taken"));
        }
        if let Some((from, until)) = self.manual_s
            && !(from >= 0.0 && until > from)
        {
            return fail(format!("driving by hand from {from} to {until} s: the end must come after the beginning"));
        }
        if self.scene_change_s.is_some_and(|at| !(at >= 0.0 && at.is_finite())) {
            return fail("the scene can change at a time in seconds, not below 0".into());
        }
        if !(self.patience_s > 0.0 && self.patience_s.is_finite()) {
            return fail(format!("a patience of {} s: more than 0 is meant", self.patience_s));
        }
        Ok(())
    }
}
