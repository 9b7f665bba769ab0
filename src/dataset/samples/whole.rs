//! A validation side of whole recordings: drives that no row of the training side belongs to.

use std::collections::HashSet;

use super::split::{
    Split, SplitMode, SplitSpec, all_rows, drop_low_throttle, drop_unlabelled, refuse_too_many, set_cameras,
};
use super::{Balance, Item, SampleSpec, Targets};
use crate::dataset::recording::Recording;
use crate::{Error, Result};

/// Puts the recordings, whose labels are `targets`, from number `first` on, whole, on the validation side, and those before on the
/// training side. Rows of the training side whose picture stands on the validation side too are left out.
///
/// # Errors
///
/// If a table is wrong, or if one of the sides would be empty.
pub fn split_whole(
    recordings: &[Recording],
    first: usize,
    targets: &Targets,
    samples: &SampleSpec,
    balance: &Balance,
    seed: u64,
) -> Result<Split> {
    samples.validate()?;
    balance.validate()?;
    refuse_too_many(recordings)?;
    let (mut validation, mut training): (Vec<Item>, Vec<Item>) =
        all_rows(recordings).into_iter().partition(|item| usize::from(item.recording) >= first);
    let picture = |item: &Item| recordings[usize::from(item.recording)].picture_hash(item.row as usize);
    let held_out: HashSet<u64> = validation.iter().filter_map(picture).collect();
    let before = training.len();
    training.retain(|item| picture(item).is_none_or(|hash| !held_out.contains(&hash)));
    let mut notices = Vec::new();
    if training.len() < before {
        let twins = before - training.len();
        notices.push(format!("{twins} training rows show a picture of the validation recordings and are left out"));
    }
    let low_throttle_rows =
        [&mut training, &mut validation].map(|side| drop_low_throttle(side, recordings, samples)).iter().sum();
    let unlabelled_rows = [&mut training, &mut validation].map(|side| drop_unlabelled(side, targets)).iter().sum();
    let balanced_rows = balance.apply(&mut training, targets, seed);
    let sides = samples.side_cameras.is_some();
    set_cameras(&mut training, recordings, sides);
    set_cameras(&mut validation, recordings, sides && samples.validation_side_cameras);
    for (side, name) in [(&training, "training"), (&validation, "validation")] {
        if side.is_empty() {
            let message = format!("no {name} rows are left: record more, or leave out less");
            return Err(Error::Data { place: "the recordings".into(), message });
        }
    }
    let spec = SplitSpec { mode: SplitMode::Blocks, validation_share: 0.0 };
    Ok(Split {
        spec,
        whole: true,
        training,
        times: Vec::new(),
        simulator: Vec::new(),
        validation,
        guard_rows: 0,
        low_throttle_rows,
        unlabelled_rows,
        unrecorded: targets.unrecorded(),
        balanced_rows,
        notices,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::testing::recording_of;
    use crate::dataset::{Correction, Recording, View};

    fn split_of(recordings: &[Recording], first: usize, samples: &SampleSpec) -> Result<Split> {
        split_whole(recordings, first, &Targets::wheel(recordings), samples, &Balance::default(), 1)
    }

    #[test]
    fn the_last_recordings_are_the_validation_side_and_nothing_of_the_others_is() {
        let recordings = [recording_of(&[0.1; 30], 100), recording_of(&[0.2; 20], 100), recording_of(&[0.3; 10], 100)];
        let samples = SampleSpec { side_cameras: Some(Correction::Fixed(0.2)), ..SampleSpec::default() };
        let split = split_of(&recordings, 2, &samples).unwrap();
        assert_eq!((split.training.len(), split.validation.len(), split.guard_rows), (50, 10, 0));
        assert!(split.training.iter().all(|item| item.recording < 2 && item.cameras().count() == 3));
        assert!(split.validation.iter().all(|item| item.recording == 2 && item.cameras().eq([View::Centre])));
        assert!(split.summary().starts_with("split by recording: 50 training rows (150 images), 10 validation"));
        assert!(split_of(&recordings, 3, &samples).unwrap_err().to_string().contains("no validation rows"));
        assert!(split_of(&recordings, 0, &samples).unwrap_err().to_string().contains("no training rows"));
    }

    #[test]
    fn pictures_that_stand_on_both_sides_are_not_trained_on() {
        let mut recordings = [recording_of(&[0.1; 4], 100), recording_of(&[0.2; 3], 100)];
        recordings[0].picture_hashes = vec![1, 2, 3, 4];
        recordings[1].picture_hashes = vec![9, 3, 8];
        let split = split_of(&recordings, 1, &SampleSpec::default()).unwrap();
        assert_eq!(split.training.iter().map(|item| item.row).collect::<Vec<_>>(), [0, 1, 3]);
        assert_eq!(split.validation.len(), 3);
        assert!(split.summary().contains("1 training rows show a picture"));
    }
}
