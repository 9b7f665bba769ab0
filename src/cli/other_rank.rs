//! What the ranks other than 0 do: they carry out the orders of rank 0 until there is no more work.

use std::process::ExitCode;
use std::sync::Arc;

use super::process::{pool, stop_on_ctrl_c};
use crate::cluster::tasks::{Work, decline, take_part};
use crate::cluster::{Order, Team, await_bytes, await_order};
use crate::error::{Error, Result};
use crate::{evaluation, simulator, training};

/// Follows rank 0.
pub(super) fn run(team: &Arc<dyn Team>) -> ExitCode {
    match follow(team) {
        Ok(()) => ExitCode::SUCCESS,
        // Rank 0 prints for all.
        Err(Error::Interrupted) => ExitCode::from(130),
        Err(_) => ExitCode::FAILURE,
    }
}

/// Takes part in a piece of work of which rank 0 has sent these bytes.
type TakePart = fn(&dyn Team, Result<&[u8]>) -> Result<()>;

/// The kinds of work, by name.
const WORK: [(&str, TakePart); 3] = [
    (simulator::Drives::NAME, take_part::<simulator::Drives>),
    (simulator::Photographs::NAME, take_part::<simulator::Photographs>),
    (evaluation::Answers::NAME, take_part::<evaluation::Answers>),
];

fn follow(team: &Arc<dyn Team>) -> Result<()> {
    // Rank 0 hears of Ctrl-C itself.
    let stop = stop_on_ctrl_c().unwrap_or_default();
    // Rank 0 hears of an error of work that was done together; what else there is to do it decides.
    let mut ended = Ok(());
    loop {
        // Rank 0 may wait for work to be done.
        match await_order(&**team).inspect_err(|error| decline(&**team, error))? {
            Order::Train { job, threads } => {
                ended = match pool(threads) {
                    Ok(pool) => pool.install(|| training::take_part(team, Ok(&job), &stop)),
                    Err(error) => training::take_part(team, Err(error), &stop),
                };
            }
            Order::Work { name, threads } => {
                let bytes = await_bytes(&**team);
                let Some((_, take_part)) = WORK.iter().find(|(known, _)| *known == name) else {
                    let error = Error::Fault(format!("no rank does {name}"));
                    decline(&**team, &error);
                    return Err(error);
                };
                ended = match pool(threads) {
                    Ok(pool) => pool.install(|| take_part(&**team, Ok(&bytes))),
                    Err(error) => take_part(&**team, Err(error)),
                };
            }
            Order::End => return ended,
        }
    }
}
