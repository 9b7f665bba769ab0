//! The ranks of MPI.
//!
//! All threads of a process may call MPI here, one at a time. An error of MPI ends the whole job, as does a rank that dies.

use std::panic::AssertUnwindSafe;
use std::process::ExitCode;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use mpi::Threading;
use mpi::datatype::{Partition, PartitionMut};
use mpi::environment::Universe;
use mpi::topology::SimpleCommunicator;
use mpi::traits::*;
use sha2::{Digest, Sha256};
use steersman_kernels::Isa;

use super::{TEAM, Team, agree};
use crate::engine::network::Ranks;
use crate::error::{Error, Result};

/// What the launchers of MPI programs set: `mpirun` of Open MPI and MPICH, and `srun`.
const LAUNCHERS: [&str; 6] = ["OMPI_COMM_WORLD_SIZE", "PMIX_RANK", "PMI_RANK", "PMI_SIZE", "PMI_FD", "MPI_LOCALNRANKS"];

/// Runs `lead` on rank 0, and `follow` on the others, if a launcher of MPI started this process; else only `lead`. `say` prints what all
/// should know.
///
/// A panic of one rank ends the whole job.
pub fn run(
    lead: impl FnOnce() -> ExitCode,
    follow: impl FnOnce(&Arc<dyn Team>) -> ExitCode,
    say: impl Fn(&str),
) -> ExitCode {
    if LAUNCHERS.iter().all(|name| std::env::var_os(name).is_none()) {
        return lead();
    }
    let Some((universe, threading)) = mpi::initialize_with_threading(Threading::Serialized) else { return lead() };
    let work = || -> ExitCode {
        let team = match join(&universe, threading, &say) {
            Ok(team) => team,
            Err(error) => {
                if SimpleCommunicator::world().rank() == 0 {
                    say(&format!("error: {error}"));
                }
                return ExitCode::FAILURE;
            }
        };
        if team.rank() > 0 {
            return follow(&team);
        }
        let code = lead();
        super::dismiss(&team);
        code
    };
    std::panic::catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|_| {
        let world = SimpleCommunicator::world();
        say(&format!("error: rank {} of {} panicked; the job ends", world.rank(), world.size()));
        world.abort(101)
    })
}

/// Agrees with the other ranks on program and instruction set.
fn join(universe: &Universe, threading: Threading, say: &impl Fn(&str)) -> Result<Arc<dyn Team>> {
    let world = universe.world();
    let node = world.split_shared(world.rank());
    let team: Arc<dyn Team> = Arc::new(MpiTeam {
        rank: world.rank() as usize,
        size: world.size() as usize,
        on_this_machine: node.size() as usize,
        sent_bytes: AtomicU64::new(0),
        met_ns: AtomicU64::new(0),
        calls: Mutex::default(),
    });
    let threads = match threading {
        Threading::Serialized | Threading::Multiple => Ok(()),
        _ => Err(Error::System(
            "this MPI library lets only the first thread of a process call it; another build can do more".into(),
        )),
    };
    agree(&*team, threads)?;
    let programs = team.gather_bytes(&agree(&*team, program())?);
    if let Some(rank) = programs.iter().position(|program| *program != programs[0]) {
        return Err(super::of_rank(
            rank,
            team.size(),
            "the program there is not that of rank 0; start the same one everywhere",
        ));
    }
    let offered = team.gather_bytes(Isa::wanted().name().as_bytes());
    let available = Isa::available();
    let place = |name: &[u8]| available.iter().position(|isa| isa.name().as_bytes() == name);
    // What is unknown here is above all that is known.
    let lowest = offered.iter().filter_map(|name| place(name)).min().unwrap_or(0);
    let isa = available[lowest].lower_best();
    if team.rank() == 0 {
        say(&format!("{} ranks compute with {} vector code", team.size(), isa.name()));
    }
    TEAM.set(team.clone()).map_err(|_| Error::Fault("this process has joined its team already".into()))?;
    Ok(team)
}

/// Version and digest of this program.
fn program() -> Result<Vec<u8>> {
    let path = std::env::current_exe().map_err(Error::io("this program"))?;
    let digest = Sha256::digest(std::fs::read(&path).map_err(Error::io(&path))?);
    Ok([env!("CARGO_PKG_VERSION").as_bytes(), &digest].concat())
}

