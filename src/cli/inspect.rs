//! `steersman inspect`: what is in a recording.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;

use super::fit_camera;
use super::recording_args::RecordingArgs;
use super::share_bar::ShareBar;
use super::{RecipeArgs, end_with, new_folder, pool, print, print_json, refuse_existing, stop_on_ctrl_c};
use crate::dataset::inspect::{Report, Treatment, inspect};
use crate::error::{Error, Result};
use crate::files::atomic_file;
use crate::report::pages::inspection;

/// Say what is in a recording: rows, sessions, labels, pictures, what cannot be used, and what to do about it
#[derive(Debug, Args)]
pub struct InspectArgs {
    /// Recordings: folders, logs, or .zip and .tar.gz archives of them
    #[arg(required = true, value_name = "RECORDING")]
    recordings: Vec<PathBuf>,
    /// Write a page with pictures, report.html, into this folder, which must not exist
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    reading: RecordingArgs,
    #[command(flatten)]
    recipe: RecipeArgs,
    /// Print a [camera] table for steersman.toml instead: the mount that predicts the side cameras' pictures best
    #[arg(long, conflicts_with_all = ["out", "json"])]
    fit_camera: bool,
    /// Seed of the split that the page shows
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Threads; 0 is one for each core
    #[arg(long, default_value_t = 0)]
    threads: usize,
    /// Print one JSON array as the last line, one object a recording
    #[arg(long)]
    json: bool,
}

/// What `--json` prints for a recording.
#[derive(Serialize)]
#[serde(untagged)]
enum Answer {
    Report(Box<Report>),
    Failed { path: String, error: String },
}

pub fn run(args: InspectArgs) -> Result<()> {
    let recipe = args.recipe.find_or("recording")?;
    args.out.as_deref().map_or(Ok(()), refuse_existing)?;
    let (pool, stop) = (pool(args.threads)?, stop_on_ctrl_c()?);
    if args.fit_camera {
        return pool.install(|| fit_camera::run(&args.recordings, &args.reading));
    }
    let said = args.reading.said();
    let treatment =
        Treatment { samples: recipe.samples.clone(), balance: recipe.balance.clone(), labels: recipe.labels };
    let (mut inspections, mut reports, mut failed) = (Vec::new(), Vec::new(), Vec::new());
    for path in &args.reading.expand(args.recordings)? {
        let mut bar = ShareBar::new(format!("looking at {}", path.display()), &stop);
        let inspection = pool.install(|| inspect(path, &said, &treatment, &mut bar));
        drop(bar);
        let inspection = match inspection {
            Ok(inspection) => inspection,
            Err(Error::Interrupted) => return Err(Error::Interrupted),
            // The other recordings are looked at all the same.
            Err(error) => {
                reports.push(Answer::Failed { path: path.display().to_string(), error: error.to_string() });
                failed.push(error);
                continue;
            }
        };
        if !args.json {
            print(&format!("{}\n", inspection.report))?;
        }
        let report = &inspection.report;
        if report.usable == 0 {
            failed.push(Error::data(path, format!("none of {} rows can be used", report.rows)));
        } else if let Some(trouble) = inspection.recording.unit_trouble() {
            failed.push(Error::data(path, trouble));
        }
        reports.push(Answer::Report(Box::new(report.clone())));
        inspections.push(inspection);
    }
    if let Some(out) = &args.out {
        let page = inspection::page(inspections, &recipe, args.seed);
        new_folder(out)?;
        let path = out.join("report.html");
        atomic_file::write(&path, page.as_bytes())?;
        eprintln!("wrote {}", path.display());
    }
    if args.json {
        print_json(&reports)?;
    }
    end_with(failed)
}
