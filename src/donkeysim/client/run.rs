//! What is measured of one run, from the telemetry alone.

use super::telemetry::Telemetry;
use crate::simulator::car::dynamics::{MAX_STEER_DEG, MPS_PER_MPH};
use crate::simulator::trial::outcome::{Failure, Moment, Trial};

/// Longest time between two telemetries that counts as driven, s: after more, the simulator was paused.
const MAX_STEP_S: f64 = 1.0;
/// Shortest time between two crossings of the starting line; several parts of the car may each report one, s.
const MIN_LAP_S: f64 = 3.0;
/// Speed of a car that stands, m/s, and longest time that it may, s.
const STANDING_MPS: f64 = 0.1;
const STANDING_LIMIT_S: f64 = 10.0;
/// Most moments that are kept of a run: 14 hours at 20 a second.
const MAX_MOMENTS: usize = 1 << 20;

/// A run under way. A unit of the scene counts as a metre.
#[derive(Debug)]
pub(super) struct Run {
    trial: Trial,
    laps: Laps,
    /// Units of the scene in a unit of the telemetry's places and speeds.
    scale: f64,
    max_cte_m: f64,
    /// The simulator's time of the last telemetry, s.
    last_s: Option<f64>,
    standing_s: f64,
    /// The last answer: time, s, and steering.
    last_answer: Option<(f64, f64)>,
}

impl Run {
    /// A run that begins now.
    pub fn new(scale: f64, max_cte_m: f64) -> Run {
        Run {
            trial: Trial::default(),
            laps: Laps::default(),
            scale,
            max_cte_m,
            last_s: None,
            standing_s: 0.0,
            last_answer: None,
        }
    }

    /// Takes notice of a telemetry that arrived `arrived_s` after the drive began, by the clock of this machine.
    pub fn see(&mut self, telemetry: &Telemetry, arrived_s: f64) {
        let now_s = telemetry.time_s.unwrap_or(arrived_s);
        let step_s = self.last_s.map_or(0.0, |last_s| (now_s - last_s).clamp(0.0, MAX_STEP_S));
        self.last_s = Some(now_s);
        self.trial.time_s += step_s;
        if let Some(speed_mps) = self.speed_mps(telemetry) {
            self.trial.distance_m += speed_mps * step_s;
            self.standing_s = if speed_mps < STANDING_MPS { self.standing_s + step_s } else { 0.0 };
        }
        let cte_m = telemetry.cte.map_or(0.0, f64::abs);
        self.trial.worst_cte_m = self.trial.worst_cte_m.max(cte_m);
        self.laps.see_node(telemetry.node);
        self.trial.laps_completed = self.laps.completed();
        if telemetry.hit {
            self.fail(Failure::Crash);
        } else if cte_m > self.max_cte_m {
            self.fail(Failure::LeftRoad);
        } else if self.standing_s > STANDING_LIMIT_S {
            self.fail(Failure::StoodStill);
        }
    }

    /// The car crosses the starting line `index`.
    pub fn cross_line(&mut self, index: i64) {
        self.laps.cross_line(index, self.trial.time_s);
        self.trial.laps_completed = self.laps.completed();
    }

    /// The simulator has timed a lap.
    pub fn time_lap(&mut self, lap_time_s: f64) {
        self.laps.timed += usize::from(lap_time_s > 0.0);
        self.trial.laps_completed = self.laps.completed();
    }

    /// Ends the run early; the first reason counts.
    pub fn fail(&mut self, failure: Failure) {
        self.trial.failure.get_or_insert(failure);
    }

    /// Keeps what was answered to `telemetry`, [-1, 1] both.
    pub fn answer(&mut self, telemetry: &Telemetry, steering: f64, throttle: f64) {
        let time_s = self.trial.time_s;
        if let Some((last_s, last)) = self.last_answer.filter(|(last_s, _)| time_s > *last_s) {
            let change_deg = (steering - last) * MAX_STEER_DEG;
            self.trial.whiteness_sum += change_deg * change_deg / (time_s - last_s);
        }
        self.last_answer = Some((time_s, steering));
        let [x, y] = telemetry.place.unwrap_or([f64::NAN; 2]).map(|units| units * self.scale);
        self.trial.moments.push(Moment {
            time_s,
            x,
            y,
            // The simulator counts clockwise from ahead, which is north here.
            heading_deg: telemetry.yaw_deg.map_or(f64::NAN, |yaw_deg| {
                let turned = (90.0 - yaw_deg).rem_euclid(360.0);
                if turned > 180.0 { turned - 360.0 } else { turned }
            }),
            s_m: self.trial.distance_m,
            cte_m: telemetry.cte.unwrap_or(f64::NAN),
            steering,
            throttle,
            speed_mph: self.speed_mps(telemetry).unwrap_or(f64::NAN) / MPS_PER_MPH,
            intervention: false,
        });
    }

    /// Speed, m/s.
    pub fn speed_mps(&self, telemetry: &Telemetry) -> Option<f64> {
        telemetry.speed.map(|speed| speed.abs() * self.scale).filter(|mps| mps.is_finite())
    }

    /// Time of the run, s.
    pub fn time_s(&self) -> f64 {
        self.trial.time_s
    }

    /// Whole laps so far.
    pub fn laps_completed(&self) -> usize {
        self.trial.laps_completed
    }

    /// Laps so far with the part that the nodes tell of the present one.
    pub fn laps_driven(&self) -> f64 {
        let by_nodes = self.laps.node.map_or(0.0, |[_, total]| self.laps.passed as f64 / total as f64);
        by_nodes.max(self.trial.laps_completed as f64)
    }

