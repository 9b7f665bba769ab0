//! Several processes, on one machine or many, that do the work of one.
//!
//! `mpirun -n 4 steersman train …` starts four processes of the same program: the ranks. Rank 0 runs the command as ever: it alone reads
//! the arguments, writes, prints and saves. The others wait for its [orders](Order) and carry them out.
//! In a training all ranks go through the same steps, each with its share of every batch, and have the same weights after each.
//!
//! # What goes over the wire
//!
//! In a step, with `P` parameters (of four bytes) on `N` ranks, where `N` is a power of two and the batch has as many shards:
//!
//! | what | bytes that a rank sends |
//! |---|---|
//! | the sum of the gradient's slices, and the slices of the sum | `2 · 4 P · (N − 1) / N` |
//! | for each batch-norm barrier, forward and backward: two sums a channel | `16 · channels · (N − 1)` |
//! | loss, and whether all could go on | `16 · (N − 1)` |
//!
//! Another `N` has up to a few subtrees a rank, and the first slices of the gradient go out once for each of them. The notice at the end of a
//! training says what was counted. Nothing is sent while the backward pass goes on: the gradient is complete only at its end in networks
//! without batch norm, and its slices are small beside the time of a step. The same notice says which share of the time of its steps each rank
//! spent where all meet; for the rank that waits least this is about what overlapping could save at most.
//!
//! # What else is shared out
//!
//! Work that consists of many [tasks] goes to whoever is free, task by task: drives, the pictures of recordings, answers to pictures. Rank 0
//! sends what all tasks have in common (a model, tracks) once, then the tasks, and writes what comes back.
//!
//! # How training scales
//!
//! On `N` machines of `c` cores a step on `B` images in `S` shards (up to 16 of a small batch; above 128 images 8 in each, and above 512 images 64 shards) takes about
//!
//! ```text
//! ceil(ceil(S / N) / c) · B / S · a  +  B · d / (N · c)  +  u  +  m · (N − 1) · l  +  v / w
//! ```
//!
//! with CPU time `a` for an image forward and backward and `d` to load it, `u` for the update of all weights, `m` meetings (two for each batch-norm
//! layer, and four), latency `l`, and `v` bytes sent (see above) at `w` bytes a second. `train --profile` gives `a`, `d` and `u`, and the notice
//! at the end `v` and the time for meetings. A batch keeps at most `S` cores busy, so many cores want large batches.
//!
//! With `hyper` on two cores (AVX-512) `a` is 1.08 ms, `d` 0.18 ms, `u` 1.6 ms and `m` 16, from `--profile` of one process, and `v` was counted as
//! 1.07 MB on 2 ranks and 1.57 MB on 4. On one busy machine 1, 2 and 4 ranks of one thread trained 765, 1,169 and 970 images/s, and the rank
//! that waited least spent 5 % of the time of its steps on meetings with 2 ranks and 21 % with 4, twice as many as cores (`default` in batches of 64: 7 and 34 %).
//! Waiting for slower ranks is in that, so it is the most that an overlap with the backward pass could win. For 2 ranks the formula gives 1,552
//! images/s: it does not know of ranks that wait for a core.
//!
//! What follows is a prediction and no measurement: images/s of `hyper` at its batch of 384 (48 shards) on 8 machines, with assumed networks of
//! `l` = 50, 20 and 5 us and `w` = 0.11, 1.1 and 11 GB/s, beside the same formula for one machine:
//!
//! | cores a machine | 1 machine | 8, 1 Gbit/s | 8, 10 Gbit/s | 8, 100 Gbit/s |
//! |---|---|---|---|---|
//! | 2 | 1,600 | 7,000 | 11,000 | 12,000 |
//! | 4 | 3,100 | 8,700 | 15,000 | 17,000 |
//! | 8 | 6,100 | 11,000 | 25,000 | 31,000 |
//! | 16 | 12,000 | 11,000 | 26,000 | 33,000 |
//! | 64 | 33,000 | 11,000 | 26,000 | 34,000 |
//!
//! From 8 machines of 6 cores on each shard has a core of its own: more cores, or more machines, need larger batches.
//!
//! # Cores and memory
//!
//! The ranks on a machine share out its cores, unless `--threads` says how many each has; a launcher that binds its processes to cores has done
//! so already. Threads are not bound beyond that. A buffer of a shard lies where the thread that first worked on it touched it, because
//! buffers are created without being written, so its pages are near that core. Each rank has the buffers of its own shards alone, all
//! weights, and the decoded pictures that it needed so far, up to `--cache`.
//!
//! With the feature `mpi` the ranks are those of MPI (see the module `mpi`); without it there is but this process.

pub mod message;
#[cfg(feature = "mpi")]
pub mod mpi;
pub mod process;
pub mod tasks;

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::engine::network::Ranks;
use crate::error::{Error, Result};

/// The processes that work together, and how they talk.
pub trait Team: Ranks {
    /// The bytes of all ranks; those of this one are `mine`. All ranks call it at once.
    fn gather_bytes(&self, mine: &[u8]) -> Vec<Vec<u8>>;

    /// Sends `message` to rank `to`.
    fn send(&self, to: usize, message: &[u8]);

    /// The next message of any rank with that rank, if one has come.
    fn try_receive(&self) -> Option<(usize, Vec<u8>)>;

    /// Number of ranks on the machine of this one.
    fn on_this_machine(&self) -> usize;

    /// Bytes that this rank has sent to others so far.
    fn sent_bytes(&self) -> u64;

    /// Time that this rank has spent so far where all ranks meet: waiting for the others, and for what is on its way.
    fn met(&self) -> Duration;
}

