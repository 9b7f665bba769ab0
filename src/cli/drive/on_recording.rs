//! `steersman drive --on RECORDING`: closed-loop driving on recorded pictures.

use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use serde::Serialize;

use super::sweep::ascending;
use crate::calm::Calm;
use crate::cli::arguments::{RecordingArgs, load_pilot, model_file, refuse_existing};
use crate::cli::process::{end_with, pool, stop_on_ctrl_c, stop_or_ok};
use crate::cli::terminal::{ShareBar, print, print_json, right_aligned};
use crate::cli::video::tell_video;
use crate::error::{Error, Result};
use crate::files::new_folder::NewFolder;
use crate::geometry::GeometryEntry;
use crate::live::{Hello, Live, WatchRecording};
use crate::observer::{StopSignal, Tally};
use crate::picture::RgbImage;
use crate::pilot::Pilot;
use crate::replay::{
    ReplayFrame, ReplayLog, ReplayOptions, ReplayRun, ReplaySummary, WarpCheck, replay_as_far, side_camera_check,
    summarise,
};
use crate::report;
use crate::report::pages::sweep::Swept;
use crate::report::video::on_recording::ReplayVideo;
use crate::report::video::onlooker::Onlooker;

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
    /// Folder for the trajectories and maps.
    pub out: Option<&'a Path>,
    /// Port of the page that shows the drive.
    pub watch: Option<u16>,
    /// Video of the first session.
    pub video: Option<&'a Path>,
    /// Colour in it what excites the model.
    pub saliency: bool,
    /// Pictures a second of it.
    pub fps: Option<f64>,
    /// Name of a camera preset.
    pub camera: Option<&'a str>,
    /// Times from a picture to the wheels, ms; several are driven one after the other.
    pub latencies_ms: &'a [f64],
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
    if args.latencies_ms.len() > 1 {
        return sweep(args, &log, &pool);
    }
    let latency_ms = args.latencies_ms.first().copied().unwrap_or_default();
    let options = ReplayOptions { latency_ms, ..ReplayOptions::usual(&log.geometry) };
    let at_wheel = Wheel::find(args.model)?;
    let other = args.against.map(|name| Wheel::find(name).map(|wheel| (name, wheel))).transpose()?;
    if let Some(video) = args.video {
        refuse_existing(video)?;
    }
    let folder = args.out.map(NewFolder::create).transpose()?;
    let hello = || Hello::on_recording(format!("at the wheel: {}", args.model), &log);
    let live = args.watch.map(|port| Live::start(port, hello(), false)).transpose()?;
    let stop = stop_on_ctrl_c()?;
    if let Some(live) = &live {
        eprintln!("open {} to watch", live.url());
    }
    let drive = Drive { log: &log, options: &options, stop: &stop };
    let began = Instant::now();
    let (runs, mut stopped) = pool.install(|| match &live {
        Some(live) => drive.watched(&at_wheel, args.model, live),
        None => drive.go(&at_wheel, args.model),
    })?;
    let summary = summarise(&runs, began.elapsed().as_secs_f64());
    if let Some(live) = live {
        let ReplaySummary { autonomy_percent, interventions, offset_mean_m, .. } = summary;
        live.finish(&format!(
            "The drive of {} is {}: autonomy {autonomy_percent:.1} %, put back {interventions} times, on average \
             {offset_mean_m:.2} m from the path.",
            args.model,
            if stopped { "stopped" } else { "over" }
        ));
    }
    if stopped {
        let kept =
            args.out.map_or("add --out DIR to keep what was driven".into(), |out| format!("kept in {}", out.display()));
        eprintln!("stopped after {:.0} m of {}; {kept}", summary.distance_m, args.model);
    }
    let other = match other {
        Some((name, wheel)) if !stopped => {
            let began = Instant::now();
            match pool.install(|| drive.go(&wheel, name)) {
                Ok((runs, false)) => Some((name, summarise(&runs, began.elapsed().as_secs_f64()))),
                // A drive along other parts of the recording is no comparison.
                Ok((_, true)) | Err(Error::Interrupted) => {
                    eprintln!("stopped in the drive of {name}; that of {} is whole", args.model);
                    stopped = true;
                    None
                }
                Err(error) => return Err(error),
            }
        }
        _ => None,
    };
    if stopped && args.video.is_some() {
        eprintln!("no film was made");
    }
    // What was driven is told, whatever fails now.
    let mut failed = Vec::new();
    let warp = if stopped { Ok(None) } else { pool.install(|| side_camera_check(&log)) };
    let warp = warp.unwrap_or_else(|error| {
        failed.push(error);
        None
    });
    if let Some(folder) = folder {
        failed.extend(report::on_recording::write(&log, &runs, &summary, folder).err());
    }
    if let (Some(path), Some(run), false) = (args.video, runs.first(), stopped) {
        failed.extend(pool.install(|| drive.film(&at_wheel, args, run, path)).err());
    }
    if args.json {
        let (assumed_speed_mps, warp, against) =
            (log.assumed_speed_mps, warp.as_ref(), other.as_ref().map(|(_, summary)| summary));
        print_json(&Report { recording: args.on, summary: &summary, assumed_speed_mps, warp, against })?;
        return end_with(failed).and(stop_or_ok(stopped));
    }
    let mut text = summary_text(args.model, &summary);
    if let Some((name, summary)) = &other {
        text += &format!("\n{}", summary_text(name, summary));
    }
    if let Some(mps) = log.assumed_speed_mps {
        text += &format!("note: the recording says no speed; {mps:.1} m/s was assumed\n");
    }
    let unchecked = || match failed.is_empty() && !stopped {
        true => "note: without side cameras the warped views cannot be checked\n".into(),
        false => String::new(),
    };
    text += &warp.map_or_else(unchecked, warp_text);
    print(&text)?;
    end_with(failed).and(stop_or_ok(stopped))
}

