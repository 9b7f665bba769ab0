//! Closed loop on recorded pictures: `drive --on RECORDING`, and the views that it is made of.

mod common;

use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use common::command::{error, json, run, steersman};
use common::mp4;
use common::page::{Page, serve};
use steersman::Error;
use steersman::dataset::{self, DrivenSessions};
use steersman::geometry::{CarGeometry, LookAhead};
use steersman::picture::RgbImage;
use steersman::replay::{
    ReplayFrame, ReplayLog, ReplayOptions, ReplayRun, replay, replay_as_far, side_camera_check, summarise,
};

/// A quarter of a lap of `lake` by the expert, with keys.
fn record(dir: &Path) {
    run(dir, &["record", "--track", "lake", "--laps", "0.25", "--style", "keyboard", "--out", "drive"]);
}

/// Drives with `steer`, which is told the pursuit of the path at the frame before.
fn drive(log: &ReplayLog, latency_ms: f64, steer: impl Fn(f64) -> f32 + Sync) -> Vec<ReplayRun> {
    let options = ReplayOptions { latency_ms, ..ReplayOptions::usual(&log.geometry) };
    let pursuit = Mutex::new(0.0);
    let driver = || Ok(|_: &RgbImage| Ok(steer(*pursuit.lock().unwrap())));
    let seen = |_: usize, frame: &ReplayFrame| {
        *pursuit.lock().unwrap() = frame.moment.pursuit.unwrap_or(0.0);
        Ok(())
    };
    replay(log, &options, driver, &seen).unwrap()
}

#[test]
fn who_pursues_the_path_stays_on_it_and_who_does_not_is_put_back() {
    let scratch = tempfile::tempdir().unwrap();
    record(scratch.path());
    let recording = dataset::load(&scratch.path().join("drive")).unwrap();
    let log = ReplayLog::new(&recording, CarGeometry::preset("steersman").unwrap()).unwrap();
    assert_eq!((log.sessions.len(), log.assumed_speed_mps), (1, None));

    let good = summarise(&drive(&log, 0.0, |pursuit| pursuit as f32), 1.0);
    assert_eq!((good.interventions, good.autonomy_percent), (0, 100.0));
    assert!(good.offset_p95_m < 0.2, "{good:?}");
    assert!((good.distance_m - log.sessions[0].path.length_m()).abs() < 1e-3);

    let zero = drive(&log, 0.0, |_| 0.0);
    let summary = summarise(&zero, 1.0);
    assert!(summary.interventions >= 3 && summary.whiteness_deg_s == 0.0, "{summary:?}");
    let calm = summary.calm.unwrap();
    assert_eq!((calm.reversals_per_min, calm.angle_change_p95_deg), (0.0, 0.0), "a wheel held straight");
    assert!(calm.lateral_jerk_rms_mps3 < 1e-9, "{calm:?}");
    // A wheel that moves by 2 deg to and fro at every frame turns back 20 times a second.
    let mut right = false;
    let shaking = std::sync::Mutex::new(&mut right);
    let shaken = summarise(
        &drive(&log, 0.0, |pursuit| {
            let mut right = shaking.lock().unwrap();
            **right = !**right;
            pursuit as f32 + if **right { 0.04 } else { -0.04 }
        }),
        1.0,
    );
    let calm = shaken.calm.unwrap();
    assert!((1000.0..=1200.0).contains(&calm.reversals_per_min), "{calm:?}");
    assert!((1.9..3.0).contains(&calm.angle_change_p95_deg), "{calm:?}");
    let charged = 6.0 * summary.interventions as f64;
    assert!((summary.autonomy_percent - (100.0 * (1.0 - charged / summary.time_s)).max(0.0)).abs() < 1e-9);
    // The moment after each intervention the car is on the path again.
    let moments = &zero[0].moments;
    assert!(moments.iter().all(|m| m.offset_m.abs() <= 1.0 && m.turn_deg.abs() <= 15.0));
    let back: Vec<_> = moments.iter().filter(|m| m.put_back).collect();
    assert!(!back.is_empty() && back.iter().all(|m| m.offset_m.abs() < 1e-6 && m.turn_deg.abs() < 1e-6));

    let late = summarise(&drive(&log, 400.0, |pursuit| pursuit as f32), 1.0);
    assert!(late.offset_rms_m > good.offset_rms_m, "{late:?}");
    // A driver that answers nonsense steers straight ahead.
    assert!(drive(&log, 0.0, |_| f32::NAN) == zero);
}

