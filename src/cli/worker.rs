//! What the ranks other than 0 do: they carry out the orders of rank 0 until there is no more work.

use std::process::ExitCode;
use std::sync::Arc;

use clap::Parser;

use super::process::{pool, stop_on_ctrl_c};
use super::{Cli, Command, drive};
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
    // Rank 0 hears of Ctrl-C itself.
    let stop = stop_on_ctrl_c().unwrap_or_default();
    // Rank 0 hears of an error of work that was done together; what else there is to do it decides.
    let mut ended = Ok(());
    loop {
        match await_order(&**team)? {
            Order::Train { job, threads } => {
                ended = match pool(threads) {
                    Ok(pool) => pool.install(|| training::take_part(team, Ok(&job), &stop)),
                    Err(error) => training::take_part(team, Err(error), &stop),
                };
            }
            Order::Drive { arguments, against, fingerprint, threads } => {
                let args = match Cli::try_parse_from(arguments) {
                    Ok(Cli { command: Command::Drive(args) }) => Ok(args),
                    _ => Err(Error::Fault("the arguments of rank 0 cannot be read".into())),
                };
                let help = |args| drive::help(&**team, args, against, &fingerprint);
                ended = match (args, pool(threads)) {
                    (Ok(args), Ok(pool)) => pool.install(|| help(Ok(&args))),
                    (Err(error), _) | (_, Err(error)) => help(Err(error)),
                };
            }
            Order::End => return ended,
        }
    }
}
