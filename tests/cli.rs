//! The commands as a user runs them, on a painted log.

mod common;

use std::fs;
use std::path::Path;

use common::command::{error, json, run};
use common::painted_log;

/// A quick training run: few epochs of the small network.
const QUICK: [&str; 7] = ["train", "log", "--recipe", "lenet", "--set", "epochs=3", "--json"];

fn folder_with_log(rows: usize) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    painted_log::write(&folder.path().join("log"), rows, "");
    folder
}

fn number(value: &serde_json::Value, key: &str) -> f64 {
    value[key].as_f64().unwrap_or_else(|| panic!("no number `{key}` in {value}"))
}

#[test]
fn train_evaluate_and_predict_fit_together() {
    let folder = folder_with_log(700);
    let dir = folder.path();
    let result = json(dir, &[&QUICK[..], &["--set", "epochs=8", "--out", "run"]].concat());
    assert_eq!((number(&result, "epochs"), number(&result, "leak_percent")), (8.0, 0.0));
    assert!(number(&result, "relative_to_zero") < 0.5, "the stripe is easy to follow: {result}");
    assert_eq!(result["weights_hash"].as_str().unwrap().len(), 64);
    for file in ["recipe.toml", "run.json", "split.csv", "history.csv", "model.safetensors", "last.safetensors"] {
        assert!(dir.join("run").join(file).is_file(), "{file}");
    }
    assert_eq!(fs::read_to_string(dir.join("run/history.csv")).unwrap().lines().count(), 1 + 8);

    let model = result["model"].as_str().unwrap();
    let metrics = json(dir, &["evaluate", model, "log", "--json"]);
    assert_eq!(number(&metrics, "rows"), 700.0);
    assert!(number(&metrics, "relative_to_zero") < 0.5, "{metrics}");

    let image = format!("log/IMG/{}", first_image(&dir.join("log/IMG"), "center"));
    let answers = json(dir, &["predict", model, &image, &image, "--json"]);
    assert_eq!(answers.as_array().unwrap().len(), 2);
    assert_eq!(answers[0], answers[1]);
    assert!((number(&answers[0], "steering") - painted_log::steering(0)).abs() < 0.3, "{answers}");

    let summary = String::from_utf8(run(dir, &["summary", model]).stdout).unwrap();
    assert!(summary.contains("Total params: 28,589"), "{summary}");
    assert!(summary.starts_with(&format!("model {model}\nrecipe lenet: ")), "{summary}");
}

#[test]
fn a_recording_is_trained_with_the_recipe_for_recordings() {
    let folder = folder_with_log(150);
    let result = json(folder.path(), &["train", "log", "--set", "epochs=1", "--json"]);
    assert!(result["model"].as_str().unwrap().contains("recording-1"), "{result}");
    let recipe = fs::read_to_string(folder.path().join("runs/recording-1/recipe.toml")).unwrap();
    assert!(recipe.contains("kind = \"path\""), "{recipe}");
}

fn first_image(folder: &Path, camera: &str) -> String {
    let names = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    names.filter(|name| name.starts_with(camera)).min().unwrap()
}

#[test]
fn a_profile_adds_up_and_changes_no_weight() {
    let folder = folder_with_log(300);
    let plain = json(folder.path(), &[&QUICK[..], &["--out", "plain"]].concat());
    assert!(plain.get("profile").is_none(), "{plain}");
    let measured = json(folder.path(), &[&QUICK[..], &["--out", "measured", "--profile", "--threads", "2"]].concat());
    assert_eq!(measured["weights_hash"], plain["weights_hash"]);

    let profile = &measured["profile"];
    for key in ["decode_s", "preprocess_s", "forward_s", "backward_s", "update_s", "evaluation_s", "waiting_for_data_s"]
    {
        assert!(number(profile, key) > 0.0, "{key}: {profile}");
    }
    assert_eq!((number(profile, "augment_s"), number(profile, "threads")), (0.0, 2.0), "lenet does not augment");
    let parts = ["decode", "preprocess", "augment", "forward", "backward", "update", "evaluation", "other"];
    let sum: f64 = parts.iter().map(|part| number(profile, &format!("{part}_s"))).sum();
    let capacity = 2.0 * number(profile, "wall_s");
    assert!((sum - capacity).abs() < 0.01 * capacity, "{profile}");
    if let Some(busy) = profile["busy_percent"].as_f64() {
        assert!(busy > 0.0 && busy < 150.0, "{profile}");
    }
}

