//! The commands, one file or folder each, by its name: its arguments and `run`. What several commands take lies in `arguments/`, how
//! they print and show progress in `terminal/`, threads and Ctrl-C in `process.rs`.
//!
//! Results go to standard output, everything else to standard error. With `--json` the last line of standard output is one
//! JSON value. Exit codes: 0 done, 1 error, 2 wrong arguments, 130 interrupted.

#[macro_use]
mod terminal;

pub(crate) mod arguments;
mod bench;
mod compare;
mod drive;
mod evaluate;
mod experiment;
mod explain;
pub(crate) mod export;
mod import;
mod inspect;
#[cfg(feature = "mpi")]
mod other_rank;
mod predict;
mod process;
mod record;
mod runs;
mod serve;
mod sim;
pub(crate) mod summary;
mod tracks;
mod train;
mod video;

use std::process::ExitCode;
use std::time::Instant;

use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{CommandFactory, Parser, Subcommand};

use crate::error::Error;
use crate::recipe::Recipe;
use crate::text::escaped_lines;

/// Learn to steer a car from its front camera, and drive with what was learned.
#[derive(Debug, Parser)]
#[command(name = "steersman", version, about, propagate_version = true, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    #[command(
        after_help = "Examples:\n  steersman train\n      the whole job: record the expert, train, drive\n  steersman train data/sample --recipe lenet --set epochs=3\n      a recording of your own"
    )]
    Train(train::TrainArgs),
    #[command(
        after_help = "Examples:\n  steersman record --track lake --out recordings/lake\n      the expert drives a lap\n  steersman record --track lake --manual --out recordings/mine\n      you drive, in the browser"
    )]
    Record(record::RecordArgs),
    #[command(
        after_help = "Examples:\n  steersman drive runs/default-1/model.safetensors --track coast\n      how well it drives, in figures\n  steersman drive runs/default-1/model.safetensors --track coast --watch\n      the same, to look at in the browser"
    )]
    Drive(drive::DriveArgs),
    #[command(
        after_help = "Example:\n  steersman serve runs/default-1/model.safetensors\n      for Udacity's simulator in autonomous mode"
    )]
    Serve(serve::ServeArgs),
    #[command(
        after_help = "Example:\n  steersman sim --track lake\n      the simulator for a server of your own, on port 4567"
    )]
    Sim(sim::SimArgs),
    #[command(
        after_help = "Example:\n  steersman evaluate runs/default-1/model.safetensors data/sample\n      error in degrees, beside a straight wheel"
    )]
    Evaluate(evaluate::EvaluateArgs),
    #[command(after_help = "Example:\n  steersman experiment --help\n      see the experiments and their options")]
    Experiment(experiment::ExperimentArgs),
    #[command(
        after_help = "Example:\n  steersman predict runs/default-1/model.safetensors frame.jpg\n      one angle for each image"
    )]
    Predict(predict::PredictArgs),
    #[command(
        after_help = "Examples:\n  steersman export runs/default-1/model.safetensors --to onnx model.onnx\n      for ONNX Runtime\n  steersman export runs/default-1/model.safetensors --to c model.c\n      for a microcontroller"
    )]
    Export(export::ExportArgs),
    #[command(
        after_help = "Example:\n  steersman inspect data/sample --out inspection\n      what is in it, and a page with pictures"
    )]
    Inspect(inspect::InspectArgs),
    #[command(after_help = "Example:\n  steersman tracks\n      the tracks there are")]
    Tracks(tracks::TracksArgs),
    #[command(
        after_help = "Examples:\n  steersman video data/sample sample.mp4 --model runs/default-1/model.safetensors\n      a recording, with the model beside the driver\n  steersman video runs/default-1/drives/lake lake.mp4\n      a saved drive"
    )]
    Video(video::VideoArgs),
    #[command(
        after_help = "Examples:\n  steersman explain runs/default-1/model.safetensors --track lake --out explained\n      on what the expert sees\n  steersman explain runs/default-1/model.safetensors data/sample --out explained\n      on a recording"
    )]
    Explain(explain::ExplainArgs),
    #[command(
        after_help = "Example:\n  steersman compare runs/default-1 runs/lenet-1 --out compared.html\n      two runs on one page"
    )]
    Compare(compare::CompareArgs),
    #[command(
        after_help = "Examples:\n  steersman runs\n      those in the folder runs\n  steersman runs class-1 class-2 --out runs.html\n      those of two folders, as a page"
    )]
    Runs(runs::RunsArgs),
    #[command(
        after_help = "Examples:\n  steersman summary --recipe pilotnet\n      the layers of a recipe\n  steersman summary runs/default-1/model.safetensors\n      those of a model, and how it was trained"
    )]
    Summary(summary::SummaryArgs),
    #[command(
        after_help = "Examples:\n  steersman bench --recipe lenet\n      images a second\n  steersman bench --recipe default --profile\n      where a training step spends its time"
    )]
    Bench(bench::BenchArgs),
    #[command(
        after_help = "Example:\n  steersman import model.h5 --fit data/sample --out imported.safetensors\n      a model of Keras, with the preprocessing that fits a recording"
    )]
    Import(import::ImportArgs),
}

