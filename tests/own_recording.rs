//! `train RECORDING`: the table at its end, and whole recordings as the validation side.

mod common;

use std::fs;
use std::path::Path;

use common::command::{error, json, run};
use common::served::Served;
use serde_json::Value;

/// A quarter of a lap of `lake` by the expert, with keys.
fn record(dir: &Path, seed: &str, out: &str) {
    run(dir, &["record", "--track", "lake", "--laps", "0.25", "--style", "keyboard", "--seed", seed, "--out", out]);
}

fn number(value: &Value, pointer: &str) -> f64 {
    value.pointer(pointer).and_then(Value::as_f64).unwrap_or_else(|| panic!("{pointer} in {value}"))
}

/// Line and side of each row in `split.csv`.
fn split(dir: &Path) -> Vec<(String, u64, String)> {
    let mut reader = csv::Reader::from_path(dir.join("split.csv")).unwrap();
    let row = |record: csv::StringRecord| (record[0].to_string(), record[1].parse().unwrap(), record[2].to_string());
    reader.records().map(|record| row(record.unwrap())).collect()
}

#[test]
fn the_table_is_what_evaluate_and_drive_say() {
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path();
    record(dir, "1", "drive");
    let lenet = [
        "--recipe",
        "lenet",
        "--set",
        "epochs=2",
        "--set",
        "balance.keep_zero=1.0",
        "--set",
        "samples.min_throttle=-1",
    ];
    // All rows on the training side: one session, so one stretch.
    let whole = ["train", "drive", "--set", "split.validation_share=0", "--out", "run", "--json"];
    let told = json(dir, &[&whole[..], &lenet].concat());
    let sides = told.pointer("/on_recording/sides").unwrap().as_array().unwrap();
    let side = &sides[0];
    assert_eq!((sides.len(), &side["side"]), (1, &Value::from("training")));
    let evaluated = json(dir, &["evaluate", "run/model.safetensors", "drive", "--json"]);
    for (of_table, of_evaluate) in [
        ("/rows", "/rows"),
        ("/wheel_mae_deg", "/mae_deg"),
        ("/wheel_relative_to_zero", "/relative_to_zero"),
        ("/path_rows", "/path_rows"),
        ("/path_mae_deg", "/path_mae_deg"),
        ("/path_relative_to_zero", "/path_relative_to_zero"),
    ] {
        let (table, evaluate) = (number(side, of_table), number(&evaluated, of_evaluate));
        assert!((table - evaluate).abs() < 1e-9, "{of_table}: {table}, evaluate says {evaluate}");
    }
    let driven = json(dir, &["drive", "run/model.safetensors", "--on", "drive", "--json"]);
    for field in ["autonomy_percent", "interventions_per_km", "offset_mean_m", "offset_p95_m", "distance_m"] {
        assert_eq!(number(side, &format!("/drive/{field}")), number(&driven, &format!("/{field}")), "{field}");
    }
    let kept: Value = serde_json::from_slice(&fs::read(dir.join("run/replay.json")).unwrap()).unwrap();
    assert_eq!(kept["sides"][0]["drive"]["offset_mean_m"], side["drive"]["offset_mean_m"]);
    let page = fs::read_to_string(dir.join("run/report.html")).unwrap();
    let autonomy = format!("{:.1} %", number(side, "/drive/autonomy_percent"));
    assert!(page.contains("On the recording") && page.contains(&autonomy), "{autonomy}");

    // Blocks of rows as the validation side: each side drives on stretches where the other has no row.
    let blocks = ["train", "drive", "--set", "epochs=1", "--recipe", "lenet", "--out", "blocks"];
    let output = run(dir, &blocks);
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(text.contains("training ") && text.contains("validation ") && text.contains("driven are its parts"));
    let kept: Value = serde_json::from_slice(&fs::read(dir.join("blocks/replay.json")).unwrap()).unwrap();
    let rows = split(&dir.join("blocks"));
    for (side, other) in [(0, "validation"), (1, "training")] {
        let stretches = kept["sides"][side]["stretches"].as_array().unwrap();
        assert!(!stretches.is_empty());
        for stretch in stretches {
            let [first, last] = [0, 1].map(|i| stretch["lines"][i].as_u64().unwrap());
            assert!(first < last && rows.iter().all(|(_, line, at)| at != other || *line < first || *line > last));
        }
    }
}

