//! The server: it listens, gives each connection a thread, and shows the status.

use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::Scope;
use std::time::{Duration, Instant};

use super::co_driver::CoDriver;
use super::connection;
use super::journal::{Incident, Journal};
use super::options::ServerOptions;
use super::recording::Recorder;
use super::seat::Seat;
use super::server_event::ServeEvent;
use super::shared::Shared;
use super::statistics::Summary;
use crate::error::{Error, Result};
use crate::net::connections::Connections;
use crate::net::http;
use crate::observer::{Observer, StopSignal};
use crate::pilot::Pilot;

/// Largest number of open connections.
const MAX_CONNECTIONS: usize = 32;
/// Longest time that a new connection waits until another has made room.
const ROOM_PATIENCE: Duration = Duration::from_millis(20);
/// Pause between two checks of the listener.
const LISTEN_PAUSE: Duration = Duration::from_millis(5);
/// Time between status lines.
const STATUS_INTERVAL: Duration = Duration::from_secs(1);
/// Time without any connection after which the server says so.
const NOBODY_TIME: Duration = Duration::from_secs(15);
/// Stack of a connection's thread, bytes.
const STACK: usize = 1 << 20;

/// A server that already listens.
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

    /// The address at which it listens.
    ///
    /// # Errors
    ///
    /// [`Error::System`] if the system does not know it.
    pub fn address(&self) -> Result<SocketAddr> {
        self.listener.local_addr().map_err(|e| Error::System(format!("cannot tell the address: {e}")))
    }

    /// Serves until `stop` is requested, and then cuts the throttle of the driven car. A `co_driver` may take the wheel.
    ///
    /// # Errors
    ///
    /// If a recording cannot be written, and the error of the observer, which also ends the serving.
    pub fn run(
        self,
        pilot: Pilot,
        co_driver: Option<&dyn CoDriver>,
        observer: &mut (dyn Observer<ServeEvent> + Send),
        stop: &StopSignal,
    ) -> Result<Summary> {
        let Server { listener, options, recorder } = self;
        let shared = Shared {
            options: &options,
            pilot: Mutex::new(pilot),
            seat: Seat::default(),
            journal: Journal::new(observer, options.check),
            co_driver,
            recorder,
            recording_failed: AtomicBool::new(false),
            stop,
            connections: Connections::new(MAX_CONNECTIONS),
            statistics: Mutex::default(),
        };
        let connections = std::thread::scope(|scope| listen(&listener, scope, &shared));
        let incidents = shared.journal.counts();
        let recorded = shared.recorder.map(Recorder::finish).transpose()?;
        shared.journal.into_result()?;
        let statistics = shared.statistics.into_inner().unwrap_or_else(PoisonError::into_inner);
        Ok(statistics.summary(connections, incidents, recorded))
    }
}

/// Accepts connections until `stop` is requested. Returns their number.
fn listen<'scope, 'env, 'o>(
    listener: &TcpListener,
    scope: &'scope Scope<'scope, 'env>,
    shared: &'env Shared<'o>,
) -> u64 {
    let began = Instant::now();
    let (mut connections, mut nobody_yet) = (0, true);
    let mut last_status = began;
    let failed = || shared.recording_failed.load(Ordering::Relaxed) || shared.journal.failed();
    while !shared.stop.requested() && !failed() {
        match listener.accept() {
            Ok((stream, address)) => {
                connections += 1;
                nobody_yet = false;
                admit(scope, shared, connections, stream, address);
            }
            // No client, or the connection is gone already, or the process has no file handle left.
            Err(_) => std::thread::sleep(LISTEN_PAUSE),
        }
        let since = last_status.elapsed();
        if since >= STATUS_INTERVAL {
            last_status = Instant::now();
            let status = shared.statistics().status(since.as_secs_f64());
            if let Some(status) = status {
                shared.journal.status(status);
            }
            if nobody_yet && began.elapsed() >= NOBODY_TIME {
                nobody_yet = false;
                shared.journal.report(Incident::NobodyConnects, format_args!("nobody has connected yet"));
            }
        }
    }
    // The threads of the connections check `stop`; a failed recording ends them, too.
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
    let (peer, closed_one) = shared.connections.add(id, &stream, ROOM_PATIENCE);
    if closed_one || peer.is_none() {
        let text = format_args!("{address}: more than {MAX_CONNECTIONS} connections");
        shared.journal.report(Incident::TooManyConnections, text);
    }
    let Some(peer) = peer else { return };
    let thread = std::thread::Builder::new().name(format!("client {id}")).stack_size(STACK);
    let serve = move || {
        // A fault of this program that one client triggers must not end the drive of another.
        let served = catch_unwind(AssertUnwindSafe(|| connection::serve(shared, &peer, address)));
        shared.seat.leave(id);
        // It may be closed already.
        let _ = peer.stream.shutdown(Shutdown::Both);
        shared.connections.remove(id);
        if served.is_err() {
            shared.journal.report(Incident::Fault, format_args!("{address}: closed by a fault of this program"));
        }
    };
    if let Err(error) = thread.spawn_scoped(scope, serve) {
        shared.connections.remove(id);
        shared
            .journal
            .report(Incident::TooManyConnections, format_args!("{address}: no thread can be started: {error}"));
    }
}
