//! `steersman sim`: the built-in simulator as the client of a driving server.

mod donkeysim;

use std::path::{Path, PathBuf};

use clap::Args;
use serde::Serialize;

use super::process::stop_on_ctrl_c;
use super::terminal::{ShareBar, or_dash, print_json};
use crate::error::{Error, Result};
use crate::files::atomic_file;
use crate::files::limits::keep_elsewhere;
use crate::files::new_folder::create_now;
use crate::observer::Observer;
use crate::simulator::Track;
use crate::simulator::trial::outcome::{Failure, line_errors_m};
use crate::simulator::trial::trajectory::trajectory_csv;
use crate::simulator_client::{ClientEvent, ClientOptions, ClientReport, ServerUrl, TimeMode, drive};
use crate::statistics::quantile;
use crate::udacity::{DecimalMark, NumberStyle};
use donkeysim::{DonkeySimArgs, Role};

/// Put the built-in simulator in the place of Udacity's: it connects to a driving server, as `serve` is one; or of DonkeySim
#[derive(Debug, Args)]
pub struct SimArgs {
    /// Be another simulator than Udacity's
    #[arg(long = "as", value_enum, value_name = "NAME", conflicts_with = "connect")]
    role: Option<Role>,
    #[command(flatten)]
    donkeysim: DonkeySimArgs,
    /// The server; a path may be left out
    #[arg(
        long,
        value_name = "URL",
        num_args = 0..=1,
        default_value = ServerUrl::DEFAULT,
        default_missing_value = ServerUrl::DEFAULT
    )]
    connect: ServerUrl,
    /// lake, mountain, coast, forest, random:SEED, or a track file
    #[arg(long)]
    track: String,
    /// Draws start, direction, light and texture, as in `drive`
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Laps to drive
    #[arg(long, default_value_t = 1)]
    laps: usize,
    /// Speed at the start in mph; `drive` starts at the speed it is to hold, Udacity's simulator at 0
    #[arg(long, default_value_t = 20.0, value_name = "MPH")]
    start_mph: f64,
    /// Simulated time waits for each reply, 20 frames a second, so that a lap is the one of `drive` with the same seed
    #[arg(long, conflicts_with = "fps")]
    lockstep: bool,
    /// Frames for each second of the clock, without --lockstep
    #[arg(long, default_value_t = 60.0)]
    fps: f64,
    /// Write and read numbers as a machine with a decimal comma does
    #[arg(long)]
    decimal_comma: bool,
    /// Be a simulator of the second term: telemetry with `cte`, numbers in commands
    #[arg(long, conflicts_with = "decimal_comma")]
    term2: bool,
    /// Somebody holds W and steers from one second to another, as in 5:8
    #[arg(long, value_name = "FROM:TO", value_parser = interval)]
    manual: Option<(f64, f64)>,
    /// Somebody takes the wheel whenever the car is more than 0.6 m beside the middle, and gives it back at 0.2 m; unlike Udacity's
    /// simulator this one goes on to send pictures, so that `serve --record` records the correction
    #[arg(long)]
    correct: bool,
    /// Second at which the scene is left without a word to the server, and entered again
    #[arg(long, value_name = "SECOND")]
    scene_change: Option<f64>,
    /// Stop after so many telemetries were answered
    #[arg(long, value_name = "N")]
    frames: Option<u64>,
    /// Longest time without a reply, in seconds
    #[arg(long, default_value_t = 30.0, value_name = "SECONDS")]
    patience: f64,
    /// Save the trajectory as free_SEED.csv, as `drive` does; the folder must not exist
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Print one JSON object as the last line
    #[arg(long)]
    json: bool,
}

/// What `sim --json` prints.
#[derive(Serialize)]
struct Summary {
    track: String,
    seed: u64,
    lockstep: bool,
    laps_completed: usize,
    laps_total: usize,
    failure: Option<Failure>,
    distance_m: f64,
    /// Simulated time, s.
    time_s: f64,
    cte_mean_m: f64,
    cte_rms_m: f64,
    cte_p95_m: f64,
    cte_max_m: f64,
    off_road_s: f64,
    mean_speed_mph: f64,
    whiteness_deg_s: f64,
    frames: u64,
    telemetries: u64,
    manual_telemetries: u64,
    corrected_telemetries: u64,
    commands: u64,
    manuals: u64,
    questions: u64,
    tokens_lost: u64,
    connections: u64,
    /// Commands for each second of the clock.
    commands_per_s: f64,
    round_trip_ms_p50: Option<f64>,
    round_trip_ms_p99: Option<f64>,
    round_trip_ms_max: Option<f64>,
}

