//! The server: it listens, gives each connection a thread, and says how it goes.

use std::collections::BTreeMap;
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::Scope;
use std::time::{Duration, Instant};

use serde::Serialize;

use super::connection;
use super::helm::HelmOptions;
use super::journal::{Event, Journal};
use super::latency::Latencies;
use super::protocol::{Command, DEFAULT_PORT};
use super::recording::{Recorded, Recorder};
use super::registry::Registry;
use super::seat::Seat;
use crate::error::{Error, Result};
use crate::net::http;
use crate::observer::{Observer, StopSignal};
use crate::pilot::Pilot;

/// Connections that are kept at once.
const MAX_CONNECTIONS: usize = 32;
/// How long a new connection waits for room.
const ROOM_PATIENCE: Duration = Duration::from_millis(20);
/// Pause between looks at the listener.
const LISTEN_PAUSE: Duration = Duration::from_millis(5);
/// Time between status lines.
const STATUS_INTERVAL: Duration = Duration::from_secs(1);
/// Without a connection for so long, something is said.
const LONELY: Duration = Duration::from_secs(15);
/// Stack of a connection's thread, bytes.
const STACK: usize = 1 << 20;

/// What a server tells the person at the keyboard.
#[derive(Clone, Debug, PartialEq)]
pub enum ServeEvent {
    /// A line that stays.
    Line(String),
    /// The line that shows how it goes; replaces the one before. Comes about once a second while a client is driven.
    Status(String),
}

/// How to serve.
#[derive(Clone, Debug)]
pub struct ServerOptions {
    /// Address to listen at; with port 0 the system chooses one.
    pub address: SocketAddr,
    /// How to drive.
    pub helm: HelmOptions,
    /// Folder to record into; must not exist.
    pub record: Option<PathBuf>,
    /// Origins of web pages that may connect; `*` is any.
    pub allowed_origins: Vec<String>,
    /// Show every step and message.
    pub check: bool,
}

impl Default for ServerOptions {
    fn default() -> Self {
        ServerOptions {
            address: SocketAddr::from(([127, 0, 0, 1], DEFAULT_PORT)),
            helm: HelmOptions::default(),
            record: None,
            allowed_origins: Vec::new(),
            check: false,
        }
    }
}

/// What a server did.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// Telemetry that was answered with a command.
    pub frames: u64,
    /// Time between the first and the last of them, s.
    pub seconds: f64,
    /// Their rate.
    pub frames_per_second: Option<f64>,
    /// From the last byte of telemetry received to its command sent: median, ms.
    pub latency_p50_ms: Option<f64>,
    /// The same: 99th percentile, ms.
    pub latency_p99_ms: Option<f64>,
    /// The same: longest, ms.
    pub latency_max_ms: Option<f64>,
    /// Telemetry that was not answered because newer had come.
    pub superseded: u64,
    /// Connections accepted.
    pub connections: u64,
    /// How often something was worth reporting, by kind.
    pub events: BTreeMap<Event, u64>,
    /// What was recorded.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub recorded: Option<Recorded>,
}

/// Counts of what is answered.
#[derive(Debug, Default)]
pub(super) struct Statistics {
    pub superseded: u64,
    frames: u64,
    first: Option<Instant>,
    last: Option<Instant>,
    all: Latencies,
    /// Since the last status line.
    recent: Latencies,
    command: Command,
    speed_mph: f64,
}

impl Statistics {
    /// Telemetry that had come at `came` was answered at `sent`.
    pub fn answered(&mut self, came: Instant, sent: Instant, command: Command, speed_mph: f64) {
        let latency = sent.saturating_duration_since(came);
        self.frames += 1;
        self.first.get_or_insert(came);
        self.last = Some(came);
        self.all.add(latency);
        self.recent.add(latency);
        (self.command, self.speed_mph) = (command, speed_mph);
    }

    /// The status line; `None` if nothing was answered since the last, `seconds` ago.
    fn status(&mut self, seconds: f64) -> Option<String> {
        let (p50, p99) = (self.recent.quantile_ms(0.5)?, self.recent.quantile_ms(0.99)?);
        let rate = self.recent.total() as f64 / seconds;
        self.recent.clear();
        let (steering, mph) = (self.command.steering, self.speed_mph);
        Some(format!(
            "{rate:.1} frames/s  latency p50 {p50:.2} p99 {p99:.2} ms  steering {steering:+.3}  speed {mph:.1} mph"
        ))
    }
}

/// What the threads of a server share.
pub(super) struct Shared<'a> {
    pub options: &'a ServerOptions,
    pub pilot: Mutex<Pilot>,
    pub seat: Seat,
    pub journal: Journal<'a>,
    pub recorder: Option<Recorder>,
    pub recording_failed: AtomicBool,
    pub stop: &'a StopSignal,
    registry: Registry,
    statistics: Mutex<Statistics>,
}

impl Shared<'_> {
    pub fn statistics(&self) -> MutexGuard<'_, Statistics> {
        self.statistics.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A server that listens already.
#[derive(Debug)]
pub struct Server {
    listener: TcpListener,
    options: ServerOptions,
    recorder: Option<Recorder>,
}