/// Runs the command line of this process. Among the ranks of an MPI job only rank 0 reads it; the others do what it tells them.
pub fn main() -> ExitCode {
    #[cfg(feature = "mpi")]
    return crate::cluster::mpi::run(command, other_rank::run, |text| eprintln!("{text}"));
    #[cfg(not(feature = "mpi"))]
    match crate::cluster::require_alone() {
        Ok(()) => command(),
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

fn command() -> ExitCode {
    let started = Instant::now();
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => return wrong_arguments(&error),
    };
    let result = match cli.command {
        Command::Train(args) => train::run(args),
        Command::Record(args) => record::run(args),
        Command::Drive(args) => drive::run(args),
        Command::Serve(args) => serve::run(args),
        Command::Sim(args) => sim::run(args),
        Command::Evaluate(args) => evaluate::run(args),
        Command::Experiment(args) => experiment::run(args),
        Command::Predict(args) => predict::run(args),
        Command::Export(args) => export::run(args),
        Command::Inspect(args) => inspect::run(args),
        Command::Tracks(args) => tracks::run(args),
        Command::Video(args) => video::run(args),
        Command::Explain(args) => explain::run(args),
        Command::Compare(args) => compare::run(args),
        Command::Runs(args) => runs::run(args),
        Command::Summary(args) => summary::run(args),
        Command::Bench(args) => bench::run(args, started),
        Command::Import(args) => import::run(args),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(Error::Interrupted) => ExitCode::from(130),
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

/// Prints what clap has to say: help, the version, or what is wrong with the arguments, which may be names of foreign files.
fn wrong_arguments(error: &clap::Error) -> ExitCode {
    let text = error.render().to_string();
    let hint = recipe_entry(error, std::env::args_os().map(|arg| arg.to_string_lossy().into_owned()).collect());
    if escaped_lines(&text) == text && hint.is_none() {
        let _ = error.print();
        return ExitCode::from(error.exit_code() as u8);
    }
    eprintln!("{}", text.trim_end());
    if let Some(hint) = hint {
        eprintln!("\n  tip: {hint}");
    }
    ExitCode::from(2)
}

/// How to give what an unknown argument among `args` means, if that is an entry of recipes and the command takes a recipe.
fn recipe_entry(error: &clap::Error, args: Vec<String>) -> Option<String> {
    let ContextValue::String(unknown) = error.get(ContextKind::InvalidArg)? else { return None };
    let is_it = |arg: &&String| arg.split('=').next() == unknown.split('=').next();
    if error.kind() != ErrorKind::UnknownArgument || !unknown.starts_with("--") {
        return None;
    }
    let command = Cli::command();
    let command = command.find_subcommand(args.get(1)?)?;
    command.get_arguments().find(|arg| arg.get_long() == Some("set"))?;
    let place = args.iter().position(|arg| is_it(&arg))?;
    let value = match args[place].split_once('=') {
        Some((_, value)) => value,
        None => args.get(place + 1).map_or("VALUE", String::as_str),
    };
    let key = Recipe::key_like(unknown.split('=').next()?.trim_start_matches('-'))?;
    Some(format!("{key} is an entry of the recipe: use --set {key}={value}"))
}