/// A drive at one latency of several; what `--json` prints of it.
#[derive(Serialize)]
struct AtLatency {
    latency_ms: f64,
    #[serde(flatten)]
    summary: ReplaySummary,
}

/// What `drive --on RECORDING --latency-ms A,B,… --json` prints.
#[derive(Serialize)]
struct SweepReport<'a> {
    recording: &'a Path,
    driver: &'a str,
    points: &'a [AtLatency],
}

/// Drives at each of several latencies, from the smallest to the largest.
fn sweep(args: &ReplayArgs, log: &ReplayLog, pool: &rayon::ThreadPool) -> Result<()> {
    let all = ascending(Swept::LatencyMs, args.latencies_ms)?.into_iter();
    let all: Vec<_> =
        all.map(|latency_ms| ReplayOptions { latency_ms, ..ReplayOptions::usual(&log.geometry) }).collect();
    all.iter().try_for_each(ReplayOptions::check)?;
    let (wheel, stop) = (Wheel::find(args.model)?, stop_on_ctrl_c()?);
    let (mut points, mut stopped) = (Vec::new(), false);
    for options in all {
        let began = Instant::now();
        let drive = Drive { log, options: &options, stop: &stop };
        let runs = match pool.install(|| drive.go(&wheel, &format!("{}, {} ms", args.model, options.latency_ms))) {
            Ok((runs, false)) => runs,
            // What is whole is told.
            Ok((_, true)) | Err(Error::Interrupted) => {
                stopped = true;
                break;
            }
            Err(error) => return Err(error),
        };
        let summary = summarise(&runs, began.elapsed().as_secs_f64());
        points.push(AtLatency { latency_ms: options.latency_ms, summary });
    }
    if points.is_empty() {
        return stop_or_ok(stopped);
    }
    if stopped {
        eprintln!("stopped after {} of {} latencies", points.len(), args.latencies_ms.len());
    }
    if args.json {
        return print_json(&SweepReport { recording: args.on, driver: args.model, points: &points })
            .and(stop_or_ok(stopped));
    }
    let headers = ["at", "autonomy", "put back", "off the path", "95 % below", "whiteness", "reversals", "jerk"];
    let mut rows = vec![headers.map(String::from).to_vec()];
    rows.extend(points.iter().map(|AtLatency { latency_ms, summary: s }| {
        let calm = s.calm.unwrap_or_default();
        vec![
            format!("{latency_ms} ms"),
            format!("{:.1} %", s.autonomy_percent),
            s.interventions.to_string(),
            format!("{:.2} m", s.offset_mean_m),
            format!("{:.2} m", s.offset_p95_m),
            format!("{:.1} deg/s", s.whiteness_deg_s),
            format!("{:.1}/min", calm.reversals_per_min),
            format!("{:.1} m/s³", calm.lateral_jerk_rms_mps3),
        ]
    }));
    print(&format!("{} on the recording\n{}", args.model, right_aligned(&rows)))?;
    stop_or_ok(stopped)
}

/// Who steers: a model, or nobody.
struct Wheel(Option<Pilot>);

impl Wheel {
    fn find(name: &str) -> Result<Wheel> {
        match name {
            "zero" => Ok(Wheel(None)),
            "expert" => Err(Error::Usage(
                "no expert drives on a recording: it would follow the path that is the measure; name a model or `zero`"
                    .into(),
            )),
            path => Ok(Wheel(Some(load_pilot(Path::new(path))?))),
        }
    }

    fn driver(&self) -> impl FnMut(&RgbImage) -> Result<f32> + use<> {
        let mut pilot = self.0.clone();
        move |view: &RgbImage| match &mut pilot {
            Some(pilot) => pilot.steer(view.view()),
            None => Ok(0.0),
        }
    }
}

/// What is driven on, and how.
struct Drive<'a> {
    log: &'a ReplayLog<'a>,
    options: &'a ReplayOptions,
    stop: &'a StopSignal,
}

