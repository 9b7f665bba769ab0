//! Batch-norm statistics of averaged weights, fitted anew where the recipe says so.

use ndarray::ArrayView1;

use super::checkpoint::State;
use super::data::images;
use super::together::Together;
use crate::dataset::loader::{Batch, Loader};
use crate::engine::loss::{PairTerms, Smoothness};
use crate::engine::network::{Network, StepInput, TrainingPlan};
use crate::error::Result;

/// Fits the running statistics to the averaged weights, over the first batches of the epoch of `training`, if the recipe asks for
/// that and the average has begun. It begins with the statistics of the weights under way. Call it before each evaluation.
///
/// # Errors
///
/// [`Error::Io`](crate::Error::Io) if the image cache fails.
pub(super) fn refit_statistics(
    state: &mut State,
    (network, plan): (&Network, &mut TrainingPlan),
    (training, together): (&Loader, &Together),
    [current, next]: &mut [Batch; 2],
    seed: u64,
) -> Result<()> {
    let Some(average) = state.average.as_mut().filter(|average| average.updates > 0) else { return Ok(()) };
    let batches = training.batches().min(average.spec().refit_batches() as usize);
    if batches == 0 {
        return Ok(());
    }
    let parameters = &mut average.parameters;
    parameters.statistics.copy_from_slice(&state.parameters.statistics);
    let filled = together.fill(training, 0, current);
    let complete = together.meet(filled, Ok(()))?;
    together.settle(training, current, complete)?;
    for batch in 0..batches {
        // The next batch is loaded while the network looks at this one.
        let ((), filled) = rayon::join(
            || {
                if current.n > 0 {
                    let (x, labels) = (images(network.input(), current), ArrayView1::from(&current.labels));
                    let input = StepInput { x, labels, seed, step: batch as u64 };
                    let pairs = PairTerms::new(&Smoothness::default(), current.pairs);
                    plan.pass_statistics(network, parameters, &pairs, input, current.n);
                }
            },
            || if batch + 1 < batches { together.fill(training, batch + 1, next) } else { Ok(true) },
        );
        let complete = together.meet(filled, Ok(()))?;
        std::mem::swap(current, next);
        if batch + 1 < batches {
            together.settle(training, current, complete)?;
        }
    }
    Ok(())
}
