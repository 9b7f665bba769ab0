//! `steersman train`: the main job.

use std::path::PathBuf;

use clap::Args;

use super::progress::Progress;
use super::{RecipeArgs, or_dash, pool, print_json, stop_on_ctrl_c};
use crate::error::{Error, Result};
use crate::training::{self, RunFolder, TrainRequest, TrainResult};

/// Train a network on recordings
#[derive(Debug, Args)]
pub struct TrainArgs {
    /// Udacity logs (a folder or its driving_log.csv) or donkeycar tubs
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
    /// Threads; 0 is one for each core
    #[arg(long, default_value_t = 0)]
    threads: usize,
    /// Memory for decoded images, in MiB; what does not fit goes to a temporary file
    #[arg(long, default_value_t = 1024, value_name = "MIB")]
    cache: usize,
    /// Go on with a run that was stopped, as if it had never stopped
    #[arg(long, value_name = "RUN", conflicts_with_all = ["recordings", "recipe", "overrides", "out", "seed", "cache"])]
    resume: Option<PathBuf>,
    /// Print one JSON object as the last line
    #[arg(long)]
    json: bool,
}

pub fn run(args: TrainArgs) -> Result<()> {
    let stop = stop_on_ctrl_c()?;
    let pool = pool(args.threads)?;
    let (folder, result) = match args.resume {
        Some(folder) => {
            let mut progress = Progress::new();
            let result = pool.install(|| training::resume(&folder, &mut progress, &stop));
            (folder, result)
        }
        None => {
            let recipe = args.recipe.find()?;
            let out = args.out.unwrap_or_else(|| RunFolder::next_free(&recipe.name));
            let mut progress = Progress::new();
            let request = TrainRequest {
                recordings: args.recordings,
                recipe,
                out: out.clone(),
                seed: args.seed,
                cache_mib: args.cache,
            };
            let result = pool.install(|| training::train(request, &mut progress, &stop));
            (out, result)
        }
    };
    match result {
        Ok(result) => report(&result, args.json),
        Err(Error::Interrupted) => {
            eprintln!("stopped and saved; go on with: steersman train --resume {}", folder.display());
            Err(Error::Interrupted)
        }
        Err(error) => Err(error),
    }
}

fn report(result: &TrainResult, json: bool) -> Result<()> {
    if json {
        return print_json(result);
    }
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
    Ok(())
}
