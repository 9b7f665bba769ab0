//! A sweep: one driver on one track under growing latency or noise, and where it breaks. Its page and its CSV.

use std::path::Path;

use serde::Serialize;

use super::html::Page;
use crate::error::{Error, Result};
use crate::report::charts::chart::{Axis, Chart, Mark};
use crate::report::charts::palette;
use crate::report::tone::Tone;
use crate::simulator::DriveSummary;

/// Two charts side by side.
const HALF: [f64; 2] = [552.0, 360.0];

/// What grows in a sweep.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Swept {
    /// Time from a picture to the wheels, ms.
    LatencyMs,
    /// Standard deviation of a disturbance of the steering.
    Noise,
}

impl Swept {
    /// `150 ms`, `noise 0.1`.
    pub fn value(self, value: f64) -> String {
        match self {
            Swept::LatencyMs => format!("{value} ms"),
            Swept::Noise => format!("noise {value}"),
        }
    }

    fn axis(self) -> Axis {
        Axis::new(match self {
            Swept::LatencyMs => "time from a picture to the wheels, ms",
            Swept::Noise => "noise of the steering, standard deviation",
        })
    }
}

/// The drives of one driver, from the smallest value to the largest.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Sweep {
    /// Model, or `expert`.
    pub driver: String,
    /// What grows.
    pub swept: Swept,
    /// Its values with what they led to.
    pub points: Vec<SweepPoint>,
}

/// One value of a sweep.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SweepPoint {
    /// Latency in ms, or noise.
    pub value: f64,
    /// The drive.
    #[serde(flatten)]
    pub drive: DriveSummary,
}

impl Sweep {
    /// The smallest value at which a lap was not completed without help; `None` if the driver holds throughout.
    pub fn breaks_at(&self) -> Option<f64> {
        let broken = self.points.iter().filter(|point| point.drive.laps_completed < point.drive.laps_total);
        broken.map(|point| point.value).min_by(f64::total_cmp)
    }

    /// Says where the driver breaks.
    pub fn verdict(&self) -> String {
        let last = self.points.iter().map(|point| point.value).max_by(f64::total_cmp).unwrap_or_default();
        match self.breaks_at() {
            Some(value) => format!("{} breaks at {}", self.driver, self.swept.value(value)),
            None => format!("{} completes every lap up to {}", self.driver, self.swept.value(last)),
        }
    }
}

/// The page of sweeps of the same values on one track.
pub fn page(track: &str, sweeps: &[Sweep]) -> String {
    let drivers: Vec<&str> = sweeps.iter().map(|sweep| sweep.driver.as_str()).collect();
    let mut page = Page::new(&format!("Where it breaks: {track}"), &drivers.join(", "));
    for sweep in sweeps {
        page.advice(&sweep.verdict(), if sweep.breaks_at().is_some() { Tone::Neutral } else { Tone::Good });
    }
    let chart = |title: &str, axis: Axis, value: fn(&DriveSummary) -> f64| {
        let Some(first) = sweeps.first() else { return String::new() };
        let chart = Chart::new(title, HALF, first.swept.axis(), axis);
        let with = |chart: Chart, (i, sweep): (usize, &Sweep)| {
            let points: Vec<[f64; 2]> = sweep.points.iter().map(|point| [point.value, value(&point.drive)]).collect();
            let chart = chart.add(&sweep.driver, palette::series(i), Mark::Line(2.0), points.clone());
            chart.add("", palette::series(i), Mark::Dots(6.0), points)
        };
        sweeps.iter().enumerate().fold(chart, with).draw()
    };
    let percent = || Axis::new("%").range(0.0, 100.0);
    page.drawings(&[
        chart("Laps completed without help", percent(), |s| {
            100.0 * s.laps_completed as f64 / s.laps_total.max(1) as f64
        }),
        chart("Autonomy", percent(), |s| s.autonomy_percent),
        chart("Distance from the line, 95 % below", Axis::new("m"), |s| s.cte_p95_m),
        chart("Whiteness: how much the wheel trembles", Axis::new("deg/s"), |s| s.whiteness_deg_s),
        chart("Wheel reversals", Axis::new("a minute"), |s| s.calm.unwrap_or_default().reversals_per_min),
        chart("Lateral jerk", Axis::new("m/s³"), |s| s.calm.unwrap_or_default().lateral_jerk_rms_mps3),
    ]);
    for sweep in sweeps {
        page.subsection(&sweep.driver);
        let headers: Vec<&str> = COLUMNS.iter().map(|(name, _)| *name).collect();
        let row = |point: &SweepPoint| COLUMNS.iter().map(|(_, cell)| cell(sweep.swept, point)).collect();
        page.table(&headers, &sweep.points.iter().map(row).collect::<Vec<Vec<String>>>());
    }
    page.finish()
}

/// How a column of the table writes a point.
type Cell = fn(Swept, &SweepPoint) -> String;