#[test]
fn views_from_the_path_are_the_recorded_ones_and_warped_ones_resemble_the_side_cameras() {
    let scratch = tempfile::tempdir().unwrap();
    record(scratch.path());
    let recording = dataset::load(&scratch.path().join("drive")).unwrap();
    let log = ReplayLog::new(&recording, CarGeometry::preset("steersman").unwrap()).unwrap();
    let first = Mutex::new(None);
    let driver = || Ok(|_: &RgbImage| Ok(0.0));
    replay(&log, &ReplayOptions::usual(&log.geometry), driver, &|_, frame| {
        first.lock().unwrap().get_or_insert_with(|| (frame.moment, frame.view.clone()));
        Ok(())
    })
    .unwrap();
    let (moment, view) = first.into_inner().unwrap().unwrap();
    let mut recorded = RgbImage::default();
    let bytes = std::fs::read(recording.image_path(moment.row, dataset::View::Centre).unwrap()).unwrap();
    steersman::picture::decode::decode_rgb(&bytes, &mut recorded).unwrap();
    assert_eq!(moment.row, 0);
    assert!(view.pixels.iter().zip(&recorded.pixels).all(|(a, b)| a.abs_diff(*b) <= 1));

    // On the road region the error is at most half of that without the warp.
    let check = side_camera_check(&log).unwrap().unwrap();
    assert!(check.rows > 50 && check.ratio() <= 0.5, "{check:?}");
    // Cameras that sit elsewhere than is said are found out.
    let wrong = CarGeometry { side_offsets_m: [0.8, -0.8], ..log.geometry.clone() };
    let check = side_camera_check(&ReplayLog::new(&recording, wrong).unwrap()).unwrap().unwrap();
    assert!(check.ratio() > 1.0 && check.doubtful > check.rows / 2, "{check:?}");
}

#[test]
fn path_labels_are_smoother_than_keys_and_mean_the_same_road() {
    let scratch = tempfile::tempdir().unwrap();
    record(scratch.path());
    let recording = dataset::load(&scratch.path().join("drive")).unwrap();
    let geometry = CarGeometry::preset("steersman").unwrap();
    assert!(recording.camera_named && recording.geometry == geometry, "the recorder says what its camera is");
    let labels = DrivenSessions::of(&recording, geometry.clone()).path_labels(LookAhead::usual(&geometry));
    let pairs: Vec<(f64, f64)> = (labels.iter().zip(&recording.rows))
        .filter_map(|(label, row)| Some((f64::from((*label)?), f64::from(row.steering))))
        .collect();
    assert!(pairs.len() + 15 > recording.rows.len(), "only the end of the session has no label");
    let change = |of: fn(&(f64, f64)) -> f64| pairs.windows(2).map(|w| (of(&w[1]) - of(&w[0])).abs()).sum::<f64>();
    assert!(change(|p| p.0) < 0.5 * change(|p| p.1), "the path's label changes less than the keys' steering");
    let mean = |of: fn(&(f64, f64)) -> f64| pairs.iter().map(of).sum::<f64>() / pairs.len() as f64;
    assert!((mean(|p| p.0) - mean(|p| p.1)).abs() < 0.01);
}

