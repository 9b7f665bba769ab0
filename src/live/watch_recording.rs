//! Shows a drive on a recording in real time.

use std::time::Instant;

use super::messages::{Hello, State};
use super::playback::PlaybackClock;
use super::server::Live;
use super::watch::Shown;
use crate::error::Result;
use crate::geometry::{MPH_PER_MPS, Offset, Pose};
use crate::observer::StopSignal;
use crate::pilot::Pilot;
use crate::replay::{MAX_OFFSET_M, ReplayFrame, ReplayLog};
use crate::report::charts::map;
use crate::report::charts::palette::{self, heat_hex};
use crate::report::explain::saliency::Saliency;

/// Room between the paths of two sessions on the map, m.
const BETWEEN_M: f64 = 10.0;

/// Shows drives along the sessions of a recording on a page, one after the other, in real time.
pub struct WatchRecording<'a> {
    live: &'a Live,
    stop: &'a StopSignal,
    driver: &'a str,
    saliency: Option<(Pilot, Saliency)>,
    /// Where each session's path begins on the map, m east and north.
    origins: Vec<[f64; 2]>,
    lengths_m: Vec<f64>,
    session: Option<usize>,
    clock: PlaybackClock,
    shown: Shown,
    put_back: usize,
}

impl Hello {
    /// The greeting for a drive on `log`: the ground where the car is not put back is its road.
    pub fn on_recording(subject: String, log: &ReplayLog) -> Hello {
        let edges = log.sessions.iter().zip(origins(log)).map(|(session, [east, north])| {
            let beside = |pose: &Pose, right_m: f64| {
                let at = pose.displaced(Offset { right_m, ..Offset::default() });
                [at.x_m + east, at.y_m + north]
            };
            let right = session.path.poses().iter().map(|pose| beside(pose, MAX_OFFSET_M));
            right.chain(session.path.poses().iter().rev().map(|pose| beside(pose, -MAX_OFFSET_M))).collect()
        });
        Hello {
            mode: "watch",
            subject,
            track: log.recording.path.display().to_string(),
            held_out: false,
            lap_m: log.sessions.iter().map(|session| session.path.length_m()).sum(),
            edges: edges.collect(),
            full_lock_deg: log.geometry.full_lock_deg,
            heat: (0..map::COLOURS).map(|step| heat_hex(map::step_share(step))).collect(),
            ranges_m: map::RANGES_M,
            palette: [palette::MODEL, palette::REFERENCE],
            saliency: (0..=8).map(|k| palette::saliency_hex(f64::from(k) / 8.0)).collect(),
        }
    }
}

/// Where the paths of the sessions begin, so that they lie side by side.
fn origins(log: &ReplayLog) -> Vec<[f64; 2]> {
    let mut from_m = 0.0;
    let place = |session: &crate::dataset::DrivenSession| {
        let x = || session.path.poses().iter().map(|pose| pose.x_m);
        let (low, high) = (x().fold(0.0, f64::min), x().fold(0.0, f64::max));
        let east = from_m - low;
        from_m += high - low + BETWEEN_M;
        [east, 0.0]
    };
    log.sessions.iter().map(place).collect()
}

impl<'a> WatchRecording<'a> {
    /// Shows the drives of `driver` on `log` on `live`, whose greeting is [`Hello::on_recording`], until `stop` is requested. `pilot`
    /// is the model that drives, if any.
    pub fn new(
        live: &'a Live,
        log: &ReplayLog,
        driver: &'a str,
        pilot: Option<&Pilot>,
        stop: &'a StopSignal,
    ) -> WatchRecording<'a> {
        WatchRecording {
            live,
            stop,
            driver,
            // A network without a convolution has no saliency.
            saliency: pilot.and_then(|pilot| Some((pilot.clone(), Saliency::new(pilot.network()).ok()?))),
            origins: origins(log),
            lengths_m: log.sessions.iter().map(|session| session.path.length_m()).collect(),
            session: None,
            clock: PlaybackClock::start(Instant::now()),
            shown: Shown::default(),
            put_back: 0,
        }
    }

    /// Shows a frame of the drive along session number `session`.
    ///
    /// # Errors
    ///
    /// [`Error::Interrupted`](crate::Error::Interrupted) if the stop is requested; as [`Pilot::steer`].
    pub fn show(&mut self, session: usize, frame: &ReplayFrame) -> Result<()> {
        if self.session != Some(session) {
            (self.session, self.clock, self.put_back) = (Some(session), PlaybackClock::start(Instant::now()), 0);
        }
        let moment = &frame.moment;
        self.shown.wait(&mut self.clock, self.live, (session as u64, moment.time_s), self.stop)?;
        self.put_back += usize::from(moment.put_back);
        let [east, north] = self.origins[session];
        let heading = moment.heading_deg.to_radians();
        let before_m: f64 = self.lengths_m[..session].iter().sum();
        let state = State {
            title: format!("{}, session {} of {}", self.driver, session + 1, self.origins.len()),
            trail_id: session as u64,
            time_s: moment.time_s,
            x: moment.x_m + east,
            y: moment.y_m + north,
            heading: [libm::cos(heading), libm::sin(heading)],
            steering: moment.steering,
            expert: moment.pursuit.unwrap_or(0.0),
            speed_mph: moment.speed_mps * MPH_PER_MPS,
            cte_m: moment.offset_m,
            laps: (before_m + moment.along_m) / self.lengths_m.iter().sum::<f64>().max(1e-9),
            put_back: self.put_back,
            ..State::default()
        };
        let saliency = &mut self.saliency;
        self.shown.show(self.live, state, |camera_jpeg, saliency_jpeg| {
            *camera_jpeg = frame.view.to_jpeg();
            if let Some((pilot, saliency)) = saliency {
                saliency.steer(pilot, frame.view.view())?;
                let mut image = frame.view.clone();
                saliency.overlay(&pilot.recipe().preprocessing, &mut image);
                *saliency_jpeg = image.to_jpeg();
            }
            Ok(())
        })
    }
}
