//! `steersman drive MODEL --donkeysim`: the model drives the car of DonkeySim.

use std::net::{IpAddr, SocketAddr};
use std::path::Path;

use clap::Args;

use super::DriveArgs;
use crate::cli::process::{stop_on_ctrl_c, stop_or_ok};
use crate::cli::terminal::{ShareBar, counted, or_dash, print, print_json};
use crate::donkeysim::DEFAULT_PORT;
use crate::donkeysim::client::{DonkeyDrive, DonkeyDriveOptions, DonkeyDriveSummary, DonkeyFrame, drive};
use crate::error::{Error, Result};
use crate::files::limits::keep_elsewhere;
use crate::files::new_folder::NewFolder;
use crate::observer::Observer;
use crate::simulator::trial::outcome::Failure;
use crate::simulator::trial::trajectory::trajectory_csv;
use crate::simulator::{DriverAnswer, Wheel};
use crate::simulator_client::ClientEvent;
use crate::text::excerpt;

/// Highest or widest picture that is decoded, pixels.
const MAX_SIDE: usize = 1920;

/// How to drive in DonkeySim.
#[derive(Debug, Args)]
#[command(next_help_heading = "With --donkeysim")]
pub struct DonkeyDriveArgs {
    /// Drive in DonkeySim, which listens there, instead of on a track
    #[arg(
        long,
        value_name = "HOST:PORT",
        conflicts_with_all = ["track", "on", "against", "watch", "video", "camera", "latency_ms", "noise", "seed"]
    )]
    donkeysim: Option<String>,
    /// Scene to choose in its menu [default: generated_track]
    #[arg(long, requires = "donkeysim", value_name = "NAME")]
    scene: Option<String>,
    /// Setting of its camera, as in fov=80; without any it stays as it is, and pictures of the model's size are asked for
    #[arg(long, requires = "donkeysim", value_name = "NAME=VALUE", value_parser = setting)]
    cam: Vec<(String, f64)>,
    /// Longest time of a run, s
    #[arg(long, requires = "donkeysim", default_value_t = 300.0, value_name = "S")]
    time_limit: f64,
    /// Longest time without a word of the simulator, or a telemetry that can be driven by, s; loading a scene may take 12 times as long
    #[arg(long, requires = "donkeysim", default_value_t = 10.0, value_name = "S")]
    patience: f64,
    /// Distance from the line beyond which the car has left the road, in units of the scene
    #[arg(long, requires = "donkeysim", default_value_t = 8.0, value_name = "UNITS")]
    max_cte: f64,
    /// Units of the scene, which count as metres, for each unit of its telemetry: 8, or 1 for older builds
    #[arg(long, requires = "donkeysim", default_value_t = 8.0)]
    scale: f64,
}

impl DonkeyDriveArgs {
    /// Whether DonkeySim is to be driven.
    pub fn is_given(&self) -> bool {
        self.donkeysim.is_some()
    }
}

/// `NAME=VALUE`.
fn setting(text: &str) -> Result<(String, f64), String> {
    let parts = text.split_once('=').and_then(|(name, value)| Some((name.to_string(), value.parse().ok()?)));
    parts.ok_or_else(|| "a name and a number are meant, as in fov=80".into())
}

/// `HOST:PORT`; the usual port if there is none. An address of IPv6 stands in brackets, or alone.
fn with_port(server: &str) -> Result<String> {
    if let Ok(address) = server.parse::<IpAddr>() {
        return Ok(SocketAddr::new(address, DEFAULT_PORT).to_string());
    }
    let wrong = |what: &str| Err(Error::Usage(format!("--donkeysim {}: {what}", excerpt(server, 80))));
    // What follows the host.
    let end = match server.starts_with('[') {
        true => server.find(']').map_or(server.len(), |bracket| bracket + 1),
        false => server.find(':').unwrap_or(server.len()),
    };
    let (host, rest) = server.split_at(end);
    match rest.strip_prefix(':') {
        _ if host.is_empty() => wrong("HOST:PORT is meant, as in 127.0.0.1:9091"),
        None if rest.is_empty() => Ok(format!("{server}:{DEFAULT_PORT}")),
        Some(port) if port.contains(':') => {
            wrong("an address of IPv6 with a port stands in brackets, as in [::1]:9091")
        }
        Some(port) if port.parse::<u16>().is_ok_and(|port| port > 0) => Ok(server.into()),
        _ => wrong("the port is a number from 1 to 65535, as in 127.0.0.1:9091"),
    }
}

