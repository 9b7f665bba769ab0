//! Drives along the sessions of a recording, and what they came to.

use std::ops::ControlFlow;
use std::sync::atomic::{AtomicBool, Ordering};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::log::{Frames, ReplayLog};
use crate::calm::{Calm, CalmFrame};
use crate::dataset::{DrivenSession, View};
use crate::error::{Error, Result};
use crate::geometry::{CarGeometry, LookAhead, Offset, PixelGrid, ViewWarp};
use crate::picture::RgbImage;

/// Frames that a driver sees in each second, as in the simulator.
pub const DRIVE_HZ: f64 = 20.0;
/// Distance from the path at which the car is put back, m (NVIDIA 2016).
pub const MAX_OFFSET_M: f64 = 1.0;
/// Turn from the path at which the car is put back, deg.
pub const MAX_TURN_DEG: f64 = 15.0;
/// Time charged for each time the car is put back, s (NVIDIA 2016).
const INTERVENTION_S: f64 = 6.0;
/// A car that stood in the recording rolls on at this speed, in wheelbases a second.
const MIN_WHEELBASES_PER_S: f64 = 0.5;

/// How a recording is driven on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ReplayOptions {
    /// Time from a picture to the wheels, ms, in steps of 50.
    pub latency_ms: f64,
    /// How far ahead the path is pursued by the steering that is shown beside the driver's.
    pub look_ahead: LookAhead,
    /// Whether a frame whose picture cannot be read is left out, with the wheel as it was; otherwise it ends the drive.
    pub leave_out_unreadable: bool,
}

impl ReplayOptions {
    /// No latency, the usual look-ahead, and every picture can be read.
    pub fn usual(geometry: &CarGeometry) -> ReplayOptions {
        ReplayOptions { latency_ms: 0.0, look_ahead: LookAhead::usual(geometry), leave_out_unreadable: false }
    }

    /// Checks that it can be driven.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] with what is possible.
    pub fn check(&self) -> Result<()> {
        if !(0.0..=2000.0).contains(&self.latency_ms) {
            return Err(Error::Usage(format!("latency {} ms: 0 to 2000 ms can be simulated", self.latency_ms)));
        }
        Ok(())
    }
}

/// One moment of a drive on a recording.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ReplayMoment {
    /// Time since the start of the session, s.
    pub time_s: f64,
    /// Row of the recording whose picture was shown.
    pub row: usize,
    /// Place of the rear axle, m, in the coordinates of the session's path.
    pub x_m: f64,
    /// See `x_m`.
    pub y_m: f64,
    /// Where the car points, deg, anticlockwise from x.
    pub heading_deg: f64,
    /// Way along the path, m.
    pub along_m: f64,
    /// Distance from the path, m, + = right.
    pub offset_m: f64,
    /// Turn from the path, deg, + = right.
    pub turn_deg: f64,
    /// What the driver asked for, [-1, 1].
    pub steering: f64,
    /// What would lead back to the path, [-1, 1]; `None` near the end of a session, where no path lies ahead.
    pub pursuit: Option<f64>,
    /// Speed, m/s.
    pub speed_mps: f64,
    /// Whether the car was just put back.
    pub put_back: bool,
}

/// What there is to see at one frame of a drive on a recording.
#[derive(Debug)]
pub struct ReplayFrame<'a> {
    /// The warped picture, as the driver saw it.
    pub view: &'a RgbImage,
    /// The session that is driven.
    pub session: &'a DrivenSession,
    /// Where the car is, and how it is steered.
    pub moment: ReplayMoment,
}

/// A drive along one session.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReplayRun {
    /// Moments at 20 Hz.
    pub moments: Vec<ReplayMoment>,
    /// Angle of the front wheels at steering 1, deg.
    pub full_lock_deg: f64,
    /// Whether the session was driven to its end.
    pub whole: bool,
    /// Times the car was put back.
    pub interventions: usize,
    /// Way along the path, m.
    pub distance_m: f64,
    /// Time, s.
    pub time_s: f64,
    /// Sum of squared changes of the wheels' angle, deg²/s.
    pub whiteness_sum: f64,
    /// Why a picture could not be read, for each frame that was left out for that.
    pub unreadable: Vec<String>,
}

