//! Training on several ranks: each makes and works on its share of every batch, and all have the same weights after every step.

use std::ops::Range;
use std::sync::Arc;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use super::checkpoint::State;
use super::data::Data;
use super::run::TrainingRun;
use super::run_folder::{RunFolder, RunInfo};
use crate::cluster::message::written;
use crate::cluster::{self, Claim, Order, Team, agree};
use crate::dataset::loader::{Batch, Loader};
use crate::engine::network::share;
use crate::error::{Error, Result};
use crate::observer::{StopSignal, Unobserved};
use crate::recipe::Recipe;

/// This process among those that train together; alone by default.
#[derive(Clone, Debug, Default)]
pub(super) struct Together {
    team: Option<Arc<dyn Team>>,
}

/// What the other ranks need to take part in a run.
#[derive(Debug, Serialize, Deserialize)]
struct Job {
    /// The run, with the paths of its recordings as they were given.
    info: RunInfo,
    recipe_name: String,
    recipe: String,
}

impl Together {
    /// Whether this process is the one that writes and tells.
    pub fn leads(&self) -> bool {
        self.team.as_ref().is_none_or(|team| team.rank() == 0)
    }

    /// The other processes and this one, if it is not alone.
    pub fn team(&self) -> Option<&Arc<dyn Team>> {
        self.team.as_ref()
    }

    /// Bytes that this process has sent to others so far.
    pub fn sent_bytes(&self) -> u64 {
        self.team.as_ref().map_or(0, |team| team.sent_bytes())
    }

    /// The share of this process of a batch of `images`.
    pub fn share(&self, images: usize, pairs: bool) -> Range<usize> {
        let (rank, ranks) = self.team.as_ref().map_or((0, 1), |team| (team.rank(), team.size()));
        share(images, pairs, rank, ranks)
    }

    /// Makes the share of batch number `batch`; [`meet`](Together::meet) takes the answer, and [`settle`](Together::settle) must follow.
    pub fn fill(&self, loader: &Loader, batch: usize, out: &mut Batch) -> Result<bool> {
        loader.fill_share(batch, out, &|images, pairs| self.share(images, pairs))
    }

    /// The end of [`fill`](Together::fill), where `complete` is the answer of all.
    pub fn settle(&self, loader: &Loader, out: &mut Batch, complete: bool) -> Result<()> {
        if let Some(team) = self.team.as_ref().filter(|_| !complete) {
            // All ranks leave out what one of them could not decode, and so have batches of the same size.
            self.meet(loader.make_whole(out).map(|()| true), Ok(()))?;
            let losses = team.gather_bytes(&agree(&**team, written(&loader.losses(out)))?);
            let read = losses.iter().try_for_each(|bytes| {
                let losses = serde_json::from_slice(bytes).map_err(|e| Error::Fault(e.to_string()))?;
                loader.take_losses(out, losses);
                Ok(())
            });
            agree(&**team, read)?;
        }
        loader.settle(out, complete, &|images, pairs| self.share(images, pairs));
        Ok(())
    }

    /// Where all ranks meet after a step: an error of one ends the work of all, and the answer is whether all of them `filled` their share
    /// of the next batch completely.
    pub fn meet(&self, filled: Result<bool>, ended: Result<()>) -> Result<bool> {
        let mine = filled.and_then(|complete| ended.map(|()| complete));
        let Some(team) = &self.team else { return mine };
        const COMPLETE: f64 = 0.0;
        const INCOMPLETE: f64 = 1.0;
        const FAILED: f64 = 2.0;
        let told = match &mine {
            Ok(true) => COMPLETE,
            Ok(false) => INCOMPLETE,
            Err(_) => FAILED,
        };
        let counts = vec![1; team.size()];
        let mut all = vec![COMPLETE; team.size()];
        team.gather_f64(&[told], &counts, &mut all);
        let worst = all.iter().fold(COMPLETE, |worst: f64, told| worst.max(*told));
        if worst == FAILED { agree(&**team, mine) } else { Ok(worst == COMPLETE) }
    }

    /// The `values` of all ranks, one rank after the other, where rank `r` has those of its share of a batch of `images`, `each` of every
    /// image.
    pub fn gather(&self, values: &[f32], images: usize, each: usize, all: &mut Vec<f32>) {
        all.clear();
        let Some(team) = &self.team else { return all.extend_from_slice(values) };
        let size = team.size();
        let counts: Vec<usize> = (0..size).map(|rank| share(images, false, rank, size).len() * each).collect();
        all.resize(images * each, 0.0);
        team.gather_f32(values, &counts, all);
    }

