//! The commands, one file each: its arguments and `run`.
//!
//! Results go to standard output, everything else to standard error. With `--json` the last line of standard output is one
//! JSON value. Exit codes: 0 done, 1 error, 2 wrong arguments, 130 interrupted.

/// As that of the standard library, but foreign text reaches no terminal raw (see [`crate::text`]), and whoever reads may stop
/// before the end, as `head` does. All commands print through this macro, [`eprintln`], [`print`] and [`print_json`].
macro_rules! println {
    () => { $crate::cli::print_line(std::io::stdout(), "") };
    ($($arg:tt)+) => { $crate::cli::print_line(std::io::stdout(), &format!($($arg)+)) };
}

/// As [`println`], to standard error.
macro_rules! eprintln {
    ($($arg:tt)+) => { $crate::cli::print_line(std::io::stderr(), &format!($($arg)+)) };
}

mod bench;
mod compare;
mod donkeysim;
mod drive;
mod drive_donkeysim;
mod drive_sweep;
mod evaluate;
mod experiment;
mod experiment_replay;
mod explain;
pub(crate) mod export;
mod fit_camera;
mod import;
mod inspect;
pub(crate) mod model_arg;
mod predict;
mod progress;
mod record;
mod recording_args;
mod replay;
mod runs;
mod serve;
mod share_bar;
mod sim;
pub(crate) mod summary;
mod terminal;
pub(crate) mod throttle;
mod tracks;
mod train;
mod verdict;
mod video;
mod words;
#[cfg(feature = "mpi")]
mod worker;

use std::io::{self, IsTerminal, Write};
use std::path::Path;
use std::process::ExitCode;
use std::time::Instant;

use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{Args, CommandFactory, Parser, Subcommand};
use serde::Serialize;

use crate::error::{Error, Result};
use crate::geometry::CarGeometry;
use crate::model_file::{Model, notice_without_digest};
use crate::observer::StopSignal;
use crate::pilot::Pilot;
use crate::recipe::Recipe;
use crate::simulator::camera_trouble;
use crate::text::{escaped, escaped_json, escaped_lines};
use model_arg::model_file;

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
    return crate::cluster::mpi::run(command, worker::run, |text| eprintln!("{text}"));
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

/// Which recipe, and what to change in it.
#[derive(Clone, Debug, Args)]
struct RecipeArgs {
    /// A built-in recipe (default, calm, recording, hyper, hyper-prelu, lenet, pilotnet, donkey) or a recipe file [default: recording
    /// with a recording, else default]
    #[arg(long, value_name = "NAME|FILE")]
    recipe: Option<String>,
    /// Change an entry of the recipe, as in epochs=3 or optimizer.learning_rate=1e-4
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
}

impl RecipeArgs {
    fn is_given(&self) -> bool {
        self.recipe.is_some() || !self.overrides.is_empty()
    }

    fn find(&self) -> Result<Recipe> {
        self.find_or("default")
    }

    /// The recipe that is named, or else the built-in one called `default`.
    fn find_or(&self, default: &str) -> Result<Recipe> {
        Recipe::find(self.recipe.as_deref().unwrap_or(default), &self.overrides)
    }

    /// The recipe that is named, or else that of the model in the file `from`.
    fn find_or_of(&self, from: &Path) -> Result<Recipe> {
        match self.recipe {
            Some(_) => self.find(),
            None => Recipe::parse(&from.display().to_string(), &load_model(from)?.recipe.to_toml()?, &self.overrides),
        }
    }
}

/// Reads the model that `given` means, and says so if it has no digest.
fn load_model(given: &Path) -> Result<Model> {
    let path = &model_file(given)?;
    let model = Model::load(path)?;
    say_if_without_digest(path)?;
    Ok(model)
}

/// Reads the model that `given` means to drive with it, and says so if it has no digest.
fn load_pilot(given: &Path) -> Result<Pilot> {
    let path = &model_file(given)?;
    let pilot = Pilot::load(path)?;
    say_if_without_digest(path)?;
    Ok(pilot)
}