#[test]
fn evaluation_says_when_rows_were_trained_on_and_only_then() {
    let folder = folder_with_log(200);
    let other = folder.path().join("other");
    painted_log::write(&other, 50, "_b");
    json(folder.path(), &[&QUICK[..], &["--out", "run"]].concat());
    let stderr = |recording: &str| {
        String::from_utf8(run(folder.path(), &["evaluate", "run/model.safetensors", recording]).stderr).unwrap()
    };
    assert!(stderr("log").contains("belong to the model's training split"));
    assert!(!stderr("other").contains("belong to"));
}

#[test]
fn the_same_seed_gives_the_same_weights_for_any_threads_and_cache_and_another_seed_others() {
    let folder = folder_with_log(150);
    let hash = |extra: &[&str]| {
        let result = json(folder.path(), &[&QUICK[..], extra].concat());
        result["weights_hash"].as_str().unwrap().to_string()
    };
    let first = hash(&["--threads", "1"]);
    assert_eq!(first, hash(&["--threads", "2"]));
    assert_eq!(first, hash(&["--threads", "5", "--cache", "0"]));
    assert_ne!(first, hash(&["--seed", "2"]));
}

#[test]
fn bad_input_is_an_error_with_place_and_remedy() {
    let folder = folder_with_log(150);
    let dir = folder.path();
    fs::write(dir.join("damaged.safetensors"), b"\x10\0\0\0\0\0\0\0{\"a\":").unwrap();
    fs::write(dir.join("text.jpg"), b"no picture").unwrap();
    let mut log = fs::read_to_string(dir.join("log/driving_log.csv")).unwrap();
    fs::create_dir(dir.join("empty")).unwrap();
    fs::create_dir(dir.join("lost")).unwrap();
    fs::write(dir.join("lost/driving_log.csv"), &log).unwrap();
    log.push_str("broken line\n");
    fs::write(dir.join("log/driving_log.csv"), &log).unwrap();

    for (args, expected) in [
        (&["train", "nowhere"][..], "nowhere"),
        (&["train", "empty"], "empty"),
        (&["train", "lost"], "image missing"),
        (&["train", "log", "--recipe", "lenett"], "did you mean `lenet`?"),
        (&["train", "log", "--set", "epoch=1"], "did you mean `epochs`?"),
        (&["train", "log", "--set", "preprocessing.resize=[9, 9]"], "layer `"),
        (&["train", "log", "--out", "log"], "is not empty"),
        (&["train", "--out", "log"], "is not empty"),
        (&["experiment", "split", "--out", "log"], "exists already"),
        (&["experiment", "colour", "--track", "lakes"], "lake"),
        (&["experiment", "colour", "--recipe", "lenett"], "did you mean `lenet`?"),
        (&["train", "--resume", "log"], "is no run folder"),
        (&["evaluate", "damaged.safetensors", "log"], "damaged.safetensors: is no safetensors file, or is damaged"),
        (&["evaluate", "text.jpg", "log"], "text.jpg"),
        (&["predict", "missing.safetensors", "text.jpg"], "missing.safetensors"),
        (&["summary", "--recipe", "none.toml"], "none.toml"),
        (&["inspect", "nowhere.csv"], "nowhere.csv"),
    ] {
        let message = error(dir, args);
        assert!(message.contains(expected), "{args:?}: {message}");
    }
    let runs = dir.join("runs");
    assert!(!runs.exists(), "a run that cannot begin leaves no folder behind");
    assert_eq!(fs::read_to_string(dir.join("log/driving_log.csv")).unwrap(), log, "recordings are only read");
}