#[test]
fn what_cannot_be_said_has_a_reason() {
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path();
    record(dir, "1", "drive");
    let log = fs::read_to_string(dir.join("drive/driving_log.csv")).unwrap();
    // Neither speed nor a label but zero.
    let bare: String = (log.lines().skip(1))
        .map(|line| format!("{}\n", [&line.split(',').collect::<Vec<_>>()[..3], &["0", "0.5", "0"]].concat().join(",")))
        .collect();
    fs::write(dir.join("drive/driving_log.csv"), format!("center,left,right,steering,throttle,brake\n{bare}")).unwrap();
    let random = ["train", "drive", "--recipe", "lenet", "--set", "epochs=1", "--set", "split.mode=random"];
    let output = run(dir, &[&random[..], &["--set", "balance.keep_zero=1.0", "--out", "run"]].concat());
    let text = String::from_utf8(output.stdout).unwrap();
    for reason in [
        "says no speed; 14.",
        "training: every recorded label is 0",
        "validation: its rows lie in no stretch of 20 m or more, so nothing can be driven",
    ] {
        assert!(text.contains(reason), "{reason} in {text}");
    }
}

#[test]
fn whole_recordings_are_the_validation_side_and_choose_the_epoch_by_the_path() {
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path();
    record(dir, "1", "drive");
    record(dir, "2", "other");
    let held_out = [
        "train",
        "drive",
        "--validate",
        "other",
        "--recipe",
        "lenet",
        "--set",
        "epochs=4",
        "--set",
        "samples.min_throttle=-1",
    ];
    let by = |keep_by: &str, out: &str| {
        let keep_by = format!("keep_by={keep_by}");
        json(dir, &[&held_out[..], &["--set", &keep_by, "--out", out, "--json"]].concat())
    };
    let [by_loss, by_path] = [by("loss", "loss"), by("path", "path")];
    assert_eq!(by_loss["weights_hash"], by_path["weights_hash"], "the measure changes nothing in the training");
    for (recording, _, side) in split(&dir.join("path")) {
        assert_eq!(side == "validation", recording.ends_with("other"), "{recording} {side}");
    }
    let mut history = csv::Reader::from_path(dir.join("path/history.csv")).unwrap();
    let column = history.headers().unwrap().iter().position(|name| name == "val_path_mse").unwrap();
    let path_mse: Vec<f64> = history.records().map(|record| record.unwrap()[column].parse().unwrap()).collect();
    let best = (0..4).min_by(|a, b| path_mse[*a].total_cmp(&path_mse[*b])).unwrap();
    assert_eq!(number(&by_path, "/best_epoch"), best as f64 + 1.0, "{path_mse:?}");
    // The path error of the table is that of the history.
    let sides = by_path.pointer("/on_recording/sides").unwrap();
    let [other, stretch] = [&sides[1], &sides[1]["stretches"][0]];
    assert_eq!((number(stretch, "/recording"), sides[1]["stretches"].as_array().unwrap().len()), (1.0, 1));
    let evaluated = json(dir, &["evaluate", "path/model.safetensors", "other", "--json"]);
    assert!((number(other, "/path_mae_deg") - number(&evaluated, "/path_mae_deg")).abs() < 1e-9);
    assert!(!fs::read_to_string(dir.join("loss/history.csv")).unwrap().contains("val_path_mse"));

    // Recordings that have moved are named in their order, those to validate on last.
    fs::rename(dir.join("other"), dir.join("moved")).unwrap();
    fs::remove_file(dir.join("path/result.json")).unwrap();
    let told = error(dir, &["train", "--resume", "path"]);
    assert!(told.contains("other") && told.contains("--recordings"), "{told}");
    let again = json(dir, &["train", "--resume", "path", "--recordings", "drive", "moved", "--json"]);
    assert_eq!(again["weights_hash"], by_path["weights_hash"]);
}

