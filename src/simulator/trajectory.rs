//! The way of a run as a file, and read again.

use std::fmt::Write as _;
use std::path::Path;

use serde::Deserialize;

use super::run::Run;
use crate::{Error, Result};

/// A run as CSV text, one line for each frame.
pub fn trajectory_csv(run: &Run) -> String {
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
