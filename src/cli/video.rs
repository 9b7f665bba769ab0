//! `steersman video`: recordings and drives as video files.

use std::path::{Path, PathBuf};

use clap::Args;
use serde::Serialize;

use super::arguments::{RecordingArgs, load_pilot};
use super::process::stop_on_ctrl_c;
use super::terminal::{ShareBar, print_json};
use crate::error::{Error, Result};
use crate::report::video::onlooker::Onlooker;
use crate::report::video::recording;
use crate::report::video::replay::{self, RunChoice};
use crate::report::video::summary::VideoSummary;
use crate::simulator::trial::trajectory::{RUN_DEPTH, find_drives, is_drive};

/// Write a recording or a saved drive as a video that browsers and VLC play
#[derive(Debug, Args)]
pub struct VideoArgs {
    /// A recording, or a folder that `drive --out` wrote
    #[arg(value_name = "RECORDING|DRIVE")]
    source: PathBuf,
    /// Where to write: H.264 in an .mp4 file, which must not exist
    file: PathBuf,
    /// A model whose steering is shown too
    #[arg(long)]
    model: Option<PathBuf>,
    /// Colour what excites the model
    #[arg(long, requires = "model")]
    saliency: bool,
    /// Pictures a second [default: as recorded, 20 for a drive]
    #[arg(long, value_name = "N")]
    fps: Option<f64>,
    /// The run of a drive with this seed [default: the first]
    #[arg(long)]
    seed: Option<u64>,
    /// The run of a drive in which the car was put back where it went astray
    #[arg(long)]
    assisted: bool,
    #[command(flatten)]
    reading: RecordingArgs,
    /// Print one JSON object as the last line
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Answer<'a> {
    file: &'a Path,
    #[serde(flatten)]
    summary: VideoSummary,
}

pub fn run(args: VideoArgs) -> Result<()> {
    let onlooker = match &args.model {
        Some(model) => Some(Onlooker::new(load_pilot(model)?, args.saliency)?),
        None => None,
    };
    let is_drive = is_drive(&args.source);
    let below = if is_drive { Vec::new() } else { find_drives(&args.source, RUN_DEPTH) };
    if !below.is_empty() {
        let names: Vec<String> = below.iter().map(|path| path.display().to_string()).collect();
        let message = format!("holds drives and is none itself; name one of {}", names.join(", "));
        return Err(Error::Usage(format!("{} {message}", args.source.display())));
    }
    if !is_drive && (args.seed.is_some() || args.assisted) {
        let message = "is no folder of `drive --out`, so there is no run to choose; leave out --seed and --assisted";
        return Err(Error::Usage(format!("{} {message}", args.source.display())));
    }
    let stop = stop_on_ctrl_c()?;
    let mut bar = ShareBar::new("filming", &stop);
    let (summary, stopped) = if is_drive {
        let choice = RunChoice { seed: args.seed, assisted: args.assisted };
        replay::film(&args.source, choice, &args.file, onlooker, args.fps, &mut bar)?
    } else {
        recording::film(&args.reading.load(&args.source)?, &args.file, onlooker, args.fps, &mut bar)?
    };
    drop(bar);
    if args.json {
        print_json(&Answer { file: &args.file, summary })?;
    } else {
        tell_video(&args.file, &summary);
    }
    if stopped { Err(Error::Interrupted) } else { Ok(()) }
}

/// Says on standard error what was written.
pub(super) fn tell_video(path: &Path, summary: &VideoSummary) {
    let VideoSummary { frames, fps, seconds, bytes, unreadable } = summary;
    let megabytes = *bytes as f64 / 1e6;
    eprintln!("wrote {}: {seconds:.1} s, {frames} pictures at {fps:.4} a second, {megabytes:.1} MB", path.display());
    if *unreadable > 0 {
        eprintln!("note: {unreadable} pictures are missing or cannot be read; `steersman inspect` names them");
    }
}
