//! The loop closed, small: the expert is recorded, a network learns from it and drives by its own pictures.
//!
//! Training on an unoptimised build takes minutes, so the test runs with `cargo test --release` only.
#![cfg(not(debug_assertions))]

use std::path::Path;

use steersman::Error;
use steersman::main_job::TrackResult;
use steersman::main_job::experiment::{self, ExperimentEvent, ExperimentPlan, Subject, write_csv};
use steersman::main_job::job::{Job, JobEvent, JobNote, JobRequest, Scope, test_on_tracks};
use steersman::main_job::training_set::{Take, recordings};
use steersman::observer::{StopSignal, Unobserved};
use steersman::pilot::Pilot;
use steersman::recipe::Recipe;
use steersman::simulator::{DriveOptions, Driver, Track, Zero, drive};
use steersman::training::{TrainRequest, TrainResult, TrainingEvent, train};

fn learn(folder: &Path, threads: usize) -> (TrainResult, TrackResult) {
    let take =
        |reverse, recovery, seed| Take { track: "lake".into(), laps: 0.15, reverse, recovery, seed, ..Take::default() };
    let takes = [take(false, false, 101), take(true, false, 102), take(false, true, 103), take(true, true, 104)];
    let overrides = ["epochs=8", "samples.flip=both", "samples.side_cameras=0.25"].map(String::from);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    pool.install(|| {
        let recordings = recordings(&folder.join("recordings"), &takes, None, &mut Unobserved).unwrap().0;
        let recipe = Recipe::find("lenet", &overrides).unwrap();
        let request = TrainRequest::new(recordings, recipe, folder.join(format!("run-{threads}")));
        let result = train(request, &mut Unobserved, &StopSignal::default()).unwrap();
        let pilot = Pilot::load(&result.model).unwrap();
        let options = DriveOptions { runs: 4, ..Default::default() };
        let never = StopSignal::default();
        let on_track = test_on_tracks(&pilot, &["lake"], &options, None, &mut Unobserved, &never).unwrap().remove(0);
        (result, on_track)
    })
}

#[test]
fn what_is_learned_from_the_expert_drives_and_does_so_alike_for_any_number_of_threads() {
    let folder = tempfile::tempdir().unwrap();
    let (result, lake) = learn(folder.path(), 1);
    let options = DriveOptions { runs: 4, ..Default::default() };
    let new_zero = || -> steersman::Result<Box<dyn Driver>> { Ok(Box::new(Zero)) };
    let zero = drive(&Track::load("lake").unwrap(), new_zero, &options, &mut Unobserved).unwrap().summary;
    eprintln!(
        "offline {:.2} deg; autonomy {:.1} % (zero {:.1} %), way {:.0} m (zero {:.0} m)",
        lake.offline_mae_deg,
        lake.drive.autonomy_percent,
        zero.autonomy_percent,
        lake.drive.distance_m,
        zero.distance_m
    );
    assert!(result.relative_to_zero.unwrap() < 0.8, "{result:?}");
    assert!(lake.drive.distance_m > 2.0 * zero.distance_m);
    assert!(lake.drive.interventions < zero.interventions / 2);

    let (again, same_lake) = learn(folder.path(), 2);
    assert_eq!(again.weights_hash, result.weights_hash);
    assert_eq!(same_lake.offline_mae_deg, lake.offline_mae_deg);
    assert_eq!(same_lake.drive.cte_rms_m, lake.drive.cte_rms_m);
}

fn small_scope(folder: &Path) -> Scope {
    let take =
        |recovery, seed| Take { track: "lake".into(), laps: 0.05, reverse: false, recovery, seed, ..Take::default() };
    Scope {
        recordings: folder.join("recordings"),
        takes: vec![take(false, 1), take(true, 2)],
        tracks: vec!["lake".into()],
    }
}

fn lenet(epochs: u32) -> Recipe {
    Recipe::find("lenet", &[format!("epochs={epochs}"), "split.validation_share=0.3".into()]).unwrap()
}

