//! Answers that a user can act on: what is said to arguments that cannot be carried out as they are.

mod common;

use std::fs;
use std::path::Path;

use common::archive::{Tree, zip};
use common::command::{error, json, run, steersman};
use common::painted_log;
use common::served::random_model;

/// A folder with a log, a run folder with a model in it, and pictures of which one is damaged.
fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    painted_log::write(&dir.join("log"), 60, "");
    fs::create_dir(dir.join("run")).unwrap();
    random_model(&dir.join("run/model.safetensors"), "lenet");
    let picture = fs::read_dir(dir.join("log/IMG")).unwrap().map(|entry| entry.unwrap().path()).min().unwrap();
    let bytes = fs::read(picture).unwrap();
    fs::write(dir.join("good.jpg"), &bytes).unwrap();
    fs::write(dir.join("bad.jpg"), &bytes[..bytes.len() / 2]).unwrap();
    folder
}

#[test]
fn the_folder_of_a_run_stands_for_its_model() {
    let folder = folder();
    let dir = folder.path();
    for args in [
        &["summary", "run", "--json"][..],
        &["predict", "run", "good.jpg", "--json"],
        &["evaluate", "run", "log", "--json"],
        &["drive", "run", "--on", "log", "--json"],
    ] {
        let file: Vec<&str> =
            args.iter().map(|arg| if *arg == "run" { "run/model.safetensors" } else { arg }).collect();
        assert_eq!(without_times(json(dir, args)), without_times(json(dir, &file)), "{args:?}");
    }
    run(dir, &["export", "run", "--to", "c", "model.c"]);
    let all = ["--set", "split.validation_share=0", "--set", "epochs=1"];
    run(dir, &[&["train", "log", "--from", "run", "--out", "second"][..], &all].concat());
}

/// `value` without what differs from one drive to the next.
fn without_times(mut value: serde_json::Value) -> serde_json::Value {
    if let Some(object) = value.as_object_mut() {
        object.retain(|key, _| !key.contains("realtime") && !key.contains("per_second") && key != "model");
    }
    value
}

#[test]
fn what_is_no_model_is_answered_with_what_to_do() {
    let folder = folder();
    let dir = folder.path();
    let tree: Tree = fs::read_dir(dir.join("log/IMG"))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .map(|path| (format!("IMG/{}", path.file_name().unwrap().to_str().unwrap()), fs::read(path).unwrap()))
        .chain([("driving_log.csv".into(), fs::read(dir.join("log/driving_log.csv")).unwrap())])
        .collect();
    fs::write(dir.join("drive.zip"), zip(&tree, "")).unwrap();
    fs::create_dir_all(dir.join("stopped")).unwrap();
    fs::write(dir.join("stopped/run.json"), "{}").unwrap();
    fs::create_dir(dir.join("empty")).unwrap();
    fs::write(dir.join("old.h5"), b"\x89HDF\r\n\x1a\n and so on").unwrap();
    let failures: Vec<String> = [
        (
            &["evaluate", "log", "run"][..],
            "log: is a recording, no model; this is the other way round: steersman evaluate run log\n",
        ),
        (
            &["evaluate", "log/driving_log.csv", "run/model.safetensors", "--json"],
            "steersman evaluate run/model.safetensors log/driving_log.csv --json\n",
        ),
        (&["evaluate", "drive.zip", "run"], "steersman evaluate run drive.zip\n"),
        (&["drive", "log", "--on", "run"], "steersman drive run --on log\n"),
        (&["predict", "log", "good.jpg"], "log: is a recording, no model; name a model there"),
        (
            &["drive", "lenet", "--track", "lake"],
            "lenet is a recipe, no model; train a model with: steersman train --recipe lenet",
        ),
        (&["drive", "lake", "--track", "lake"], "lake is a track, no model"),
        (&["summary", "stopped"], "this run has no model yet; go on with: steersman train --resume stopped"),
        (&["summary", "empty"], "no model.safetensors in this folder"),
        (&["summary", "."], "is a folder of runs; name a model, such as ./run/model.safetensors"),
        (&["summary", "old.h5"], "is a model of Keras; steersman import"),
        (
            &["summary", "nothing"],
            "nothing: No such file or directory (os error 2); check the name, it is looked for in /",
        ),
        (&["train", "nothing", "--out", "run"], "check the name, it is looked for in /"),
        (&["evaluate", "run", "run"], "is the folder of a run, no recording"),
        (&["train", "run"], "is the folder of a run, no recording"),
        (&["train", "log", "--from", "lenet"], "lenet is a recipe, no model"),
        (&["train", "log", "--set", "optimizer.lr=1"], "unknown field `lr` (did you mean `learning_rate`?)"),
        (&["train", "log", "--set", "batch_size=9"], "unknown field `batch_size` (did you mean `batch`?)"),
    ]
    .into_iter()
    .filter_map(|(args, expected)| {
        let message = error(dir, args);
        (!message.contains(expected)).then(|| format!("{args:?}: `{expected}` is not in: {message}"))
    })
    .collect();
    assert!(failures.is_empty(), "{}", failures.join("\n"));
    // Where there is a run of the recipe, its model is named.
    fs::create_dir(dir.join("runs")).unwrap();
    fs::rename(dir.join("run"), dir.join("runs/lenet-1")).unwrap();
    for given in ["lenet", "lent"] {
        let message = error(dir, &["drive", given, "--track", "lake"]);
        assert!(message.contains("newest model is runs/lenet-1/model.safetensors"), "{message}");
    }
}

