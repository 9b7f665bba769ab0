//! The process of a command: its threads, Ctrl-C, and how it ends.

use crate::error::{Error, Result};
use crate::observer::StopSignal;

/// A rayon pool of `threads` (0: one for each core, which the ranks on a machine share out).
pub(crate) fn pool(threads: usize) -> Result<rayon::ThreadPool> {
    let threads = crate::cluster::threads(threads);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    pool.map_err(|e| {
        Error::System(format!("cannot start {threads} threads: {e}; give a smaller number with --threads"))
    })
}

/// A signal that Ctrl-C gives; the second Ctrl-C ends the process at once.
pub(crate) fn stop_on_ctrl_c() -> Result<StopSignal> {
    let stop = StopSignal::default();
    let signal = stop.clone();
    let handler = move || {
        if signal.request() {
            std::process::exit(130);
        }
    };
    ctrlc::set_handler(handler).map_err(|e| Error::System(format!("cannot listen for Ctrl-C: {e}")))?;
    Ok(stop)
}

/// The end of a command that went on after some of its inputs `failed`: the last error ends it, those before are told.
pub(crate) fn end_with(mut failed: Vec<Error>) -> Result<()> {
    let last = failed.pop();
    failed.iter().for_each(|error| eprintln!("error: {error}"));
    last.map_or(Ok(()), Err)
}

/// The end of a command that was stopped, if it was, after it has told what it has.
pub(crate) fn stop_or_ok(stopped: bool) -> Result<()> {
    if stopped { Err(Error::Interrupted) } else { Ok(()) }
}
