//! `steersman train`: the main job.

mod verdict;

use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::Args;
use serde::Serialize;
use steersman_kernels::Isa;
use steersman_kernels::conv::ConvAlgorithm;

use super::arguments::{RecipeArgs, RecordingArgs, model_file};
use super::process::{pool, stop_on_ctrl_c};
use super::terminal::{JobDisplay, beside_steering, counted, or_dash, print, print_json};
use crate::dataset::held_out::trained_on_held_out;
use crate::error::{Error, Result};
use crate::live::{self, training::TrainingPage};
use crate::main_job::dagger_on_log::{self, DaggerNote, Round};
use crate::main_job::job::{Job, JobEvent, JobNote, JobRequest, Scope};
use crate::main_job::on_recording::judge_run;
use crate::main_job::with_simulator::{Allowed, beside_recordings};
use crate::main_job::{MainJobResult, TrackResult};
use crate::observer::{Observer, StopSignal};
use crate::recipe::Recipe;
use crate::replay::RecordingVerdict;
use crate::report;
use crate::text::percent;
use crate::training::{self, DEFAULT_CACHE_MIB, NewRun, RunFolder, TrainRequest, TrainResult, TransferRequest};

/// Time of one core (Zen 3, 2.4 GHz) for recording and for driving, s.
const SIMULATOR_CORE_S: f64 = 160.0;
/// The same for training the default recipe.
const TRAINING_CORE_S: f64 = 160.0;
/// Reading and changing an image takes as long as this many multiply-adds.
const IMAGE_MULTIPLY_ADDS: f64 = 1.5e6;

/// Train a network on recordings
#[derive(Debug, Args)]
pub struct TrainArgs {
    /// Recordings: folders, logs, or .zip and .tar.gz archives of them. Without any, the whole job is done: the expert's
    /// drives in the simulator are recorded under data/recordings/, trained on, and the model drives
    #[arg(value_name = "RECORDING")]
    recordings: Vec<PathBuf>,
    /// Validate on this recording, whole, instead of on a share of the rows; may be given several times
    #[arg(long, value_name = "RECORDING", requires = "recordings")]
    validate: Vec<PathBuf>,
    /// Train on the simulator's set as well, as the recording's camera sees it; it is recorded under data/recordings/ first if it is
    /// not there. SHARE of each epoch's images are the simulator's [default: samples.simulator_share of the recipe, 0.5]
    #[arg(long, value_name = "SHARE", num_args = 0..=1, require_equals = true, requires = "recordings", conflicts_with = "resume")]
    with_simulator: Option<Option<f64>>,
    #[command(flatten)]
    reading: RecordingArgs,
    #[command(flatten)]
    recipe: RecipeArgs,
    /// Run folder; a new one under runs/ by default
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Seed of all random choices: the same seed gives the same weights, bit for bit, for any number of threads
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Begin with the weights of a model where layers have the same name and shape; without --recipe, with its recipe
    #[arg(long, value_name = "MODEL", conflicts_with = "resume")]
    from: Option<PathBuf>,
    /// Layers that keep the weights they were given, as in conv1,bn1
    #[arg(long, value_name = "LAYER", requires = "from", value_delimiter = ',')]
    freeze: Vec<String>,
    /// Threads; 0 is one for each core
    #[arg(long, default_value_t = 0)]
    threads: usize,
    /// How convolutions are computed: auto (the fastest for each shape) or im2col (the textbook way) [default: auto]
    #[arg(long, value_name = "NAME")]
    algorithm: Option<ConvAlgorithm>,
    /// Memory for decoded images, in MiB; what does not fit goes to a temporary file
    #[arg(long, default_value_t = DEFAULT_CACHE_MIB, value_name = "MIB")]
    cache: usize,
    /// Go on with a run that was stopped, as if it had never stopped
    #[arg(long, value_name = "RUN", conflicts_with_all = ["recordings", "validate", "recipe", "overrides", "out", "seed", "cache", "algorithm"])]
    resume: Option<PathBuf>,
    /// With --resume: where the recordings of the run are now, in their order, if they were moved
    #[arg(long = "recordings", value_name = "RECORDING", requires = "resume", num_args = 1..)]
    moved: Vec<PathBuf>,
    /// Without a recording: runs of the finished model on each track, of one lap
    #[arg(long, default_value_t = 1, conflicts_with_all = ["recordings", "resume"])]
    runs: usize,
    /// After the training the model drives N times, and what it met is trained on as well (DAgger): without a recording through
    /// the training tracks, where the expert labels it and training begins anew; on a recording along the driven path, which says
    /// how to steer back, and training goes on for half as many epochs
    #[arg(long, default_value_t = 0, value_name = "N", conflicts_with = "resume",
          value_parser = clap::value_parser!(u32).range(..=20))]
    dagger: u32,
    /// Train on recordings of held-out tracks all the same
    #[arg(long, requires = "recordings")]
    force_held_out: bool,
    /// Show the training on a page of this machine: how far it is, curves, worst frames; the same report is in the run folder at the end
    #[arg(long)]
    watch: bool,
    /// Port of that page; 0 takes any free one
    #[arg(long, default_value_t = live::training::DEFAULT_PORT, requires = "watch")]
    port: u16,
    /// Say at the end where the time went: decoding, forward, backward and so on, and how busy the cores were
    #[arg(long)]
    profile: bool,
    /// Print one JSON object as the last line
    #[arg(long)]
    json: bool,
}

