//! `steersman experiment`: the two experiments of the write-ups, what labels are, and what makes the wheel calm, each to the end of the
//! road; and one of the replay.

mod replay;

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};

use super::arguments::{RecipeArgs, RecordingArgs, refuse_existing};
use super::process::{pool, stop_on_ctrl_c};
use super::terminal::{JobDisplay, counted, or_dash, print_json};
use crate::dataset::held_out::{self, trained_on_held_out};
use crate::error::{Error, Result};
use crate::main_job::experiment::{
    self, ExperimentEvent, ExperimentPlan, ExperimentRow, Subject, keyboard_drives, takes, write_csv,
};
use crate::main_job::job::{RECORDINGS, training_set};
use crate::main_job::training_set::{RANDOM_TRACKS, labelled};
use crate::observer::Observer;
use crate::simulator::Track;
use crate::training::DEFAULT_CACHE_MIB;
use replay::ReplayExperimentArgs;

/// Trainings of each variant.
const USUAL_SEEDS: u64 = 3;
/// Random tracks that are trained on.
const USUAL_RANDOM_TRACKS: u64 = 12;

/// Compare splits, colour spaces, labels, what makes the wheel calm, or models: what a number promises beside what the drive delivers
#[derive(Debug, Args)]
pub struct ExperimentArgs {
    /// What is varied
    subject: SubjectArg,
    #[command(flatten)]
    recipe: RecipeArgs,
    /// Trainings of each variant, with the seeds 1, 2, … [default: 3; replay: 1]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=100))]
    seeds: Option<u64>,
    /// Track to drive; may be given several times [default: lake, forest, random:1000001; labels: lake,
    /// mountain, random:1; replay: lake, which it also records]
    #[arg(long = "track", value_name = "TRACK")]
    tracks: Vec<String>,
    /// Runs on each track, of one lap
    #[arg(long, default_value_t = 2)]
    runs: usize,
    /// Random tracks to train on, beside lake and mountain [default: 12]
    #[arg(long, value_name = "N", conflicts_with = "recordings",
          value_parser = clap::value_parser!(u64).range(..=RANDOM_TRACKS))]
    random_tracks: Option<u64>,
    /// Train on these recordings instead of the simulator's
    #[arg(long = "recording", value_name = "RECORDING")]
    recordings: Vec<PathBuf>,
    #[command(flatten)]
    reading: RecordingArgs,
    /// Train on recordings of held-out tracks all the same
    #[arg(long, requires = "recordings")]
    force_held_out: bool,
    /// A first impression: one seed, 2 epochs, one run on one track
    #[arg(long, conflicts_with_all = ["seeds", "runs"])]
    quick: bool,
    /// Save every trial as a line of this CSV file, which must not exist; replay writes a page of the same name beside it
    /// [default: runs/experiment-SUBJECT-N.csv]
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Memory for decoded images, in MiB
    #[arg(long, default_value_t = DEFAULT_CACHE_MIB, value_name = "MIB")]
    cache: usize,
    /// Threads; 0 is one for each core
    #[arg(long, default_value_t = 0)]
    threads: usize,
    /// Print one JSON array as the last line
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum SubjectArg {
    /// Validation rows by blocks of time, single rows, single images
    Split,
    /// RGB, YUV, HSV, the saturation alone, grey
    Colour,
    /// Labels from the recorded wheel, or from the driven path with look-aheads of 0.7, 1.0 and 1.3 s, where keys drove: by default on
    /// a lap of lake in each direction, with the recipe `recording`; 12 trainings, 10 to 20 minutes on two cores
    Labels,
    /// Models of all qualities: does driving on a recording tell how they drive in the simulator?
    Replay,
    /// Larger batches, averaged weights, noise in the pictures, terms of smoothness, blur before strides, ELU: what makes the wheel calm
    Smooth,
}

