//! The loop closed, small: the expert is recorded, a network learns from it and drives by its own pictures.
//!
//! Training on an unoptimised build takes minutes, so the test runs with `cargo test --release` only.
#![cfg(not(debug_assertions))]

use std::path::Path;
use std::sync::atomic::AtomicBool;

use steersman::main_job::training_set::{Take, recordings};
use steersman::main_job::{TrackResult, test_on_track};
use steersman::pilot::Pilot;
use steersman::recipe::Recipe;
use steersman::simulator::{DriveOptions, Driver, Track, Zero, drive};
use steersman::training::{EpochRecord, Observer, TrainRequest, TrainResult, train};

struct Silent;

impl Observer for Silent {
    fn notice(&mut self, _: &str) {}
    fn progress(&mut self, _: u32, _: usize, _: usize, _: f64) {}
    fn epoch(&mut self, _: &EpochRecord, _: u32) {}
}

fn learn(folder: &Path, threads: usize) -> (TrainResult, TrackResult) {
    let take = |reverse, recovery, seed| Take { track: "lake".into(), laps: 0.15, reverse, recovery, seed };
    let takes = [take(false, false, 101), take(true, false, 102), take(false, true, 103), take(true, true, 104)];
    let overrides = ["epochs=8", "samples.flip=both", "samples.side_cameras=0.25"].map(String::from);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    pool.install(|| {
        let request = TrainRequest {
            recordings: recordings(&folder.join("recordings"), &takes, &|_| true).unwrap().0,
            recipe: Recipe::find("lenet", &overrides).unwrap(),
            out: folder.join(format!("run-{threads}")),
            seed: 1,
            cache_mib: 256,
        };
        let result = train(request, &mut Silent, &AtomicBool::new(false)).unwrap();
        let pilot = Pilot::load(&result.model).unwrap();
        let options = DriveOptions { runs: 4, ..Default::default() };
        let on_track = test_on_track(&pilot, &Track::load("lake").unwrap(), &options, &|_| true).unwrap();
        (result, on_track)
    })
}

#[test]
fn what_is_learned_from_the_expert_drives_and_does_so_alike_for_any_number_of_threads() {
    let folder = tempfile::tempdir().unwrap();
    let (result, lake) = learn(folder.path(), 1);
    let options = DriveOptions { runs: 4, ..Default::default() };
    let new_zero = || -> steersman::Result<Box<dyn Driver>> { Ok(Box::new(Zero)) };
    let zero = drive(&Track::load("lake").unwrap(), new_zero, &options, &|_| true).unwrap().summary;
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