/// What `train RECORDING --json` prints.
#[derive(Serialize)]
struct Report<'a> {
    #[serde(flatten)]
    training: &'a TrainResult,
    /// What the model is worth on the recordings.
    #[serde(skip_serializing_if = "Option::is_none")]
    on_recording: Option<&'a RecordingVerdict>,
    /// With `--dagger`: the same of the first training and of each round.
    #[serde(skip_serializing_if = "<[&RecordingVerdict]>::is_empty")]
    dagger: &'a [&'a RecordingVerdict],
}

pub fn run(args: TrainArgs) -> Result<()> {
    let started = Instant::now();
    if args.runs == 0 {
        return Err(Error::Usage("--runs 0: at least 1 run is needed".into()));
    }
    let stop = stop_on_ctrl_c()?;
    let pool = pool(args.threads)?;
    let page = args.watch.then(|| TrainingPage::start(args.port)).transpose()?;
    if let Some(page) = &page {
        eprintln!("open {} in a browser", page.url());
    }
    let from = args.from.as_deref().map(model_file).transpose()?;
    let from = from.map(|model| TransferRequest { model, freeze: args.freeze });
    let recipe = || match &from {
        Some(from) => args.recipe.find_or_of(&from.model),
        None if args.recordings.is_empty() => args.recipe.find(),
        None => args.recipe.find_or("recording"),
    };
    let note = match &args.resume {
        Some(folder) => JobNote::read(folder)?,
        None if args.recordings.is_empty() => Some(JobNote { runs: args.runs, dagger_rounds: args.dagger, round: 0 }),
        None => None,
    };
    if let Some(note) = note {
        let mut display = JobDisplay::new(&stop).with_page(page);
        let scope = Scope::default();
        let mut job = Job::new(scope.clone(), note, &mut display, &stop).with_profile(args.profile);
        let result = match args.resume {
            Some(folder) => pool.install(|| job.go_on(&folder)),
            None => {
                let recipe = recipe()?;
                eprintln!("{}", plan(&recipe, &scope, args.dagger, pool.current_num_threads())?);
                let run = NewRun::at(args.out, &recipe.name)?;
                let out = run.path().to_path_buf();
                let (seed, cache_mib, algorithm) = (args.seed, args.cache, args.algorithm);
                let request = JobRequest { recipe, out, seed, cache_mib, from, algorithm };
                run.settle(pool.install(|| job.begin(request)))
            }
        };
        let folder = job.folder().map(Path::to_path_buf);
        drop(job);
        // The bar would take the lines below it along.
        display.finish();
        let result = pool.install(|| explain_stop(result, folder.as_deref()));
        if let (Ok(_), Some(folder)) = (&result, &folder) {
            pool.install(|| write_report(folder));
        }
        let words = last_words(result.as_ref().map(|result| &result.training), folder.as_deref());
        display.close_page(&words, folder.as_deref());
        let result = result?;
        if args.json {
            return print_json(&result);
        }
        print_training(&result.training);
        print_drives(&result);
        println!(
            "\nall of it took {:.0} s; drive with: steersman drive {} --track coast",
            started.elapsed().as_secs_f64(),
            result.training.model.display()
        );
        return Ok(());
    }
    let mut display = JobDisplay::new(&stop).with_page(page);
    let mut rounds = Vec::new();
    let (folder, note, result) = match args.resume {
        Some(folder) => {
            let note = DaggerNote::read(&folder)?;
            let moved = (!args.moved.is_empty()).then_some(&args.moved[..]);
            let mut observer = |event| display.observe(JobEvent::Training(event));
            let result = pool.install(|| training::resume_with(&folder, moved, args.profile, &mut observer, &stop));
            (folder, note, result)
        }
        None => {
            let (mut recipe, said) = (recipe()?, args.reading.said());
            let [recordings, validate] = [args.recordings, args.validate].map(|paths| args.reading.expand(paths));
            let (recordings, validate) = (recordings?, validate?);
            let allowed = Allowed { with_simulator: args.with_simulator, held_out: args.force_held_out };
            let sides = [&recordings[..], &validate];
            let mut notice = |text: &str| eprintln!("note: {text}");
            let set = || beside_recordings(&mut recipe, sides, &said, allowed, &mut notice, &mut display, &stop);
            let simulator = pool.install(set);
            display.finish();
            let simulator = explain_stop(simulator, None)?;
            let run = NewRun::at(args.out, &recipe.name)?;
            let out = run.path().to_path_buf();
            let request = TrainRequest {
                validate,
                simulator,
                said,
                seed: args.seed,
                cache_mib: args.cache,
                from,
                profile: args.profile,
                algorithm: args.algorithm,
                ..TrainRequest::new(recordings, recipe, out.clone())
            };
            let note = (args.dagger > 0).then_some(DaggerNote { rounds: args.dagger, round: 0 });
            let free = (1..=args.dagger).try_for_each(|round| dagger_on_log::require_free(&out, round));
            let noted = free.and_then(|()| note.iter().try_for_each(|note| note.write(&out)));
            let mut observer = |event| display.observe(JobEvent::Training(event));
            let train = || {
                let result = training::train(request, &mut observer, &stop);
                if result.is_err() && note.is_some() {
                    DaggerNote::take_back(&out);
                }
                result
            };
            let result = run.settle(noted.and_then(|()| pool.install(train)));
            (out, note, result)
        }
    };
    // Where `--resume` goes on after a stop.
    let mut at = folder.clone();
    let result = result.and_then(|result| {
        if let Some(note) = note.as_ref().filter(|note| note.round < note.rounds) {
            pool.install(|| judge_or_say(&folder, &stop));
            pool.install(|| dagger_on_log::rounds(note, args.profile, &mut display, &stop, &mut at, &mut rounds))?;
        }
        Ok(result)
    });
    display.finish();
    let result = pool.install(|| explain_stop(result, Some(&at)));
    if let Err(error) = &result {
        display.close_page(&last_words(Err(error), Some(&at)), Some(&at));
    }
    let result = result?;
    let last = rounds.last().map_or(&folder, |round: &Round| &round.folder).clone();
    let (result, verdict) = match rounds.last() {
        Some(round) => (round.training.clone(), Some(round.verdict.clone())),
        None => (result, pool.install(|| judge_or_say(&folder, &stop))),
    };
    pool.install(|| write_report(&last));
    display.close_page(&last_words(Ok(&result), Some(&last)), Some(&last));
    let by_round = note.as_ref().map_or(Ok(Vec::new()), |note| verdicts(note, &folder, &rounds))?;
    let by_round: Vec<&RecordingVerdict> = by_round.iter().collect();
    if args.json {
        print_json(&Report { training: &result, on_recording: verdict.as_ref(), dagger: &by_round })?;
        return stop.check();
    }
    print_training(&result);
    if let Some(verdict) = verdict {
        print(&verdict::table(&verdict, result.best_epoch))?;
    }
    if !by_round.is_empty() {
        print(&verdict::rounds(&by_round))?;
    }
    // Judging may have been stopped.
    stop.check()
}

