//! `steersman drive`: closed-loop driving in the simulator.

mod donkeysim;
mod on_recording;
mod sweep;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::Args;
use serde::Serialize;

use super::arguments::{RecordingArgs, Throttle, camera_preset, load_pilot};
use super::process::{pool, stop_on_ctrl_c, stop_or_ok};
use super::terminal::{ShareBar, counted, print, print_json};
use super::video::tell_video;
use crate::dataset::held_out::trained_on_held_out;
use crate::error::{Error, Result};
use crate::files::limits::keep_elsewhere;
use crate::files::new_folder::NewFolder;
use crate::live::{DEFAULT_PORT, Hello, Live, Watch};
use crate::observer::StopSignal;
use crate::pilot::Pilot;
use crate::report::charts::map;
use crate::report::pages::sweep::Swept;
use crate::report::video::drive::DriveVideo;
use crate::report::video::onlooker::Onlooker;
use crate::report::video::painter::Captions;
use crate::simulator::trial::statistics::PairedTest;
use crate::simulator::trial::trajectory::write_trajectories;
use crate::simulator::{
    DriveOptions, DriveResult, DriveSummary, Leg, Speed, Track, Wheel, compare, drive_legs, drive_observed_as_far,
};
use donkeysim::DonkeyDriveArgs;
use on_recording::ReplayArgs;

/// Let a model drive in the simulator and measure how well
#[derive(Debug, Args)]
pub struct DriveArgs {
    /// Model file, or `expert`, or `zero` (never steers)
    pub(super) model: String,
    /// lake, mountain, coast, forest, random:SEED, or a track file
    #[arg(long, required_unless_present_any = ["on", "donkeysim"])]
    track: Option<String>,
    /// Drive on the pictures of a recording instead of a track: the nearest one, warped to where the car is
    #[arg(long, value_name = "RECORDING", conflicts_with = "track")]
    on: Option<PathBuf>,
    /// Camera and car of the recording, or on a track those with which the model drives: udacity, udacity-straight, steersman or
    /// donkeycar [default: by the recording's format; on a track steersman]
    #[arg(long, value_name = "PRESET")]
    camera: Option<String>,
    #[command(flatten)]
    reading: RecordingArgs,
    /// Laps of each run
    #[arg(long, default_value_t = 1)]
    pub(super) laps: usize,
    /// Speed to hold in mph, or `auto`: 30 mph, less in bends [default: 20]; with --throttle model the highest [default: 30]
    #[arg(long, value_name = "MPH|auto", value_parser = speed)]
    pub(super) speed: Option<Speed>,
    /// Who gives the throttle: a controller that holds --speed, or the model, by its output `throttle` or `speed`
    #[arg(long, value_enum, default_value_t = Throttle::Hold, conflicts_with = "on")]
    pub(super) throttle: Throttle,
    /// Runs, each with a seed of its own, counted from --seed [default: 10; with --donkeysim 1]
    #[arg(long)]
    pub(super) runs: Option<usize>,
    /// First seed; a seed draws start, direction, light, texture and noise
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Time from a picture to the wheels, ms; of several, as in 0,50,100,150,200, each is driven, and it is said where it breaks
    #[arg(long, default_value = "0", value_name = "MS,…", value_delimiter = ',')]
    latency_ms: Vec<f64>,
    /// Standard deviation of a disturbance of the steering; several are driven like several latencies
    #[arg(long, default_value = "0", value_name = "SHARE,…", value_delimiter = ',')]
    noise: Vec<f64>,
    /// A second model, `expert` or `zero`: drives the same seeds, and the difference is tested
    #[arg(long, value_name = "MODEL")]
    pub(super) against: Option<String>,
    /// Save the trajectories as csv files, and a map of them; the folder must not exist
    #[arg(long, value_name = "DIR")]
    pub(super) out: Option<PathBuf>,
    /// Show the runs, one after the other and in real time, on a page in a browser of this machine
    #[arg(long)]
    watch: bool,
    /// Port of the page; 0 takes any free one
    #[arg(long, default_value_t = DEFAULT_PORT, requires = "watch")]
    port: u16,
    /// Save a video of the first run, driven without help: H.264 in an .mp4 file, which must not exist
    #[arg(long, value_name = "FILE")]
    video: Option<PathBuf>,
    /// Colour in the video what excites the model
    #[arg(long, requires = "video")]
    saliency: bool,
    /// Pictures a second of the video [default: 20, as the driver sees them]
    #[arg(long, value_name = "N", requires = "video")]
    fps: Option<f64>,
    /// Threads; 0 is one for each core
    #[arg(long, default_value_t = 0)]
    pub(super) threads: usize,
    /// Print one JSON object as the last line
    #[arg(long)]
    pub(super) json: bool,
    #[command(flatten)]
    pub(super) donkeysim: DonkeyDriveArgs,
}

