//! Work in many tasks of their own, which rank 0 hands out one by one to whoever is free.
//!
//! A kind of work is a type that implements [`Work`]: it holds what all of its tasks have in common, which every rank is sent once, and does
//! a task. Rank 0 makes the tasks, takes their results, and works too. All of it travels as bytes: no rank needs a file of another one, and
//! a task has the same result whoever does it. Where there is but one process, the same functions run without any bytes.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Barrier, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use super::message::Message;
use super::{Claim, Order, Team, asked_threads, await_message, of_rank};
use crate::error::{Error, Result};

/// A kind of work, and what all of its tasks have in common.
pub trait Work: Message + Sync {
    /// What an [order](Order) calls it.
    const NAME: &'static str;
    /// What differs from task to task.
    type Task: Message;
    /// The result of a task.
    type Done: Message;

    /// Does a task. It may use the rayon pool, but must not wait in it for what another task holds.
    ///
    /// # Errors
    ///
    /// Those of the work; they end all of it.
    fn perform(&self, task: Self::Task) -> Result<Self::Done>;
}

/// How a piece of work ended.
#[derive(Debug)]
pub struct Ran {
    /// Threads that worked, of all ranks.
    pub threads: usize,
    /// The error that ended it before its end, that of the lowest task if there are several, and
    /// [`Error::Interrupted`] only if there is no other.
    pub ended: Result<()>,
}

/// How long rank 0 sleeps between two looks for messages: short beside a task.
const NAP: Duration = Duration::from_micros(300);

/// What a message to rank 0 begins with.
const ASKS: u8 = 0;
const DONE: u8 = 1;
const FAILED: u8 = 2;
const LEAVES: u8 = 3;
/// What its answer begins with.
const TASK: u8 = 4;
const NO_TASK: u8 = 5;

/// Does the tasks 0 to `count` of `work` on all threads of this rayon pool, and of the pools of all ranks if this process leads a team
/// that has nothing else to do. `task` makes a task, here, just before it is begun; `keep` is given its result, here, by any thread and
/// in any order. After an error of either no further task is begun.
pub fn run<W: Work>(
    work: &W,
    count: usize,
    task: impl Fn(usize) -> Result<W::Task> + Sync,
    keep: impl Fn(usize, W::Done) -> Result<()> + Sync,
) -> Ran {
    // One task has nothing to share out.
    let claim = if count > 1 { Claim::of_leader() } else { None };
    let ordered = claim.as_ref().map_or(Ok(()), |claim| {
        let order = Order::Work { name: W::NAME.into(), threads: asked_threads() };
        claim.order(&order, &[&work.to_bytes()?])
    });
    match ordered {
        Ok(()) => run_among(claim.as_ref().map(|claim| &**claim.team()), work, count, task, keep),
        Err(error) => Ran { threads: 0, ended: Err(error) },
    }
}

