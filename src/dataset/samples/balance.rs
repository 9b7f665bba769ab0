//! Fewer rows of the steering values that are too common: the `[balance]` table of a recipe.

use super::labels::Targets;
use super::spec::Item;
use crate::engine::random::{Purpose, rng, shuffle};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};

/// The `[balance]` table of a recipe: fewer rows of the steering values that are too common.
///
/// Which rows are kept is drawn once a run. Only training rows are left out, except that with the split
/// `random-images` it happens before the split, as in the second write-up.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Balance {
    /// Share kept of the rows whose steering is exactly 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub keep_zero: Option<f64>,
    /// Number of equally wide steering bins from -1 to 1; goes with `histogram_max`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub histogram_bins: Option<usize>,
    /// Most rows kept in each bin.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub histogram_max: Option<usize>,
}

impl Balance {
    /// Checks the numbers.
    ///
    /// # Errors
    /// [`Error::Usage`] naming the key.
    pub fn validate(&self) -> Result<()> {
        if self.keep_zero.is_some_and(|x| !(0.0..=1.0).contains(&x)) {
            return Err(Error::Usage("[balance] keep_zero: must be 0 to 1".into()));
        }
        if self.histogram_bins.is_some() != self.histogram_max.is_some() {
            return Err(Error::Usage("[balance] histogram_bins and histogram_max go together".into()));
        }
        if self.histogram_bins.is_some_and(|bins| !(1..=10_000).contains(&bins)) {
            return Err(Error::Usage("[balance] histogram_bins: must be 1 to 10000".into()));
        }
        Ok(())
    }

    /// Leaves out items, which have labels; returns how many.
    pub(super) fn apply(&self, items: &mut Vec<Item>, targets: &Targets, seed: u64) -> usize {
        let before = items.len();
        if let Some(share) = self.keep_zero {
            let zeros: Vec<u32> = positions(items, |item| targets.label(*item) == Some(0.0));
            let kept = (share * zeros.len() as f64).round() as usize;
            thin_out(items, zeros, kept, seed, 0);
        }
        if let (Some(bins), Some(most)) = (self.histogram_bins, self.histogram_max) {
            let bin_of = |item: &Item| {
                let share = (f64::from(targets.label(*item).unwrap_or(0.0)) + 1.0) / 2.0;
                ((share * bins as f64) as usize).min(bins - 1)
            };
            for bin in 0..bins {
                let members = positions(items, |item| bin_of(item) == bin);
                thin_out(items, members, most, seed, 1 + bin as u64);
            }
        }
        before - items.len()
    }
}

fn positions(items: &[Item], chosen: impl Fn(&Item) -> bool) -> Vec<u32> {
    (0..items.len() as u32).filter(|&i| chosen(&items[i as usize])).collect()
}

/// Keeps `kept` of the items at `members`, chosen at random, and all others.
fn thin_out(items: &mut Vec<Item>, mut members: Vec<u32>, kept: usize, seed: u64, stream: u64) {
    if members.len() <= kept {
        return;
    }
    shuffle(&mut rng(seed, Purpose::Balance, 0, stream), &mut members);
    let mut dropped = members.split_off(kept);
    dropped.sort_unstable();
    let mut dropped = dropped.into_iter().peekable();
    let mut position = 0;
    items.retain(|_| {
        let keep = dropped.next_if_eq(&position).is_none();
        position += 1;
        keep
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::recording::View;
    use crate::dataset::testing::recording_of;

    #[test]
    fn zeros_are_thinned_to_the_share_asked_for() {
        let steering: Vec<f32> = (0..1000).map(|i| if i % 2 == 0 { 0.0 } else { 0.3 }).collect();
        let targets = Targets::wheel(&[recording_of(&steering, 100)]);
        let all: Vec<Item> = (0..1000).map(|row| Item::new(0, row, [View::Centre])).collect();
        let balance = Balance { keep_zero: Some(0.4), ..Default::default() };
        let run = |seed| {
            let mut items = all.clone();
            assert_eq!(balance.apply(&mut items, &targets, seed), 300);
            items
        };
        let items = run(1);
        let zeros = items.iter().filter(|item| targets.label(**item) == Some(0.0)).count();
        assert_eq!((items.len(), zeros), (700, 200));
        assert!(items.is_sorted());
        assert_eq!(items, run(1));
        assert_ne!(items, run(2));
    }

    #[test]
    fn no_bin_holds_more_than_its_most() {
        let steering: Vec<f32> = (0..1000).map(|i| (i as f32 / 1000.0).powi(3)).collect();
        let targets = Targets::wheel(&[recording_of(&steering, 100)]);
        let mut items: Vec<Item> = (0..1000).map(|row| Item::new(0, row, [View::Centre])).collect();
        Balance { histogram_bins: Some(20), histogram_max: Some(50), ..Default::default() }
            .apply(&mut items, &targets, 3);
        let mut counts = [0; 20];
        for item in &items {
            counts[((targets.label(*item).unwrap() + 1.0) * 10.0) as usize] += 1;
        }
        assert!(counts.iter().all(|&n| n <= 50) && counts[10] == 50, "{counts:?}");
    }
}
