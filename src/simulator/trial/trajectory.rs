//! The way of a run as a file, and read again.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::files::new_folder::NewFolder;
use crate::simulator::trial::outcome::Trial;
use crate::simulator::trial::summary::{DriveResult, DriveSummary};
use crate::{Error, Result};

/// How deep drives lie below the folder of a training run: `drives/NAME`.
pub const RUN_DEPTH: usize = 2;

/// File in the folder of a drive that holds what was measured.
pub(crate) const SUMMARY: &str = "summary.json";

/// A run as CSV text, one line for each frame.
pub fn trajectory_csv(run: &Trial) -> String {
    let mut text = String::from("time_s,x_m,y_m,s_m,cte_m,steering,throttle,speed_mph,intervention,heading_deg\n");
    for m in &run.moments {
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "{:.2},{:.4},{:.4},{:.3},{:.4},{:.5},{:.4},{:.3},{},{:.4}",
            m.time_s,
            m.x,
            m.y,
            m.s_m,
            m.cte_m,
            m.steering,
            m.throttle,
            m.speed_mph,
            u8::from(m.intervention),
            m.heading_deg
        );
    }
    text
}

/// A line of a trajectory, as far as pictures need it.
#[derive(Clone, Copy, Debug, Deserialize)]
pub struct Waypoint {
    /// Time since the start, s.
    pub time_s: f64,
    /// East, m.
    pub x_m: f64,
    /// North, m.
    pub y_m: f64,
    /// Cross-track error, m, + = right as driven.
    pub cte_m: f64,
    /// What the driver asked for, [-1, 1].
    pub steering: f64,
    /// Speed, mph.
    pub speed_mph: f64,
    /// 1 if the car was just put back, else 0.
    pub intervention: u8,
    /// Where the car points: deg, anticlockwise from east. Older files do not tell.
    pub heading_deg: Option<f64>,
}

/// The trajectories in the folder of a drive: `free` or `assisted`, seed, file; in the order of the seeds.
pub fn trajectories(folder: &Path) -> Vec<(String, u64, PathBuf)> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    let mut found: Vec<_> = entries
        .filter_map(|path| {
            let (kind, seed) = path.file_name()?.to_str()?.strip_suffix(".csv")?.split_once('_')?;
            let known = ["free", "assisted"].contains(&kind);
            known.then_some(()).and(Some((kind.to_string(), seed.parse().ok()?, path.clone())))
        })
        .collect();
    found.sort_by_key(|(_, seed, _)| *seed);
    found
}

/// Whether `path` is a folder that `drive --out` wrote.
pub fn is_drive(path: &Path) -> bool {
    path.join(SUMMARY).is_file() && !trajectories(path).is_empty()
}

/// Folders of drives at `folder` and at most `depth` folders below it, in the order of their names.
pub fn find_drives(folder: &Path, depth: usize) -> Vec<PathBuf> {
    if is_drive(folder) {
        return vec![folder.to_path_buf()];
    }
    if depth == 0 {
        return Vec::new();
    }
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    let mut folders: Vec<PathBuf> = entries.filter(|path| path.is_dir()).collect();
    folders.sort();
    folders.iter().flat_map(|folder| find_drives(folder, depth - 1)).collect()
}

/// Reads the summary of the drive in `folder`.
///
/// # Errors
/// [`Error::Io`] if it cannot be read, [`Error::Data`] with the line that is not as it must be.
pub fn read_summary(folder: &Path) -> Result<DriveSummary> {
    let path = folder.join(SUMMARY);
    let text = std::fs::read_to_string(&path).map_err(Error::io(&path))?;
    serde_json::from_str(&text).map_err(|e| Error::data_at(&path, e.line() as u64, e.to_string()))
}

/// Reads the trajectory `path`.
///
/// # Errors
/// [`Error::Io`] if it cannot be read, [`Error::Data`] with the line that is not as it must be.
pub fn read_trajectory(path: &Path) -> Result<Vec<Waypoint>> {
    let bytes = std::fs::read(path).map_err(Error::io(path))?;
    let mut way: Vec<Waypoint> = Vec::new();
    for waypoint in csv::Reader::from_reader(&bytes[..]).deserialize() {
        let line = way.len() as u64 + 2;
        way.push(waypoint.map_err(|e: csv::Error| Error::data_at(path, line, e.to_string()))?);
    }
    Ok(way)
}

/// Writes the runs as `free_SEED.csv` and `assisted_SEED.csv`, and their summary as `summary.json`, into `folder`, and
/// gives it its name.
///
/// # Errors
/// If it cannot be written.
pub fn write_trajectories(result: &DriveResult, folder: NewFolder) -> Result<()> {
    for pair in &result.trials {
        for (kind, run) in [("free", &pair.free), ("assisted", &pair.assisted)] {
            let path = folder.unfinished().join(format!("{kind}_{}.csv", pair.seed));
            let written = std::fs::write(&path, trajectory_csv(run));
            written.map_err(|source| folder.explain(Error::Io { path, source }))?;
        }
    }
    let path = folder.unfinished().join(SUMMARY);
    let text = serde_json::to_string_pretty(&result.summary).map_err(|e| Error::data(&path, e.to_string()))?;
    std::fs::write(&path, text + "\n").map_err(|source| folder.explain(Error::Io { path, source }))?;
    folder.finish()
}
