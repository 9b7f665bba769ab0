//! What a recording covers so far, and what it lacks.

use serde::Serialize;

use crate::dataset::inspect::advice::{FEW_ROWS, MANY_ZEROS, MUCH_FULL_LOCK, RARE_SIDE};
use crate::dataset::inspect::{FULL_LOCK, STRAIGHT};

/// Smallest distance from the line at which driving back to it counts as a recovery, m. The recoveries of the expert begin
/// there.
const RECOVERY_M: f64 = 0.7;
/// Smallest share of rows that should show a recovery.
const MIN_RECOVERY: f64 = 0.05;
/// Laps after which there should be recoveries.
const SETTLED_LAPS: f64 = 1.0;
/// Smallest share of the distance that should be driven in each direction.
const MIN_REVERSE: f64 = 0.2;

/// What counts of a row.
#[derive(Clone, Copy, Debug, Default)]
pub struct Row {
    /// Label, [-1, 1], + = right.
    pub steering: f64,
    /// Cross-track error, m, + = right as driven.
    pub cte_m: f64,
    /// Sine of the angle between car and line, + = the car points to the right of it.
    pub heading_error: f64,
    /// Whether the car drives against the direction of the track's points.
    pub reverse: bool,
    /// Distance along the line since the row before, m.
    pub way_m: f64,
}

/// Counts over the rows so far.
#[derive(Clone, Debug, Default)]
pub struct Coverage {
    rows: usize,
    left: usize,
    right: usize,
    zero: usize,
    full_lock: usize,
    recovery: usize,
    way_m: f64,
    reverse_m: f64,
}

/// What the page shows of the counts.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Shares {
    /// Rows recorded.
    pub rows: usize,
    /// Duration of the rows, minutes.
    pub minutes: f64,
    /// Distance of the rows, laps.
    pub laps: f64,
    /// Share of rows that steer left by more than a degree, 0 to 1.
    pub left: f64,
    /// Share of rows that steer right by more than a degree.
    pub right: f64,
    /// Share of rows that drive back to the line from beside it.
    pub recovery: f64,
    /// Share of the distance driven against the direction of the track's points.
    pub reverse: f64,
}

impl Coverage {
    /// Counts a row.
    pub fn add(&mut self, row: &Row) {
        // The precision of the log, so that the counts are those of `inspect`.
        let steering = row.steering as f32;
        self.rows += 1;
        self.left += usize::from(steering < -STRAIGHT);
        self.right += usize::from(steering > STRAIGHT);
        self.zero += usize::from(steering == 0.0);
        self.full_lock += usize::from(steering.abs() >= FULL_LOCK);
        // Positive errors are to the right, and so are positive angles: opposite signs lead back.
        self.recovery += usize::from(row.cte_m.abs() >= RECOVERY_M && row.cte_m * row.heading_error < 0.0);
        let way_m = row.way_m.max(0.0);
        self.way_m += way_m;
        self.reverse_m += if row.reverse { way_m } else { 0.0 };
    }

    fn share(&self, of: usize) -> f64 {
        of as f64 / self.rows.max(1) as f64
    }

    /// The shares at `hz` rows per second and a lap of `lap_m` metres.
    pub fn shares(&self, hz: u64, lap_m: f64) -> Shares {
        Shares {
            rows: self.rows,
            minutes: self.rows as f64 / hz as f64 / 60.0,
            laps: self.way_m / lap_m,
            left: self.share(self.left),
            right: self.share(self.right),
            recovery: self.share(self.recovery),
            reverse: self.reverse_m / self.way_m.max(1e-9),
        }
    }