/// What the models of the first training and of all rounds are worth, where the folder of one of them is `folder` with the note `note`;
/// `done` are the rounds of this time.
fn verdicts(note: &DaggerNote, folder: &Path, done: &[Round]) -> Result<Vec<RecordingVerdict>> {
    let of_round = |round| {
        let folder = note.folder(folder, round)?;
        match done.iter().find(|round| round.folder == folder) {
            Some(round) => Ok(Some(round.verdict.clone())),
            None => RunFolder::open(&folder)?.replay(),
        }
    };
    (0..=note.rounds).filter_map(|round| of_round(round).transpose()).collect()
}

/// Judges the model of the run in `folder` on its recordings. The run is saved; a judgement that cannot be made, or that `stop` ends,
/// takes nothing from it.
fn judge_or_say(folder: &Path, stop: &StopSignal) -> Option<RecordingVerdict> {
    let say = |error: &Error| match error {
        Error::Interrupted => eprintln!(
            "stopped; the run is saved, but the model was not judged on the recording: steersman train --resume {} does that",
            folder.display()
        ),
        error => eprintln!("note: the model was not judged on the recording: {error}"),
    };
    judge_run(folder, stop).inspect_err(say).ok()
}

/// What the main job is going to do, and about how long it takes on `threads` threads.
fn plan(recipe: &Recipe, scope: &Scope, dagger_rounds: u32, threads: usize) -> Result<String> {
    let work = |recipe: &Recipe| -> Result<f64> {
        let multiply_adds = recipe.network(Isa::best())?.multiply_adds() as f64;
        Ok(f64::from(recipe.epochs) * (multiply_adds + IMAGE_MULTIPLY_ADDS))
    };
    let relative = work(recipe)? / work(&Recipe::find("default", &[])?)?;
    let trainings = f64::from(dagger_rounds + 1);
    let minutes = (SIMULATOR_CORE_S + trainings * relative * TRAINING_CORE_S) / 60.0 / threads as f64;
    let about = if minutes < 1.5 { "a minute".into() } else { format!("{minutes:.0} minutes") };
    let rounds = match dagger_rounds {
        0 => String::new(),
        rounds => format!(", lets the model drive and learn from it {}", counted(rounds as usize, "time")),
    };
    Ok(format!(
        "records {} of the simulator's expert if they are not there, trains {} for {}{rounds}, then drives on {}: about {about} \
         with {}; Ctrl-C stops and saves",
        counted(scope.takes.len(), "drive"),
        recipe.name,
        counted(recipe.epochs as usize, "epoch"),
        counted(scope.tracks.len(), "track"),
        counted(threads, "thread"),
    ))
}

