//! What the ranks other than 0 do: they carry out the orders of rank 0 until there is no more work.

use std::process::ExitCode;
use std::sync::Arc;

use clap::Parser;

use super::{Cli, Command, drive, pool, stop_on_ctrl_c};
use crate::cluster::{Order, Team, await_order};
use crate::error::{Error, Result};
use crate::training;

/// Follows rank 0.
pub(super) fn run(team: &Arc<dyn Team>) -> ExitCode {
    match follow(team) {
        Ok(()) => ExitCode::SUCCESS,
        // Rank 0 prints for all.
        Err(Error::Interrupted) => ExitCode::from(130),
        Err(_) => ExitCode::FAILURE,
    }
}

fn follow(team: &Arc<dyn Team>) -> Result<()> {
    let stop = stop_on_ctrl_c()?;
    // Rank 0 hears of an error of work that was done together; what else there is to do it decides.
    let mut ended = Ok(());
    loop {
        match await_order(&**team)? {
            Order::Train { job, threads } => {
                ended = pool(threads)?.install(|| training::take_part(team, &job, &stop));
            }
            Order::Drive { arguments, against, fingerprint, threads } => {
                // Rank 0 runs with these arguments, so they can be read.
                if let Ok(Cli { command: Command::Drive(args) }) = Cli::try_parse_from(arguments) {
                    ended = pool(threads)?.install(|| drive::help(&**team, &args, against, &fingerprint));
                }
            }
            Order::End => return ended,
        }
    }
}