#[derive(Debug)]
struct MpiTeam {
    rank: usize,
    size: usize,
    on_this_machine: usize,
    sent_bytes: AtomicU64,
    met_ns: AtomicU64,
    /// MPI is called by one thread at a time.
    calls: Mutex<()>,
}

impl MpiTeam {
    fn call(&self) -> (MutexGuard<'_, ()>, SimpleCommunicator) {
        (self.calls.lock().unwrap_or_else(PoisonError::into_inner), SimpleCommunicator::world())
    }

    fn count(&self, bytes: usize) {
        self.sent_bytes.fetch_add(bytes as u64, Ordering::Relaxed);
    }

    /// The same from each rank, and sent to each other one.
    fn gather<T: Equivalence>(&self, mine: &[T], counts: &[usize], all: &mut [T]) {
        // MPI takes no empty buffer, and all ranks know that nobody has anything.
        if all.is_empty() {
            return;
        }
        self.meet(|world| {
            self.count(size_of_val(mine) * (self.size - 1));
            let (counts, starts) = counts_and_starts(counts);
            world.all_gather_varcount_into(mine, &mut PartitionMut::new(all, counts, starts));
        });
    }

    /// Does `together` what all ranks do at once, and adds its time.
    fn meet(&self, together: impl FnOnce(SimpleCommunicator)) {
        let began = Instant::now();
        let (_call, world) = self.call();
        together(world);
        self.met_ns.fetch_add(began.elapsed().as_nanos() as u64, Ordering::Relaxed);
    }
}

/// As MPI wants them: the counts, and the sums of those before.
fn counts_and_starts(counts: &[usize]) -> (Vec<i32>, Vec<i32>) {
    let number = |count: usize| i32::try_from(count).expect("MPI counts to 2^31");
    let starts = counts.iter().scan(0, |end, count| {
        *end += count;
        Some(number(*end - count))
    });
    (counts.iter().map(|count| number(*count)).collect(), starts.collect())
}

impl Ranks for MpiTeam {
    fn rank(&self) -> usize {
        self.rank
    }

    fn size(&self) -> usize {
        self.size
    }

    fn gather_f64(&self, mine: &[f64], counts: &[usize], all: &mut [f64]) {
        self.gather(mine, counts, all);
    }

    fn gather_f32(&self, mine: &[f32], counts: &[usize], all: &mut [f32]) {
        self.gather(mine, counts, all);
    }

    fn exchange_f32(&self, send: &[f32], send_counts: &[usize], receive: &mut [f32], receive_counts: &[usize]) {
        self.meet(|world| {
            self.count(4 * (send.len() - send_counts[self.rank]));
            let (send_counts, send_starts) = counts_and_starts(send_counts);
            let (receive_counts, receive_starts) = counts_and_starts(receive_counts);
            let send = Partition::new(send, send_counts, send_starts);
            world.all_to_all_varcount_into(&send, &mut PartitionMut::new(receive, receive_counts, receive_starts));
        });
    }
}

impl Team for MpiTeam {
    fn on_this_machine(&self) -> usize {
        self.on_this_machine
    }

    fn gather_bytes(&self, mine: &[u8]) -> Vec<Vec<u8>> {
        let mut lens = vec![0u64; self.size];
        self.gather(&[mine.len() as u64], &vec![1; self.size], &mut lens);
        let lens: Vec<usize> = lens.into_iter().map(|len| len as usize).collect();
        let mut all = vec![0; lens.iter().sum()];
        self.gather(mine, &lens, &mut all);
        let mut rest = &all[..];
        let parts = lens.iter().map(|len| {
            let (part, after) = rest.split_at(*len);
            rest = after;
            part.to_vec()
        });
        parts.collect()
    }

    fn send(&self, to: usize, message: &[u8]) {
        let (_call, world) = self.call();
        self.count(message.len());
        world.process_at_rank(to as i32).send(message);
    }

    fn try_receive(&self) -> Option<(usize, Vec<u8>)> {
        let (_call, world) = self.call();
        // The tag of `send`.
        let (message, status) = world.any_process().immediate_matched_probe_with_tag(0)?;
        let (bytes, _) = (message, status).matched_receive_vec();
        Some((status.source_rank() as usize, bytes))
    }

    fn sent_bytes(&self) -> u64 {
        self.sent_bytes.load(Ordering::Relaxed)
    }

    fn met(&self) -> Duration {
        Duration::from_nanos(self.met_ns.load(Ordering::Relaxed))
    }
}