pub fn run(args: &DriveArgs) -> Result<()> {
    let Wheel::Model(mut pilot) = args.wheel(&args.model)? else {
        let message = format!("{} knows our own tracks only: name a model file to drive in DonkeySim", args.model);
        return Err(Error::Usage(message));
    };
    let given = &args.donkeysim;
    let options = DonkeyDriveOptions {
        server: with_port(given.donkeysim.as_deref().unwrap_or_default())?,
        scene: given.scene.clone(),
        picture: pilot.recipe().preprocessing.source,
        camera: given.cam.clone(),
        laps: args.laps,
        runs: args.runs.unwrap_or(1),
        time_limit_s: given.time_limit,
        speed: args.throttle.aimed_at(args.speed)?,
        scale: given.scale,
        max_cte: given.max_cte,
        patience_s: given.patience,
        ..DonkeyDriveOptions::default()
    };
    options.check()?;
    let folder = args.out.as_deref().map(NewFolder::create).transpose()?;
    let mut bar = ShareBar::new(format!("driving in DonkeySim at {}", options.server), &stop_on_ctrl_c()?);
    let mut observer = |event| match event {
        ClientEvent::Notice(text) => {
            bar.print(&text);
            Ok(())
        }
        ClientEvent::Progress(progress) => bar.observe(progress),
    };
    let mut driver = |frame: DonkeyFrame| {
        let answer = pilot.answer_encoded_within(frame.picture, MAX_SIDE).map_err(|error| error.to_string())?;
        Ok(DriverAnswer { steering: answer.steering, pace: pilot.pace(&answer) })
    };
    let mut driven = drive(&options, &mut driver, &mut observer)?;
    drop(bar);
    let ended = driven.ended.take();
    let summary = DonkeyDriveSummary::new(&options, &driven);
    if ended.is_some() {
        let kept = match &args.out {
            Some(out) => format!("kept in {}", out.display()),
            None => "add --out DIR to keep what was driven".into(),
        };
        eprintln!("ended early, in run {} of {}; {kept}", driven.last_run, options.runs);
    }
    // What was measured is told even if it cannot be saved.
    let saved = folder.map_or(Ok(()), |folder| {
        save(&driven, &summary, folder).map_err(|cause| {
            let again = |other: &Path| save(&driven, &summary, NewFolder::create(&other.join("drive"))?);
            keep_elsewhere(cause, again, |other| format!("the drive is kept in {}", other.join("drive").display()))
        })
    });
    if args.json {
        print_json(&summary)?;
    } else {
        print(&text(&args.model, &summary, &driven))?;
    }
    match ended {
        Some(Error::Interrupted) => saved.and(stop_or_ok(true)),
        Some(error) => saved.and(Err(error)),
        None => saved,
    }
}

/// Writes `run_N.csv` for each run, counted from 1, and the measures as `donkeysim.json`.
fn save(driven: &DonkeyDrive, summary: &DonkeyDriveSummary, folder: NewFolder) -> Result<()> {
    let write = |name: String, text: String| {
        let path = folder.unfinished().join(name);
        std::fs::write(&path, text).map_err(|source| folder.explain(Error::Io { path, source }))
    };
    for (index, run) in driven.runs.iter().enumerate() {
        write(format!("run_{}.csv", index + 1), trajectory_csv(run))?;
    }
    let json =
        serde_json::to_string_pretty(summary).map_err(|e| Error::Fault(format!("the measures are no JSON: {e}")))?;
    write("donkeysim.json".into(), json + "\n")?;
    folder.finish()
}

fn text(model: &str, s: &DonkeyDriveSummary, driven: &DonkeyDrive) -> String {
    let scene = s.scene.as_ref().map_or(String::new(), |scene| format!(", scene {scene}"));
    let (low, high) = (100.0 * s.completed_low, 100.0 * s.completed_high);
    let of = |which: Failure| driven.runs.iter().filter(|run| run.failure == Some(which)).count();
    let calm = s.calm.map_or(String::new(), |calm| {
        format!(
            "wheel reversals            {:.1} a minute\nangle's change, 95 %       {:.2} deg a frame\n",
            calm.reversals_per_min, calm.angle_change_p95_deg
        )
    });
    let [mean, rms, p95, max] =
        [s.cte_mean_m, s.cte_rms_m, s.cte_p95_m, s.cte_max_m].map(|distance_m| or_dash(distance_m, 2));
    format!(
        "{model} in DonkeySim at {}{scene}, {}; units of the scene as m\n\
         laps completed             {}/{} (whole runs: {low:.0} to {high:.0} %, 95 %)\n\
         autonomy                   {:.1} % (6 s for each run that failed)\n\
         runs that failed           {}: {} hit something, {} left the road, {} stood still, {} disqualified\n\
         distance driven            {:.0} m in {:.1} s\n\
         cross-track mean/RMS/p95   {mean} / {rms} / {p95} m, at most {max} m\n\
         mean speed                 {:.1} mph\n\
         whiteness                  {:.1} deg/s\n{calm}\
         telemetry                  {} answered, {} superseded, {} unreadable\n\
         answer p50/p99             {} / {} ms\n",
        s.server,
        counted(s.runs, "run"),
        s.laps_completed,
        s.laps_total,
        s.autonomy_percent,
        s.interventions,
        of(Failure::Crash),
        of(Failure::LeftRoad),
        of(Failure::StoodStill),
        of(Failure::Disqualified),
        s.distance_m,
        s.time_s,
        s.mean_speed_mph,
        s.whiteness_deg_s,
        s.answered,
        s.superseded,
        s.unreadable,
        or_dash(s.answer_ms_p50, 2),
        or_dash(s.answer_ms_p99, 2),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_usual_port_is_added_where_none_is_given_and_none_is_misread() {
        for (given, meant) in [
            ("127.0.0.1", "127.0.0.1:9091"),
            ("127.0.0.1:80", "127.0.0.1:80"),
            ("localhost", "localhost:9091"),
            ("sim.example:65535", "sim.example:65535"),
            ("::1", "[::1]:9091"),
            ("fe80::9091", "[fe80::9091]:9091"),
            ("[::1]", "[::1]:9091"),
            ("[::1]:7", "[::1]:7"),
        ] {
            assert_eq!(with_port(given).unwrap(), meant);
        }
        for (given, remedy) in [
            ("localhost:99999", "1 to 65535"),
            ("localhost:0", "1 to 65535"),
            ("localhost:", "1 to 65535"),
            ("localhost:x", "1 to 65535"),
            ("[::1]:99999", "1 to 65535"),
            ("[::1]9091", "1 to 65535"),
            ("a:b:1", "[::1]:9091"),
            ("", "HOST:PORT"),
            (":9091", "HOST:PORT"),
        ] {
            let message = with_port(given).unwrap_err().to_string();
            assert!(message.contains(remedy), "{given}: {message}");
        }
    }
}