/// [`run`] together with the other ranks of `team`, which have been told to [`take_part`].
fn run_among<W: Work>(
    team: Option<&dyn Team>,
    work: &W,
    count: usize,
    task: impl Fn(usize) -> Result<W::Task> + Sync,
    keep: impl Fn(usize, W::Done) -> Result<()> + Sync,
) -> Ran {
    let (next, broken) = (AtomicUsize::new(0), AtomicBool::new(false));
    let failed: Mutex<Option<((bool, usize), Error)>> = Mutex::new(None);
    let fail = |task: usize, error: Error| {
        broken.store(true, Ordering::Relaxed);
        let order = (matches!(error, Error::Interrupted), task);
        let mut failed = failed.lock().unwrap_or_else(PoisonError::into_inner);
        if failed.as_ref().is_none_or(|(first, _)| order < *first) {
            *failed = Some((order, error));
        }
    };
    let draw = || {
        let goes_on = !broken.load(Ordering::Relaxed);
        goes_on.then(|| next.fetch_add(1, Ordering::Relaxed)).filter(|number| *number < count)
    };
    let settle = |number: usize, done: Result<W::Done>| {
        if let Err(error) = done.and_then(|done| keep(number, done)) {
            fail(number, error);
        }
    };
    let of_others = AtomicUsize::new(0);
    let serve = |team: &dyn Team| {
        let mut others = team.size() - 1;
        while others > 0 {
            let Some((rank, message)) = team.try_receive() else {
                thread::sleep(NAP);
                continue;
            };
            let (kind, number, content) = taken_apart(&message);
            let error = || of_rank(rank, team.size(), &String::from_utf8_lossy(content));
            match kind {
                DONE => settle(number, W::Done::of_bytes(content)),
                FAILED => fail(number, error()),
                LEAVES => {
                    others -= 1;
                    of_others.fetch_add(number, Ordering::Relaxed);
                    if !content.is_empty() {
                        fail(0, error());
                    }
                    continue;
                }
                _ => {}
            }
            let answer = draw().and_then(|number| match task(number).and_then(|task| task.to_bytes()) {
                Ok(bytes) => Some(put_together(TASK, number, &bytes)),
                Err(error) => {
                    fail(number, error);
                    None
                }
            });
            team.send(rank, &answer.unwrap_or_else(|| put_together(NO_TASK, 0, &[])));
        }
    };
    thread::scope(|scope| {
        if let Some(team) = team {
            scope.spawn(move || serve(team));
        }
        on_all_threads(|| {
            while let Some(number) = draw() {
                settle(number, task(number).and_then(|task| performed(work, task)));
            }
        });
    });
    let ended = match failed.into_inner().unwrap_or_else(PoisonError::into_inner) {
        Some((_, error)) => Err(error),
        None => Ok(()),
    };
    Ran { threads: rayon::current_num_threads() + of_others.into_inner(), ended }
}

/// Another rank than 0: does tasks of a [`run`] on all threads of this rayon pool until there are none left; `work` is what rank 0 sent of
/// it. If that cannot be had here, rank 0 hears why.
///
/// # Errors
///
/// Why it could not be had.
pub fn take_part<W: Work>(team: &dyn Team, work: Result<&[u8]>) -> Result<()> {
    let prepared = work.and_then(W::of_bytes);
    let text = prepared.as_ref().err().map_or(String::new(), Error::to_string);
    let ended = prepared.map(|work| {
        // One thread at a time asks and waits for the answer.
        let talk = Mutex::new(());
        let ask = |message: Vec<u8>| -> Option<(usize, Vec<u8>)> {
            let _talk = talk.lock().unwrap_or_else(PoisonError::into_inner);
            team.send(0, &message);
            let (_, answer) = await_message(team);
            let (kind, number, content) = taken_apart(&answer);
            (kind == TASK).then(|| (number, content.to_vec()))
        };
        on_all_threads(|| {
            let mut drawn = ask(put_together(ASKS, 0, &[]));
            while let Some((number, task)) = drawn {
                let done = W::Task::of_bytes(&task).and_then(|task| performed(&work, task)?.to_bytes());
                drawn = match done {
                    Ok(done) => ask(put_together(DONE, number, &done)),
                    Err(error) => ask(put_together(FAILED, number, error.to_string().as_bytes())),
                };
            }
        });
        rayon::current_num_threads()
    });
    // Who has no work has no pool either.
    team.send(0, &put_together(LEAVES, ended.as_ref().map_or(0, |threads| *threads), text.as_bytes()));
    ended.map(drop)
}

/// Another rank than 0: tells rank 0, which waits for it in a [`run`], why it cannot take part.
pub fn decline(team: &dyn Team, why: &Error) {
    team.send(0, &put_together(LEAVES, 0, why.to_string().as_bytes()));
}

/// Runs `work` on each thread of this rayon pool. It is no parallel iterator, and all threads begin together: a thread that waits within a
/// task must not begin another one meanwhile, which could wait for what the first one holds.
fn on_all_threads(work: impl Fn() + Sync) {
    let begin = Barrier::new(rayon::current_num_threads());
    rayon::broadcast(|_| {
        begin.wait();
        work();
    });
}

/// Does `task`; a panic is an error too, so that the other tasks end at once.
fn performed<W: Work>(work: &W, task: W::Task) -> Result<W::Done> {
    catch_unwind(AssertUnwindSafe(|| work.perform(task)))
        .unwrap_or_else(|_| Err(Error::Fault(format!("a task of {} panicked", W::NAME))))
}