static TEAM: OnceLock<Arc<dyn Team>> = OnceLock::new();
static CLAIMED: AtomicBool = AtomicBool::new(false);
static ASKED_THREADS: AtomicUsize = AtomicUsize::new(0);

/// The team for one piece of work of rank 0, until it is dropped.
#[derive(Debug)]
pub struct Claim {
    team: Arc<dyn Team>,
}

impl Claim {
    /// The team, if there is one, this process leads it, and it has no other work.
    pub fn of_leader() -> Option<Claim> {
        let team = TEAM.get().filter(|team| team.rank() == 0 && team.size() > 1)?;
        (!CLAIMED.swap(true, Ordering::Acquire)).then(|| Claim { team: team.clone() })
    }

    /// The team.
    pub fn team(&self) -> &Arc<dyn Team> {
        &self.team
    }

    /// Tells the other ranks what to do, and sends them what belongs to it.
    ///
    /// # Errors
    ///
    /// [`Error::Fault`] if the order cannot be written.
    pub fn order(&self, order: &Order, with: &[&[u8]]) -> Result<()> {
        let message = message::written(order)?;
        for rank in 1..self.team.size() {
            self.team.send(rank, &message);
            with.iter().for_each(|bytes| self.team.send(rank, bytes));
        }
        Ok(())
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        CLAIMED.store(false, Ordering::Release);
    }
}

/// What rank 0 tells the others to do.
#[derive(Debug, Serialize, Deserialize)]
pub enum Order {
    /// Take part in a training.
    Train {
        /// What [`training`](crate::training) needs to know.
        job: String,
        /// Number of threads.
        threads: usize,
    },
    /// Do tasks of a piece of [work](tasks::Work). The next message says what they have in common.
    Work {
        /// The [kind of work](tasks::Work::NAME).
        name: String,
        /// Number of threads.
        threads: usize,
    },
    /// There is no more work.
    End,
}

/// Whether this process does what rank 0 tells it, and prints nothing.
pub fn follows() -> bool {
    TEAM.get().is_some_and(|team| team.rank() > 0)
}

/// Waits for the next order of rank 0.
///
/// # Errors
///
/// [`Error::Fault`] if it cannot be read.
pub fn await_order(team: &dyn Team) -> Result<Order> {
    let (_, message) = await_message(team);
    serde_json::from_slice(&message).map_err(|e| Error::Fault(format!("an order of rank 0 cannot be read: {e}")))
}

/// Waits for what rank 0 sends with an order.
pub fn await_bytes(team: &dyn Team) -> Vec<u8> {
    await_message(team).1
}

/// Waits for the next message, without keeping a core busy.
pub(crate) fn await_message(team: &dyn Team) -> (usize, Vec<u8>) {
    loop {
        match team.try_receive() {
            Some(message) => return message,
            None => std::thread::sleep(Duration::from_millis(1)),
        }
    }
}

/// Tells the other ranks that there is no more work.
#[cfg(feature = "mpi")]
fn dismiss(team: &Arc<dyn Team>) {
    if let Ok(message) = message::written(&Order::End) {
        (1..team.size()).for_each(|rank| team.send(rank, &message));
    }
}

/// How many of the cores of this machine are for this process, if others of its team run there too and no `threads` are asked for.
pub fn threads(threads: usize) -> usize {
    ASKED_THREADS.store(threads, Ordering::Relaxed);
    match TEAM.get().map(|team| team.on_this_machine()) {
        Some(ranks) if threads == 0 && ranks > 1 => {
            // A launcher that binds its processes to cores has shared them out already.
            let allowed = std::thread::available_parallelism().map_or(1, usize::from);
            allowed.min((process::cores() / ranks).max(1))
        }
        _ => threads,
    }
}

/// The number of threads that the command line of rank 0 asks for; 0 leaves it to each rank.
pub fn asked_threads() -> usize {
    ASKED_THREADS.load(Ordering::Relaxed)
}

/// Fails if a launcher started several of this program, which cannot find each other without the feature `mpi`.
///
/// # Errors
///
/// [`Error::Usage`].
#[cfg(not(feature = "mpi"))]
pub fn require_alone() -> Result<()> {
    let several = |name: &str| std::env::var(name).is_ok_and(|size| size.parse().is_ok_and(|size: usize| size > 1));
    match ["OMPI_COMM_WORLD_SIZE", "PMI_SIZE"].into_iter().find(|name| several(name)) {
        None => Ok(()),
        Some(name) => Err(Error::Usage(format!(
            "this program was started several times at once ({name}) but was built without MPI, so each would do all of the work: build \
             it with --features mpi"
        ))),
    }
}

/// The result of this rank if all ranks succeeded, else an error. All ranks call it at once.
///
/// # Errors
///
/// The error of this rank; if it has none, that of the first rank that has one, with its number.
pub fn agree<T>(team: &dyn Team, mine: Result<T>) -> Result<T> {
    let text = match &mine {
        Ok(_) => String::new(),
        Err(Error::Interrupted) => INTERRUPTED.into(),
        Err(error) => error.to_string(),
    };
    let all = team.gather_bytes(text.as_bytes());
    let mine = mine?;
    match all.iter().enumerate().find(|(_, text)| !text.is_empty()) {
        None => Ok(mine),
        Some((_, text)) if text == INTERRUPTED.as_bytes() => Err(Error::Interrupted),
        Some((rank, text)) => Err(of_rank(rank, all.len(), &String::from_utf8_lossy(text))),
    }
}

const INTERRUPTED: &str = "\0interrupted";

/// The error `text` of another rank.
pub(crate) fn of_rank(rank: usize, ranks: usize, text: &str) -> Error {
    Error::Rank(format!("rank {rank} of {ranks} (counted from 0): {text}"))
}

#[cfg(test)]
mod testing;