#[test]
fn the_command_tells_writes_and_refuses() {
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path();
    record(dir);
    let told = |threads: &str, out: &str| {
        let mut report = json(dir, &["drive", "zero", "--on", "drive", "--threads", threads, "--out", out, "--json"]);
        report.as_object_mut().unwrap().remove("frames_per_second");
        (report, std::fs::read_to_string(dir.join(out).join("assisted_1.csv")).unwrap())
    };
    let (report, csv) = told("1", "one");
    assert_eq!((&report, &csv), (&told("2", "two").0, &csv));
    assert!(report["interventions"].as_u64() > Some(2) && report["warp"]["rows"].as_u64() > Some(50), "{report}");
    assert_eq!(csv.lines().count() as u64, 1 + report["frames"].as_u64().unwrap());
    // The folder is laid out as that of a drive on a track.
    let read = |name: &str| std::fs::read_to_string(dir.join("one").join(name)).unwrap();
    let summary: serde_json::Value = serde_json::from_str(&read("summary.json")).unwrap();
    assert_eq!(
        (&summary["track"], &summary["laps_completed"], &summary["runs"]),
        (&"drive (recording)".into(), &0.into(), &1.into())
    );
    for (of_track, own) in
        [("autonomy_percent", "autonomy_percent"), ("cte_p95_m", "offset_p95_m"), ("distance_m", "distance_m")]
    {
        assert_eq!(summary[of_track], report[own], "{of_track}");
    }
    let put_back = csv.lines().skip(1).filter(|line| line.split(',').nth(8) == Some("1")).count();
    assert_eq!(put_back as u64, report["interventions"].as_u64().unwrap());
    assert!(csv.starts_with("time_s,x_m,y_m,s_m,cte_m,steering,throttle,speed_mph,intervention,heading_deg,"));
    let map = read("map.svg");
    assert!(roxmltree::Document::parse(&map).is_ok() && map.contains("session 1 of 1, put back: "));

    let said = |args: &[&str]| error(dir, args);
    assert!(said(&["drive", "expert", "--on", "drive"]).contains("name a model"));
    assert!(said(&["drive", "zero", "--on", "drive", "--camera", "tank"]).contains("udacity-straight"));
    assert!(said(&["drive", "zero", "--on", "nowhere"]).contains("nowhere"));

    // What stands beside the log decides; without it a preset is assumed, and said so.
    let ratio = |report: &serde_json::Value| report["warp"]["warped"].as_f64().unwrap();
    let beside = dir.join("drive/steersman.toml");
    std::fs::write(&beside, "[camera]\npreset = \"udacity\"\nside_offsets_m = [0.8, -0.8]\n").unwrap();
    let (wrong, _) = told("1", "wrong");
    assert!(ratio(&wrong) > 1.3 * ratio(&report), "side cameras that have changed places: {wrong}");

    // The fit comes near the mount, as near as land that is not flat lets it, and what it prints can stand beside the log.
    std::fs::write(&beside, "[camera]\npreset = \"steersman\"\nheight_m = 1.4\npitch_deg = 7.5\nroll_deg = 0.0\n")
        .unwrap();
    let table = String::from_utf8(run(dir, &["inspect", "drive", "--fit-camera"]).stdout).unwrap();
    let fitted: toml::Table = table.parse().unwrap();
    let found = |key: &str| fitted["camera"][key].as_float().unwrap();
    assert!((found("pitch_deg") - 9.5).abs() < 1.0 && (found("roll_deg") - 1.2).abs() < 0.3, "{table}");
    assert!((found("height_m") - 1.2).abs() < 0.1, "{table}");
    std::fs::write(&beside, &table).unwrap();
    let (again, _) = told("1", "again");
    assert!(ratio(&again) < 1.05 * ratio(&report), "{again}");
    assert!(said(&["inspect", "drive", "drive", "--fit-camera"]).contains("one recording"));

    std::fs::write(&beside, "[camera]\nheight_m = 0.0\n").unwrap();
    let told_off = said(&["drive", "zero", "--on", "drive"]);
    assert!(told_off.contains("steersman.toml") && told_off.contains("height_m: must be 0.01 to 100 m"), "{told_off}");
    std::fs::remove_file(&beside).unwrap();
    let told = run(dir, &["drive", "zero", "--on", "drive"]).stderr;
    assert!(String::from_utf8(told).unwrap().contains("`udacity` is assumed"));
    assert!(said(&["drive", "zero", "--on", "drive", "--latency-ms=-1"]).contains("latency"));
    assert!(said(&["drive", "zero", "--on", "drive", "--noise", "0.1"]).contains("leave it out"));
    assert!(said(&["drive", "zero", "--on", "drive", "--latency-ms", "0,3000"]).contains("3000"));
    assert!(said(&["drive", "zero", "--on", "drive", "--latency-ms", "0,50,0"]).contains("named twice"));

    // Several latencies are driven from the smallest to the largest, each as it would be alone.
    let swept = json(dir, &["drive", "zero", "--on", "drive", "--latency-ms", "200,0", "--json"]);
    let points = swept["points"].as_array().unwrap();
    let latencies: Vec<f64> = points.iter().map(|point| point["latency_ms"].as_f64().unwrap()).collect();
    assert_eq!(latencies, [0.0, 200.0]);
    let alone = json(dir, &["drive", "zero", "--on", "drive", "--latency-ms", "200", "--json"]);
    for key in ["interventions", "offset_mean_m", "whiteness_deg_s", "calm"] {
        assert_eq!(points[1][key], alone[key], "{key}");
    }
    assert!(alone["calm"]["reversals_per_min"].is_number(), "{alone}");
    let told = run(dir, &["drive", "zero", "--on", "drive", "--latency-ms", "0,200"]).stdout;
    let table = String::from_utf8(told).unwrap();
    assert!(table.contains("200 ms") && table.contains("reversals"), "{table}");

    // What was driven is told, whatever cannot be written; the command fails all the same.
    let nowhere = ["drive", "zero", "--on", "drive", "--video", "drive/driving_log.csv/film.mp4"];
    let output = steersman(dir).args(nowhere).output().unwrap();
    let [told, trouble] = [output.stdout, output.stderr].map(|bytes| String::from_utf8(bytes).unwrap());
    assert!(!output.status.success() && trouble.contains("film.mp4"), "{trouble}");
    assert!(told.contains("autonomy") && told.contains("warped views are only a rough guess"), "{told}");
    let output = steersman(dir).args(nowhere).arg("--json").output().unwrap();
    let told: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(!output.status.success() && told["interventions"].as_u64() > Some(2), "{told}");
}

