//! `steersman drive --on RECORDING`: closed-loop driving on recorded pictures.

use std::path::{Path, PathBuf};
use std::time::Instant;

use serde::Serialize;

use super::model_arg::model_file;
use super::recording_args::RecordingArgs;
use super::share_bar::ShareBar;
use super::{load_pilot, pool, print, print_json, stop_on_ctrl_c};
use crate::error::{Error, Result};
use crate::files::atomic_file;
use crate::files::new_folder::NewFolder;
use crate::geometry::GeometryEntry;
use crate::observer::{StopSignal, Tally};
use crate::picture::RgbImage;
use crate::replay::{
    ReplayLog, ReplayOptions, ReplayRun, ReplaySummary, WarpCheck, moments_csv, replay, side_camera_check, summarise,
};

/// What `drive` was asked for, as far as it concerns recordings.
pub struct ReplayArgs<'a> {
    /// Model file, or `zero`.
    pub model: &'a str,
    /// The recording.
    pub on: &'a Path,
    /// How it is read.
    pub reading: &'a RecordingArgs,
    /// A second model.
    pub against: Option<&'a str>,
    /// Folder for the trajectories.
    pub out: Option<&'a Path>,
    /// Name of a camera preset.
    pub camera: Option<&'a str>,
    /// Time from a picture to the wheels, ms.
    pub latency_ms: f64,
    /// Threads; 0 is one for each core.
    pub threads: usize,
    /// Print JSON.
    pub json: bool,
}

/// What `drive --on RECORDING --json` prints.
#[derive(Serialize)]
struct Report<'a> {
    recording: &'a Path,
    #[serde(flatten)]
    summary: &'a ReplaySummary,
    /// Speed that was assumed because the recording says none, m/s.
    #[serde(skip_serializing_if = "Option::is_none")]
    assumed_speed_mps: Option<f64>,
    /// How far the warped views can be trusted; absent without side cameras.
    #[serde(skip_serializing_if = "Option::is_none")]
    warp: Option<&'a WarpCheck>,
    /// The second model.
    #[serde(skip_serializing_if = "Option::is_none")]
    against: Option<&'a ReplaySummary>,
}

pub fn run(args: &ReplayArgs) -> Result<()> {
    let pool = pool(args.threads)?;
    // A model that is none is told before the recording is read.
    let models =
        [Some(args.model), args.against].into_iter().flatten().filter(|name| !matches!(*name, "zero" | "expert"));
    models.map(|name| model_file(Path::new(name))).collect::<Result<Vec<_>>>()?;
    let recording = pool.install(|| args.reading.load(args.on))?;
    recording.require_usable()?;
    let geometry = match args.camera {
        Some(name) => GeometryEntry { preset: Some(name.into()), ..GeometryEntry::default() }.resolve(name)?,
        None => {
            recording.camera_notice().iter().for_each(|notice| eprintln!("{notice}"));
            recording.geometry.clone()
        }
    };
    let log = ReplayLog::new(&recording, geometry)?;
    let options = ReplayOptions { latency_ms: args.latency_ms, ..ReplayOptions::usual(&log.geometry) };
    let folder = args.out.map(NewFolder::create).transpose()?;
    let stop = stop_on_ctrl_c()?;
    let go = |name: &str| -> Result<(Vec<ReplayRun>, ReplaySummary)> {
        let began = Instant::now();
        let runs = pool.install(|| drive_on(&log, &options, name, &stop))?;
        let summary = summarise(&runs, began.elapsed().as_secs_f64());
        Ok((runs, summary))
    };
    let (runs, summary) = go(args.model)?;
    let against = args.against.map(go).transpose()?.map(|(_, summary)| summary);
    let warp = pool.install(|| side_camera_check(&log))?;
    if let Some(folder) = folder {
        write_runs(&runs, &summary, folder)?;
    }
    if args.json {
        let (assumed_speed_mps, warp, against) = (log.assumed_speed_mps, warp.as_ref(), against.as_ref());
        return print_json(&Report { recording: args.on, summary: &summary, assumed_speed_mps, warp, against });
    }
    let mut text = summary_text(args.model, &summary);
    if let (Some(name), Some(summary)) = (args.against, &against) {
        text += &format!("\n{}", summary_text(name, summary));
    }
    if let Some(mps) = log.assumed_speed_mps {
        text += &format!("note: the recording says no speed; {mps:.1} m/s was assumed\n");
    }
    text += &warp.map_or("note: without side cameras the warped views cannot be checked\n".into(), warp_text);
    print(&text)
}