fn say_if_without_digest(path: &Path) -> Result<()> {
    if let Some(notice) = notice_without_digest(path)?.filter(|_| !crate::cluster::follows()) {
        eprintln!("note: {}", escaped(&notice));
    }
    Ok(())
}

/// The camera and the car of the preset `name`, which the simulator must be able to have.
fn camera_preset(name: &str) -> Result<CarGeometry> {
    let known = || CarGeometry::presets().map(|(name, _)| name).collect::<Vec<_>>().join(", ");
    let car = CarGeometry::preset(name)
        .ok_or_else(|| Error::Usage(format!("--camera {name}: there is no such camera; known are {}", known())))?;
    match camera_trouble(&car) {
        Some(trouble) => Err(Error::Usage(format!("--camera {name}: {trouble}"))),
        None => Ok(car),
    }
}

/// A rayon pool of `threads` (0: one for each core, which the ranks on a machine share out).
fn pool(threads: usize) -> Result<rayon::ThreadPool> {
    let threads = crate::cluster::threads(threads);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    pool.map_err(|e| {
        Error::System(format!("cannot start {threads} threads: {e}; give a smaller number with --threads"))
    })
}

/// A signal that Ctrl-C gives; the second Ctrl-C ends the process at once.
fn stop_on_ctrl_c() -> Result<StopSignal> {
    let stop = StopSignal::default();
    let signal = stop.clone();
    let handler = move || {
        if signal.request() {
            std::process::exit(130);
        }
    };
    ctrlc::set_handler(handler).map_err(|e| Error::System(format!("cannot listen for Ctrl-C: {e}")))?;
    Ok(stop)
}

/// The end of a command that went on after some of its inputs `failed`: the last error ends it, those before are told.
fn end_with(mut failed: Vec<Error>) -> Result<()> {
    let last = failed.pop();
    failed.iter().for_each(|error| eprintln!("error: {error}"));
    last.map_or(Ok(()), Err)
}

/// Refuses an output that exists already.
fn refuse_existing(path: &Path) -> Result<()> {
    match path.exists() {
        true => Err(Error::Usage(format!("{}: exists already and is not overwritten; name a new one", path.display()))),
        false => Ok(()),
    }
}

/// Makes the new folder `path`, and those it lies in.
fn new_folder(path: &Path) -> Result<()> {
    refuse_existing(path)?;
    std::fs::create_dir_all(path).map_err(Error::io(path))
}

/// Prints a line to `out`, as [`println`] does.
fn print_line(mut out: impl Write + IsTerminal + terminal::Columns, text: &str) {
    let text = terminal::fitted(&escaped_lines(text), &out);
    // A stream that is closed takes no complaint either.
    let _ = writeln!(out, "{text}");
}

/// Prints `text`. Whoever reads may stop before the end, as `head` does.
fn print(text: &str) -> Result<()> {
    let stdout = std::io::stdout();
    let text = terminal::fitted(&escaped_lines(text), &stdout);
    match stdout.lock().write_all(text.as_bytes()) {
        Err(e) if e.kind() != io::ErrorKind::BrokenPipe => Err(Error::io("standard output")(e)),
        _ => Ok(()),
    }
}

/// Prints one JSON value as the last line.
fn print_json(value: &impl Serialize) -> Result<()> {
    let text = serde_json::to_string(value).map_err(|e| Error::Fault(format!("cannot be written as JSON: {e}")))?;
    match std::io::stdout().lock().write_all((escaped_json(&text) + "\n").as_bytes()) {
        Err(e) if e.kind() != io::ErrorKind::BrokenPipe => Err(Error::io("standard output")(e)),
        _ => Ok(()),
    }
}

/// A number with `decimals`, or a dash where there is none.
fn or_dash(value: Option<f64>, decimals: usize) -> String {
    value.map_or("-".into(), |value| format!("{value:.decimals$}"))
}
