//! `steersman inspect`: what is in a recording.

mod fit_camera;

use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::Args;
use serde::Serialize;

use super::arguments::{RecipeArgs, RecordingArgs, model_file, new_folder, refuse_existing};
use super::process::{end_with, pool, stop_on_ctrl_c};
use super::terminal::{ShareBar, print, print_json};
use crate::coach::{self, Coach};
use crate::dataset::inspect::{Report, Treatment, inspect};
use crate::error::{Error, Result};
use crate::files::atomic_file;
use crate::observer::StopSignal;
use crate::pilot::Pilot;
use crate::report::pages::inspection;

/// Models that the page shows at a time.
const MAX_MODELS: usize = 2;

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
    /// Open a page in the browser to look through one recording and leave rows out; no picture and no row is changed
    #[arg(long, conflicts_with_all = ["out", "fit_camera"])]
    edit: bool,
    /// With --edit: show what this model answers beside the labels, and where it differs most; may be given twice
    #[arg(long, value_name = "MODEL", requires = "edit")]
    model: Vec<PathBuf>,
    /// With --edit: port of the page; 0 takes any free one
    #[arg(long, default_value_t = coach::DEFAULT_PORT, requires = "edit")]
    port: u16,
    /// Seed of the split that the page shows
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Threads; 0 is one for each core
    #[arg(long, default_value_t = 0)]
    threads: usize,
    /// Print one JSON array as the last line, one object a recording; with --edit one object, at the end
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

/// What `--edit --json` prints.
#[derive(Serialize)]
struct Edited {
    /// Rows that are left out at the end.
    left_out: usize,
    saved_to: String,
}

pub fn run(args: InspectArgs) -> Result<()> {
    let recipe = args.recipe.find_or("recording")?;
    args.out.as_deref().map_or(Ok(()), refuse_existing)?;
    let (pool, stop) = (pool(args.threads)?, stop_on_ctrl_c()?);
    if args.fit_camera {
        return pool.install(|| fit_camera::run(&args.recordings, &args.reading));
    }
    if args.edit {
        return edit(&args, pool, &stop);
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

/// Serves the coach until Ctrl-C.
fn edit(args: &InspectArgs, pool: rayon::ThreadPool, stop: &StopSignal) -> Result<()> {
    let recordings = args.reading.expand(args.recordings.clone())?;
    let [recording] = &recordings[..] else {
        return Err(Error::Usage(format!("--edit opens one recording, and {} are named", recordings.len())));
    };
    if args.model.len() > MAX_MODELS {
        return Err(Error::Usage(format!(
            "--edit shows at most {MAX_MODELS} models, and {} are named",
            args.model.len()
        )));
    }
    let pilot = |path: &PathBuf| Ok((name_of(path), Pilot::load(&model_file(path)?)?));
    let models = args.model.iter().map(pilot).collect::<Result<_>>()?;
    let coach = Coach::start(recording, &args.reading.said(), models, args.port, pool)?;
    eprintln!("open {} to look through the recording; Ctrl-C ends", coach.url());
    while !stop.requested() {
        std::thread::sleep(Duration::from_millis(50));
    }
    let (count, place) = (coach.left_out(), coach.saves_to().display().to_string());
    drop(coach);
    let rows = if count == 1 { "1 row is".into() } else { format!("{count} rows are") };
    eprintln!("{rows} left out in {place}; next: steersman train {}", recording.display());
    if args.json { print_json(&Edited { left_out: count, saved_to: place }) } else { Ok(()) }
}

/// What a model is called on the page: the folder of its run, or its file.
fn name_of(model: &Path) -> String {
    let is_usual = model.file_name().is_some_and(|name| name == "model.safetensors");
    let named = if is_usual { model.parent().filter(|run| run.file_name().is_some()) } else { None }.unwrap_or(model);
    named.file_name().unwrap_or(named.as_os_str()).to_string_lossy().into_owned()
}