    /// Whether the run has failed, or is too long to be kept.
    pub fn is_over(&self) -> bool {
        self.trial.failure.is_some() || self.trial.moments.len() >= MAX_MOMENTS
    }

    /// Why the run has failed.
    pub fn failure(&self) -> Option<Failure> {
        self.trial.failure
    }

    /// Whether the simulator has said anything from which laps can be counted.
    pub fn counts_laps(&self) -> bool {
        self.laps.line.is_some() || self.laps.timed > 0 || self.laps.node.is_some()
    }

    /// Ends the run, which was to have `laps` laps.
    pub fn finish(mut self, laps: usize) -> Trial {
        self.trial.laps_completed = self.trial.laps_completed.min(laps);
        self.trial
    }
}

/// Counts laps, by all that the simulator says: the starting line is crossed again, a lap is timed, or as many nodes of the line are
/// passed as there are.
#[derive(Debug, Default)]
struct Laps {
    /// The first line that was crossed, how often, and when last, s.
    line: Option<(i64, usize, f64)>,
    /// Laps that the simulator has timed.
    timed: usize,
    /// The last node and their number.
    node: Option<[u64; 2]>,
    /// Nodes passed, less where the car drives backwards.
    passed: i64,
}

impl Laps {
    fn cross_line(&mut self, index: i64, now_s: f64) {
        match &mut self.line {
            None => self.line = Some((index, 1, now_s)),
            Some((first, crossings, last_s)) if *first == index && now_s - *last_s >= MIN_LAP_S => {
                (*crossings, *last_s) = (*crossings + 1, now_s);
            }
            Some(_) => {}
        }
    }

    fn see_node(&mut self, node: Option<[u64; 2]>) {
        let Some([active, total]) = node else { return };
        if let Some([last, same]) = self.node
            && same == total
        {
            let ahead = (active as i64 - last as i64).rem_euclid(total as i64);
            self.passed += if ahead > total as i64 / 2 { ahead - total as i64 } else { ahead };
        }
        self.node = node;
    }

    fn completed(&self) -> usize {
        let by_line = self.line.map_or(0, |(_, crossings, _)| crossings - 1);
        let by_nodes = self.node.map_or(0, |[_, total]| (self.passed.max(0) as u64 / total) as usize);
        by_line.max(self.timed).max(by_nodes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(time_s: f64) -> Telemetry {
        Telemetry { time_s: Some(time_s), speed: Some(0.5), cte: Some(0.1), ..Telemetry::default() }
    }

    #[test]
    fn laps_are_counted_by_line_by_time_and_by_nodes() {
        let mut run = Run::new(8.0, 8.0);
        let mut now_s = 50.0;
        for (steps, laps) in [(1, 0), (5, 0), (5, 0), (20, 1), (20, 2)] {
            for _ in 0..steps {
                now_s += 0.2;
                run.see(&at(now_s), 0.0);
            }
            run.cross_line(0);
            run.cross_line(0);
            run.cross_line(1);
            assert_eq!(run.laps_completed(), laps, "{now_s}");
        }
        let mut timed = Run::new(8.0, 8.0);
        [0.0, 31.0, 30.0].into_iter().for_each(|s| timed.time_lap(s));
        assert_eq!(timed.laps_completed(), 2);
        let mut nodes = Run::new(8.0, 8.0);
        for (node, laps) in [(98, 0), (2, 0), (99, 0), (40, 0), (80, 0), (97, 0), (98, 1), (97, 0), (30, 1)] {
            nodes.see(&Telemetry { node: Some([node, 100]), ..at(0.0) }, 0.0);
            assert_eq!(nodes.laps_completed(), laps, "{node}");
        }
        assert!((nodes.laps_driven() - 1.32).abs() < 1e-9, "{}", nodes.laps_driven());
        assert!(nodes.counts_laps() && !Run::new(8.0, 8.0).counts_laps());
        assert_eq!(nodes.finish(1).laps_completed, 1);
    }

    #[test]
    fn distance_and_failures_are_measured_in_units_of_the_scene() {
        let mut run = Run::new(8.0, 4.0);
        for k in 0..=20 {
            run.see(&at(7.0 + f64::from(k) * 0.05), 0.0);
        }
        assert!((run.trial.distance_m - 4.0).abs() < 1e-9 && !run.is_over(), "{}", run.trial.distance_m);
        let placed = Telemetry { place: Some([1.0, 2.0]), yaw_deg: Some(120.0), ..at(8.0) };
        run.answer(&placed, 0.1, 0.2);
        run.see(&at(8.05), 0.0);
        run.answer(&at(8.05), 0.2, 0.2);
        let moments = &run.trial.moments;
        assert_eq!((moments[0].x, moments[0].y, moments[0].heading_deg), (8.0, 16.0, -30.0));
        assert!(moments[1].x.is_nan() && (moments[1].speed_mph * MPS_PER_MPH - 4.0).abs() < 1e-9);
        assert!((run.trial.whiteness_sum - 2.5 * 2.5 / 0.05).abs() < 1e-6);
        run.see(&Telemetry { cte: Some(-4.5), ..at(8.1) }, 0.0);
        run.see(&Telemetry { hit: true, ..at(8.15) }, 0.0);
        assert_eq!((run.failure(), run.trial.worst_cte_m), (Some(Failure::LeftRoad), 4.5), "the first reason counts");
        let mut standing = Run::new(8.0, 8.0);
        (0..120).for_each(|k| standing.see(&Telemetry { speed: Some(0.0), ..at(f64::from(k) * 0.1) }, 0.0));
        assert_eq!(standing.failure(), Some(Failure::StoodStill));
    }
}