/// Writes the page of the finished run in `folder`. The run is saved; a page that cannot be written takes nothing from it.
fn write_report(folder: &Path) {
    match report::pages::run::write(folder) {
        Ok(page) => eprintln!("report {}", page.display()),
        Err(error) => eprintln!("note: no report.html: {error}"),
    }
}

/// The last words on the page of a training.
fn last_words(result: std::result::Result<&TrainResult, &Error>, folder: Option<&Path>) -> String {
    match (result, folder) {
        (Ok(result), _) => format!("The training is over: the model is {}.", result.model.display()),
        (Err(Error::Interrupted), Some(folder)) => {
            format!("Stopped and saved; go on with: steersman train --resume {}", folder.display())
        }
        (Err(error), _) => format!("The training has ended: {error}."),
    }
}

/// Says after a stop how to go on: with the run in `folder`, if there is one, which gets its page too. Call it inside a rayon
/// pool.
fn explain_stop<T>(result: Result<T>, folder: Option<&Path>) -> Result<T> {
    if let Err(Error::Interrupted) = &result {
        match folder {
            Some(folder) => {
                eprintln!("stopped and saved; go on with: steersman train --resume {}", folder.display());
                // Before the first epoch has ended there is nothing to report.
                if folder.join("model.safetensors").exists() {
                    write_report(folder);
                }
            }
            None => eprintln!("stopped; nothing was trained yet, and what was recorded is not kept"),
        }
    }
    result
}

/// A leak above this, in percent, is worth a word.
const MUCH_LEAK: f64 = 3.0;

fn print_training(result: &TrainResult) {
    let twins = result.near_twin_percent.unwrap_or(0.0);
    let leak = result.leak_percent.max(twins);
    let simulator = match result.simulator_images {
        0 => String::new(),
        images => format!(", {images} of them the simulator's,"),
    };
    println!(
        "trained on {} images{simulator} for {} in {:.1} s ({:.0} images/s); {} validation images, leak {} %",
        result.train_images,
        counted(result.epochs as usize, "epoch"),
        result.seconds,
        result.images_per_second,
        result.val_images,
        percent(leak)
    );
    if leak > MUCH_LEAK {
        println!(
            "note: {} % of the validation frames look like a training frame, {} % have one within a second: the validation error \
             is too good. Leave out recordings that are there twice, or a split that leaks; record more road",
            percent(twins),
            percent(result.leak_percent)
        );
    }
    println!(
        "epoch {}: validation MSE {}; centre camera {}, MAE {} deg, {} of the error of predicting zero{}",
        result.best_epoch,
        or_dash(result.val_mse, 4),
        or_dash(result.val_center_mse, 4),
        or_dash(result.val_mae_deg, 2),
        or_dash(result.relative_to_zero, 2),
        beside_steering(result.val_throttle_mae, result.val_speed_mae_mph)
    );
    if !result.trained_on_held_out.is_empty() {
        println!("note: the model was {}", trained_on_held_out(&result.trained_on_held_out));
    }
    if let Some(profile) = &result.profile {
        println!("{}", profile.table());
    }
    println!("model {}", result.model.display());
}

fn print_drives(result: &MainJobResult) {
    println!("\nThe weights of epoch {} drive, one lap a run:", result.training.best_epoch);
    println!("track                       offline MAE     laps  autonomy  interventions  mean distance from line");
    for TrackResult { drive, offline_mae_deg } in &result.drives {
        let name = format!("{} ({})", drive.track, if drive.held_out { "held out" } else { "trained" });
        let laps = format!("{}/{}", drive.laps_completed, drive.laps_total);
        println!(
            "{name:<26} {offline_mae_deg:>8.2} deg {laps:>8} {:>7.1} % {:>14} {:>22.2} m",
            drive.autonomy_percent, drive.interventions, drive.cte_mean_m
        );
    }
    println!(
        "laps and distance from line: without help, up to the first failure; autonomy and interventions: with help"
    );
}
