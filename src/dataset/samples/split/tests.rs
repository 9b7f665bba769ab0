use super::*;
use crate::dataset::augment::Augmentation;
use crate::dataset::leak::LeakAudit;
use crate::dataset::testing::{recording_of, recordings_folder};
use crate::dataset::{Correction, LabelKind, LabelSpec};

/// A recording of several sessions, each of `rows` rows every 100 ms, with a minute between them. The steering of
/// session i is i / 10.
fn sessions(rows: &[usize]) -> Recording {
    let steering: Vec<f32> =
        rows.iter().enumerate().flat_map(|(i, &n)| std::iter::repeat_n(i as f32 / 10.0, n)).collect();
    let mut recording = recording_of(&steering, 100);
    let mut row = 0;
    recording.sessions.clear();
    for (i, &n) in rows.iter().enumerate() {
        for row in &mut recording.rows[row..row + n] {
            row.time_ms += 60_000 * i as i64;
        }
        recording.sessions.push(row..row + n);
        row += n;
    }
    recording
}

fn run(recordings: &[Recording], mode: SplitMode, seed: u64) -> Split {
    let spec = SplitSpec { mode, validation_share: 0.2 };
    split(recordings, &Targets::wheel(recordings), &spec, &SampleSpec::default(), &Balance::default(), seed).unwrap()
}

#[test]
fn blocks_do_not_leak_and_stand_on_both_sides_of_each_long_session() {
    // Two directions of 150 s, some scraps, a session of 200 s in another recording.
    let recordings = [sessions(&[1500, 20, 3, 1500]), sessions(&[2000])];
    for seed in 0..50 {
        let split = run(&recordings, SplitMode::Blocks, seed);
        let audit = LeakAudit::of(&split, &recordings);
        assert_eq!((audit.within_one_second, audit.validation_rows), (0, split.validation.len()), "seed {seed}");
        let total: usize = recordings.iter().map(|r| r.rows.len()).sum();
        assert_eq!(split.training.len() + split.validation.len() + split.guard_rows, total);
        let share = split.validation.len() as f64 / total as f64;
        assert!((share - 0.2).abs() < 0.01, "seed {seed}: {share}");
        for (recording, session) in [(0, 0..1500), (0, 1523..3023), (1, 0..2000)] {
            let count = |side: &[Item]| {
                side.iter().filter(|i| i.recording == recording && session.contains(&(i.row as usize))).count()
            };
            assert!(count(&split.validation) >= 290 && count(&split.training) >= 1100, "seed {seed}");
        }
        assert!(split.training.is_sorted() && split.validation.is_sorted());
    }
}

#[test]
fn the_guard_is_at_least_a_second() {
    let recordings = [sessions(&[1500])];
    let split = run(&recordings, SplitMode::Blocks, 7);
    let time = |item: &Item| recordings[0].rows[item.row as usize].time_ms;
    for training in &split.training {
        assert!(split.validation.iter().all(|held_out| time(training).abs_diff(time(held_out)) > 1000));
    }
    assert!((20..=44).contains(&split.guard_rows), "{}", split.guard_rows);
}

#[test]
fn a_seed_gives_one_split() {
    let recordings = [sessions(&[1500, 300, 300, 300, 300, 300])];
    for mode in [SplitMode::Blocks, SplitMode::Random, SplitMode::RandomImages] {
        assert_eq!(run(&recordings, mode, 1), run(&recordings, mode, 1));
        assert_ne!(run(&recordings, mode, 1).validation, run(&recordings, mode, 2).validation);
    }
}

#[test]
fn short_sessions_go_whole_to_one_side() {
    let recordings = [sessions(&[100; 10])];
    let split = run(&recordings, SplitMode::Blocks, 3);
    assert_eq!((split.validation.len(), split.training.len(), split.guard_rows), (200, 800, 0));
    for session in &recordings[0].sessions {
        let held_out = split.validation.iter().filter(|item| session.contains(&(item.row as usize))).count();
        assert!(held_out == 0 || held_out == 100);
    }
}

#[test]
fn a_single_short_session_is_cut_with_a_notice() {
    let recordings = [sessions(&[250])];
    let split = run(&recordings, SplitMode::Blocks, 0);
    assert_eq!(LeakAudit::of(&split, &recordings).within_one_second, 0);
    assert!((45..=55).contains(&split.validation.len()));
    assert!(split.summary().contains("those of at least 10 s are cut"));
    let tiny = [sessions(&[50])];
    let error = super::split(
        &tiny,
        &Targets::wheel(&tiny),
        &SplitSpec::default(),
        &SampleSpec::default(),
        &Balance::default(),
        0,
    );
    assert!(error.unwrap_err().to_string().contains("validation_share = 0"));
    let none = SplitSpec { validation_share: 0.0, ..Default::default() };
    let split =
        super::split(&tiny, &Targets::wheel(&tiny), &none, &SampleSpec::default(), &Balance::default(), 0).unwrap();
    assert_eq!((split.training.len(), split.validation.len()), (50, 0));
}

