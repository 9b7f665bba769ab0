//! Weighing the rows in which a person took the wheel from a model that drove: they show what the model does wrong.

use super::{Item, SampleSpec};
use crate::dataset::recording::Recording;
use crate::engine::random::{Purpose, rng, unit};

/// Repeats the rows of `training` in which a person took over, as often as `samples` says; with a weight of 1 nothing changes.
/// Returns their number, each counted once.
pub fn weigh(training: &mut Vec<Item>, recordings: &[Recording], samples: &SampleSpec, seed: u64) -> usize {
    let taken_over = |item: &Item| recordings[usize::from(item.recording)].rows[item.row as usize].taken_over;
    let count = training.iter().filter(|item| taken_over(item)).count();
    if samples.takeover_weight == 1.0 || count == 0 {
        return count;
    }
    // Epoch 1: the split itself draws from epoch 0.
    let mut rng = rng(seed, Purpose::Split, 1, 0);
    let weighed = training.iter().flat_map(|item| {
        let times = if taken_over(item) {
            let whole = samples.takeover_weight.floor();
            whole as usize + usize::from(unit(&mut rng) < samples.takeover_weight - whole)
        } else {
            1
        };
        std::iter::repeat_n(*item, times)
    });
    *training = weighed.collect();
    count
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::View;
    use crate::dataset::testing::recording_of;

    #[test]
    fn rows_of_a_person_count_as_often_as_said_and_others_once() {
        let mut recording = recording_of(&[0.1; 1000], 100);
        recording.rows.iter_mut().skip(100).step_by(2).take(400).for_each(|row| row.taken_over = true);
        let recordings = [recording];
        let items: Vec<Item> = (0..1000).map(|row| Item::new(0, row, [View::Centre])).collect();
        let weighed = |takeover_weight| {
            let mut training = items.clone();
            let samples = SampleSpec { takeover_weight, ..SampleSpec::default() };
            assert_eq!(weigh(&mut training, &recordings, &samples, 1), 400);
            training
        };
        assert_eq!(weighed(1.0), items);
        assert_eq!(weighed(3.0).len(), 600 + 3 * 400);
        assert_eq!(weighed(0.0).len(), 600);
        let half = weighed(2.5).len() as f64;
        assert!((half - 1600.0).abs() < 60.0, "{half}");
        let times = |row: u32| weighed(3.0).iter().filter(|item| item.row == row).count();
        assert_eq!([times(0), times(100), times(101), times(102)], [1, 3, 1, 3]);
        assert!(weighed(3.0).is_sorted());
    }
}
