//! `steersman drive --latency-ms 0,50,100`: the same drive under growing latency or noise.

use std::path::Path;
use std::sync::Arc;

use serde::Serialize;

use super::DriveArgs;
use crate::cli::process::{pool, stop_on_ctrl_c, stop_or_ok};
use crate::cli::terminal::{ShareBar, counted, print, print_json, right_aligned};
use crate::error::{Error, Result};
use crate::files::new_folder::NewFolder;
use crate::report::charts::map;
use crate::report::pages::sweep::{self, COLUMNS, Sweep, SweepPoint, Swept};
use crate::simulator::trial::trajectory::write_trajectories;
use crate::simulator::{DriveOptions, Leg, Track, Wheel, drive_legs};

/// What a sweep prints with `--json`.
#[derive(Serialize)]
struct Report<'a> {
    track: &'a str,
    #[serde(flatten)]
    sweep: &'a Sweep,
    /// The smallest value that costs a lap.
    breaks_at: Option<f64>,
    /// The second driver.
    #[serde(skip_serializing_if = "Option::is_none")]
    against: Option<Box<Report<'a>>>,
}

impl<'a> Report<'a> {
    fn of(track: &'a str, sweep: &'a Sweep, against: Option<&'a Sweep>) -> Report<'a> {
        let against = against.map(|other| Box::new(Report::of(track, other, None)));
        Report { track, sweep, breaks_at: sweep.breaks_at(), against }
    }
}

/// Drives at each of the `values` of what is swept; `options` say the rest.
pub fn run(args: &DriveArgs, track: &Arc<Track>, options: &DriveOptions, swept: Swept, values: &[f64]) -> Result<()> {
    let drives = drives(options, swept, values)?;
    let drivers: Vec<&str> = std::iter::once(args.model.as_str()).chain(args.against.as_deref()).collect();
    let wheels = drivers.iter().map(|name| args.wheel(name)).collect::<Result<Vec<Wheel>>>()?;
    // What cannot be created is told before minutes are spent.
    let folder = args.out.as_deref().map(NewFolder::create).transpose()?;
    let stop = stop_on_ctrl_c()?;
    let pool = pool(args.threads)?;
    let (mut sweeps, mut ended) = (Vec::new(), false);
    for (number, (wheel, driver)) in wheels.iter().zip(&drivers).enumerate() {
        let legs = drives.iter().map(|(_, options)| Leg { track: track.clone(), options: options.clone() }).collect();
        let mut bar = ShareBar::new(format!("{driver} on {}", track.name()), &stop);
        let results = match pool.install(|| drive_legs(wheel, legs, false, &mut bar)) {
            Ok((results, stopped)) => {
                ended = stopped;
                results
            }
            Err(Error::Interrupted) => {
                ended = true;
                break;
            }
            Err(error) => return Err(error),
        };
        drop(bar);
        let mut points = Vec::new();
        // What is whole is kept.
        let whole = results.into_iter().take_while(|result| result.complete).filter_map(|result| result.drive);
        for (result, (value, _)) in whole.zip(&drives) {
            if let Some(folder) = &folder {
                let name = format!("{}{}", if number == 0 { "" } else { "against-" }, swept.value(*value));
                let of_value = NewFolder::create(&folder.unfinished().join(name.replace(' ', "-")))?;
                map::write(track, &result, &of_value)?;
                write_trajectories(&result, of_value)?;
            }
            points.push(SweepPoint { value: *value, drive: result.summary });
        }
        if !points.is_empty() {
            sweeps.push(Sweep { driver: driver.to_string(), swept, points });
        }
        if ended {
            break;
        }
    }
    if sweeps.is_empty() {
        return stop_or_ok(ended);
    }
    if ended {
        let driven: usize = sweeps.iter().map(|sweep| sweep.points.len()).sum();
        eprintln!("stopped after {driven} of {}", counted(drives.len() * wheels.len(), "value"));
    }
    let saved = folder.map_or(Ok(()), |folder| save(track, &sweeps, folder));
    if args.json {
        print_json(&Report::of(track.name(), &sweeps[0], sweeps.get(1)))?;
    } else {
        print(&sweeps.iter().map(|sweep| table(track, options.runs, sweep)).collect::<Vec<_>>().join("\n"))?;
    }
    saved.and(stop_or_ok(ended))
}

/// The drives of a sweep, each with its value, from the smallest value to the largest.
///
/// # Errors
/// [`Error::Usage`] for a value that cannot be driven, and for one that is named twice.
fn drives(options: &DriveOptions, swept: Swept, values: &[f64]) -> Result<Vec<(f64, DriveOptions)>> {
    let of_value = |&value: &f64| {
        let options = match swept {
            Swept::LatencyMs => DriveOptions { latency_ms: value, ..options.clone() },
            Swept::Noise => DriveOptions { noise: value, ..options.clone() },
        };
        options.check().map(|()| (value, options))
    };
    ascending(swept, values)?.iter().map(of_value).collect()
}

/// `values` from the smallest to the largest.
///
/// # Errors
/// [`Error::Usage`] for one that is named twice.
pub(super) fn ascending(swept: Swept, values: &[f64]) -> Result<Vec<f64>> {
    let mut values = values.to_vec();
    values.sort_by(f64::total_cmp);
    match values.windows(2).find(|pair| pair[0] == pair[1]) {
        Some(pair) => Err(Error::Usage(format!("{} is named twice: name each value once", swept.value(pair[0])))),
        None => Ok(values),
    }
}

/// Writes `sweep.csv` and `sweep.html`, and gives the folder its name.
fn save(track: &Track, sweeps: &[Sweep], folder: NewFolder) -> Result<()> {
    let write = |name: &str, bytes: &[u8]| {
        let path = folder.unfinished().join(name);
        std::fs::write(&path, bytes).map_err(|source| folder.explain(Error::Io { path, source }))
    };
    write("sweep.csv", &sweep::csv(Path::new("sweep.csv"), sweeps)?)?;
    write("sweep.html", sweep::page(track.name(), sweeps).as_bytes())?;
    folder.finish()
}

/// The table of a driver for the terminal, and where it breaks.
fn table(track: &Track, runs: usize, sweep: &Sweep) -> String {
    let mut rows: Vec<Vec<String>> = vec![COLUMNS.iter().map(|(header, _)| header.to_string()).collect()];
    rows.extend(sweep.points.iter().map(|point| COLUMNS.iter().map(|(_, cell)| cell(sweep.swept, point)).collect()));
    format!(
        "{} on {}, {} each\n{}{}\n",
        sweep.driver,
        track.name(),
        counted(runs, "run"),
        right_aligned(&rows),
        sweep.verdict()
    )
}