/// Runs of a drive on a track, unless another number is asked for.
const RUNS: usize = 10;

/// What `drive --json` prints.
#[derive(Serialize)]
struct Report<'a> {
    #[serde(flatten)]
    summary: &'a DriveSummary,
    /// The same of the second model.
    #[serde(skip_serializing_if = "Option::is_none")]
    against: Option<&'a DriveSummary>,
    /// A is the first model, B the second.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    comparison: Vec<PairedTest>,
}

pub fn run(args: DriveArgs) -> Result<()> {
    if args.donkeysim.is_given() {
        return donkeysim::run(&args);
    }
    let swept = match (args.latency_ms.len() > 1, args.noise.len() > 1) {
        (false, false) => None,
        (true, false) => Some((Swept::LatencyMs, &args.latency_ms)),
        (false, true) => Some((Swept::Noise, &args.noise)),
        (true, true) => {
            return Err(Error::Usage("several values of --latency-ms or of --noise are driven, not of both".into()));
        }
    };
    if swept.is_some() && (args.watch || args.video.is_some()) {
        let message = "several values of --latency-ms or --noise do not go with --watch or --video: give one";
        return Err(Error::Usage(message.into()));
    }
    if args.on.is_some() && swept.is_some() && (args.out.is_some() || args.against.is_some()) {
        let message = "several values of --latency-ms with --on do not go with --out or --against: give one";
        return Err(Error::Usage(message.into()));
    }
    if args.on.is_some() && args.noise != [0.0] {
        return Err(Error::Usage("--noise disturbs the steering on a track, not on a recording: leave it out".into()));
    }
    let track = match (&args.on, &args.track) {
        (None, Some(track)) => Arc::new(Track::load(track)?),
        (None, None) => return Err(Error::Usage("name a track with --track, or a recording with --on".into())),
        (Some(on), _) => {
            return on_recording::run(&ReplayArgs {
                model: &args.model,
                on,
                reading: &args.reading,
                against: args.against.as_deref(),
                out: args.out.as_deref(),
                watch: args.watch.then_some(args.port),
                video: args.video.as_deref(),
                saliency: args.saliency,
                fps: args.fps,
                camera: args.camera.as_deref(),
                latencies_ms: &args.latency_ms,
                threads: args.threads,
                json: args.json,
            });
        }
    };
    if args.camera.is_some() && (args.watch || args.video.is_some()) {
        return Err(Error::Usage(
            "--camera on a track goes neither with --watch nor with --video: leave it out".into(),
        ));
    }
    let options = args.options()?;
    options.check()?;
    if let Some((swept, values)) = swept {
        return sweep::run(&args, &track, &options, swept, values);
    }
    let at_wheel = args.wheel(&args.model)?;
    let against = args.against.as_deref().map(|name| args.wheel(name)).transpose()?;
    // What cannot be created is told before minutes are spent.
    let folder = args.out.as_deref().map(NewFolder::create).transpose()?;
    let then = args.against.as_ref().map_or(String::new(), |name| format!(", then {name}"));
    let hello = || Hello::new("watch", format!("at the wheel: {}{then}", args.model), &track);
    let live = args.watch.then(|| Live::start(args.port, hello(), false)).transpose()?;
    let video = args.video.as_deref().map(|path| begin_video(&at_wheel, path, &track, &args)).transpose()?;
    let stop = stop_on_ctrl_c()?;
    if let Some(live) = &live {
        eprintln!("open {} to watch", live.url());
    }
    let pool = pool(args.threads)?;
    let go =
        |wheel: &Wheel, name: &str| pool.install(|| drive_with(wheel, &track, &options, name, live.as_ref(), &stop));
    let (result, mut stopped) = go(&at_wheel, &args.model)?;
    let other = match (&against, &args.against) {
        (Some(wheel), Some(name)) if !stopped => match go(wheel, name) {
            Ok((other, false)) => Some(other),
            Ok((_, true)) | Err(Error::Interrupted) => {
                stopped = true;
                None
            }
            Err(error) => return Err(error),
        },
        _ => None,
    };
    if stopped {
        let driven = format!("{} of {}", result.trials.len(), counted(options.runs, "run"));
        let kept = args
            .out
            .as_ref()
            .map_or("add --out DIR to keep what was driven".into(), |out| format!("kept in {}", out.display()));
        eprintln!("stopped after {driven} of {}; {kept}", args.model);
    }
    if let Some(live) = live {
        let DriveSummary { laps_completed, laps_total, autonomy_percent, cte_mean_m, .. } = &result.summary;
        live.finish(&format!(
            "The drive of {} is {}: {laps_completed} of {laps_total} laps completed, autonomy {autonomy_percent:.1} %, on average \
             {cte_mean_m:.2} m off the middle.{}",
            args.model,
            if stopped { "stopped" } else { "over" },
            calm_words(&result.summary)
        ));
    }
    let comparison = other.as_ref().map_or(Ok(Vec::new()), |other| compare(&result, other))?;
    // What was measured is told even if it cannot be saved.
    let save = |folder: NewFolder| {
        map::write(&track, &result, &folder)?;
        write_trajectories(&result, folder)
    };
    let saved = folder.map_or(Ok(()), |folder| {
        save(folder).map_err(|cause| {
            let again = |other: &Path| save(NewFolder::create(&other.join("drive"))?);
            keep_elsewhere(cause, again, |other| format!("the drive is kept in {}", other.join("drive").display()))
        })
    });
    let film = |video: DriveVideo| film(&at_wheel, video, &track, &options, &args, &stop);
    if args.json {
        let against = other.as_ref().map(|other| &other.summary);
        // The JSON is the last line, so the video comes first; what it ends with must not hide what was measured.
        let filmed = video.map_or(Ok(()), film);
        print_json(&Report { summary: &result.summary, against, comparison })?;
        return saved.and(filmed).and(stop_or_ok(stopped));
    }
    let mut text = summary_text(&args.model, &result.summary);
    if let (Some(other), Some(name)) = (&other, &args.against) {
        text += &format!("\n{}", summary_text(name, &other.summary));
        text += &format!("\nA is {}, B is {name}; p: how often chance alone differs as much\n", args.model);
        for test in comparison {
            let verdict = if test.significant() { "more than chance" } else { "may be chance" };
            let PairedTest { measure, mean_a, mean_b, p_value } = &test;
            text += &format!("{measure:<45} A {mean_a:>8.3}  B {mean_b:>8.3}  p {p_value:.4}  {verdict}\n");
        }
    }
    print(&text)?;
    saved.and(video.map_or(Ok(()), film)).and(stop_or_ok(stopped))
}

