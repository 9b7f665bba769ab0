//! DAgger (Ross, Gordon and Bagnell 2011): the model drives, and the expert labels every frame with its own steering.

use std::path::{Path, PathBuf};

use super::training_set::{Take, with_requests};
use crate::error::Result;
use crate::files::new_folder::NewFolder;
use crate::observer::{Observer, Progress};
use crate::pilot::Pilot;
use crate::simulator::{Wheel, record_driven};

/// Fraction of each take's laps that the model drives.
const LAPS: f64 = 0.5;

/// The takes of `round` (from 1): the plain ones among `takes`, shortened, with new starts and light.
fn takes_of_round(takes: &[Take], round: u32) -> Vec<Take> {
    let plain = takes.iter().filter(|take| !take.recovery).cloned();
    plain.map(|take| Take { laps: LAPS * take.laps, seed: take.seed + 1000 * u64::from(round), ..take }).collect()
}

/// Share of the seconds in which the expert drives in `round`: 1/2, 1/4, …. Each round shows more of the model's own errors.
fn expert_share(round: u32) -> f64 {
    0.5f64.powi(round.min(60) as i32)
}

/// The recordings of `round` in the folder `out`: the plain ones of `takes`, driven by `pilot`, labelled by the expert;
/// recorded first if `out` is not there yet.
///
/// # Errors
///
/// As [`super::training_set::recordings`].
pub fn recordings(
    pilot: &Pilot,
    takes: &[Take],
    out: &Path,
    round: u32,
    observer: &mut (dyn Observer<Progress> + Send),
) -> Result<Vec<PathBuf>> {
    let takes = takes_of_round(takes, round);
    if !out.exists() {
        let new = NewFolder::create(out)?;
        let wheel = Wheel::Model(Box::new(pilot.clone()));
        let recorded = with_requests(&takes, None, new.unfinished(), |requests| {
            record_driven(requests, &wheel, expert_share(round), observer)
        });
        recorded.map_err(|error| new.explain(error))?;
        new.finish()?;
    }
    Ok(takes.iter().map(|take| out.join(take.folder())).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_round_drives_other_takes_and_leans_less_on_the_expert() {
        let all = super::super::training_set::takes();
        let (first, second) = (takes_of_round(&all, 1), takes_of_round(&all, 2));
        assert!(first.iter().zip(&second).all(|(a, b)| a.seed != b.seed && a.track == b.track && !a.recovery));
        assert_eq!([1, 2].map(expert_share), [0.5, 0.25]);
    }
}