impl ReplayRun {
    /// Whether anything of the session was driven, or there was nothing to drive.
    pub fn begun(&self) -> bool {
        self.whole || !self.moments.is_empty()
    }

    /// Share of the time in which nobody had to help, %.
    pub fn autonomy_percent(&self) -> f64 {
        autonomy_percent(self.interventions, self.time_s)
    }

    /// The moments and the time, s, as [`Calm::of`] takes them.
    fn calm_frames(&self) -> (Vec<CalmFrame>, f64) {
        let frames = self.moments.iter().map(|moment| CalmFrame {
            time_s: moment.time_s,
            angle_deg: moment.steering * self.full_lock_deg,
            heading_deg: moment.heading_deg,
            speed_mps: moment.speed_mps,
            put_back: moment.put_back,
        });
        (frames.collect(), self.time_s)
    }
}

fn autonomy_percent(interventions: usize, time_s: f64) -> f64 {
    (100.0 * (1.0 - INTERVENTION_S * interventions as f64 / time_s.max(1e-9))).max(0.0)
}

/// The measures of a drive on a recording; the fields of `drive --on RECORDING --json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReplaySummary {
    /// Sessions driven.
    pub sessions: usize,
    /// Share of the time in which nobody had to help, %: `(1 - 6 s * interventions / time) * 100`, not below 0.
    pub autonomy_percent: f64,
    /// Times the car was put back.
    pub interventions: usize,
    /// The same for each km.
    pub interventions_per_km: f64,
    /// Way along the path, m.
    pub distance_m: f64,
    /// Time, s.
    pub time_s: f64,
    /// Distance from the path: mean, m.
    pub offset_mean_m: f64,
    /// Its root mean square, m.
    pub offset_rms_m: f64,
    /// Its 95th percentile, m.
    pub offset_p95_m: f64,
    /// Root mean square rate of the steering, deg/s.
    pub whiteness_deg_s: f64,
    /// How calm the drive is; absent where an older version drove.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub calm: Option<Calm>,
    /// Frames shown.
    pub frames: usize,
    /// Frames a second; the one number that differs between runs.
    pub frames_per_second: f64,
}

/// Drives along every session of `log`, sessions in parallel; results do not depend on the number of threads. `new_driver` makes
/// a driver: steering in [-1, 1], + = right, for a picture. `seen` is shown every frame; an error of it ends the drive.
///
/// # Errors
///
/// Pictures that cannot be read, unless they are left out, and the errors of drivers and of `seen`.
pub fn replay<D>(
    log: &ReplayLog,
    options: &ReplayOptions,
    new_driver: impl Fn() -> Result<D> + Sync,
    seen: &(dyn Fn(usize, &ReplayFrame) -> Result<()> + Sync),
) -> Result<Vec<ReplayRun>>
where
    D: FnMut(&RgbImage) -> Result<f32>,
{
    match replay_as_far(log, options, new_driver, seen)? {
        (runs, false) => Ok(runs),
        (_, true) => Err(Error::Interrupted),
    }
}