#[cfg(unix)]
#[test]
fn a_pipe_is_no_model() {
    let folder = folder();
    assert!(std::process::Command::new("mkfifo").arg(folder.path().join("pipe")).status().unwrap().success());
    assert!(error(folder.path(), &["summary", "pipe"]).contains("pipe: is a FIFO"));
}

/// Standard error of a command with wrong arguments.
fn wrong_arguments(dir: &Path, args: &[&str]) -> String {
    let output = steersman(dir).args(args).output().unwrap();
    assert_eq!(output.status.code(), Some(2), "{args:?}");
    String::from_utf8(output.stderr).unwrap()
}

#[test]
fn entries_of_recipes_given_as_arguments_are_answered_with_set() {
    let dir = Path::new(".");
    for (args, expected) in [
        (&["train", "log", "--epochs", "3"][..], "use --set epochs=3"),
        (&["train", "--epochs=3"], "use --set epochs=3"),
        (&["train", "log", "--learning-rate", "1e-4"], "use --set optimizer.learning_rate=1e-4"),
        (&["bench", "--lr", "0.1"], "use --set optimizer.learning_rate=0.1"),
        (&["train", "log", "--batch-size", "64"], "use --set batch=64"),
    ] {
        let message = wrong_arguments(dir, args);
        assert!(message.contains("unexpected argument") && message.contains(expected), "{args:?}: {message}");
    }
    // `drive` takes no recipe, and no recipe has wings.
    for args in [&["drive", "model", "--track", "lake", "--epochs", "3"][..], &["train", "log", "--wings", "2"]] {
        let message = wrong_arguments(dir, args);
        assert!(message.contains("unexpected argument") && !message.contains("--set"), "{args:?}: {message}");
    }
}

#[test]
fn one_bad_input_does_not_hide_the_good_ones() {
    let folder = folder();
    let dir = folder.path();
    let output = steersman(dir).args(["predict", "run", "good.jpg", "bad.jpg", "good.jpg"]).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let printed = String::from_utf8(output.stdout).unwrap();
    assert_eq!(printed.lines().filter(|line| line.ends_with("good.jpg")).count(), 2, "{printed}");
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("error: bad.jpg: the JPEG is truncated"), "{said}");

    let output = steersman(dir).args(["predict", "run", "bad.jpg", "good.jpg", "--json"]).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let answers: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(answers[0]["error"].as_str().unwrap().contains("truncated") && answers[0].get("steering").is_none());
    assert!(answers[1]["steering"].is_number() && answers[1].get("error").is_none(), "{answers}");

    let output = steersman(dir).args(["inspect", "log", "nothing", "run", "--json"]).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let reports: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&reports[0]["usable"], &reports[1]["path"]), (&60.into(), &"nothing".into()), "{reports}");
    assert!(reports[2]["error"].as_str().unwrap().contains("folder of a run"), "{reports}");
}

#[test]
fn whatever_reads_recordings_takes_archives_and_what_is_said_about_them() {
    let folder = folder();
    let dir = folder.path();
    // Labels in degrees, which the usual reading refuses.
    let log = fs::read_to_string(dir.join("log/driving_log.csv")).unwrap();
    let degrees: String = log
        .lines()
        .map(|line| {
            let mut fields: Vec<String> = line.split(", ").map(String::from).collect();
            if let Some(Ok(steering)) = fields.get(3).map(|field| field.parse::<f64>()) {
                fields[3] = (25.0 * steering).to_string();
            }
            fields.join(",") + "\n"
        })
        .collect();
    let tree: Tree = fs::read_dir(dir.join("log/IMG"))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .map(|path| (format!("IMG/{}", path.file_name().unwrap().to_str().unwrap()), fs::read(path).unwrap()))
        .chain([("driving_log.csv".into(), degrees.into_bytes())])
        .collect();
    fs::write(dir.join("drive.zip"), zip(&tree, "my drive/")).unwrap();
    let keras = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/keras/keras3.keras").display().to_string();
    for (args, out) in [
        (&["evaluate", "run", "drive.zip"][..], None),
        (&["explain", "run", "drive.zip"], Some("explained")),
        (&["tracks", "lake", "--beside", "drive.zip"], Some("sheets")),
        (&["import", &keras, "--fit", "drive.zip"], None),
        (
            &["experiment", "colour", "--recording", "drive.zip", "--set", "epochs=1", "--quick", "--track", "lake"],
            Some("trials.csv"),
        ),
        (&["drive", "run", "--on", "drive.zip"], None),
        (&["video", "drive.zip", "out.mp4"], None),
        (&["train", "drive.zip", "--recipe", "lenet", "--set", "epochs=1"], Some("trained")),
    ] {
        let option = if args[0] == "tracks" { "--sheet" } else { "--out" };
        let out = out.map_or(vec![], |out| vec![option, out]);
        let message = error(dir, &[args, &out[..]].concat());
        assert!(message.contains("--unit degrees"), "{args:?}: {message}");
        if matches!(args[0], "evaluate" | "explain" | "import" | "train" | "tracks") {
            let all = if args[0] == "train" { &["--set", "split.validation_share=0"][..] } else { &[] };
            run(dir, &[args, &["--unit", "degrees"], all, &out[..]].concat());
        }
    }
}