/// The columns of the table: header and cell.
pub const COLUMNS: [(&str, Cell); 9] = [
    ("at", |swept, p| swept.value(p.value)),
    ("laps", |_, p| format!("{}/{}", p.drive.laps_completed, p.drive.laps_total)),
    ("autonomy", |_, p| format!("{:.1} %", p.drive.autonomy_percent)),
    ("put back", |_, p| p.drive.interventions.to_string()),
    ("off the line", |_, p| format!("{:.2} m", p.drive.cte_mean_m)),
    ("95 % below", |_, p| format!("{:.2} m", p.drive.cte_p95_m)),
    ("whiteness", |_, p| format!("{:.1} deg/s", p.drive.whiteness_deg_s)),
    ("reversals", |_, p| format!("{:.1}/min", p.drive.calm.unwrap_or_default().reversals_per_min)),
    ("jerk", |_, p| format!("{:.1} m/s³", p.drive.calm.unwrap_or_default().lateral_jerk_rms_mps3)),
];

/// `sweeps` as the CSV of the file `path`, a line for each point.
///
/// # Errors
///
/// [`Error::Data`] for values that CSV cannot hold.
pub fn csv(path: &Path, sweeps: &[Sweep]) -> Result<Vec<u8>> {
    #[derive(Serialize)]
    struct Line<'a> {
        driver: &'a str,
        swept: Swept,
        value: f64,
        laps_completed: usize,
        laps_total: usize,
        autonomy_percent: f64,
        interventions: usize,
        cte_mean_m: f64,
        cte_p95_m: f64,
        whiteness_deg_s: f64,
        expert_whiteness_deg_s: f64,
        reversals_per_min: Option<f64>,
        angle_change_p95_deg: Option<f64>,
        lateral_jerk_rms_mps3: Option<f64>,
    }
    let mut writer = csv::Writer::from_writer(Vec::new());
    for sweep in sweeps {
        for SweepPoint { value, drive } in &sweep.points {
            let line = Line {
                driver: &sweep.driver,
                swept: sweep.swept,
                value: *value,
                laps_completed: drive.laps_completed,
                laps_total: drive.laps_total,
                autonomy_percent: drive.autonomy_percent,
                interventions: drive.interventions,
                cte_mean_m: drive.cte_mean_m,
                cte_p95_m: drive.cte_p95_m,
                whiteness_deg_s: drive.whiteness_deg_s,
                expert_whiteness_deg_s: drive.expert_whiteness_deg_s,
                reversals_per_min: drive.calm.map(|calm| calm.reversals_per_min),
                angle_change_p95_deg: drive.calm.map(|calm| calm.angle_change_p95_deg),
                lateral_jerk_rms_mps3: drive.calm.map(|calm| calm.lateral_jerk_rms_mps3),
            };
            writer.serialize(line).map_err(|e| Error::data(path, e.to_string()))?;
        }
    }
    writer.into_inner().map_err(|e| Error::data(path, e.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::observer::Unobserved;
    use crate::simulator::{DriveOptions, Driver, Expert, Track, drive};

    /// The expert on `lake` at these latencies, one run each.
    fn expert(latencies_ms: &[f64]) -> Sweep {
        let track = Track::load("lake").unwrap();
        let point = |&value: &f64| {
            let options = DriveOptions { runs: 1, latency_ms: value, ..Default::default() };
            let new_driver = || -> Result<Box<dyn Driver>> { Ok(Box::new(Expert)) };
            SweepPoint { value, drive: drive(&track, new_driver, &options, &mut Unobserved).unwrap().summary }
        };
        Sweep { driver: "expert".into(), swept: Swept::LatencyMs, points: latencies_ms.iter().map(point).collect() }
    }

    #[test]
    fn a_driver_breaks_at_the_smallest_value_that_costs_a_lap() {
        let sweep = expert(&[2000.0, 0.0, 1500.0]);
        let laps: Vec<usize> = sweep.points.iter().map(|point| point.drive.laps_completed).collect();
        assert_eq!(laps, [0, 1, 0]);
        assert_eq!((sweep.breaks_at(), sweep.verdict().as_str()), (Some(1500.0), "expert breaks at 1500 ms"));
        let calm = Sweep { points: sweep.points[1..2].to_vec(), ..sweep.clone() };
        assert_eq!((calm.breaks_at(), calm.verdict().as_str()), (None, "expert completes every lap up to 0 ms"));

        let text = page("lake", &[sweep.clone(), calm]);
        crate::report::pages::html::assert_stands_alone(&text);
        assert!(text.contains("expert breaks at 1500 ms") && text.contains("Laps completed without help"));
        let csv = String::from_utf8(csv(Path::new("sweep.csv"), &[sweep]).unwrap()).unwrap();
        let lines: Vec<&str> = csv.lines().collect();
        assert!(lines[0].starts_with("driver,swept,value,laps_completed,laps_total,autonomy_percent"), "{csv}");
        assert!(lines.len() == 4 && lines[2].starts_with("expert,latency_ms,0.0,1,1,100.0,0,"), "{csv}");
    }
}