#[test]
fn the_help_of_every_command_has_an_example() {
    let text = |args: &[&str]| String::from_utf8(run(Path::new("."), args).stdout).unwrap();
    let help = text(&["--help"]);
    let commands = help.lines().skip_while(|line| *line != "Commands:").skip(1).take_while(|line| !line.is_empty());
    // Where the terminal is narrow, a description goes on in lines that are set in farther.
    let named = commands.filter_map(|line| line.strip_prefix("  ").filter(|line| !line.starts_with(' ')));
    let commands: Vec<&str> = named.filter_map(|line| line.split_whitespace().next()).collect();
    assert!(commands.len() > 15, "{commands:?}");
    for command in commands.into_iter().filter(|command| *command != "help") {
        let help = text(&[command, "--help"]);
        assert!(help.contains("Example") && help.contains(&format!("\n  steersman {command}")), "{command}: {help}");
    }
}

#[test]
fn a_bad_row_is_counted_and_left_out_and_a_damaged_image_too() {
    let folder = folder_with_log(150);
    let log = folder.path().join("log/driving_log.csv");
    let text = fs::read_to_string(&log).unwrap() + "IMG/a.jpg, IMG/b.jpg, IMG/c.jpg, left, 0, 0, 0\n";
    fs::write(&log, text).unwrap();
    // Complete at both ends, so only decoding finds out.
    let image = folder.path().join("log/IMG/center_2026_01_01_00_00_07_000.jpg");
    let mut bytes = fs::read(&image).unwrap();
    let middle = bytes.len() / 3;
    bytes[20..middle].fill(0xff);
    fs::write(&image, bytes).unwrap();
    let output = run(folder.path(), &[&QUICK[..], &["--set", "split.validation_share=0"]].concat());
    let notices = String::from_utf8(output.stderr).unwrap();
    assert!(notices.contains("1 of 151 rows cannot be used"), "{notices}");
    assert!(notices.contains("1 images cannot be decoded and are left out"), "{notices}");
}

#[test]
fn inspect_prints_text_and_json() {
    let folder = folder_with_log(30);
    let text = String::from_utf8(run(folder.path(), &["inspect", "log"]).stdout).unwrap();
    assert!(text.contains("30 of 30 usable"), "{text}");
    let reports = json(folder.path(), &["inspect", "log", "--json"]);
    assert_eq!(number(&reports[0], "usable"), 30.0);
}

#[test]
fn summary_prints_the_table_of_the_write_up() {
    let text = String::from_utf8(run(Path::new("."), &["summary", "--recipe", "hyper"]).stdout).unwrap();
    // Output shape and parameters of each layer that has some, from the first write-up.
    let table = [
        ("conv1", "38x158x8", "224"),
        ("bn1", "38x158x8", "32"),
        ("conv2", "36x156x16", "1,168"),
        ("bn2", "36x156x16", "64"),
        ("conv3", "16x76x24", "3,480"),
        ("bn3", "16x76x24", "96"),
        ("prelu1", "16x76x24", "29,184"),
        ("conv4", "6x36x32", "6,944"),
        ("bn4", "6x36x32", "128"),
        ("prelu2", "6x36x32", "6,912"),
        ("conv5", "1x16x64", "18,496"),
        ("bn5", "1x16x64", "256"),
        ("prelu3", "1x16x64", "1,024"),
        ("dense1", "100", "102,500"),
        ("bn6", "100", "400"),
        ("prelu4", "100", "100"),
        ("dense2", "50", "5,050"),
        ("prelu5", "50", "50"),
        ("dense3", "1", "51"),
    ];
    for (name, output, params) in table {
        let line = text.lines().find(|line| line.starts_with(&format!("{name} "))).unwrap_or_else(|| panic!("{name}"));
        let words: Vec<&str> = line.split_whitespace().collect();
        assert!(words.contains(&output) && words.contains(&params), "{line}");
    }
    for line in ["Total params: 176,159", "Trainable params: 175,671", "Non-trainable params: 488"] {
        assert!(text.contains(line), "{text}");
    }
}

const BENCH: [&str; 8] = ["bench", "--recipe", "lenet", "--batch", "16", "--seconds", "0.05", "--json"];

