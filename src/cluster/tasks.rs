//! Work in many tasks of their own, which rank 0 hands out one by one to whoever is free.
//!
//! Rank 0 works too. A task is a number; its result goes back to rank 0 as bytes, so results lie in the order of the tasks whoever did them.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use super::{Claim, Team, await_message, of_rank};
use crate::error::{Error, Result};

/// How long rank 0 sleeps between two looks for messages: short beside a task.
const NAP: Duration = Duration::from_micros(300);

/// What a message to rank 0 begins with.
const ASKS: u8 = 0;
const DONE: u8 = 1;
const FAILED: u8 = 2;
const LEAVES: u8 = 3;

/// Rank 0: does the tasks 0 to `count` on all threads of this rayon pool and on all ranks, which must have had the order to
/// [`help`]. `work` does a task here; `take` makes a result of the bytes of another rank. Of a task that nobody began, because `stopped`
/// says so, the result is [`Error::Interrupted`].
pub fn spread<T: Send>(
    claim: &Claim,
    count: usize,
    work: impl Fn(usize) -> Result<T> + Sync,
    take: impl Fn(&[u8]) -> Result<T> + Sync,
    stopped: impl Fn() -> bool + Sync,
) -> Vec<Result<T>> {
    let team = &**claim.team();
    let next = AtomicUsize::new(0);
    // The error of a rank ends the work of all.
    let broken = AtomicBool::new(false);
    let draw = || {
        let goes_on = !broken.load(Ordering::Relaxed) && !stopped();
        goes_on.then(|| next.fetch_add(1, Ordering::Relaxed)).filter(|task| *task < count)
    };
    let results: Mutex<Vec<Result<T>>> = Mutex::new((0..count).map(|_| Err(Error::Interrupted)).collect());
    let keep = |task: usize, result: Result<T>| {
        let mut results = results.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(place) = results.get_mut(task) {
            *place = result;
        }
    };
    let failed = Mutex::new(None);
    thread::scope(|scope| {
        scope.spawn(|| {
            let mut workers = team.size() - 1;
            while workers > 0 {
                let Some((rank, message)) = team.try_receive() else {
                    thread::sleep(NAP);
                    continue;
                };
                let (kind, task, content) = taken_apart(&message);
                let error = || of_rank(rank, team.size(), &String::from_utf8_lossy(content));
                match kind {
                    DONE => keep(task, take(content)),
                    FAILED => {
                        broken.store(true, Ordering::Relaxed);
                        keep(task, Err(error()));
                    }
                    LEAVES => {
                        workers -= 1;
                        if !content.is_empty() {
                            broken.store(true, Ordering::Relaxed);
                            *failed.lock().unwrap_or_else(PoisonError::into_inner) = Some(error());
                        }
                        continue;
                    }
                    _ => {}
                }
                let task = draw().unwrap_or(usize::MAX) as u64;
                team.send(rank, &task.to_le_bytes());
            }
        });
        rayon::broadcast(|_| {
            while let Some(task) = draw() {
                keep(task, work(task));
            }
        });
    });
    let mut results = results.into_inner().unwrap_or_else(PoisonError::into_inner);
    if let (Some(error), Some(first)) =
        (failed.into_inner().unwrap_or_else(PoisonError::into_inner), results.first_mut())
    {
        *first = Err(error);
    }
    results
}

/// Another rank: takes tasks from rank 0 on all threads of this rayon pool until there are none left. `prepared` does a task; if it could
/// not be made, rank 0 hears why.
///
/// # Errors
///
/// That of `prepared`.
pub fn help(team: &dyn Team, prepared: Result<impl Fn(usize) -> Result<Vec<u8>> + Sync>) -> Result<()> {
    let text = prepared.as_ref().err().map_or(String::new(), Error::to_string);
    let ended = prepared.map(|work| {
        // One thread at a time asks and waits for the answer.
        let ask = |message: Vec<u8>, talk: &Mutex<()>| -> usize {
            let _talk = talk.lock().unwrap_or_else(PoisonError::into_inner);
            team.send(0, &message);
            let (_, answer) = await_message(team);
            answer.try_into().map_or(usize::MAX, |bytes| u64::from_le_bytes(bytes) as usize)
        };
        let talk = Mutex::new(());
        rayon::broadcast(|_| {
            let mut task = ask(put_together(ASKS, 0, &[]), &talk);
            while task != usize::MAX {
                task = match work(task) {
                    Ok(result) => ask(put_together(DONE, task, &result), &talk),
                    Err(error) => ask(put_together(FAILED, task, error.to_string().as_bytes()), &talk),
                };
            }
        });
    });
    team.send(0, &put_together(LEAVES, 0, text.as_bytes()));
    ended
}

fn put_together(kind: u8, task: usize, content: &[u8]) -> Vec<u8> {
    [&[kind][..], &(task as u64).to_le_bytes(), content].concat()
}

fn taken_apart(message: &[u8]) -> (u8, usize, &[u8]) {
    match message.split_at_checked(9) {
        Some((head, content)) => {
            let number = head[1..].try_into().map_or(usize::MAX, |bytes| u64::from_le_bytes(bytes) as usize);
            (head[0], number, content)
        }
        None => (ASKS, usize::MAX, &[]),
    }
}