/// As [`replay`]; but if `seen` ends it with [`Error::Interrupted`], the runs as far as they were driven, and `true`. A session that was not
/// begun has a run without moments.
///
/// # Errors
///
/// As [`replay`]; [`Error::Interrupted`] if nothing was driven.
pub fn replay_as_far<D>(
    log: &ReplayLog,
    options: &ReplayOptions,
    new_driver: impl Fn() -> Result<D> + Sync,
    seen: &(dyn Fn(usize, &ReplayFrame) -> Result<()> + Sync),
) -> Result<(Vec<ReplayRun>, bool)>
where
    D: FnMut(&RgbImage) -> Result<f32>,
{
    options.check()?;
    let stopped = AtomicBool::new(false);
    let along = |(number, session): (usize, &DrivenSession)| {
        let seen = |frame: &ReplayFrame| match seen(number, frame) {
            Err(Error::Interrupted) => {
                stopped.store(true, Ordering::Relaxed);
                Ok(ControlFlow::Break(()))
            }
            other => other.map(ControlFlow::Continue),
        };
        drive_session(log, session, options, new_driver()?, &seen)
    };
    let runs: Vec<ReplayRun> = log.sessions.par_iter().enumerate().map(along).collect::<Result<_>>()?;
    let stopped = stopped.into_inner();
    if stopped && runs.iter().all(|run| run.moments.is_empty()) {
        return Err(Error::Interrupted);
    }
    Ok((runs, stopped))
}

fn drive_session(
    log: &ReplayLog,
    session: &DrivenSession,
    options: &ReplayOptions,
    mut driver: impl FnMut(&RgbImage) -> Result<f32>,
    seen: &dyn Fn(&ReplayFrame) -> Result<ControlFlow<()>>,
) -> Result<ReplayRun> {
    let ReplayLog { geometry, .. } = log;
    let path = &session.path;
    let mut run = ReplayRun { full_lock_deg: geometry.full_lock_deg, whole: true, ..ReplayRun::default() };
    let mut eye = Eye::default();
    let Some(mut pose) = path.pose_at(0.0) else { return Ok(run) };
    let mut at_m = 0.0;
    let mut put_back = false;
    let mut last_steering: Option<f64> = None;
    let delay = (options.latency_ms / 1000.0 * DRIVE_HZ).round() as usize;
    let mut on_the_way = std::collections::VecDeque::from(vec![0.0; delay]);
    let dt_s = 1.0 / DRIVE_HZ;
    while at_m < path.length_m() - 1e-6 {
        let offset = path.pose_at(at_m).unwrap_or_default().offset_to(pose);
        let row = nearest_row(session, at_m);
        let speed_mps = session.speed_mps[row].max(MIN_WHEELBASES_PER_S * geometry.wheelbase_m);
        let view = match eye.look(log, session, row, session.path.poses()[row].offset_to(pose)) {
            Ok(view) => Some(view),
            Err(error) if options.leave_out_unreadable => {
                run.unreadable.push(error.to_string());
                None
            }
            Err(error) => return Err(error),
        };
        let steering = match view {
            Some(view) => f64::from(driver(view)?),
            None => last_steering.unwrap_or(0.0),
        };
        let steering = if steering.is_finite() { steering.clamp(-1.0, 1.0) } else { 0.0 };
        if let Some(last) = last_steering {
            let change_deg = (steering - last) * geometry.full_lock_deg;
            run.whiteness_sum += change_deg * change_deg / dt_s;
        }
        last_steering = Some(steering);
        let ahead_m = options.look_ahead.distance_m(speed_mps);
        let moment = ReplayMoment {
            time_s: run.time_s,
            row: session.rows.start + row,
            x_m: pose.x_m,
            y_m: pose.y_m,
            heading_deg: pose.heading.to_degrees(),
            along_m: at_m,
            offset_m: offset.right_m,
            turn_deg: offset.turn.to_degrees(),
            steering,
            pursuit: path.pursuit(geometry, pose, at_m, ahead_m).map(|s| s.clamp(-1.0, 1.0)),
            speed_mps,
            put_back: std::mem::take(&mut put_back),
        };
        if let Some(view) = view {
            if seen(&ReplayFrame { view, session, moment })?.is_break() {
                run.whole = false;
                break;
            }
            run.moments.push(moment);
        }
        on_the_way.push_back(steering);
        let in_force = on_the_way.pop_front().unwrap_or(steering);
        pose = pose.moved(speed_mps * dt_s, geometry.curvature(in_force));
        run.time_s += dt_s;
        let (next_m, offset) = path.locate(pose, at_m, 3.0 * speed_mps * dt_s);
        // A car across the path makes no way along it, but it is put back long before it can stand still there.
        at_m = next_m.max(at_m);
        if offset.right_m.abs() > MAX_OFFSET_M || offset.turn.abs().to_degrees() > MAX_TURN_DEG {
            run.interventions += 1;
            put_back = true;
            pose = path.pose_at(at_m).unwrap_or_default();
            on_the_way.iter_mut().for_each(|steering| *steering = 0.0);
        }
    }
    run.distance_m = at_m;
    Ok(run)
}