#[test]
fn a_job_that_was_stopped_goes_on_through_dagger_to_the_drives() {
    let folder = tempfile::tempdir().unwrap();
    let never = StopSignal::default();
    let note = JobNote { runs: 1, dagger_rounds: 1, round: 0 };
    let request = |name: &str| JobRequest {
        recipe: lenet(2),
        out: folder.path().join(name),
        seed: 5,
        cache_mib: 64,
        from: None,
        algorithm: None,
    };
    let (mut watcher, scope) = (Unobserved, small_scope(folder.path()));
    let mut whole = Job::new(scope.clone(), note.clone(), &mut watcher, &never);
    let expected = whole.begin(request("whole")).unwrap();
    assert_eq!(whole.folder().unwrap(), folder.path().join("whole-dagger-1"));
    assert_eq!((expected.drives.len(), expected.drives[0].drive.track.as_str()), (1, "lake"));
    assert!(folder.path().join("whole/dagger/lake/driving_log.csv").is_file());
    let saved = std::fs::read_to_string(folder.path().join("whole-dagger-1/drives.json")).unwrap();
    for name in ["summary.json", "free_1.csv", "assisted_1.csv"] {
        assert!(folder.path().join("whole-dagger-1/drives/lake").join(name).is_file(), "{name}");
    }
    assert!(saved.contains("\"track\": \"lake\"") && saved.contains("offline_mae_deg"), "{saved}");
    let last_note = JobNote::read(&folder.path().join("whole-dagger-1")).unwrap();
    assert_eq!(last_note, Some(JobNote { round: 1, ..note.clone() }));

    let stop = StopSignal::default();
    let mut stopper = |event| {
        if let JobEvent::Training(TrainingEvent::Epoch { .. }) = event {
            stop.request();
        }
        Ok(())
    };
    let mut stopped = Job::new(scope.clone(), note.clone(), &mut stopper, &stop);
    assert!(matches!(stopped.begin(request("stopped")), Err(Error::Interrupted)));
    let path = stopped.folder().unwrap().to_path_buf();
    assert_eq!(path, folder.path().join("stopped"));
    let note = JobNote::read(&path).unwrap().unwrap();
    let mut watcher = Unobserved;
    let result = Job::new(scope.clone(), note.clone(), &mut watcher, &never).go_on(&path).unwrap();
    assert_eq!(result.training.weights_hash, expected.training.weights_hash);
    assert_eq!(result.drives[0].drive.cte_rms_m, expected.drives[0].drive.cte_rms_m);

    // What is there is not overwritten, and that is said before anything is done.
    let mut watcher = Unobserved;
    let again = Job::new(scope, note, &mut watcher, &never).begin(request("stopped"));
    assert!(again.unwrap_err().to_string().contains("stopped is not empty"));
}

#[test]
fn the_experiments_train_and_drive_every_variant() {
    let folder = tempfile::tempdir().unwrap();
    let scope = small_scope(folder.path());
    let recordings = recordings(&scope.recordings, &scope.takes, None, &mut Unobserved).unwrap().0;
    let go = |subject, stop: &StopSignal| {
        let plan = ExperimentPlan {
            subject,
            recipe: lenet(1),
            seeds: 2,
            recordings: recordings.clone(),
            said: Default::default(),
            tracks: scope.tracks.clone(),
            runs: 1,
            cache_mib: 64,
        };
        let mut told = 0;
        let mut observer = |event| {
            told += usize::from(matches!(event, ExperimentEvent::Row(_)));
            Ok(())
        };
        (experiment::run(&plan, &mut observer, stop), told)
    };
    let never = StopSignal::default();
    let (trials, told) = go(Subject::Split, &never);
    let trials = trials.unwrap();
    let variants: Vec<_> = trials.iter().map(|t| (t.variant.as_str(), t.seed)).collect();
    let expected =
        [("blocks", 1), ("blocks", 2), ("random", 1), ("random", 2), ("random-images", 1), ("random-images", 2)];
    assert!(variants == expected && told == 6, "{variants:?}");
    assert!(trials.iter().all(|t| t.laps_total == 1 && t.fresh_mae_deg > 0.0 && t.val_center_mse.is_some()));
    // Single rows have neighbours on the other side, blocks have not.
    assert!(trials[0].leak_percent < 5.0 && trials[2].leak_percent > 95.0, "{trials:?}");
    let csv = folder.path().join("split.csv");
    write_csv(&csv, &trials).unwrap();
    let text = std::fs::read_to_string(csv).unwrap();
    assert!(text.starts_with("variant,seed,leak_percent,val_center_mse,") && text.lines().count() == 7, "{text}");

    never.request();
    assert!(matches!(go(Subject::Colour, &never).0, Err(Error::Interrupted)));
}