impl Server {
    /// Begins to listen, and creates the folder of a recording.
    ///
    /// # Errors
    ///
    /// [`Error::System`] with the remedy if the address cannot be had, [`Error::Usage`] if the folder exists.
    pub fn bind(options: ServerOptions) -> Result<Server> {
        let address = options.address;
        let in_use = "end it (is drive.py still running?) or give --port";
        let listener = http::listen(address, in_use)?;
        let recorder = options.record.as_deref().map(Recorder::start).transpose()?;
        Ok(Server { listener, options, recorder })
    }

    /// The address it listens at.
    ///
    /// # Errors
    ///
    /// [`Error::System`] if the system does not know it.
    pub fn address(&self) -> Result<SocketAddr> {
        self.listener.local_addr().map_err(|e| Error::System(format!("cannot tell the address: {e}")))
    }

    /// Serves until `stop` is requested. The driven car then gets its throttle cut.
    ///
    /// # Errors
    ///
    /// If a recording cannot be written; the observer's own, which also end the serving.
    pub fn run(
        self,
        pilot: Pilot,
        observer: &mut (dyn Observer<ServeEvent> + Send),
        stop: &StopSignal,
    ) -> Result<Summary> {
        let Server { listener, options, recorder } = self;
        let shared = Shared {
            options: &options,
            pilot: Mutex::new(pilot),
            seat: Seat::default(),
            journal: Journal::new(observer, options.check),
            recorder,
            recording_failed: AtomicBool::new(false),
            stop,
            registry: Registry::new(MAX_CONNECTIONS),
            statistics: Mutex::default(),
        };
        let connections = std::thread::scope(|scope| listen(&listener, scope, &shared));
        let events = shared.journal.counts();
        let recorded = shared.recorder.map(Recorder::finish).transpose()?;
        shared.journal.into_result()?;
        let statistics = shared.statistics.into_inner().unwrap_or_else(PoisonError::into_inner);
        let seconds = match (statistics.first, statistics.last) {
            (Some(first), Some(last)) => last.duration_since(first).as_secs_f64(),
            _ => 0.0,
        };
        Ok(Summary {
            frames: statistics.frames,
            seconds,
            frames_per_second: (seconds > 0.0).then(|| (statistics.frames - 1) as f64 / seconds),
            latency_p50_ms: statistics.all.quantile_ms(0.5),
            latency_p99_ms: statistics.all.quantile_ms(0.99),
            latency_max_ms: statistics.all.longest_ms(),
            superseded: statistics.superseded,
            connections,
            events,
            recorded,
        })
    }
}

/// Accepts connections until it is told to stop; returns their number.
fn listen<'scope, 'env, 'o>(
    listener: &TcpListener,
    scope: &'scope Scope<'scope, 'env>,
    shared: &'env Shared<'o>,
) -> u64 {
    let began = Instant::now();
    let (mut connections, mut lonely) = (0, true);
    let mut last_status = began;
    let failed = || shared.recording_failed.load(Ordering::Relaxed) || shared.journal.failed();
    while !shared.stop.requested() && !failed() {
        match listener.accept() {
            Ok((stream, address)) => {
                connections += 1;
                lonely = false;
                admit(scope, shared, connections, stream, address);
            }
            // Nobody there, or the connection is gone already, or the process has no file left for it.
            Err(_) => std::thread::sleep(LISTEN_PAUSE),
        }
        let since = last_status.elapsed();
        if since >= STATUS_INTERVAL {
            last_status = Instant::now();
            let status = shared.statistics().status(since.as_secs_f64());
            if let Some(status) = status {
                shared.journal.status(status);
            }
            if lonely && began.elapsed() >= LONELY {
                lonely = false;
                shared.journal.report(Event::NobodyConnects, format_args!("nobody has connected yet"));
            }
        }
    }
    // Threads that serve a connection look at `stop`; a failed recording ends them, too.
    shared.stop.request();
    connections
}

fn admit<'scope, 'env, 'o>(
    scope: &'scope Scope<'scope, 'env>,
    shared: &'env Shared<'o>,
    id: u64,
    stream: TcpStream,
    address: SocketAddr,
) {
    let stream = Arc::new(stream);
    let (peer, closed_one) = shared.registry.add(id, &stream, ROOM_PATIENCE);
    if closed_one || peer.is_none() {
        let text = format_args!("{address}: more than {MAX_CONNECTIONS} connections");
        shared.journal.report(Event::TooManyConnections, text);
    }
    let Some(peer) = peer else { return };
    let thread = std::thread::Builder::new().name(format!("client {id}")).stack_size(STACK);
    let serve = move || {
        // A fault of this program that one client provokes must not end the drive of another.
        let served = catch_unwind(AssertUnwindSafe(|| connection::serve(shared, &peer, address)));
        shared.seat.leave(id);
        // It may be closed already.
        let _ = peer.stream.shutdown(Shutdown::Both);
        shared.registry.remove(id);
        if served.is_err() {
            shared.journal.report(Event::Fault, format_args!("{address}: closed by a fault of this program"));
        }
    };
    if let Err(error) = thread.spawn_scoped(scope, serve) {
        shared.registry.remove(id);
        shared.journal.report(Event::TooManyConnections, format_args!("{address}: no thread can be started: {error}"));
    }
}