#[test]
fn dagger_on_the_recording_trains_on_what_the_model_met_and_never_on_the_validation_side() {
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path();
    record(dir, "1", "drive");
    let train = ["train", "drive", "--recipe", "lenet", "--set", "epochs=3", "--out", "run", "--dagger", "1"];
    let told = json(dir, &[&train[..], &["--json"]].concat());
    let rounds = told["dagger"].as_array().unwrap();
    assert_eq!((rounds.len(), &rounds[1]), (2, &told["on_recording"]));
    // Half the epochs, from the weights of the first training.
    assert_eq!(told["epochs"], 2);
    let info: Value = serde_json::from_slice(&fs::read(dir.join("run-dagger-1/run.json")).unwrap()).unwrap();
    assert!(info["transfer"]["model"].as_str().unwrap().ends_with("run/model.safetensors"), "{info}");

    let [before, after] = ["run", "run-dagger-1"].map(|run| split(&dir.join(run)));
    let validation = |rows: &[(String, u64, String)]| -> Vec<u64> {
        rows.iter().filter(|row| row.2 == "validation").map(|row| row.1).collect()
    };
    assert_eq!(validation(&before), validation(&after), "the validation side stays");
    let met: Vec<_> = after.iter().filter(|row| row.0.ends_with("round-1")).collect();
    assert_eq!(met.len() + before.len(), after.len());
    assert!(met.len() > 50 && met.iter().all(|row| row.2 == "training"), "{}", met.len());

    // The views are those of places beside the path, and their labels lead back.
    let log = fs::read_to_string(dir.join("run/dagger/round-1/driving_log.csv")).unwrap();
    let labels: Vec<f64> =
        log.lines().skip(1).map(|line| line.split(',').nth(3).unwrap().trim().parse().unwrap()).collect();
    assert_eq!(labels.len(), met.len());
    // The views were seen by the camera of the recording, whatever the format says.
    let said = fs::read_to_string(dir.join("run/dagger/round-1/steersman.toml")).unwrap();
    assert!(said.contains("pitch_deg = 9.5") && said.contains("unit = \"lock\""), "{said}");
    assert!(labels.iter().any(|label| *label > 0.02) && labels.iter().any(|label| *label < -0.02), "{labels:?}");

    // A folder that a round needs is taken: said before anything is trained.
    fs::remove_dir_all(dir.join("run")).unwrap();
    assert!(error(dir, &train).contains("run-dagger-1 is not empty"));
}

/// A training with rounds that ends between two of them goes on with the next one.
#[test]
fn rounds_of_dagger_follow_after_a_stop() {
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path();
    record(dir, "1", "drive");
    let train = ["train", "drive", "--recipe", "lenet", "--set", "epochs=2", "--dagger", "2", "--out"];
    let whole = json(dir, &[&train[..], &["run", "--json"]].concat());
    let note = |run: &str| fs::read_to_string(dir.join(run).join("dagger.json")).unwrap();
    assert!(note("run").contains("\"round\": 0") && note("run-dagger-1").contains("\"round\": 1"));
    // As after a stop in the second round, before its training began; and then in the driving of the first one.
    for gone in [&["run-dagger-2"][..], &["run-dagger-1", "run-dagger-2", "run/dagger"]] {
        gone.iter().for_each(|path| fs::remove_dir_all(dir.join(path)).unwrap());
        let from = if gone.len() == 1 { "run-dagger-1" } else { "run" };
        let told = json(dir, &["train", "--resume", from, "--json"]);
        assert_eq!(told["weights_hash"], whole["weights_hash"], "{from}");
        assert_eq!(told["dagger"].as_array().unwrap().len(), 3);
        assert!(dir.join("run-dagger-2/report.html").is_file());
    }
    // A training that cannot begin leaves no note.
    let said = error(dir, &["train", "missing", "--dagger", "1", "--out", "none"]);
    assert!(said.contains("missing") && !dir.join("none/dagger.json").exists(), "{said}");
}

/// One picture that cannot be read costs its frames, and no round.
#[test]
fn dagger_leaves_out_what_cannot_be_read_and_says_so() {
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path();
    record(dir, "1", "drive");
    let pictures: Vec<_> = fs::read_dir(dir.join("drive/IMG")).unwrap().map(|entry| entry.unwrap().path()).collect();
    // They begin and end as JPEGs, so that they are noticed only when they are decoded.
    for camera in ["center", "left", "right"] {
        let mut of_camera: Vec<_> = pictures.iter().filter(|path| path.to_string_lossy().contains(camera)).collect();
        of_camera.sort();
        for path in of_camera.iter().skip(40).take(3) {
            fs::write(path, b"\xff\xd8\xff\xe0 nothing \xff\xd9").unwrap();
        }
    }
    let train = ["train", "drive", "--recipe", "lenet", "--set", "epochs=1", "--set", "split.validation_share=0"];
    let output = run(dir, &[&train[..], &["--dagger", "1", "--out", "run"]].concat());
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("frames have no picture that can be read") && said.contains("IMG"), "{said}");
    assert!(dir.join("run-dagger-1/result.json").is_file());
}

