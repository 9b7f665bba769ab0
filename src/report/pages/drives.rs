//! The drives that lie in a run folder: their table and their maps.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Deserialize;

use super::html::Page;
use crate::calm::Calm;
use crate::error::Result;
use crate::report::charts::map::{self, MapPoint};
use crate::report::tone::Tone;
use crate::simulator::trial::trajectory::{
    RUN_DEPTH, Waypoint, find_drives, read_summary, read_trajectory, trajectories,
};
use crate::simulator::{DriveSummary, Track};

/// Headers of [`DriveView::row`].
pub(super) const HEADERS: [&str; 11] = [
    "track",
    "laps without help",
    "autonomy",
    "put back",
    "mean distance from line",
    "95 % below",
    "wheel trembles by (expert)",
    "turns back a minute (expert)",
    "95 % of changes a frame below (expert)",
    "lateral jerk (expert)",
    "error on the expert's frames",
];

/// A drive, as `drive --out` wrote it.
#[derive(Debug)]
pub(super) struct DriveView {
    pub summary: DriveSummary,
    /// The ways of the assisted runs.
    ways: Vec<Vec<MapPoint>>,
    /// Mean absolute error on frames of the expert's drive, where the main job measured it.
    offline_mae_deg: Option<f64>,
}

/// What the main job notes of a drive beside its summary.
#[derive(Deserialize)]
struct OfflineError {
    track: String,
    offline_mae_deg: f64,
}

/// Reads the drives below the run folder `path`: trained tracks first, then held-out ones.
///
/// # Errors
///
/// [`Error::Io`](crate::Error::Io) and [`Error::Data`](crate::Error::Data) for a drive that cannot be read.
pub(super) fn read(path: &Path) -> Result<Vec<DriveView>> {
    let errors = std::fs::read(path.join("drives.json")).ok();
    let errors: Vec<OfflineError> = errors.and_then(|text| serde_json::from_slice(&text).ok()).unwrap_or_default();
    let read = |folder: &std::path::PathBuf| -> Result<DriveView> {
        let assisted = trajectories(folder).into_iter().filter(|(kind, ..)| kind == "assisted");
        let ways = assisted.map(|(_, _, path)| read_way(&path)).collect::<Result<_>>()?;
        let summary = read_summary(folder)?;
        let offline = errors.iter().find(|error| error.track == summary.track);
        Ok(DriveView { offline_mae_deg: offline.map(|error| error.offline_mae_deg), summary, ways })
    };
    let mut drives: Vec<DriveView> = find_drives(path, RUN_DEPTH).iter().map(read).collect::<Result<_>>()?;
    drives.sort_by(|a, b| (a.summary.held_out, &a.summary.track).cmp(&(b.summary.held_out, &b.summary.track)));
    Ok(drives)
}

fn read_way(path: &Path) -> Result<Vec<MapPoint>> {
    let point = |w: Waypoint| MapPoint { x: w.x_m, y: w.y_m, cte_m: w.cte_m, put_back: w.intervention > 0 };
    Ok(read_trajectory(path)?.into_iter().map(point).collect())
}

impl DriveView {
    /// The figures, below [`HEADERS`].
    pub(super) fn row(&self) -> Vec<String> {
        let summary = &self.summary;
        vec![
            format!("{}{}", summary.track, if summary.held_out { " (held out)" } else { "" }),
            format!("{} of {}", summary.laps_completed, summary.laps_total),
            format!("{:.1} %", summary.autonomy_percent),
            times(summary.interventions),
            format!("{:.2} m", summary.cte_mean_m),
            format!("{:.2} m", summary.cte_p95_m),
            format!("{:.1} °/s ({:.1})", summary.whiteness_deg_s, summary.expert_whiteness_deg_s),
            beside(summary, |calm| format!("{:.1}", calm.reversals_per_min), ""),
            beside(summary, |calm| format!("{:.2}", calm.angle_change_p95_deg), "°"),
            beside(summary, |calm| format!("{:.1}", calm.lateral_jerk_rms_mps3), " m/s³"),
            self.offline_mae_deg.map_or("-".into(), |mae_deg| format!("{mae_deg:.2}°")),
        ]
    }
}

/// A measure of the driver with its unit, and that of the expert, where there is one; a dash where an older version wrote the drive.
fn beside(summary: &DriveSummary, measure: impl Fn(&Calm) -> String, unit: &str) -> String {
    match (&summary.calm, &summary.expert_calm) {
        (Some(calm), Some(expert)) => format!("{}{unit} ({})", measure(calm), measure(expert)),
        (Some(calm), None) => format!("{}{unit}", measure(calm)),
        _ => "-".into(),
    }
}

/// `1 time`, `3 times`.
pub(super) fn times(count: usize) -> String {
    if count == 1 { "1 time".into() } else { format!("{count} times") }
}

/// Adds the drives of one run to `page`: what they came to, their table, their maps.
pub(super) fn describe(page: &mut Page, drives: &[DriveView]) {
    page.section("On the road");
    for (held_out, tracks) in [(false, "training tracks"), (true, "held-out tracks")] {
        let of: Vec<&DriveSummary> =
            drives.iter().map(|drive| &drive.summary).filter(|summary| summary.held_out == held_out).collect();
        if of.is_empty() {
            continue;
        }
        let done: usize = of.iter().map(|summary| summary.laps_completed).sum();
        let laps: usize = of.iter().map(|summary| summary.laps_total).sum();
        let put_back: usize = of.iter().map(|summary| summary.interventions).sum();
        let text = format!(
            "On {tracks} the model completed {done} of {laps} {} without help; with help it was put back {}.",
            if laps == 1 { "lap" } else { "laps" },
            times(put_back)
        );
        let tone = match (done == laps, put_back) {
            (true, 0) => Tone::Good,
            (true, _) => Tone::Neutral,
            (false, _) => Tone::Warning,
        };
        page.advice(&text, tone);
    }
    page.table(&HEADERS, &drives.iter().map(DriveView::row).collect::<Vec<_>>());
    page.paragraph(
        "Laps and distances are those of runs without help, up to the first failure. Autonomy, and the maps, are those of runs \
         in which the car was put back when it was more than a metre from the line. How calm the wheel is: the root mean square of \
         the rate of the front wheels' angle; how often they turn back by more than 1° in a minute; the change of their angle \
         from frame to frame that 95 % do not exceed; the root mean square of the rate of the lateral acceleration.",
    );
    page.drawings(&maps(drives.iter().map(|drive| (drive.summary.track.clone(), drive))));
}

/// The maps of titled drives; those of one track have the same scale of colours.
pub(super) fn maps<'a>(drives: impl Iterator<Item = (String, &'a DriveView)>) -> Vec<String> {
    let drives: Vec<(String, &DriveView)> = drives.collect();
    let mut scales = BTreeMap::<&str, f64>::new();
    for (_, drive) in &drives {
        let darkest_m = map::darkest_m(drive.ways.iter().flatten().map(|point| point.cte_m));
        let scale = scales.entry(&drive.summary.track).or_default();
        *scale = scale.max(darkest_m);
    }
    let draw = |(title, drive): &(String, &DriveView)| {
        let DriveView { summary, ways, .. } = drive;
        // A track file may be gone; the way alone says something as well.
        let track = Track::load(&summary.track).ok();
        let title = format!("{title}: autonomy {:.1} %", summary.autonomy_percent);
        map::figure(&title, track.as_ref(), ways, scales[summary.track.as_str()])
    };
    drives.iter().map(draw).collect()
}
