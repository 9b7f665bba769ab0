//! Weighing the rows in which a person took the wheel from a model that drove: they show what the model does wrong.

use super::split::Split;
use super::{Item, SampleSpec};
use crate::dataset::recording::Recording;
use crate::engine::random::{Purpose, rng, unit};
use crate::{Error, Result};

/// Lets the training rows of `split` in which a person took over count as often as `samples` says; with a weight of 1 nothing
/// changes. Rows that count 0 times are no training rows any more. Returns the number of rows in which a person took over.
///
/// # Errors
/// [`Error::Data`] if no training row is left.
pub fn weigh(split: &mut Split, recordings: &[Recording], samples: &SampleSpec, seed: u64) -> Result<usize> {
    let taken_over = |item: &Item| recordings[usize::from(item.recording)].rows[item.row as usize].taken_over;
    let count = split.training.iter().filter(|item| taken_over(item)).count();
    if samples.takeover_weight == 1.0 || count == 0 {
        return Ok(count);
    }
    // Epoch 1: the split itself draws from epoch 0.
    let mut rng = rng(seed, Purpose::Split, 1, 0);
    let mut times = |item: &Item| match taken_over(item) {
        true => {
            let whole = samples.takeover_weight.floor();
            whole as u32 + u32::from(unit(&mut rng) < samples.takeover_weight - whole)
        }
        false => 1,
    };
    split.times = split.training.iter().map(&mut times).collect();
    let mut counted = split.times.iter();
    split.training.retain(|_| counted.next().is_some_and(|times| *times > 0));
    split.times.retain(|times| *times > 0);
    if split.training.is_empty() {
        let message = format!(
            "a person took over in all {count} training rows, and samples.takeover_weight = {} leaves none of them: raise it",
            samples.takeover_weight
        );
        return Err(Error::Data { place: "the recordings".into(), message });
    }
    Ok(count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::samples::split::SplitSpec;
    use crate::dataset::samples::{Balance, Targets};
    use crate::dataset::testing::recording_of;

    /// The split of `recordings` without a validation side, weighed.
    fn weighed(recordings: &[Recording], takeover_weight: f64) -> Result<(usize, Split)> {
        let samples = SampleSpec { takeover_weight, ..SampleSpec::default() };
        let (targets, spec) = (Targets::wheel(recordings), SplitSpec { validation_share: 0.0, ..SplitSpec::default() });
        let mut split =
            super::super::split::split(recordings, &targets, &spec, &samples, &Balance::default(), 1).unwrap();
        weigh(&mut split, recordings, &samples, 1).map(|count| (count, split))
    }

    #[test]
    fn rows_of_a_person_count_as_often_as_said_and_others_once() {
        let mut recording = recording_of(&[0.1; 1000], 100);
        recording.rows.iter_mut().skip(100).step_by(2).take(400).for_each(|row| row.taken_over = true);
        let recordings = [recording];
        let weighed = |takeover_weight| {
            let (count, split) = weighed(&recordings, takeover_weight).unwrap();
            assert_eq!(count, 400);
            split
        };
        let total = |split: &Split| split.times.iter().sum::<u32>();
        assert!(weighed(1.0).times.is_empty() && weighed(1.0).training.len() == 1000);
        assert_eq!((weighed(3.0).training.len(), total(&weighed(3.0))), (1000, 600 + 3 * 400));
        let none = weighed(0.0);
        assert_eq!((none.training.len(), none.times), (600, vec![1; 600]));
        let half = f64::from(total(&weighed(2.5)));
        assert!((half - 1600.0).abs() < 60.0, "{half}");
        let times = |row: usize| weighed(3.0).times[row];
        assert_eq!([times(0), times(100), times(101), times(102)], [1, 3, 1, 3]);
    }

    #[test]
    fn a_weight_that_leaves_no_row_is_an_error() {
        let mut recording = recording_of(&[0.1; 50], 100);
        recording.rows.iter_mut().for_each(|row| row.taken_over = true);
        let error = weighed(&[recording], 0.0).unwrap_err().to_string();
        assert!(error.contains("takeover_weight = 0 leaves none") && error.contains("all 50"), "{error}");
    }
}