impl Summary {
    fn new(args: &SimArgs, track: &Track, report: &ClientReport) -> Summary {
        let ClientReport { run, round_trips_ms, .. } = report;
        let [cte_mean_m, cte_rms_m, cte_p95_m] = line_errors_m(run.moments.iter());
        let round_trip = |q| (!round_trips_ms.is_empty()).then(|| quantile(round_trips_ms, q));
        Summary {
            track: track.name().to_string(),
            seed: args.seed,
            lockstep: args.lockstep,
            laps_completed: run.laps_completed,
            laps_total: args.laps,
            failure: run.failure,
            distance_m: run.distance_m,
            time_s: run.time_s,
            cte_mean_m,
            cte_rms_m,
            cte_p95_m,
            cte_max_m: run.worst_cte_m,
            off_road_s: run.off_road_s,
            mean_speed_mph: run.mean_speed_mph(),
            whiteness_deg_s: run.whiteness_deg_s(),
            frames: report.frames,
            telemetries: report.telemetries,
            manual_telemetries: report.manual_telemetries,
            corrected_telemetries: report.corrected_telemetries,
            commands: report.commands,
            manuals: report.manuals,
            questions: report.questions,
            tokens_lost: report.tokens_lost,
            connections: report.connections,
            commands_per_s: report.commands as f64 / report.wall_s.max(1e-9),
            round_trip_ms_p50: round_trip(0.5),
            round_trip_ms_p99: round_trip(0.99),
            round_trip_ms_max: round_trip(1.0),
        }
    }

    fn print(&self) {
        println!("{} with seed {}{}", self.track, self.seed, if self.lockstep { ", in lockstep" } else { "" });
        let failure = match self.failure {
            None => "",
            Some(Failure::Crash) => ", then hit a wall",
            Some(Failure::LeftRoad) => ", then left the road",
            Some(Failure::StoodStill) => ", then stood still",
            Some(Failure::Disqualified) => ", then was disqualified",
        };
        println!("laps completed             {}/{}{failure}", self.laps_completed, self.laps_total);
        println!("distance driven            {:.0} m in {:.1} s", self.distance_m, self.time_s);
        let [mean, rms, p95, max] = [self.cte_mean_m, self.cte_rms_m, self.cte_p95_m, self.cte_max_m];
        println!("cross-track mean/RMS/p95   {mean:.2} / {rms:.2} / {p95:.2} m, at most {max:.2} m");
        println!("off the road               {:.1} s", self.off_road_s);
        println!("mean speed                 {:.1} mph", self.mean_speed_mph);
        println!("whiteness                  {:.1} deg/s", self.whiteness_deg_s);
        println!(
            "telemetry                  {} with picture, {} of them while corrected; {} without while driven by hand",
            self.telemetries, self.corrected_telemetries, self.manual_telemetries
        );
        println!(
            "replies                    {} commands ({:.1}/s), {} `manual`, {} unreadable; {} questions",
            self.commands, self.commands_per_s, self.manuals, self.tokens_lost, self.questions
        );
        let [p50, p99, max] =
            [self.round_trip_ms_p50, self.round_trip_ms_p99, self.round_trip_ms_max].map(|ms| or_dash(ms, 2));
        println!("round trip p50/p99/max     {p50} / {p99} / {max} ms");
        println!("connections                {}", self.connections);
    }
}

pub fn run(args: SimArgs) -> Result<()> {
    let track = Track::load(&args.track)?;
    if let Some(Role::Donkeysim) = args.role {
        return donkeysim::run(&args.donkeysim, &track, args.seed);
    }
    if let Some(out) = args.out.as_deref().filter(|out| out.exists()) {
        let message = format!("{}: exists already and is not overwritten; name a new folder", out.display());
        return Err(Error::Usage(message));
    }
    let options = ClientOptions {
        url: args.connect.clone(),
        laps: args.laps,
        seed: args.seed,
        start_mph: args.start_mph,
        time_mode: if args.lockstep { TimeMode::Lockstep } else { TimeMode::RealTime { fps: args.fps } },
        numbers: match (args.term2, args.decimal_comma) {
            (true, _) => NumberStyle::Json,
            (_, true) => NumberStyle::Strings(DecimalMark::COMMA),
            _ => NumberStyle::Strings(DecimalMark::DOT),
        },
        manual_s: args.manual,
        correct: args.correct,
        scene_change_s: args.scene_change,
        frames: args.frames,
        patience_s: args.patience,
    };
    let mut bar = ShareBar::new(format!("driving {}", track.name()), &stop_on_ctrl_c()?);
    let mut observer = |event| match event {
        ClientEvent::Notice(text) => {
            bar.print(&text);
            Ok(())
        }
        ClientEvent::Progress(progress) => bar.observe(progress),
    };
    let report = drive(&track, &options, &mut observer)?;
    drop(bar);
    if let Some(out) = &args.out {
        let save = |folder: &Path| {
            let name = format!("free_{}.csv", args.seed);
            atomic_file::write(&folder.join(name), trajectory_csv(&report.run).as_bytes())
        };
        create_now(out).and_then(|()| save(out)).map_err(|cause| {
            keep_elsewhere(cause, save, |folder| format!("the trajectory is kept in {}", folder.display()))
        })?;
    }
    let summary = Summary::new(&args, &track, &report);
    if args.json {
        return print_json(&summary);
    }
    summary.print();
    Ok(())
}

/// `FROM:TO`, in seconds.
fn interval(text: &str) -> Result<(f64, f64), String> {
    let parts = text.split_once(':').and_then(|(from, to)| Some((from.parse().ok()?, to.parse().ok()?)));
    parts.ok_or_else(|| "two times in seconds are meant, as in 5:8".into())
}
