//! The audit of near twins.

use super::*;

#[test]
fn near_twins_are_found_after_an_epoch() {
    let folder = tempfile::tempdir().unwrap();
    let recordings = recordings(folder.path(), 150);
    let wheel = Arc::new(Targets::wheel(&recordings));
    let random = SplitSpec { mode: SplitMode::Random, validation_share: 0.2 };
    let split = split(&recordings, &wheel, &random, &spec().samples, &Balance::default(), 0).unwrap();
    let (mut training, mut validation) =
        Loader::pair(&recordings, &targets(&recordings, &spec()), &split, &spec()).unwrap();
    assert_eq!(validation.near_twins(&training).frames, 0);
    epochs(&mut training);
    epochs(&mut validation);
    let twins = validation.near_twins(&training);
    assert_eq!(twins.frames, 30);
    assert!(twins.share() < 0.5, "{twins:?}");
    assert_eq!(training.near_twins(&training).share(), 1.0);
}

#[test]
fn frames_are_audited_though_views_show_their_side_pictures_instead() {
    let folder = tempfile::tempdir().unwrap();
    let recordings = recordings(folder.path(), 150);
    let mut spec = geometric();
    spec.augmentation.view = Some(ViewSpec { offset_m: 2.0, turn_deg: 6.0, probability: 1.0 });
    let split = divide(&recordings, &spec);
    let mut loader = Loader::training(&recordings, &targets(&recordings, &spec), &split, &spec).unwrap();
    let mut batch = Batch::default();
    loader.begin_epoch(0);
    (0..loader.batches()).for_each(|i| loader.fill(i, &mut batch).unwrap());
    let decoded = loader.thumbnails.iter().filter_map(OnceLock::get).flatten().count();
    assert!(decoded < split.training.len(), "some centre pictures were not needed");
    assert_eq!(loader.near_twins(&loader).frames, split.training.len());
}

#[test]
fn of_a_long_side_the_audit_looks_at_one_row_in_several() {
    let folder = tempfile::tempdir().unwrap();
    let recordings = recordings(folder.path(), 150);
    let mut spec = geometric();
    spec.augmentation.view = Some(ViewSpec { offset_m: 2.0, turn_deg: 6.0, probability: 1.0 });
    let split = divide(&recordings, &spec);
    let targets = targets(&recordings, &spec);
    let (mut training, mut validation) = Loader::pair(&recordings, &targets, &split, &spec).unwrap();
    // As on sides with more rows than frames are kept.
    (validation.compared_every, training.compared_every) = (2, 3);
    let mut batch = Batch::default();
    for loader in [&training, &validation] {
        (0..loader.batches()).for_each(|i| loader.fill(i, &mut batch).unwrap());
    }
    let twins = validation.near_twins(&training);
    assert_eq!((twins.frames, twins.one_row_in), (split.validation.len().div_ceil(2), [2, 3]));
    let of_itself = training.near_twins(&training);
    assert_eq!((of_itself.frames, of_itself.share()), (split.training.len().div_ceil(3), 1.0));
    // Another process that is told of the pictures counts the same.
    let mut other = Loader::training(&recordings, &targets, &split, &spec).unwrap();
    other.compared_every = 3;
    training.thumbnails(|piece| other.take_thumbnails(piece));
    assert_eq!(validation.near_twins(&other), twins);
}

#[test]
fn whether_a_row_that_counts_several_times_is_looked_at_does_not_depend_on_which_is_decoded_first() {
    let folder = tempfile::tempdir().unwrap();
    let recordings = recordings(folder.path(), 150);
    let mut split = divide(&recordings, &spec());
    split.times = vec![3; split.training.len()];
    for epoch in 0..4 {
        let targets = targets(&recordings, &spec());
        let mut loader = Loader::training(&recordings, &targets, &split, &spec()).unwrap();
        loader.compared_every = 2;
        loader.begin_epoch(epoch);
        let mut batch = Batch::default();
        (0..loader.batches()).for_each(|i| loader.fill(i, &mut batch).unwrap());
        // The first items of the rows have the numbers 0, 3, 6, …
        assert_eq!(loader.near_twins(&loader).frames, split.training.len().div_ceil(2));
    }
}