impl DriveArgs {
    fn options(&self) -> Result<DriveOptions> {
        Ok(DriveOptions {
            laps: self.laps,
            runs: self.runs.unwrap_or(RUNS),
            seed: self.seed,
            speed: self.throttle.aimed_at(self.speed)?,
            latency_ms: first(&self.latency_ms),
            noise: first(&self.noise),
        })
    }

    /// Who is called `name`, and gives what `--throttle` asks for.
    pub(super) fn wheel(&self, name: &str) -> Result<Wheel> {
        let wheel = match name {
            "expert" => Wheel::Expert,
            "zero" => Wheel::Zero,
            path => Wheel::Model(Box::new(load_pilot(Path::new(path))?)),
        };
        if let Wheel::Model(pilot) = &wheel {
            self.throttle.check(pilot, name)?;
        }
        // On a recording the camera is the recording's.
        let camera = self.camera.as_deref().filter(|_| self.on.is_none());
        match (wheel, camera.map(camera_preset).transpose()?) {
            (Wheel::Model(pilot), Some(car)) => Ok(Wheel::InCar(pilot, car)),
            (wheel, _) => Ok(wheel),
        }
    }
}

/// The first of the values of an option, which has at least one.
fn first(values: &[f64]) -> f64 {
    values.first().copied().unwrap_or_default()
}

/// `20` or `auto`.
fn speed(text: &str) -> Result<Speed, String> {
    match text.parse() {
        _ if text == "auto" => Ok(Speed::Auto),
        Ok(mph) => Ok(Speed::Fixed(mph)),
        Err(_) => Err("a number of mph or `auto` is meant".into()),
    }
}

/// The video of the first run of `wheel`, begun.
fn begin_video(wheel: &Wheel, path: &Path, track: &Track, args: &DriveArgs) -> Result<DriveVideo> {
    let onlooker = match wheel {
        Wheel::Model(pilot) if args.saliency => Some(Onlooker::new(Pilot::clone(pilot), true)?),
        _ if args.saliency => {
            return Err(Error::Usage(format!("{} has no saliency; leave out --saliency", args.model)));
        }
        _ => None,
    };
    let names = Captions {
        title: format!("{}, seed {}", track.name(), args.seed),
        subtitle: args.model.clone(),
        model: Some(if matches!(wheel, Wheel::Model(_)) { "model" } else { "driver" }),
        reference: "expert",
    };
    DriveVideo::create(path, track, names, args.fps, onlooker)
}