#[test]
fn a_drive_on_a_recording_is_filmed_and_watched() {
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path();
    run(dir, &["record", "--track", "lake", "--laps", "0.1", "--out", "drive"]);
    let filmed = json(dir, &["drive", "zero", "--on", "drive", "--video", "drive.mp4", "--json"]);
    let video = mp4::read(&dir.join("drive.mp4"));
    let driven_s = filmed["time_s"].as_f64().unwrap();
    // The last picture stays for two seconds.
    assert!((video.seconds[0] - driven_s - 2.0).abs() < 0.2, "{} s of {driven_s}", video.seconds[0]);
    assert!(error(dir, &["drive", "zero", "--on", "drive", "--video", "drive.mp4"]).contains("exists already"));
    let no_saliency = ["drive", "zero", "--on", "drive", "--video", "other.mp4", "--saliency"];
    assert!(error(dir, &no_saliency).contains("has no saliency"));

    let served = serve(dir, &["drive", "zero", "--on", "drive", "--watch"]);
    let mut page = Page::open(served.port);
    assert_eq!((&page.hello["mode"], page.hello["edges"].as_array().unwrap().len()), (&"watch".into(), 1));
    let first = page.next().unwrap();
    let mut last = page.next().unwrap();
    assert!(first.camera.starts_with(&[0xff, 0xd8]) && first.state["title"] == "zero, session 1 of 1");
    while let Ok(frame) = page.next() {
        last = frame;
    }
    assert!(last.number("time_s") > first.number("time_s") && last.number("laps") <= 1.0);
    assert!(last.number("x").hypot(last.number("y")) > 20.0, "the car has made way: {}", last.state);
}

#[test]
fn a_drive_that_is_interrupted_gives_what_was_driven() {
    let scratch = tempfile::tempdir().unwrap();
    record(scratch.path());
    let recording = dataset::load(&scratch.path().join("drive")).unwrap();
    let log = ReplayLog::new(&recording, CarGeometry::preset("steersman").unwrap()).unwrap();
    let options = ReplayOptions::usual(&log.geometry);
    let until = |frames: usize| {
        let shown = AtomicUsize::new(0);
        let seen = move |_: usize, _: &ReplayFrame| match shown.fetch_add(1, Ordering::Relaxed) < frames {
            true => Ok(()),
            false => Err(Error::Interrupted),
        };
        (|| Ok(|_: &RgbImage| Ok(0.0)), seen)
    };
    let whole = drive(&log, 0.0, |_| 0.0);
    let (driver, seen) = until(40);
    let (runs, stopped) = replay_as_far(&log, &options, driver, &seen).unwrap();
    assert!(stopped && !runs[0].whole && runs[0].moments[..] == whole[0].moments[..40], "{}", runs[0].moments.len());
    assert!((runs[0].time_s - 2.0).abs() < 1e-9 && (1.0..40.0).contains(&runs[0].distance_m), "{:?}", runs[0].time_s);
    let (driver, seen) = until(usize::MAX);
    assert_eq!(replay_as_far(&log, &options, driver, &seen).unwrap(), (whole, false));
    let (driver, seen) = until(0);
    assert!(matches!(replay_as_far(&log, &options, driver, &seen), Err(Error::Interrupted)));
    let (driver, seen) = until(40);
    assert!(matches!(replay(&log, &options, driver, &seen), Err(Error::Interrupted)));
}

#[cfg(unix)]
#[test]
fn ctrl_c_keeps_what_was_driven_on_a_recording() {
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path();
    record(dir);
    let served = serve(dir, &["drive", "zero", "--on", "drive", "--out", "kept", "--json", "--watch"]);
    let mut page = Page::open(served.port);
    while page.next().unwrap().number("time_s") < 1.0 {}
    served.interrupt();
    let said = served.wait_until_it_says("stopped after");
    assert!(said.contains("kept in kept"), "{said}");
    assert_eq!(served.code(), Some(130));
    let summary: serde_json::Value =
        serde_json::from_slice(&std::fs::read(dir.join("kept/replay.json")).unwrap()).unwrap();
    assert!(summary["time_s"].as_f64().unwrap() >= 1.0, "{summary}");
    let drive: serde_json::Value =
        serde_json::from_slice(&std::fs::read(dir.join("kept/summary.json")).unwrap()).unwrap();
    assert_eq!(
        (&drive["laps_completed"], &drive["laps_total"]),
        (&0.into(), &1.into()),
        "no lap was driven to its end"
    );
}