pub fn run(args: ExperimentArgs) -> Result<()> {
    if args.runs == 0 {
        return Err(Error::Usage("--runs 0: at least 1 run is needed".into()));
    }
    if let SubjectArg::Replay = args.subject {
        refuse_what_replay_ignores(&args)?;
        args.tracks.iter().try_for_each(|track| Track::load(track).map(drop))?;
        let ExperimentArgs { tracks, quick, threads, json, cache: cache_mib, .. } = args;
        let runs = if quick { 1 } else { args.runs };
        let seeds = args.seeds.unwrap_or(1);
        let replay = ReplayExperimentArgs { tracks, seeds, runs, quick, cache_mib, threads, json };
        let out = new_csv(args.out, args.subject)?;
        return replay::run(replay, &out, &page_of(&out));
    }
    let given = args.reading.expand(args.recordings)?;
    let held_out = held_out::check(&given, args.force_held_out)?;
    if !held_out.is_empty() {
        eprintln!("note: {}", trained_on_held_out(&held_out));
    }
    let labels = matches!(args.subject, SubjectArg::Labels);
    if labels && args.random_tracks.is_some() {
        return Err(Error::Usage("experiment labels trains on drives with keys; leave out --random-tracks".into()));
    }
    let mut recipe = args.recipe.find_or(if labels { "recording" } else { "default" })?;
    let (seeds, runs) = if args.quick { (1, 1) } else { (args.seeds.unwrap_or(USUAL_SEEDS), args.runs) };
    let mut tracks = args.tracks;
    if tracks.is_empty() {
        // Held-out tracks must not choose the labels of a recipe.
        let usual = if labels { ["lake", "mountain", "random:1"] } else { ["lake", "forest", "random:1000001"] };
        tracks = usual.map(String::from).to_vec();
    }
    if args.quick {
        recipe.epochs = recipe.epochs.min(2);
        tracks.truncate(1);
    }
    for track in &tracks {
        Track::load(track)?;
    }
    let stop = stop_on_ctrl_c()?;
    let (pool, mut display) = (pool(args.threads)?, JobDisplay::new(&stop));
    // A file that cannot be written is told before hours are spent.
    let out = new_csv(args.out, args.subject)?;
    let scratch = tempfile::tempdir().map_err(Error::io(std::env::temp_dir()))?;
    let recordings = match given.is_empty() {
        true if labels => pool.install(|| keyboard_drives(scratch.path(), &mut display, &stop)),
        true => {
            let takes = takes(args.random_tracks.unwrap_or(USUAL_RANDOM_TRACKS) as usize);
            pool.install(|| training_set(RECORDINGS.as_ref(), &labelled(&takes, &recipe), None, &mut display, &stop))
        }
        false => {
            recipe.labels.notice_of_recordings().into_iter().for_each(|notice| eprintln!("note: {notice}"));
            Ok(given)
        }
    };
    let recordings = recordings.inspect_err(|_| drop(std::fs::remove_file(&out)))?;
    let subject = match args.subject {
        SubjectArg::Split => Subject::Split,
        SubjectArg::Colour => Subject::Colour,
        SubjectArg::Labels => Subject::Labels,
        SubjectArg::Replay => unreachable!("it has ended above"),
        SubjectArg::Smooth => Subject::Smooth,
    };
    let plan = ExperimentPlan {
        subject,
        recipe,
        seeds,
        recordings,
        said: args.reading.said(),
        tracks,
        runs,
        cache_mib: args.cache,
    };
    let mut done = Vec::new();
    let mut observer = |event| match event {
        ExperimentEvent::Job(event) => display.observe(event),
        ExperimentEvent::Row(trial) => {
            done.push(trial);
            write_csv(&out, &done)
        }
    };
    let result = pool.install(|| experiment::run(&plan, &mut observer, &stop)).map(drop);
    // After a stop or an error too, what is done is shown and kept.
    if done.is_empty() {
        std::fs::remove_file(&out).map_err(Error::io(&out))?;
        return result;
    }
    if args.json {
        print_json(&done)?;
        return result;
    }
    print_table(&plan, &done);
    if !held_out.is_empty() {
        println!("note: {}", trained_on_held_out(&held_out));
    }
    if result.is_ok() {
        println!("every trial: {}", out.display());
    } else {
        println!("not all trials are done; those that are: {}", out.display());
    }
    result
}

/// Refuses what `experiment replay` would otherwise ignore: it makes its recordings and its models itself.
fn refuse_what_replay_ignores(args: &ExperimentArgs) -> Result<()> {
    let given = [
        (!args.recordings.is_empty(), "--recording", "makes recordings of its own"),
        (args.reading.is_given(), "what is said about recordings", "makes recordings of its own"),
        (args.random_tracks.is_some(), "--random-tracks", "trains on the tracks that it drives (--track)"),
        (args.recipe.is_given(), "--recipe and --set", "compares models of several recipes"),
    ];
    match given.into_iter().find(|(given, ..)| *given) {
        Some((_, option, why)) => Err(Error::Usage(format!("experiment replay {why}; leave out {option}"))),
        None => Ok(()),
    }
}

/// The page beside the CSV file `csv` of `experiment replay`.
fn page_of(csv: &Path) -> PathBuf {
    csv.with_extension("html")
}