impl Drive<'_> {
    /// Drives along all sessions at once; the flag is `true` if that was stopped.
    fn go(&self, wheel: &Wheel, name: &str) -> Result<(Vec<ReplayRun>, bool)> {
        let mut bar = ShareBar::new(format!("{name} on the recording"), self.stop);
        let meters = self.log.sessions.iter().map(|session| session.path.length_m() as usize + 1).sum();
        let tally = Tally::new(meters, &mut bar);
        let reached: Vec<_> = self.log.sessions.iter().map(|_| AtomicUsize::new(0)).collect();
        replay_as_far(self.log, self.options, || Ok(wheel.driver()), &|session, frame| {
            let along = frame.moment.along_m as usize;
            let before = reached[session].swap(along, Ordering::Relaxed);
            tally.add(along.saturating_sub(before))
        })
    }

    /// Drives along session number `session` alone, and shows every frame to `seen`; the flag is `true` if that stopped it.
    fn along(
        &self,
        session: usize,
        wheel: &Wheel,
        seen: &(dyn Fn(&ReplayFrame) -> Result<()> + Sync),
    ) -> Result<(ReplayRun, bool)> {
        let ReplayLog { recording, geometry, sessions, assumed_speed_mps } = self.log;
        let sessions = vec![sessions[session].clone()];
        let log = ReplayLog { recording, geometry: geometry.clone(), sessions, assumed_speed_mps: *assumed_speed_mps };
        let (mut runs, stopped) = replay_as_far(&log, self.options, || Ok(wheel.driver()), &|_, frame| seen(frame))?;
        Ok((runs.pop().unwrap_or_default(), stopped))
    }

    /// Drives along one session after the other, in real time, before those who watch.
    fn watched(&self, wheel: &Wheel, name: &str, live: &Live) -> Result<(Vec<ReplayRun>, bool)> {
        let watch = Mutex::new(WatchRecording::new(live, self.log, name, wheel.0.as_ref(), self.stop));
        let show = |session: usize, frame: &ReplayFrame| {
            watch.lock().unwrap_or_else(PoisonError::into_inner).show(session, frame)
        };
        let (mut runs, mut stopped) = (Vec::new(), false);
        for session in 0..self.log.sessions.len() {
            match self.along(session, wheel, &|frame| show(session, frame)) {
                Ok((run, ended)) => {
                    runs.push(run);
                    stopped = ended;
                }
                Err(Error::Interrupted) if !runs.is_empty() => stopped = true,
                Err(error) => return Err(error),
            }
            if stopped {
                break;
            }
        }
        Ok((runs, stopped))
    }

    /// Films the drive along the first session, whose moments are those of `run`.
    fn film(&self, wheel: &Wheel, args: &ReplayArgs, run: &ReplayRun, path: &Path) -> Result<()> {
        let onlooker = match &wheel.0 {
            Some(pilot) if args.saliency => Some(Onlooker::new(pilot.clone(), true)?),
            None if args.saliency => {
                return Err(Error::Usage(format!("{} has no saliency; leave out --saliency", args.model)));
            }
            _ => None,
        };
        let video = Mutex::new(ReplayVideo::create(path, self.log, run, args.model, args.fps, onlooker)?);
        let frames = run.moments.len();
        let mut bar = ShareBar::new("filming", self.stop);
        let tally = Tally::new(frames.max(1), &mut bar);
        let (_, stopped) = self.along(0, wheel, &|frame| {
            video.lock().unwrap_or_else(PoisonError::into_inner).show(frame)?;
            tally.add(1)
        })?;
        stop_or_ok(stopped)?;
        let video = video.into_inner().unwrap_or_else(PoisonError::into_inner);
        let summary = video.finish(&format!("put back: {}", run.interventions))?;
        drop(bar);
        tell_video(path, &summary);
        Ok(())
    }
}

fn summary_text(model: &str, s: &ReplaySummary) -> String {
    let sessions = if s.sessions == 1 { "1 session".into() } else { format!("{} sessions", s.sessions) };
    format!(
        "{model} on the recording, {sessions}\n\
         autonomy                   {:.1} %\n\
         interventions              {} ({:.2} a km)\n\
         distance driven            {:.0} m in {:.0} s\n\
         off the path mean/RMS/p95  {:.2} / {:.2} / {:.2} m\n\
         whiteness                  {:.1} deg/s\n{}\
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
        s.calm.map_or(String::new(), calm_text),
        s.frames,
        s.frames_per_second
    )
}

/// The measures of calm, a line each.
fn calm_text(calm: Calm) -> String {
    format!(
        "wheel reversals            {:.1} a minute\n\
         angle's change, 95 %       {:.2} deg a frame\n\
         lateral jerk, RMS          {:.1} m/s³\n",
        calm.reversals_per_min, calm.angle_change_p95_deg, calm.lateral_jerk_rms_mps3
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
