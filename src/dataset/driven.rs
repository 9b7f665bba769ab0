//! The paths that the sessions of a recording were driven along.

use std::ops::Range;

use super::recording::Recording;
use crate::geometry::{CarGeometry, DrivenPath, LookAhead, MPS_PER_MPH};

/// A car that makes less way stands, in wheelbases a second.
const STANDING_WHEELBASES_PER_S: f64 = 0.1;
/// Speed of a recording that says none, in wheelbases a second: 1.3 m/s for a small car, and no more than a guess.
const ASSUMED_WHEELBASES_PER_S: f64 = 5.0;

/// A session and the path that was driven in it.
#[derive(Clone, Debug)]
pub struct DrivenSession {
    /// Rows of the recording.
    pub rows: Range<usize>,
    /// Where the car was at each of them.
    pub path: DrivenPath,
    /// Speed at each of them, m/s.
    pub speed_mps: Vec<f64>,
}

/// The sessions of a recording with their paths.
#[derive(Clone, Debug)]
pub struct DrivenSessions {
    /// Camera and car.
    pub geometry: CarGeometry,
    /// All sessions, in the order of the log.
    pub sessions: Vec<DrivenSession>,
    /// Speed that was assumed because the recording says none, m/s.
    pub assumed_speed_mps: Option<f64>,
}

/// Speed at each row of `recording`, m/s: a row without one keeps the last one of its session, the first rows of a session take its
/// first one; NaN where a session has none. `None` if no row says a speed other than 0.
pub(super) fn recorded_speeds_mps(recording: &Recording) -> Option<Vec<f64>> {
    let driven = DrivenSessions::of(recording, recording.geometry.clone());
    let says_none =
        |session: &DrivenSession| recording.rows[session.rows.clone()].iter().all(|row| !row.speed_mph.is_finite());
    let speeds = driven.sessions.into_iter().flat_map(|session| match says_none(&session) {
        true => vec![f64::NAN; session.rows.len()],
        false => session.speed_mps,
    });
    driven.assumed_speed_mps.is_none().then(|| speeds.collect())
}

impl DrivenSessions {
    /// Dead reckoning from the steering, speed and time of the rows of `recording`.
    pub fn of(recording: &Recording, geometry: CarGeometry) -> DrivenSessions {
        DrivenSessions::of_stretches(recording, geometry, &recording.sessions)
    }

    /// The same for `stretches` of its rows, each within a session, as if they were sessions of their own.
    pub fn of_stretches(recording: &Recording, geometry: CarGeometry, stretches: &[Range<usize>]) -> DrivenSessions {
        // A column of zeros beside a moving wheel says no speed either.
        let known = recording.rows.iter().any(|row| row.speed_mph.is_finite() && row.speed_mph != 0.0);
        let assumed_mps = ASSUMED_WHEELBASES_PER_S * geometry.wheelbase_m;
        let sessions = (stretches.iter())
            .map(|rows| {
                let of_session = &recording.rows[rows.clone()];
                // A row without a speed keeps the last one, the first rows of a session take the first one.
                let first_mph = of_session.iter().map(|row| row.speed_mph).find(|mph| mph.is_finite() && known);
                let mut last_mps = first_mph.map_or(assumed_mps, |mph| f64::from(mph).abs() * MPS_PER_MPH);
                let speed_mps: Vec<f64> = (of_session.iter())
                    .map(|row| {
                        if known && row.speed_mph.is_finite() {
                            last_mps = f64::from(row.speed_mph).abs() * MPS_PER_MPH;
                        }
                        last_mps
                    })
                    .collect();
                let time_s: Vec<f64> = of_session.iter().map(|row| row.time_ms as f64 / 1000.0).collect();
                let steering: Vec<f64> = of_session.iter().map(|row| f64::from(row.steering)).collect();
                let path = DrivenPath::dead_reckon(&geometry, &time_s, &speed_mps, &steering);
                DrivenSession { rows: rows.clone(), path, speed_mps }
            })
            .collect();
        DrivenSessions { geometry, sessions, assumed_speed_mps: (!known).then_some(assumed_mps) }
    }

    /// The path label of each row of the recording: pursuit of the driven path, `look_ahead` ahead. `None` for rows near the end of
    /// their session, where there is no path ahead, and for rows where the car stands.
    pub fn path_labels(&self, look_ahead: LookAhead) -> Vec<Option<f32>> {
        let rows = self.sessions.last().map_or(0, |session| session.rows.end);
        let mut labels = vec![None; rows];
        for session in &self.sessions {
            for row in 0..session.path.len() {
                labels[session.rows.start + row] = self.path_label(session, row, look_ahead);
            }
        }
        labels
    }

    /// The path label of row `row` of `session`; see [`path_labels`](Self::path_labels).
    pub fn path_label(&self, session: &DrivenSession, row: usize, look_ahead: LookAhead) -> Option<f32> {
        let speed_mps = session.speed_mps[row];
        let moves = speed_mps > STANDING_WHEELBASES_PER_S * self.geometry.wheelbase_m;
        let label = session.path.label(&self.geometry, row, look_ahead.distance_m(speed_mps));
        label.filter(|_| moves).map(|label| label as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::testing::recording_of;

    #[test]
    fn rows_without_a_path_ahead_have_no_label() {
        // 20 mph are 8.9408 m/s, so 0.7 s are 6.26 m and 10 rows a second are 0.894 m apart: the last 7 rows lack a path.
        let mut recording = recording_of(&[0.2; 40], 100);
        let car = CarGeometry::preset("udacity").unwrap();
        recording.rows[3].speed_mph = 0.0;
        let driven = DrivenSessions::of(&recording, car.clone());
        assert_eq!(driven.assumed_speed_mps, None);
        let labels = driven.path_labels(LookAhead::usual(&car));
        let missing: Vec<usize> = (0..40).filter(|&row| labels[row].is_none()).collect();
        assert_eq!(missing, [3, 33, 34, 35, 36, 37, 38, 39]);
        assert!(labels.iter().flatten().all(|label| (label - 0.2).abs() < 0.02), "{labels:?}");
    }

    #[test]
    fn where_nothing_is_said_of_the_speed_one_is_assumed() {
        let mut recording = recording_of(&[0.0; 40], 100);
        recording.rows.iter_mut().for_each(|row| row.speed_mph = f32::NAN);
        let driven = DrivenSessions::of(&recording, CarGeometry::preset("donkeycar").unwrap());
        assert_eq!(driven.assumed_speed_mps, Some(5.0 * 0.26));
        assert!((driven.sessions[0].path.length_m() - 3.9 * 1.3).abs() < 1e-9);
    }
}