fn put_together(kind: u8, number: usize, content: &[u8]) -> Vec<u8> {
    [&[kind][..], &(number as u64).to_le_bytes(), content].concat()
}

fn taken_apart(message: &[u8]) -> (u8, usize, &[u8]) {
    match message.split_at_checked(9) {
        Some((head, content)) => {
            let number = head[1..].try_into().map_or(usize::MAX, |bytes| u64::from_le_bytes(bytes) as usize);
            (head[0], number, content)
        }
        None => (ASKS, 0, &[]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cluster::testing::team;

    /// Squares numbers, and fails at those that are `bad`.
    #[derive(serde::Serialize, serde::Deserialize)]
    struct Squares {
        bad: Vec<u64>,
    }

    impl Work for Squares {
        const NAME: &'static str = "squares";
        type Task = u64;
        type Done = u64;

        fn perform(&self, task: u64) -> Result<u64> {
            thread::sleep(Duration::from_micros(200));
            assert!(task != 9 || !self.bad.contains(&9), "a bad nine");
            match self.bad.contains(&task) {
                true => Err(Error::Input(format!("{task} is bad"))),
                false => Ok(task * task),
            }
        }
    }

    /// What rank 0 of `ranks` keeps of the squares of 0 to 40, and how it ended.
    fn squares(ranks: usize, bad: &[u64], keep: impl Fn(usize) -> Result<()> + Sync) -> (Vec<Option<u64>>, Ran) {
        let pool = || rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap();
        let work = Squares { bad: bad.to_vec() };
        let kept = Mutex::new(vec![None; 40]);
        let team = team(ranks);
        let ran = thread::scope(|scope| {
            for rank in &team[1..] {
                let bytes = work.to_bytes().unwrap();
                scope.spawn(move || pool().install(|| take_part::<Squares>(rank, Ok(&bytes))));
            }
            let keep = |number: usize, done| {
                kept.lock().unwrap()[number] = Some(done);
                keep(number)
            };
            let team = (ranks > 1).then(|| &team[0] as &dyn Team);
            pool().install(|| run_among(team, &work, 40, |number| Ok(number as u64), keep))
        });
        (kept.into_inner().unwrap(), ran)
    }

    #[test]
    fn every_task_is_done_once_whoever_does_it_and_all_threads_are_counted() {
        let expected: Vec<Option<u64>> = (0..40).map(|number| Some(number * number)).collect();
        for ranks in [1, 2, 4] {
            let (kept, ran) = squares(ranks, &[], |_| Ok(()));
            assert!(kept == expected && ran.ended.is_ok(), "{ranks}");
            assert_eq!(ran.threads, 2 * ranks);
        }
    }

    #[test]
    fn an_error_of_a_task_or_of_who_keeps_results_ends_the_work() {
        for ranks in [1, 3] {
            let (kept, ran) = squares(ranks, &[7], |_| Ok(()));
            assert!(kept[7].is_none() && ran.ended.unwrap_err().to_string().contains("7 is bad"), "{ranks}");
            let (kept, ran) = squares(ranks, &[], |_| Err(Error::Interrupted));
            assert!(kept.iter().any(Option::is_none) && matches!(ran.ended, Err(Error::Interrupted)), "{ranks}");
        }
    }

    #[test]
    fn a_panic_in_a_task_ends_the_work_with_an_error() {
        for ranks in [1, 3] {
            let (kept, ran) = squares(ranks, &[9], |_| Ok(()));
            assert!(kept[9].is_none(), "{ranks}");
            assert!(ran.ended.unwrap_err().to_string().contains("a task of squares panicked"), "{ranks}");
        }
    }

    #[test]
    fn a_rank_that_cannot_take_part_is_named() {
        let team = team(2);
        let ran = thread::scope(|scope| {
            let other = &team[1];
            scope.spawn(|| take_part::<Squares>(other, Ok(b"nonsense")));
            run_among(Some(&team[0]), &Squares { bad: vec![] }, 40, |number| Ok(number as u64), |_, _| Ok(()))
        });
        assert!(ran.ended.unwrap_err().to_string().starts_with("rank 1 of 2"));
    }
}
