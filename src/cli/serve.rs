//! `steersman serve`: drives Udacity's simulator, or any client that speaks its protocol.

use std::io::IsTerminal;
use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};

use super::arguments::{Throttle, load_pilot};
use super::process::stop_on_ctrl_c;
use super::terminal::{counted, or_dash, print_json};
use crate::error::{Error, Result};
use crate::live::{self, CoDriverPage};
use crate::observer::Observer;
use crate::serve::{CoDriver, HelmOptions, ServeEvent, Server, ServerOptions, Summary};
use crate::text::escaped;
use crate::udacity;

/// Drive Udacity's simulator with a model; it connects by itself in autonomous mode
#[derive(Debug, Args)]
pub struct ServeArgs {
    /// Model file
    model: PathBuf,
    /// Speed to hold, mph; with --throttle model the highest
    #[arg(long, default_value_t = 15.0, value_name = "MPH")]
    speed: f64,
    /// Who gives the throttle: a controller that holds --speed, or the model, by its output `throttle` or `speed`
    #[arg(long, value_enum, default_value_t = Throttle::Hold)]
    throttle: Throttle,
    /// Drive slower than --speed where much steering is needed
    #[arg(long)]
    slower_in_bends: bool,
    /// Smooth the steering with a low-pass filter of this time constant, ms
    #[arg(long, default_value_t = 0.0, value_name = "MS")]
    smooth: f64,
    /// Port to listen at; the simulator connects to 4567. 0 takes any free one
    #[arg(long, default_value_t = udacity::DEFAULT_PORT)]
    port: u16,
    /// Address to listen at; 0.0.0.0 lets other machines connect
    #[arg(long, default_value = "127.0.0.1", value_name = "ADDRESS")]
    host: IpAddr,
    /// Record frames and commands in the format of the simulator; the folder must not exist
    #[arg(long, value_name = "DIR")]
    record: Option<PathBuf>,
    /// Show the drive on a page of this machine, where keys, mouse or gamepad take the wheel from the model; with --record these rows
    /// are marked as a person's
    #[arg(long, value_name = "PORT", num_args = 0..=1, require_equals = true)]
    page: Option<Option<u16>>,
    /// Let web pages of this origin connect, as in http://localhost:8000; may be given several times
    #[arg(long, value_name = "ORIGIN")]
    allow_origin: Vec<String>,
    /// Show every step of the connection and what each side sends: for a car that does not move
    #[arg(long)]
    check: bool,
    /// Print one JSON object as the last line, at the end
    #[arg(long)]
    json: bool,
}

pub fn run(args: ServeArgs) -> Result<()> {
    if !(1.0..=30.0).contains(&args.speed) {
        return Err(Error::Usage(format!("--speed {}: 1 to 30 mph can be driven", args.speed)));
    }
    if !(0.0..=1000.0).contains(&args.smooth) {
        return Err(Error::Usage(format!("--smooth {}: 0 to 1000 ms are meant", args.smooth)));
    }
    let pilot = load_pilot(&args.model)?;
    args.throttle.check(&pilot, &args.model.display().to_string())?;
    let server = Server::bind(ServerOptions {
        address: SocketAddr::new(args.host, args.port),
        helm: HelmOptions {
            speed_mph: args.speed,
            pace_of_model: args.throttle == Throttle::Model,
            slower_in_bends: args.slower_in_bends,
            smooth_s: args.smooth / 1000.0,
        },
        record: args.record,
        allowed_origins: args.allow_origin,
        check: args.check,
    })?;
    let page = args
        .page
        .map(|port| CoDriverPage::start(port.unwrap_or(live::DEFAULT_PORT), args.model.display().to_string()))
        .transpose()?;
    let stop = stop_on_ctrl_c()?;
    let address = server.address()?;
    say(&format!("listening on ws://{address}/socket.io/"));
    if let Some(page) = &page {
        say(&format!("open {} in a browser to take the wheel", page.url()));
    }
    if args.port != 0 && args.port != udacity::DEFAULT_PORT {
        say(&format!("note: Udacity's simulator connects to port {} by itself", udacity::DEFAULT_PORT));
    }
    if !args.host.is_loopback() {
        say(&format!("note: whoever reaches {address} can connect; there is no password"));
    }
    let mut screen = Screen::new();
    let co_driver = page.as_ref().map(|page| page as &dyn CoDriver);
    let served = server.run(pilot, co_driver, &mut screen, &stop);
    screen.close();
    if let Some(page) = page {
        let words = served.as_ref().map_or_else(|error| format!("The server has ended: {error}."), farewell);
        page.finish(&words);
    }
    let summary = served?;
    if args.json {
        return print_json(&summary);
    }
    print_summary(&summary);
    Ok(())
}

/// The last words on the page.
fn farewell(summary: &Summary) -> String {
    match &summary.recorded {
        Some(recorded) if recorded.rows > 0 => format!(
            "The server has ended: {} rows are in {}, {} of them by you.",
            recorded.rows,
            recorded.folder.display(),
            recorded.by_user
        ),
        _ => format!("The server has ended after {}.", counted(summary.frames as usize, "frame")),
    }
}

fn print_summary(summary: &Summary) {
    println!("frames answered            {}", summary.frames);
    println!("time                       {:.1} s", summary.seconds);
    println!("frames/s                   {}", or_dash(summary.frames_per_second, 1));
    println!(
        "latency p50/p99/longest    {} / {} / {} ms",
        or_dash(summary.latency_p50_ms, 2),
        or_dash(summary.latency_p99_ms, 2),
        or_dash(summary.latency_max_ms, 2)
    );
    println!("superseded frames          {}", summary.superseded);
    println!("connections                {}", summary.connections);
    if let Some(recorded) = &summary.recorded {
        match recorded.rows {
            0 => println!("recorded                   nothing"),
            rows => println!(
                "recorded                   {rows} rows in {}, {} of them by a person",
                recorded.folder.display(),
                recorded.by_user
            ),
        }
        if recorded.dropped > 0 {
            println!("not recorded               {} rows: the disk was too slow", recorded.dropped);
        }
    }
}

/// Writes a line to standard error. Whoever reads it may have left, as in `2>&1 | head`; the car is driven on.
fn say(text: &str) {
    eprintln!("{text}");
}

/// Standard error: on a terminal the status stays in the last line, elsewhere it is written now and then.
struct Screen {
    bar: Option<ProgressBar>,
    last_plain: Option<Instant>,
}

impl Screen {
    /// Time between plain status lines.
    const PLAIN_INTERVAL: Duration = Duration::from_secs(10);

    fn new() -> Screen {
        let style = ProgressStyle::with_template("{msg}").expect("the template is valid");
        let bar = std::io::stderr().is_terminal().then(|| ProgressBar::new_spinner().with_style(style));
        Screen { bar, last_plain: None }
    }

    fn close(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

impl Observer<ServeEvent> for Screen {
    fn observe(&mut self, event: ServeEvent) -> Result<()> {
        match event {
            ServeEvent::Line(text) => self.line(&text),
            ServeEvent::Status(text) => self.status(&text),
        }
        Ok(())
    }
}

impl Screen {
    fn line(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| say(text)),
            None => say(text),
        }
    }

    fn status(&mut self, text: &str) {
        if let Some(bar) = &self.bar {
            bar.set_message(escaped(text).into_owned());
            bar.tick();
            return;
        }
        if self.last_plain.is_none_or(|last| last.elapsed() >= Self::PLAIN_INTERVAL) {
            self.last_plain = Some(Instant::now());
            say(text);
        }
    }
}
