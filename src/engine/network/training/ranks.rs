//! What a training step needs of the other processes that train with this one.

use std::fmt;

/// The processes that share the batches of a training: each is a rank, from 0.
///
/// All ranks call the same functions in the same order. A function that cannot reach the others does not return: the whole job ends.
pub trait Ranks: fmt::Debug + Send + Sync {
    /// This process.
    fn rank(&self) -> usize;

    /// Number of processes.
    fn size(&self) -> usize;

    /// Writes the numbers of all ranks to `all`, one rank after the other; those of this one are `mine`, and rank `r` has `counts[r]`.
    fn gather_f64(&self, mine: &[f64], counts: &[usize], all: &mut [f64]);

    /// The same of single precision.
    fn gather_f32(&self, mine: &[f32], counts: &[usize], all: &mut [f32]);

    /// Sends `send_counts[r]` of the numbers in `send` to each rank `r`, and receives `receive_counts[r]` from it; those of one rank after
    /// those of the other.
    fn exchange_f32(&self, send: &[f32], send_counts: &[usize], receive: &mut [f32], receive_counts: &[usize]);
}