#[test]
fn random_splits_leak_and_say_so() {
    let recordings = [sessions(&[1500])];
    for mode in [SplitMode::Random, SplitMode::RandomImages] {
        let split = run(&recordings, mode, 1);
        assert_eq!((split.training.len(), split.validation.len()), (1200, 300));
        assert!(LeakAudit::of(&split, &recordings).share() > 0.99);
        assert!(split.summary().contains("leaks"));
    }
}

#[test]
fn images_of_a_row_fall_on_both_sides_with_random_images() {
    let recordings = [sessions(&[1000])];
    let samples =
        SampleSpec { side_cameras: Some(Correction::Fixed(0.25)), validation_side_cameras: true, ..Default::default() };
    let spec = SplitSpec { mode: SplitMode::RandomImages, validation_share: 0.1 };
    let split =
        super::split(&recordings, &Targets::wheel(&recordings), &spec, &samples, &Balance::default(), 5).unwrap();
    let images = |side: &[Item]| side.iter().map(|item| item.cameras().count()).sum::<usize>();
    assert_eq!((images(&split.training), images(&split.validation)), (2700, 300));
    assert!(split.training.len() > 900 && split.validation.len() > 200);
    let centre_only = SampleSpec { validation_side_cameras: false, ..samples };
    let split =
        super::split(&recordings, &Targets::wheel(&recordings), &spec, &centre_only, &Balance::default(), 5).unwrap();
    assert!(split.validation.iter().all(|item| item.cameras().eq([View::Centre])));
}

#[test]
fn throttle_and_balance_leave_rows_out() {
    let mut recordings = [sessions(&[2000])];
    for (i, row) in recordings[0].rows.iter_mut().enumerate() {
        row.throttle = [0.0, 0.5, f32::NAN, 1.0][i % 4];
    }
    let samples =
        SampleSpec { min_throttle: Some(0.0), side_cameras: Some(Correction::Fixed(0.2)), ..Default::default() };
    let balance = Balance { keep_zero: Some(0.5), ..Default::default() };
    let split =
        super::split(&recordings, &Targets::wheel(&recordings), &SplitSpec::default(), &samples, &balance, 0).unwrap();
    assert!(split.training.iter().chain(&split.validation).all(|item| item.row % 4 != 0));
    // Every label is 0, so half of the training rows go, and none of the validation rows.
    assert!(split.balanced_rows.abs_diff(split.training.len()) <= 1);
    assert!(split.low_throttle_rows > 450 && split.validation.len() > 280);
    assert!(split.training.iter().all(|item| item.cameras().count() == 3));
    assert!(split.validation.iter().all(|item| item.cameras().count() == 1));
}

#[test]
fn rows_without_a_path_ahead_stand_on_no_side() {
    let mut recordings = [sessions(&[2000, 800])];
    recordings[0].rows[100].speed_mph = 0.0;
    let labels = LabelSpec { kind: LabelKind::Path, ..LabelSpec::default() };
    let targets = Targets::of(&recordings, &labels, &SampleSpec::default(), &Augmentation::default());
    let spec = SplitSpec { mode: SplitMode::Random, validation_share: 0.2 };
    let split = super::split(&recordings, &targets, &spec, &SampleSpec::default(), &Balance::default(), 0).unwrap();
    // At 20 mph 0.7 s are 6.26 m and rows 0.894 m apart: the last 7 of each session; and where the car stands.
    assert_eq!((split.unlabelled_rows, split.training.len() + split.validation.len()), (15, 2800 - 15));
    let used = |row: u32| split.training.iter().chain(&split.validation).any(|item| item.row == row);
    assert!(used(99) && !used(100) && used(1992) && !used(1993) && !used(2799));
    assert!(split.summary().contains("15 rows left out because the car stands"), "{}", split.summary());
}

#[test]
fn impossible_shares_are_errors() {
    for validation_share in [-0.1, 1.0, f64::NAN] {
        let spec = SplitSpec { validation_share, ..Default::default() };
        assert!(spec.validate().unwrap_err().to_string().contains("validation_share"));
    }
    assert!(toml::from_str::<SplitSpec>("mode = 'random-images'\nvalidation_share = 0.1").is_ok());
    assert!(toml::from_str::<SplitSpec>("share = 0.1").is_err());
}

#[test]
fn both_driving_directions_of_the_lake_stand_on_both_sides() {
    let Some(root) = recordings_folder() else { return };
    let recordings = [crate::dataset::load(&root.join("lake-sample")).unwrap()];
    let split = run(&recordings, SplitMode::Blocks, 1);
    assert_eq!(LeakAudit::of(&split, &recordings).within_one_second, 0);
    for half in [0..1500, 1500..3000] {
        for side in [&split.training, &split.validation] {
            assert!(side.iter().filter(|item| half.contains(&item.row)).count() > 250);
        }
    }
}