    /// What to do next, the most important first.
    pub fn advice(&self, lap_m: f64) -> Vec<String> {
        if self.rows == 0 {
            return vec!["Press R to record: nothing is recorded yet.".into()];
        }
        let mut advice = Vec::new();
        let percent = |share: f64| format!("{:.0} %", 100.0 * share);
        let laps = self.way_m / lap_m;
        let full_lock = self.share(self.full_lock);
        if full_lock > MUCH_FULL_LOCK {
            advice
                .push(format!("{} of the labels are at full lock: drive slower, or with a mouse.", percent(full_lock)));
        }
        let zeros = self.share(self.zero);
        if zeros > MANY_ZEROS {
            let zeros = percent(zeros);
            advice
                .push(format!("{zeros} of the labels are exactly zero: a mouse or gamepad tells finer how to steer."));
        }
        let (turns, rarer) = (self.left + self.right, self.left.min(self.right));
        if laps >= 0.5 && (rarer as f64) < RARE_SIDE * turns as f64 {
            let side = if self.left > self.right { "left" } else { "right" };
            let share = percent(self.left.max(self.right) as f64 / turns as f64);
            advice.push(format!("{share} of the turns are to the {side}: press U and drive the other way round."));
        } else if laps >= 2.0 * SETTLED_LAPS {
            let reverse = self.reverse_m / self.way_m.max(1e-9);
            if reverse.min(1.0 - reverse) < MIN_REVERSE {
                advice.push("Press U and drive the other way round, too: it is a new road to the network.".into());
            }
        }
        if laps >= SETTLED_LAPS && self.share(self.recovery) < MIN_RECOVERY {
            advice.push(
                "Few ways back to the middle: pause with R, drive to the edge, press R again, and steer back.".into(),
            );
        }
        if self.rows < FEW_ROWS {
            advice.push(format!("{} rows are few: a network needs {FEW_ROWS} and more.", self.rows));
        }
        if advice.is_empty() {
            advice.push("Enough of everything to train with.".into());
        }
        advice
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn driven(rows: usize, row: impl Fn(usize) -> Row) -> Coverage {
        let mut coverage = Coverage::default();
        (0..rows).for_each(|k| coverage.add(&row(k)));
        coverage
    }

    #[test]
    fn shares_are_those_of_the_rows() {
        let steering = [-0.3, -0.05, 0.0, 0.04, 1.0];
        let coverage = driven(500, |k| Row {
            steering: steering[k % 5],
            cte_m: if k.is_multiple_of(10) { 1.0 } else { 0.2 },
            heading_error: if k.is_multiple_of(20) { -0.1 } else { 0.1 },
            reverse: k < 100,
            way_m: 2.0,
        });
        let shares = coverage.shares(10, 500.0);
        assert_eq!((shares.rows, shares.left, shares.right, shares.laps), (500, 0.4, 0.2, 2.0));
        assert_eq!((shares.recovery, shares.reverse), (0.05, 0.2));
        assert!((shares.minutes - 50.0 / 60.0).abs() < 1e-9);
        let advice = coverage.advice(500.0);
        assert!(advice[0].contains("20 % of the labels are at full lock"), "{advice:?}");
    }

    #[test]
    fn advice_names_what_is_missing_and_is_content_in_the_end() {
        assert!(Coverage::default().advice(500.0)[0].contains("Press R"));
        let left = |reverse| {
            move |k: usize| Row {
                steering: if k.is_multiple_of(3) { 0.01 } else { -0.2 },
                reverse,
                way_m: 0.9,
                ..Row::default()
            }
        };
        let advice = driven(1000, left(false)).advice(800.0);
        assert!(advice[0].contains("100 % of the turns are to the left: press U"), "{advice:?}");
        assert!(advice[1].contains("pause with R") && advice[2].contains("1000 rows are few"), "{advice:?}");
        let all = driven(6000, |k| Row {
            steering: [-0.2, 0.01, 0.2][k % 3],
            cte_m: 0.8,
            heading_error: if k.is_multiple_of(9) { -0.1 } else { 0.1 },
            reverse: k.is_multiple_of(2),
            way_m: 0.9,
        });
        assert!(all.advice(800.0)[0].starts_with("Enough of everything"), "{:?}", all.advice(800.0));
    }
}