/// Lets `wheel` drive the first run again before the camera.
fn film(
    wheel: &Wheel,
    video: DriveVideo,
    track: &Track,
    options: &DriveOptions,
    args: &DriveArgs,
    stop: &StopSignal,
) -> Result<()> {
    let mut bar = ShareBar::new("filming", stop);
    let mut driver = wheel.driver();
    let (summary, stopped) =
        video.film(track, driver.as_mut(), &options.trial_options(false), options.seed, &mut bar)?;
    drop(bar);
    if let Some(path) = &args.video {
        tell_video(path, &summary);
    }
    stop_or_ok(stopped)
}

/// Lets `wheel`, called `name`, drive, as far as nobody stops it: on all ranks, or one run after the other where somebody watches. Also
/// whether it was stopped.
fn drive_with(
    wheel: &Wheel,
    track: &Arc<Track>,
    options: &DriveOptions,
    name: &str,
    live: Option<&Live>,
    stop: &StopSignal,
) -> Result<(DriveResult, bool)> {
    let Some(live) = live else {
        let mut bar = ShareBar::new(format!("{name} on {}", track.name()), stop);
        let leg = Leg { track: track.clone(), options: options.clone() };
        let (results, stopped) = drive_legs(wheel, vec![leg], false, &mut bar)?;
        let driven = results.into_iter().find_map(|result| result.drive).ok_or(Error::Interrupted)?;
        return Ok((driven, stopped));
    };
    let mut watch = Watch::new(live, name, wheel.pilot(), options.runs, stop);
    let (mut result, stopped) = drive_observed_as_far(track, || Ok(wheel.driver()), options, &mut watch)?;
    result.summary.trained_on_held_out = wheel.trained_on_held_out().to_vec();
    Ok((result, stopped))
}

fn summary_text(model: &str, s: &DriveSummary) -> String {
    let held_out = if s.held_out { " (held out)" } else { "" };
    let note = match s.trained_on_held_out.is_empty() {
        true => String::new(),
        false => format!("note: {model} was {}\n", trained_on_held_out(&s.trained_on_held_out)),
    };
    let (low, high) = (100.0 * s.completed_low, 100.0 * s.completed_high);
    format!(
        "{model} on {}{held_out}, {}\n{note}\
         laps completed             {}/{} (whole runs: {low:.0} to {high:.0} %, 95 %)\n\
         autonomy                   {:.1} %\n\
         interventions              {} ({:.2} a km)\n\
         distance driven            {:.0} m\n\
         cross-track mean/RMS/p95   {:.2} / {:.2} / {:.2} m\n\
         off the road               {:.1} s\n\
         crashes                    {}\n\
         mean speed                 {:.1} mph\n\
         whiteness                  {:.1} deg/s (expert {:.1})\n{}\
         real-time factor           {:.1}\n",
        s.track,
        counted(s.runs, "run"),
        s.laps_completed,
        s.laps_total,
        s.autonomy_percent,
        s.interventions,
        s.interventions_per_km,
        s.distance_m,
        s.cte_mean_m,
        s.cte_rms_m,
        s.cte_p95_m,
        s.off_road_s,
        s.crashes,
        s.mean_speed_mph,
        s.whiteness_deg_s,
        s.expert_whiteness_deg_s,
        calm_text(s),
        s.realtime_factor
    )
}

/// How calm the wheel was, in a sentence.
fn calm_words(s: &DriveSummary) -> String {
    let (Some(calm), Some(expert)) = (&s.calm, &s.expert_calm) else { return String::new() };
    format!(
        " The wheel turned back {:.1} times a minute (the expert's {:.1}), and its whiteness was {:.1} deg/s ({:.1}).",
        calm.reversals_per_min, expert.reversals_per_min, s.whiteness_deg_s, s.expert_whiteness_deg_s
    )
}

/// The measures of calm beside the expert's, a line each.
fn calm_text(s: &DriveSummary) -> String {
    let (Some(calm), Some(expert)) = (&s.calm, &s.expert_calm) else { return String::new() };
    format!(
        "wheel reversals            {:.1} a minute (expert {:.1})\n\
         angle's change, 95 %       {:.2} deg a frame (expert {:.2})\n\
         lateral jerk, RMS          {:.1} m/s³ (expert {:.1})\n",
        calm.reversals_per_min,
        expert.reversals_per_min,
        calm.angle_change_p95_deg,
        expert.angle_change_p95_deg,
        calm.lateral_jerk_rms_mps3,
        expert.lateral_jerk_rms_mps3
    )
}