/// Creates the CSV file `out`, which must not exist, or else the first free one under `runs/`.
fn new_csv(out: Option<PathBuf>, subject: SubjectArg) -> Result<PathBuf> {
    let name = match subject {
        SubjectArg::Split => "split",
        SubjectArg::Colour => "colour",
        SubjectArg::Labels => "labels",
        SubjectArg::Replay => "replay",
        SubjectArg::Smooth => "smooth",
    };
    let of_number = |n: u32| PathBuf::from(format!("runs/experiment-{name}-{n}.csv"));
    // The page must not overwrite anything either.
    let page = |csv: &Path| matches!(subject, SubjectArg::Replay).then(|| page_of(csv));
    let is_free = |csv: &PathBuf| !csv.exists() && page(csv).is_none_or(|page| !page.exists());
    let out = out.unwrap_or_else(|| (1..).map(of_number).find(is_free).expect("numbers go on"));
    refuse_existing(&out)?;
    if let Some(page) = page(&out) {
        if page == out {
            let name = out.with_extension("csv");
            let message = "the page of the experiment has this name; --out names the CSV file beside it, as in";
            return Err(Error::Usage(format!("{}: {message} {}", out.display(), name.display())));
        }
        refuse_existing(&page)?;
    }
    if let Some(parent) = out.parent() {
        std::fs::create_dir_all(parent).map_err(Error::io(parent))?;
    }
    std::fs::File::create_new(&out).map_err(Error::io(&out))?;
    Ok(out)
}

fn print_table(plan: &ExperimentPlan, trials: &[ExperimentRow]) {
    println!(
        "recipe {}, {}, {}; {} of each; driven: {}, {} of a lap on each",
        plan.recipe.name,
        counted(plan.recipe.epochs as usize, "epoch"),
        counted(plan.recordings.len(), "recording"),
        counted(plan.seeds as usize, "training"),
        plan.tracks.join(", "),
        counted(plan.runs, "run")
    );
    println!("                       promised by validation |  delivered on the road");
    println!("variant          leak       MSE       MAE     |  fresh MAE   laps     autonomy       distance from line");
    let mut variants: Vec<&str> = trials.iter().map(|trial| trial.variant.as_str()).collect();
    variants.dedup();
    for variant in variants {
        let of: Vec<&ExperimentRow> = trials.iter().filter(|trial| trial.variant == variant).collect();
        let mean = |f: &dyn Fn(&ExperimentRow) -> f64| of.iter().map(|trial| f(trial)).sum::<f64>() / of.len() as f64;
        let present = |f: &dyn Fn(&ExperimentRow) -> Option<f64>| {
            of.iter().map(|trial| f(trial)).sum::<Option<f64>>().map(|sum| sum / of.len() as f64)
        };
        let low = of.iter().map(|trial| trial.autonomy_percent).fold(f64::INFINITY, f64::min);
        let high = of.iter().map(|trial| trial.autonomy_percent).fold(0.0, f64::max);
        let laps: usize = of.iter().map(|trial| trial.laps_completed).sum();
        let laps_total: usize = of.iter().map(|trial| trial.laps_total).sum();
        println!(
            "{variant:<15} {:>3.0} %  {:>8}  {:>6} deg  |  {:>5.2} deg {:>9}  {:>5.1} % ({low:.0} to {high:.0}) {:>8.2} m",
            mean(&|t| t.leak_percent),
            or_dash(present(&|t| t.val_center_mse), 5),
            or_dash(present(&|t| t.val_mae_deg), 2),
            mean(&|t| t.fresh_mae_deg),
            format!("{laps}/{laps_total}"),
            mean(&|t| t.autonomy_percent),
            mean(&|t| t.cte_mean_m),
        );
    }
    if plan.subject == Subject::Smooth {
        println!("variant           whiteness (worst)        reversals        change a frame, 95 %     lateral jerk");
        let mut variants: Vec<&str> = trials.iter().map(|trial| trial.variant.as_str()).collect();
        variants.dedup();
        for variant in variants {
            let of: Vec<&ExperimentRow> = trials.iter().filter(|trial| trial.variant == variant).collect();
            let mean = |f: &dyn Fn(&ExperimentRow) -> f64| of.iter().map(|t| f(t)).sum::<f64>() / of.len() as f64;
            println!(
                "{variant:<15} {:>5.1} deg/s ({:.1}) {:>12.1} a minute {:>16.2} deg {:>14.1} m/s³",
                mean(&|t| t.whiteness_deg_s),
                of.iter().map(|t| t.worst_whiteness_deg_s).fold(0.0, f64::max),
                mean(&|t| t.reversals_per_min),
                mean(&|t| t.angle_change_p95_deg),
                mean(&|t| t.lateral_jerk_rms_mps3),
            );
        }
        let expert = trials.iter().map(|t| t.expert_whiteness_deg_s).sum::<f64>() / trials.len() as f64;
        println!("the expert's whiteness there is {expert:.1} deg/s; the worst is that of a track and a training");
    }
    println!(
        "means over the trainings; in brackets the least and most. leak: validation frames with a training frame of the same\n\
         drive within 1 s. MSE, MAE: centre camera. fresh: frames of the driven tracks that no training has seen. laps and\n\
         distance from line: without help, up to the first failure. autonomy: NVIDIA's, 6 s for each time the car is put back."
    );
}
