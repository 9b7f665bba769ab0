//! `steersman record`: the expert drives, or a person, and the cameras watch.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};

use super::arguments::camera_preset;
use super::process::{pool, stop_on_ctrl_c};
use super::terminal::{ShareBar, print_json};
use crate::error::Result;
use crate::live::{DEFAULT_PORT, ManualDrive, Shares};
use crate::simulator::car::expert::Style;
use crate::simulator::recorder::options::{RECORD_HZ, RecordingInfo};
use crate::simulator::{LogFormat, RecordOptions, Track, record};

/// Record the expert driver in the simulator, or with --manual your own driving, in the format of Udacity's simulator
#[derive(Debug, Args)]
pub struct RecordArgs {
    /// lake, mountain, coast, forest, random:SEED, or a track file
    #[arg(long)]
    track: String,
    /// Drive yourself, with keyboard, mouse or gamepad, on a page in a browser of this machine; Ctrl-C ends and saves
    #[arg(long, conflicts_with_all = ["laps", "recovery", "style", "noise", "threads", "slower_in_bends", "camera", "label_ahead"])]
    manual: bool,
    /// Port of the page, on this machine only; 0 takes any free one
    #[arg(long, default_value_t = DEFAULT_PORT, requires = "manual")]
    port: u16,
    /// Laps to drive; with --recovery laps along which the car is put off its line
    #[arg(long, default_value_t = 1.0)]
    laps: f64,
    /// Drive the other way round
    #[arg(long)]
    reverse: bool,
    /// Put the car off its line again and again, and record only the ways back
    #[arg(long)]
    recovery: bool,
    /// How the expert moves the wheel
    #[arg(long, value_enum, default_value_t = WheelStyle::Smooth)]
    style: WheelStyle,
    /// Draws where the drive begins, its light and its texture
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Speed to hold, mph, on the full-size track also with --camera donkeycar; with --manual the highest
    #[arg(long, default_value_t = 20.0, value_name = "MPH")]
    speed: f64,
    /// Drive slower than --speed before and in bends, so that the car is pushed sideways by at most MPS2, m/s² [default: 2.5]
    #[arg(long, value_name = "MPS2", num_args = 0..=1, require_equals = true, default_missing_value = "2.5")]
    slower_in_bends: Option<f64>,
    /// Label with the steering towards the point of the line METRES ahead (3 to 30) instead of what the expert steers: smaller from farther
    /// away, so that a model's errors about its place move the wheel less; no driven path can be reckoned from such labels
    #[arg(long, value_name = "METRES")]
    label_ahead: Option<f64>,
    /// Standard deviation of a disturbance of the steering that the labels do not show
    #[arg(long, default_value_t = 0.0)]
    noise: f64,
    /// Rows of the log for each second: 1, 2, 5, 10, 25 or 50
    #[arg(long, default_value_t = RECORD_HZ, value_name = "ROWS")]
    hz: u64,
    /// How the log is written
    #[arg(long, value_enum, default_value_t = Format::Sample)]
    format: Format,
    /// Camera and car to record as: steersman, udacity, udacity-straight, or donkeycar, a small car that drives on a model of the track
    /// [default: steersman]
    #[arg(long, value_name = "PRESET")]
    camera: Option<String>,
    /// Folder of the recording; must not exist
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Threads; 0 is one for each core
    #[arg(long, default_value_t = 0)]
    threads: usize,
    /// Print one JSON object as the last line
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum WheelStyle {
    /// Small steady movements
    Smooth,
    /// Through two keys: labels are often zero, with spikes between
    Keyboard,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Format {
    /// As Udacity's sample data: with header, paths relative to the log
    Sample,
    /// As version 2 of Udacity's simulator: without header, absolute paths
    V2,
}

pub fn run(args: RecordArgs) -> Result<()> {
    let track = Track::load(&args.track)?;
    let options = RecordOptions {
        car: args.camera.as_deref().map(camera_preset).transpose()?,
        laps: args.laps,
        reverse: args.reverse,
        recovery: args.recovery,
        style: match args.style {
            WheelStyle::Smooth => Style::Smooth,
            WheelStyle::Keyboard => Style::Keyboard,
        },
        seed: args.seed,
        speed_mph: args.speed,
        bends_mps2: args.slower_in_bends,
        label_ahead_m: args.label_ahead,
        noise: args.noise,
        hz: args.hz,
        format: match args.format {
            Format::Sample => LogFormat::Sample,
            Format::V2 => LogFormat::V2,
        },
    };
    if args.manual {
        return drive_by_hand(&args, &track, &options);
    }
    let stop = stop_on_ctrl_c()?;
    let mut bar = ShareBar::new(format!("recording {}", track.name()), &stop);
    let info = pool(args.threads)?.install(|| record(&track, &options, &args.out, &mut bar))?;
    drop(bar);
    if args.json {
        return print_json(&info);
    }
    print_rows(&info, &args.out);
    Ok(())
}

fn print_rows(info: &RecordingInfo, folder: &Path) {
    let held_out = if info.held_out { ", a track that training must not see" } else { "" };
    println!("{} rows of {}{held_out} in {}", info.rows, info.track, folder.display());
}

/// `record --manual`.
fn drive_by_hand(args: &RecordArgs, track: &Track, options: &RecordOptions) -> Result<()> {
    let drive = ManualDrive::prepare(track, options, &args.out, args.port)?;
    let stop = stop_on_ctrl_c()?;
    eprintln!("open {} to drive; Ctrl-C, or the button there, ends the drive and saves it", drive.url());
    let summary = drive.run(&stop)?;
    if args.json {
        return print_json(&summary);
    }
    let Some(folder) = &summary.folder else {
        println!("nothing was recorded, so there is no {}", args.out.display());
        return Ok(());
    };
    print_rows(&summary.info, folder);
    let Shares { minutes, laps, left, right, recovery, .. } = summary.coverage;
    let [left, straight, right, recovery] =
        [left, 1.0 - left - right, right, recovery].map(|share| format!("{:.0} %", 100.0 * share));
    println!(
        "{minutes:.1} minutes, {laps:.1} laps; {left} left, {straight} straight, {right} right; {recovery} ways back"
    );
    println!("for the next recording:");
    for advice in &summary.advice {
        println!("  {advice}");
    }
    Ok(())
}
