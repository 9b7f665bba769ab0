//! A drive on a recording, saved as a drive on a track is: pages, comparisons and `drive`'s readers take both.

use std::fmt::Write as _;

use crate::error::{Error, Result};
use crate::files::new_folder::NewFolder;
use crate::geometry::MPH_PER_MPS;
use crate::replay::{ReplayLog, ReplayRun, ReplaySummary};
use crate::report::charts::map::{self, MapPoint};
use crate::simulator::DriveSummary;
use crate::simulator::trial::statistics::wilson_interval;
use crate::simulator::trial::trajectory::SUMMARY;

/// Size of a map, pixels.
const MAP: [f64; 2] = [760.0, 620.0];

/// The measures of a drive along all sessions of `log` in the fields of a drive on a track: a session is a run and a lap, and
/// complete if it was driven to its end and nobody had to help; distances are those from the driven path; the expert is who drove.
pub fn drive_summary(log: &ReplayLog, runs: &[ReplayRun], summary: &ReplaySummary) -> DriveSummary {
    let completed = runs.iter().filter(|run| run.whole && run.interventions == 0).count();
    let (completed_low, completed_high) = wilson_interval(completed, summary.sessions);
    let place = log.recording.path.file_name().unwrap_or(log.recording.path.as_os_str()).to_string_lossy().into_owned();
    DriveSummary {
        track: format!("{place} (recording)"),
        held_out: false,
        trained_on_held_out: Vec::new(),
        runs: summary.sessions,
        laps_completed: completed,
        laps_total: summary.sessions,
        completed_low,
        completed_high,
        autonomy_percent: summary.autonomy_percent,
        interventions: summary.interventions,
        interventions_per_km: summary.interventions_per_km,
        distance_m: summary.distance_m,
        cte_mean_m: summary.offset_mean_m,
        cte_rms_m: summary.offset_rms_m,
        cte_p95_m: summary.offset_p95_m,
        off_road_s: 0.0,
        crashes: 0,
        mean_speed_mph: summary.distance_m / summary.time_s.max(1e-9) * MPH_PER_MPS,
        whiteness_deg_s: summary.whiteness_deg_s,
        expert_whiteness_deg_s: driver_whiteness_deg_s(log),
        calm: summary.calm,
        expert_calm: None,
        realtime_factor: summary.frames_per_second * summary.time_s / summary.frames.max(1) as f64,
    }
}

/// Root mean square rate of the recorded steering, deg/s.
fn driver_whiteness_deg_s(log: &ReplayLog) -> f64 {
    let (mut squares, mut time_s) = (0.0, 0.0);
    for session in &log.sessions {
        for pair in log.recording.rows[session.rows.clone()].windows(2) {
            let dt_s = (pair[1].time_ms - pair[0].time_ms) as f64 / 1000.0;
            if dt_s > 0.0 {
                let change_deg = f64::from(pair[1].steering - pair[0].steering) * log.geometry.full_lock_deg;
                squares += change_deg * change_deg / dt_s;
                time_s += dt_s;
            }
        }
    }
    (squares / f64::max(time_s, 1e-9)).sqrt()
}

/// Writes into `folder`, and gives it its name: `assisted_N.csv` with the moments of session N, `map.svg` (`map_N.svg` if there are
/// several sessions), `summary.json` in the fields of a drive on a track, and `replay.json`.
///
/// # Errors
///
/// If it cannot be written.
pub fn write(log: &ReplayLog, runs: &[ReplayRun], summary: &ReplaySummary, folder: NewFolder) -> Result<()> {
    let put = |name: &str, bytes: &[u8]| {
        let path = folder.unfinished().join(name);
        std::fs::write(&path, bytes).map_err(|source| folder.explain(Error::Io { path, source }))
    };
    let json = |name: &str, value: serde_json::Result<String>| -> Result<()> {
        put(name, (value.map_err(|e| Error::data(name, e.to_string()))? + "\n").as_bytes())
    };
    let begun = runs.iter().zip(&log.sessions).enumerate().filter(|(_, (run, _))| run.begun());
    for (number, (run, session)) in begun {
        put(&format!("assisted_{}.csv", number + 1), moments_csv(run).as_bytes())?;
        let way: Vec<MapPoint> = (run.moments.iter())
            .map(|m| MapPoint { x: m.x_m, y: m.y_m, cte_m: m.offset_m, put_back: m.put_back })
            .collect();
        let title = format!("session {} of {}, put back: {}", number + 1, runs.len(), run.interventions);
        let name = if runs.len() == 1 { "map.svg".into() } else { format!("map_{}.svg", number + 1) };
        put(&name, map::draw_on_path(&title, &session.path, &way, MAP).as_bytes())?;
    }
    json(SUMMARY, serde_json::to_string_pretty(&drive_summary(log, runs, summary)))?;
    json("replay.json", serde_json::to_string_pretty(summary))?;
    folder.finish()
}

/// The moments of a drive as CSV, one a line, in the columns of a trajectory on a track (distances are those from the driven path)
/// and some of its own: the row that was shown, the turn from the path, and the steering that would lead back.
fn moments_csv(run: &ReplayRun) -> String {
    let mut text = String::from(
        "time_s,x_m,y_m,s_m,cte_m,steering,throttle,speed_mph,intervention,heading_deg,row,turn_deg,pursuit\n",
    );
    for m in &run.moments {
        let pursuit = m.pursuit.map_or(String::new(), |steering| format!("{steering:.6}"));
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "{:.3},{:.4},{:.4},{:.3},{:.4},{:.6},0,{:.3},{},{:.4},{},{:.3},{pursuit}",
            m.time_s,
            m.x_m,
            m.y_m,
            m.along_m,
            m.offset_m,
            m.steering,
            m.speed_mps * MPH_PER_MPS,
            u8::from(m.put_back),
            m.heading_deg,
            m.row,
            m.turn_deg,
        );
    }
    text
}