#[test]
fn the_experiment_orders_models_on_the_road_and_on_recordings() {
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path();
    let told = json(dir, &["experiment", "replay", "--quick", "--json", "--out", "found.csv"]);
    let rows = told["rows"].as_array().unwrap();
    assert_eq!(rows.len(), 3);
    // The more noise on its weights, the larger the error of a model.
    let errors: Vec<f64> = rows.iter().map(|row| number(row, "/wheel_relative_to_zero")).collect();
    assert!(errors[2] > errors[0], "{errors:?}");
    let csv = fs::read_to_string(dir.join("found.csv")).unwrap();
    assert_eq!(csv.lines().count(), 4);
    assert!(csv.lines().last().unwrap().contains("noise 0.2"));
    assert!(fs::read_to_string(dir.join("found.html")).unwrap().contains("autonomy on recordings"));
    assert!(error(dir, &["experiment", "replay", "--recording", "x"]).contains("recordings of its own"));
    // The page takes the place of nothing, nor is anything ignored that was asked for.
    let out = |name: &str| error(dir, &["experiment", "replay", "--quick", "--out", name]);
    assert!(out("r.html").contains("r.csv") && !dir.join("r.html").exists());
    fs::write(dir.join("mine.html"), "mine").unwrap();
    assert!(out("mine.csv").contains("mine.html: exists already") && !dir.join("mine.csv").exists());
    for (option, why) in [
        (&["--recipe", "lenet"][..], "several recipes"),
        (&["--set", "epochs=1"], "several recipes"),
        (&["--hz", "5"], "recordings of its own"),
        (&["--random-tracks", "2"], "--track"),
    ] {
        let said = error(dir, &[&["experiment", "replay"][..], option].concat());
        assert!(said.contains(why), "{option:?}: {said}");
    }
    assert!(error(dir, &["experiment", "labels", "--random-tracks", "2"]).contains("drives with keys"));
}

/// The whole loop: a poor model drives, somebody corrects it, and training goes on with the corrections.
#[test]
fn corrections_are_recorded_as_such_and_weigh_as_much_as_said() {
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path();
    record(dir, "1", "old");
    run(dir, &["train", "old", "--recipe", "lenet", "--set", "epochs=1", "--out", "run"]);
    let served = Served::start(dir, "run/model.safetensors", &["--record", "new", "--speed", "20"]);
    let url = format!("ws://127.0.0.1:{}/socket.io/?EIO=4&transport=websocket", served.port);
    let sim = ["sim", "--connect", &url, "--track", "lake", "--lockstep", "--correct", "--frames", "900", "--json"];
    let driven = json(dir, &sim);
    let (summary, said) = served.stop();
    let by_user = number(&summary, "/recorded/by_user") as usize;
    assert_eq!(
        (number(&summary, "/recorded/rows"), by_user as f64),
        (900.0, number(&driven, "/corrected_telemetries"))
    );
    assert!(said.contains("a person drives") && (20..800).contains(&by_user), "{by_user}: {said}");
    // The corrections end before the car is far away.
    assert!(number(&driven, "/cte_max_m") < 2.0 && driven["failure"].is_null(), "{driven}");

    let recording = steersman::dataset::load(&dir.join("new")).unwrap();
    let taken_over = recording.rows.iter().filter(|row| row.taken_over).count();
    assert_eq!((recording.rows.len(), taken_over), (900, by_user));
    let log = fs::read_to_string(dir.join("new/driving_log.csv")).unwrap();
    assert!(log.starts_with("center,left,right,steering,throttle,brake,speed,mode\n"));
    assert_eq!(log.lines().filter(|line| line.ends_with(", user")).count(), by_user);

    // All rows are on the training side; those of a person are there three times.
    let train = ["train", "--from", "run/model.safetensors", "old", "new", "--set", "epochs=1", "--json"];
    let all =
        ["--set", "split.validation_share=0", "--set", "balance.keep_zero=1.0", "--set", "samples.min_throttle=-1"];
    let images = |weight: &str, out: &str| {
        let weight = format!("samples.takeover_weight={weight}");
        let told = json(dir, &[&train[..], &all[..], &["--set", &weight, "--out", out]].concat());
        (number(&told, "/train_images") as usize, told)
    };
    let [(once, _), (thrice, told)] = [images("1", "once"), images("3", "thrice")];
    assert_eq!(thrice, once + 2 * by_user);
    assert!(told["weights_hash"].is_string());
}