/// Drives along all sessions with the model of file `name`, or with `zero`.
fn drive_on(log: &ReplayLog, options: &ReplayOptions, name: &str, stop: &StopSignal) -> Result<Vec<ReplayRun>> {
    let pilot = match name {
        "zero" => None,
        "expert" => {
            return Err(Error::Usage(
                "no expert drives on a recording: it would follow the path that is the measure; name a model or `zero`"
                    .into(),
            ));
        }
        path => Some(load_pilot(Path::new(path))?),
    };
    let mut bar = ShareBar::new(format!("{name} on the recording"), stop);
    let meters = log.sessions.iter().map(|session| session.path.length_m() as usize + 1).sum();
    let tally = Tally::new(meters, &mut bar);
    let reached: Vec<_> = log.sessions.iter().map(|_| std::sync::atomic::AtomicUsize::new(0)).collect();
    replay(
        log,
        options,
        || {
            let mut pilot = pilot.clone();
            Ok(move |view: &RgbImage| match &mut pilot {
                Some(pilot) => pilot.steer(view.view()),
                None => Ok(0.0),
            })
        },
        &|session, frame| {
            let along = frame.moment.along_m as usize;
            let before = reached[session].swap(along, std::sync::atomic::Ordering::Relaxed);
            tally.add(along.saturating_sub(before))
        },
    )
}

/// Writes `session_N.csv` for each session and `summary.json`.
fn write_runs(runs: &[ReplayRun], summary: &ReplaySummary, folder: NewFolder) -> Result<()> {
    let write = |name: &str, bytes: &[u8]| -> Result<()> {
        let path: PathBuf = folder.unfinished().join(name);
        atomic_file::write(&path, bytes).map_err(|error| folder.explain(error))
    };
    for (number, run) in runs.iter().enumerate() {
        write(&format!("session_{}.csv", number + 1), moments_csv(run).as_bytes())?;
    }
    let text = serde_json::to_string_pretty(summary).map_err(|e| Error::data("summary.json", e.to_string()))?;
    write("summary.json", (text + "\n").as_bytes())?;
    folder.finish()
}

fn summary_text(model: &str, s: &ReplaySummary) -> String {
    let sessions = if s.sessions == 1 { "1 session".into() } else { format!("{} sessions", s.sessions) };
    format!(
        "{model} on the recording, {sessions}\n\
         autonomy                   {:.1} %\n\
         interventions              {} ({:.2} a km)\n\
         distance driven            {:.0} m in {:.0} s\n\
         off the path mean/RMS/p95  {:.2} / {:.2} / {:.2} m\n\
         whiteness                  {:.1} deg/s\n\
         frames                     {} ({:.0} a second)\n",
        s.autonomy_percent,
        s.interventions,
        s.interventions_per_km,
        s.distance_m,
        s.time_s,
        s.offset_mean_m,
        s.offset_rms_m,
        s.offset_p95_m,
        s.whiteness_deg_s,
        s.frames,
        s.frames_per_second
    )
}

fn warp_text(check: WarpCheck) -> String {
    let verdict = if check.ratio() <= 0.5 { "can be trusted" } else { "are only a rough guess" };
    format!(
        "warped views {verdict}: they predict the side cameras to {:.1} grey levels, the picture as it is to {:.1} ({} rows looked \
         at, {} of them doubtful)\n",
        check.warped, check.unwarped, check.rows, check.doubtful
    )
}
