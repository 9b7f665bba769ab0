//! The sums over all shards of a batch: those of this process, and of the others where several train together.

use std::ops::Range;
use std::sync::Arc;

use steersman_kernels::{Isa, update};

use super::ranks::Ranks;
use super::shard::Shard;
use super::shard_tree::{Sharding, fold, subtrees};

/// Which shards of the batch this process owns, and how its sums become those of all.
///
/// A gradient goes over the wire in two parts: each rank sums a slice of it, for which it receives that slice of the gradients of all
/// whole subtrees, and then all receive the summed slices. So a rank sends about two gradients a step, and not one to each other rank.
#[derive(Debug)]
pub(super) struct Reduction {
    /// Absent where this process trains alone.
    ranks: Option<Arc<dyn Ranks>>,
    sharding: Sharding,
    /// The shards of this process.
    own: Range<usize>,
    /// The largest whole subtrees of each rank's shards, one rank after the other.
    roots: Vec<Range<usize>>,
    /// Which of them are those of each rank.
    roots_of: Vec<Range<usize>>,
    own_sums: Vec<f64>,
    all_sums: Vec<f64>,
    send: Vec<f32>,
    receive: Vec<f32>,
    send_counts: Vec<usize>,
    receive_counts: Vec<usize>,
}

impl Reduction {
    /// The sums of a process that trains alone, unless there are other `ranks`.
    pub fn new(ranks: Option<Arc<dyn Ranks>>) -> Reduction {
        let size = ranks.as_ref().map_or(1, |ranks| ranks.size());
        Reduction {
            ranks,
            sharding: Sharding::new(1, false),
            own: 0..0,
            roots: Vec::new(),
            roots_of: vec![0..0; size],
            own_sums: Vec::new(),
            all_sums: Vec::new(),
            send: Vec::new(),
            receive: Vec::new(),
            send_counts: vec![0; size],
            receive_counts: vec![0; size],
        }
    }

    /// Begins a batch: says which shards each process owns.
    pub fn begin(&mut self, sharding: Sharding) {
        let size = self.roots_of.len();
        self.sharding = sharding;
        self.own = sharding.run_of(self.rank(), size);
        self.roots.clear();
        for rank in 0..size {
            let before = self.roots.len();
            subtrees(0..sharding.count(), &sharding.run_of(rank, size), &mut |root| self.roots.push(root));
            self.roots_of[rank] = before..self.roots.len();
        }
    }

    /// The shards of this process.
    pub fn own(&self) -> Range<usize> {
        self.own.clone()
    }

    /// The images of the shards of this process.
    pub fn own_images(&self) -> Range<usize> {
        self.sharding.images_of_run(self.own.clone())
    }

    /// The images of its shard `index`.
    pub fn images_of(&self, index: usize) -> Range<usize> {
        self.sharding.images_of(self.own.start + index)
    }

    /// The whole subtrees of the shards of this process.
    pub fn own_roots(&self) -> &[Range<usize>] {
        &self.roots[self.roots_of[self.rank()].clone()]
    }

    fn rank(&self) -> usize {
        self.ranks.as_ref().map_or(0, |ranks| ranks.rank())
    }

    /// Writes the sum over all shards to `sums`. `sums_of` answers the numbers in a shard, `sums.len()` many; the sums of each of the own
    /// subtrees are in its first shard.
    pub fn sum<'a>(&mut self, shards: &'a [Shard], sums_of: impl Fn(&'a Shard) -> &'a [f64], sums: &mut [f64]) {
        let len = sums.len();
        let Some(ranks) = &self.ranks else {
            return sums.copy_from_slice(&sums_of(&shards[0])[..len]);
        };
        let rank = ranks.rank();
        self.own_sums.clear();
        for root in &self.roots[self.roots_of[rank].clone()] {
            self.own_sums.extend_from_slice(&sums_of(&shards[root.start - self.own.start])[..len]);
        }
        for (count, roots) in self.receive_counts.iter_mut().zip(&self.roots_of) {
            *count = roots.len() * len;
        }
        self.all_sums.resize(self.roots.len() * len, 0.0);
        ranks.gather_f64(&self.own_sums, &self.receive_counts, &mut self.all_sums);
        let add = |acc: &mut [f64], x: &[f64]| acc.iter_mut().zip(x).for_each(|(acc, x)| *acc += x);
        fold(0..self.sharding.count(), &self.roots, &mut self.all_sums, len, &add);
        sums.copy_from_slice(&self.all_sums[..len]);
    }

    /// Writes the gradient over all shards to `gradient`. That of each of the own subtrees is in its first shard, but that of the first
    /// of them in `gradient`.
    pub fn sum_gradients(&mut self, isa: Isa, shards: &[Shard], gradient: &mut [f32]) {
        let Some(ranks) = &self.ranks else { return };
        let (rank, size) = (ranks.rank(), ranks.size());
        let slice_of = |rank: usize| gradient_slice(gradient.len(), rank, size);
        let own_roots = &self.roots[self.roots_of[rank].clone()];
        self.send.clear();
        for to in 0..size {
            let slice = slice_of(to);
            for (index, root) in own_roots.iter().enumerate() {
                let from = if index == 0 { &*gradient } else { &shards[root.start - self.own.start].gradient };
                self.send.extend_from_slice(&from[slice.clone()]);
            }
            self.send_counts[to] = own_roots.len() * slice.len();
        }
        let len = slice_of(rank).len();
        for (count, roots) in self.receive_counts.iter_mut().zip(&self.roots_of) {
            *count = roots.len() * len;
        }
        self.receive.resize(self.roots.len() * len, 0.0);
        ranks.exchange_f32(&self.send, &self.send_counts, &mut self.receive, &self.receive_counts);
        let add = |acc: &mut [f32], x: &[f32]| update::sum_into(isa, acc, x);
        fold(0..self.sharding.count(), &self.roots, &mut self.receive, len, &add);
        for (from, count) in self.receive_counts.iter_mut().enumerate() {
            *count = gradient_slice(gradient.len(), from, size).len();
        }
        ranks.gather_f32(&self.receive[..len], &self.receive_counts, gradient);
    }
}

/// The part of a gradient of `len` numbers that process `rank` of `size` sums.
fn gradient_slice(len: usize, rank: usize, size: usize) -> Range<usize> {
    len * rank / size..len * (rank + 1) / size
}