/// The row, within the session, that was recorded nearest to `at_m`.
fn nearest_row(session: &DrivenSession, at_m: f64) -> usize {
    let before = session.path.row_at(at_m);
    let after = (before + 1).min(session.path.len() - 1);
    if session.path.along_m(after) - at_m < at_m - session.path.along_m(before) { after } else { before }
}

/// Looks at the recorded world from beside the path.
#[derive(Default)]
struct Eye<'a> {
    frames: Frames<'a>,
    view: RgbImage,
}

impl<'a> Eye<'a> {
    /// The view of a car at `offset` from where it was at `row` of the session: made of the picture of the nearest camera.
    fn look(&mut self, log: &ReplayLog<'a>, session: &DrivenSession, row: usize, offset: Offset) -> Result<&RgbImage> {
        let row = session.rows.start + row;
        let [left_m, right_m] = log.geometry.side_offsets_m;
        let (camera, taken_m) = [(View::Centre, 0.0), (View::Left, left_m), (View::Right, right_m)]
            .into_iter()
            .filter(|(camera, _)| log.recording.row_has(row, *camera))
            .min_by(|a, b| (offset.right_m - a.1).abs().total_cmp(&(offset.right_m - b.1).abs()))
            .unwrap_or((View::Centre, 0.0));
        let picture = self.frames.get(log.recording, row, camera)?;
        let size = [picture.height, picture.width];
        let warp = ViewWarp::new(&log.geometry, PixelGrid::whole(&log.geometry, size), taken_m, offset);
        self.view.height = picture.height;
        self.view.width = picture.width;
        self.view.pixels.resize(picture.pixels.len(), 0);
        warp.apply(&picture.pixels, &mut self.view.pixels);
        Ok(&self.view)
    }
}

/// The measures over all sessions, which took `seconds` to drive.
pub fn summarise(runs: &[ReplayRun], seconds: f64) -> ReplaySummary {
    let time_s: f64 = runs.iter().map(|run| run.time_s).sum();
    let distance_m: f64 = runs.iter().map(|run| run.distance_m).sum();
    let interventions: usize = runs.iter().map(|run| run.interventions).sum();
    let whiteness_sum: f64 = runs.iter().map(|run| run.whiteness_sum).sum();
    let mut offsets: Vec<f64> = runs.iter().flat_map(|run| &run.moments).map(|m| m.offset_m.abs()).collect();
    offsets.sort_by(f64::total_cmp);
    let n = offsets.len().max(1) as f64;
    let p95 = offsets.get(((offsets.len() as f64 * 0.95) as usize).min(offsets.len().saturating_sub(1)));
    ReplaySummary {
        sessions: runs.iter().filter(|run| run.begun()).count(),
        autonomy_percent: autonomy_percent(interventions, time_s),
        interventions,
        interventions_per_km: interventions as f64 / (distance_m / 1000.0).max(1e-9),
        distance_m,
        time_s,
        offset_mean_m: offsets.iter().sum::<f64>() / n,
        offset_rms_m: (offsets.iter().map(|m| m * m).sum::<f64>() / n).sqrt(),
        offset_p95_m: p95.copied().unwrap_or(0.0),
        whiteness_deg_s: (whiteness_sum / time_s.max(1e-9)).sqrt(),
        calm: Some(Calm::of(runs.iter().map(|run| run.calm_frames()))),
        frames: offsets.len(),
        frames_per_second: offsets.len() as f64 / seconds.max(1e-9),
    }
}