    /// Lets the audit of near twins of each of `loaders` on rank 0, which alone tells of them, know what all ranks know of their pictures.
    pub fn collect_thumbnails(&self, loaders: &[&Loader]) {
        let Some(team) = &self.team else { return };
        if team.rank() > 0 {
            for (number, loader) in (0u8..).zip(loaders) {
                loader.thumbnails(|piece| team.send(0, &[&[number][..], piece].concat()));
            }
            return team.send(0, &[]);
        }
        let mut others = team.size() - 1;
        while others > 0 {
            let (_, message) = cluster::await_message(&**team);
            match message.split_first() {
                Some((number, piece)) => {
                    if let Some(loader) = loaders.get(usize::from(*number)) {
                        loader.take_thumbnails(piece);
                    }
                }
                None => others -= 1,
            }
        }
    }

    /// What `mine` is on each rank. All ranks call it at once.
    pub fn of_all(&self, mine: f64) -> Vec<f64> {
        let Some(team) = &self.team else { return vec![mine] };
        let mut all = vec![0.0; team.size()];
        team.gather_f64(&[mine], &vec![1; team.size()], &mut all);
        all
    }

    /// Time that this process has spent so far where all meet.
    pub fn met(&self) -> Duration {
        self.team.as_ref().map_or(Duration::ZERO, |team| team.met())
    }
}

/// Rank 0: lets the other ranks, if there are any, take part in `run`, whose recordings were named as in `given`. The team belongs to the
/// run until the claim is dropped.
pub(super) fn invite(run: &mut TrainingRun, given: &RunInfo) -> Result<Option<Claim>> {
    let Some(claim) = Claim::of_leader() else { return Ok(None) };
    let (recipe_name, recipe) = (run.recipe.name.clone(), run.recipe.to_toml()?);
    let job = Job { info: given.clone(), recipe_name, recipe };
    let job = serde_json::to_string(&job).map_err(|e| Error::Fault(format!("the run cannot be told: {e}")))?;
    let state = run.state.to_bytes(STATE.as_ref(), &run.network)?;
    claim.order(&Order::Train { job, threads: cluster::asked_threads() }, &[])?;
    let team = claim.team().clone();
    agree(&*team, Ok(()))?;
    team.gather_bytes(&state);
    run.join(team);
    Ok(Some(claim))
}

/// Another rank: takes part in the run that `job` describes, until it ends; an error in its place tells rank 0 why this one cannot. Call it inside a rayon pool.
///
/// # Errors
///
/// [`Error::Data`] if the recordings are others than those of rank 0, and as [`train`](super::train). Rank 0 knows of every error.
pub fn take_part(team: &Arc<dyn Team>, job: Result<&str>, stop: &StopSignal) -> Result<()> {
    let prepared = job.and_then(prepare);
    let (prepared, mine) = match prepared {
        Ok(run) => (Some(run), Ok(())),
        Err(error) => (None, Err(error)),
    };
    agree(&**team, mine)?;
    let Some(mut run) = prepared else { return Ok(()) };
    let states = team.gather_bytes(&[]);
    let loaded = run.take_state(&states[0]);
    run.join(team.clone());
    run.go(loaded, &mut Unobserved, stop)
}

/// What errors call the state that rank 0 sends.
const STATE: &str = "the state of the run from rank 0";

fn prepare(job: &str) -> Result<TrainingRun> {
    let Job { info, recipe_name, recipe } =
        serde_json::from_str(job).map_err(|e| Error::Fault(format!("the order of rank 0 cannot be read: {e}")))?;
    let recipe = Recipe::parse(&recipe_name, &recipe, &[])?;
    let data = Data::of_run(&info, &recipe, info.cache_mib)?;
    if data.rows_hash() != info.rows_hash || data.pictures_hash() != info.pictures_hash {
        let place = info.recordings.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(", ");
        let message =
            "here are other rows or pictures than rank 0 has; every rank must find the same recordings at this place";
        return Err(Error::Data { place, message: message.into() });
    }
    // It writes nothing there.
    TrainingRun::new((RunFolder::at(".".as_ref()), None), info, recipe, data, None, Instant::now())
}

impl TrainingRun {
    /// From now on the run is one of several ranks.
    fn join(&mut self, team: Arc<dyn Team>) {
        self.plan.set_ranks(team.clone());
        self.together = Together { team: Some(team) };
    }

    fn take_state(&mut self, bytes: &[u8]) -> Result<()> {
        let (optimizer, average) = (self.state.optimizer.clone(), self.state.average.clone());
        self.state = State::of_bytes(STATE.as_ref(), bytes, &self.network, optimizer, average)?;
        Ok(())
    }
}
