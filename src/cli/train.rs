//! `steersman train`: the main job.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use clap::Args;

use super::progress::Progress;
use super::share_bar::ShareBar;
use super::{RecipeArgs, or_dash, pool, print_json, stop_on_ctrl_c};
use crate::error::{Error, Result};
use crate::main_job::held_out::trained_on_held_out;
use crate::main_job::{MainJobResult, TRACKS, TrackResult, held_out, test_on_track, training_set};
use crate::pilot::Pilot;
use crate::simulator::{DriveOptions, Track};
use crate::training::{self, RunFolder, TrainRequest, TrainResult, TransferRequest};

/// Train a network on recordings
#[derive(Debug, Args)]
pub struct TrainArgs {
    /// Udacity logs (a folder or its driving_log.csv) or donkeycar tubs. Without any, the whole job is done: the expert's
    /// drives in the simulator are recorded under data/recordings/, trained on, and the model drives
    #[arg(value_name = "RECORDING")]
    recordings: Vec<PathBuf>,
    #[command(flatten)]
    recipe: RecipeArgs,
    /// Run folder; a new one under runs/ by default
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Seed of all random choices: the same seed gives the same weights, bit for bit, for any number of threads
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Begin with the weights of a model where layers have the same name and shape; without --recipe, with its recipe
    #[arg(long, value_name = "MODEL", requires = "recordings", conflicts_with = "resume")]
    from: Option<PathBuf>,
    /// Layers that keep the weights they were given, as in conv1,bn1
    #[arg(long, value_name = "LAYER", requires = "from", value_delimiter = ',')]
    freeze: Vec<String>,
    /// Threads; 0 is one for each core
    #[arg(long, default_value_t = 0)]
    threads: usize,
    /// Memory for decoded images, in MiB; what does not fit goes to a temporary file
    #[arg(long, default_value_t = 1024, value_name = "MIB")]
    cache: usize,
    /// Go on with a run that was stopped, as if it had never stopped
    #[arg(long, value_name = "RUN", conflicts_with_all = ["recordings", "recipe", "overrides", "out", "seed", "cache"])]
    resume: Option<PathBuf>,
    /// Without a recording: runs of the finished model on each track, of one lap
    #[arg(long, default_value_t = 1, conflicts_with_all = ["recordings", "resume"])]
    runs: usize,
    /// Train on recordings of held-out tracks all the same
    #[arg(long)]
    force_held_out: bool,
    /// Print one JSON object as the last line
    #[arg(long)]
    json: bool,
}

/// Where the main job keeps what it records.
const RECORDINGS: &str = "data/recordings";

pub fn run(args: TrainArgs) -> Result<()> {
    let started = Instant::now();
    if args.runs == 0 {
        return Err(Error::Usage("--runs 0: at least 1 run is needed".into()));
    }
    let stop = stop_on_ctrl_c()?;
    let pool = pool(args.threads)?;
    let whole_job = args.resume.is_none() && args.recordings.is_empty();
    let (folder, result) = match args.resume {
        Some(folder) => {
            let mut progress = Progress::new();
            let result = pool.install(|| training::resume(&folder, &mut progress, &stop));
            (folder, result)
        }
        None => {
            let recipe = match &args.from {
                Some(from) => args.recipe.find_or_of(from)?,
                None => args.recipe.find()?,
            };
            let recordings = match whole_job {
                true => pool.install(|| training_set(&stop))?,
                false => args.recordings,
            };
            let held_out = held_out::check(&recordings, args.force_held_out)?;
            if !held_out.is_empty() {
                eprintln!("note: {}", trained_on_held_out(&held_out));
            }
            let out = args.out.unwrap_or_else(|| RunFolder::next_free(&recipe.name));
            let mut progress = Progress::new();
            let from = args.from.map(|model| TransferRequest { model, freeze: args.freeze });
            let (seed, cache_mib) = (args.seed, args.cache);
            let request = TrainRequest { recordings, recipe, out: out.clone(), seed, cache_mib, from };
            let result = pool.install(|| training::train(request, &mut progress, &stop));
            (out, result)
        }
    };
    match result {
        Ok(training) if whole_job => {
            let last = folder.join("last.safetensors");
            let drives = pool.install(|| drives(&last, args.runs, &stop))?;
            let result = MainJobResult { training, drives };
            if args.json {
                return print_json(&result);
            }
            print_training(&result.training);
            print_drives(&result.drives);
            println!(
                "\nall of it took {:.0} s; drive with: steersman drive {} --track coast",
                started.elapsed().as_secs_f64(),
                last.display()
            );
            Ok(())
        }
        Ok(result) if args.json => print_json(&result),
        Ok(result) => {
            print_training(&result);
            Ok(())
        }
        Err(Error::Interrupted) => {
            eprintln!("stopped and saved; go on with: steersman train --resume {}", folder.display());
            Err(Error::Interrupted)
        }
        Err(error) => Err(error),
    }
}

/// The recordings of the main job, recorded now if they are not there.
fn training_set(stop: &AtomicBool) -> Result<Vec<PathBuf>> {
    let bar = ShareBar::new("recording the expert");
    let progress = |share| {
        bar.set(share);
        !stop.load(Ordering::Relaxed)
    };
    let takes = training_set::takes();
    let (paths, reused) = training_set::recordings(Path::new(RECORDINGS), &takes, &progress)?;
    drop(bar);
    let verb = if reused { "found" } else { "recorded" };
    eprintln!("{verb} the training set of {} recordings under {RECORDINGS}", paths.len());
    Ok(paths)
}

/// Drives `model` on every track of the main job. It gets the weights of the last epoch: those with the lowest validation
/// error may be an early epoch's, which predicts well and drives badly.
fn drives(model: &Path, runs: usize, stop: &AtomicBool) -> Result<Vec<TrackResult>> {
    let pilot = Pilot::load(model)?;
    let options = DriveOptions { runs, ..Default::default() };
    let on_track = |name: &&str| {
        let track = Track::load(name)?;
        let bar = ShareBar::new(format!("driving on {name}"));
        let progress = |share| {
            bar.set(share);
            !stop.load(Ordering::Relaxed)
        };
        test_on_track(&pilot, &track, &options, &progress)
    };
    TRACKS.iter().map(on_track).collect()
}

fn print_training(result: &TrainResult) {
    println!(
        "trained on {} images for {} epochs in {:.1} s ({:.0} images/s); {} validation images, leak {:.1} %",
        result.train_images,
        result.epochs,
        result.seconds,
        result.images_per_second,
        result.val_images,
        result.leak_percent
    );
    println!(
        "best epoch {}: validation MSE {}; centre camera {}, MAE {} deg, {} of the error of predicting zero",
        result.best_epoch,
        or_dash(result.val_mse, 4),
        or_dash(result.val_center_mse, 4),
        or_dash(result.val_mae_deg, 2),
        or_dash(result.relative_to_zero, 2)
    );
    println!("model {}", result.model.display());
}

fn print_drives(drives: &[TrackResult]) {
    println!("\ntrack                       offline MAE     laps  autonomy  interventions  mean distance from line");
    for TrackResult { drive, offline_mae_deg } in drives {
        let name = format!("{} ({})", drive.track, if drive.held_out { "held out" } else { "trained" });
        let laps = format!("{}/{}", drive.laps_completed, drive.laps_total);
        println!(
            "{name:<26} {offline_mae_deg:>8.2} deg {laps:>8} {:>7.1} % {:>14} {:>22.2} m",
            drive.autonomy_percent, drive.interventions, drive.cte_mean_m
        );
    }
}