#[test]
fn bench_prints_every_figure() {
    let result = json(Path::new("."), &[&BENCH[..], &["--profile"]].concat());
    for key in [
        "train_images_per_second",
        "train_gflops",
        "infer_us_p50",
        "infer_us_p99",
        "infer_images_per_second",
        "peak_gflops",
        "first_step_s",
        "threads",
    ] {
        assert!(number(&result, key) > 0.0, "{key}: {result}");
    }
    assert!(number(&result, "infer_us_p99") >= number(&result, "infer_us_p50"));
    assert!(result["isa"].is_string());
    let layers = result["profile"]["layers"].as_array().unwrap();
    let names: Vec<&str> = layers.iter().map(|layer| layer["layers"].as_str().unwrap()).collect();
    assert_eq!(names[..4], ["scale1", "conv1+elu1+pool1", "conv2+elu2+pool2", "dense1"]);
    for key in ["forward_ms", "backward_ms", "forward_gflops", "backward_gflops"] {
        assert!(number(&layers[1], key) > 0.0, "{key}: {result}");
    }
    assert_eq!(number(&layers[0], "forward_gflops"), 0.0, "scaling multiplies nothing");
    assert!(number(&result["profile"], "update_ms") > 0.0, "{result}");
}

/// Steering and throttle: every image has two numbers.
#[test]
fn bench_measures_a_network_with_two_outputs() {
    let arguments = ["bench", "--recipe", "donkey", "--batch", "2", "--seconds", "0.05", "--json"];
    let result = json(Path::new("."), &arguments);
    for key in ["train_images_per_second", "infer_us_p50", "infer_images_per_second"] {
        assert!(number(&result, key) > 0.0, "{key}: {result}");
    }
}

#[test]
fn a_sweep_of_latencies_says_where_a_driver_breaks_and_saves_table_chart_and_drives() {
    let folder = tempfile::tempdir().unwrap();
    let sweep = ["drive", "expert", "--track", "lake", "--runs", "1", "--latency-ms", "2000,0", "--against", "zero"];
    let result = json(folder.path(), &[&sweep[..], &["--out", "sweep", "--json"]].concat());
    assert_eq!(
        (&result["driver"], &result["swept"], number(&result, "breaks_at")),
        (&"expert".into(), &"latency_ms".into(), 2000.0)
    );
    let laps: Vec<f64> =
        result["points"].as_array().unwrap().iter().map(|point| number(point, "laps_completed")).collect();
    assert_eq!(laps, [1.0, 0.0]);
    let one =
        json(folder.path(), &["drive", "expert", "--track", "lake", "--runs", "1", "--latency-ms", "2000", "--json"]);
    for key in ["cte_mean_m", "whiteness_deg_s", "interventions"] {
        assert_eq!(one[key], result["points"][1][key], "{key}");
    }
    assert_eq!((&result["against"]["driver"], number(&result["against"], "breaks_at")), (&"zero".into(), 0.0));
    let csv = std::fs::read_to_string(folder.path().join("sweep/sweep.csv")).unwrap();
    assert_eq!(csv.lines().count(), 5, "{csv}");
    for file in ["sweep.html", "0-ms/summary.json", "2000-ms/free_1.csv", "against-0-ms/summary.json"] {
        assert!(folder.path().join("sweep").join(file).is_file(), "{file}");
    }
    for (arguments, message) in [
        (&["--latency-ms", "0,50", "--noise", "0,0.1"][..], "not of both"),
        (&["--noise", "0,0.1", "--watch"][..], "give one"),
        (&["--latency-ms", "0,3000"][..], "3000"),
        (&["--latency-ms", "0,50,0"][..], "0 ms is named twice"),
        (&["--noise", "0.1,2"][..], "noise 2"),
    ] {
        let refused = common::command::error(folder.path(), &[&sweep[..6], arguments].concat());
        assert!(refused.contains(message), "{refused}");
    }
}

/// Several of them would write into the same folder.
#[cfg(not(feature = "mpi"))]
#[test]
fn a_program_without_mpi_refuses_to_run_several_times_under_its_launcher() {
    let folder = tempfile::tempdir().unwrap();
    let started = |ranks: &str| {
        common::command::steersman(folder.path()).arg("tracks").env("OMPI_COMM_WORLD_SIZE", ranks).output().unwrap()
    };
    let output = started("2");
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("--features mpi"));
    assert!(started("1").status.success());
}
