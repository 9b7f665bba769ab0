//! A run that is killed in the middle of an epoch, or interrupted, goes on to the same bits as one that was left alone.

mod common;

use std::fs;
use std::io::Read;
use std::path::Path;
use std::process::{Child, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use common::command::{json, steersman};
use common::painted_log;

/// Small batches, so that an epoch takes long enough to be interrupted; a schedule and early stopping, so that their memory
/// has to survive too.
const ARGS: [&str; 17] = [
    "train",
    "log",
    "--recipe",
    "lenet",
    "--set",
    "epochs=4",
    "--set",
    "batch=4",
    "--set",
    "schedule.shape={kind='reduce_on_plateau', factor=0.5, patience_epochs=1}",
    "--set",
    "early_stopping={patience_epochs=9}",
    "--set",
    "samples.flip=both",
    "--json",
    "--seed",
    "5",
];

fn uninterrupted(folder: &Path) -> serde_json::Value {
    json(folder, &[&ARGS[..], &["--out", "whole"]].concat())
}

fn start(folder: &Path, out: &str) -> Child {
    steersman(folder).args(ARGS).args(["--out", out]).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
}

/// Waits until the first epoch is on disk, then until the second is under way.
fn wait_for_second_epoch(folder: &Path, out: &str) {
    let deadline = Instant::now() + Duration::from_secs(120);
    while !folder.join(out).join("checkpoint.safetensors").exists() {
        assert!(Instant::now() < deadline, "no checkpoint");
        sleep(Duration::from_millis(5));
    }
    sleep(Duration::from_millis(50));
}

fn assert_same_result(folder: &Path, out: &str, whole: &serde_json::Value) {
    for key in ["weights_hash", "val_mse", "val_center_mse", "train_mse", "best_epoch", "epochs"] {
        let resumed = json(folder, &["train", "--resume", out, "--json"]);
        assert_eq!(resumed[key], whole[key], "{key}");
    }
    let model = |run: &str| fs::read(folder.join(run).join("last.safetensors")).unwrap();
    assert!(model(out) == model("whole"), "the model files differ");
    let left =
        fs::read_dir(folder.join(out)).unwrap().filter(|e| e.as_ref().unwrap().file_name() != "run.json").count();
    let expected = fs::read_dir(folder.join("whole")).unwrap().count() - 1;
    assert_eq!(left, expected, "temporary files are left behind");
}

#[test]
fn a_killed_run_goes_on_to_the_same_bits() {
    let folder = tempfile::tempdir().unwrap();
    painted_log::write(&folder.path().join("log"), 400, "");
    let whole = uninterrupted(folder.path());
    let mut child = start(folder.path(), "killed");
    wait_for_second_epoch(folder.path(), "killed");
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(!folder.path().join("killed/result.json").exists(), "it was finished before it could be killed");
    assert_same_result(folder.path(), "killed", &whole);
}

/// An average whose running statistics are fitted anew, and one whose statistics are averaged; batches hold pairs.
#[test]
fn a_killed_run_goes_on_to_the_same_averaged_weights() {
    let folder = tempfile::tempdir().unwrap();
    painted_log::write(&folder.path().join("log"), 400, "");
    let layers = "layers=[{kind='conv2d', filters=4, kernel=[3, 3], stride=[2, 2]}, {kind='batch_norm'}, {kind='relu'}, \
                  {kind='flatten'}, {kind='dense', units=1}]";
    let pairs = "smoothness={pairs_share=1.0, spatial=1.0, temporal=1.0}";
    let of = |averaging| [&ARGS[..], &["--set", layers, "--set", averaging, "--set", pairs]].concat();
    let mut hashes = Vec::new();
    for averaging in ["averaging={kind='ema', decay=0.99, refit_batches=5}", "averaging={kind='swa', from_share=0.3}"] {
        let args = of(averaging);
        let whole = json(folder.path(), &[&args[..], &["--out", "whole", "--threads", "1"]].concat());
        let mut child = steersman(folder.path())
            .args(&args)
            .args(["--out", "killed"])
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        wait_for_second_epoch(folder.path(), "killed");
        child.kill().unwrap();
        child.wait().unwrap();
        assert!(!folder.path().join("killed/result.json").exists(), "it was finished before it could be killed");
        assert_same_result(folder.path(), "killed", &whole);
        hashes.push(whole["weights_hash"].to_string());
        ["whole", "killed"].iter().for_each(|run| fs::remove_dir_all(folder.path().join(run)).unwrap());
    }
    let args = of("averaging={kind='ema', decay=0.99}");
    hashes.push(json(folder.path(), &[&args[..], &["--out", "averaged"]].concat())["weights_hash"].to_string());
    hashes.sort();
    hashes.dedup();
    assert_eq!(hashes.len(), 3, "the entries of the recipe make a difference");
}

#[test]
fn a_run_by_im2col_goes_on_by_im2col() {
    let folder = tempfile::tempdir().unwrap();
    painted_log::write(&folder.path().join("log"), 400, "");
    let auto = json(folder.path(), &[&ARGS[..], &["--out", "auto", "--algorithm", "auto"]].concat());
    assert!(auto.get("algorithm").is_none());
    let whole = json(folder.path(), &[&ARGS[..], &["--out", "whole", "--algorithm", "im2col"]].concat());
    assert_eq!(whole["algorithm"], "im2col");
    assert_ne!(whole["weights_hash"], auto["weights_hash"], "another order of summation, other last bits");
    let by_environment =
        steersman(folder.path()).args(ARGS).args(["--out", "named"]).env("STEERSMAN_CONV", "im2col").output().unwrap();
    assert!(by_environment.status.success());
    let named: serde_json::Value =
        serde_json::from_slice(by_environment.stdout.trim_ascii().rsplit(|&b| b == b'\n').next().unwrap()).unwrap();
    assert_eq!(named["weights_hash"], whole["weights_hash"]);
    let args = [&ARGS[..], &["--out", "killed", "--algorithm", "im2col"]].concat();
    let mut child = steersman(folder.path()).args(args).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    wait_for_second_epoch(folder.path(), "killed");
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(!folder.path().join("killed/result.json").exists(), "it was finished before it could be killed");
    assert_same_result(folder.path(), "killed", &whole);
    let unknown = steersman(folder.path()).args(["train", "log", "--algorithm", "gemm"]).output().unwrap();
    let message = String::from_utf8_lossy(&unknown.stderr);
    assert!(!unknown.status.success() && message.contains("the algorithms are auto and im2col"), "{message}");
}

#[cfg(unix)]
#[test]
fn ctrl_c_saves_in_the_middle_of_an_epoch_and_the_run_goes_on_to_the_same_bits() {
    let folder = tempfile::tempdir().unwrap();
    painted_log::write(&folder.path().join("log"), 400, "");
    let whole = uninterrupted(folder.path());
    let mut child = start(folder.path(), "stopped");
    wait_for_second_epoch(folder.path(), "stopped");
    let interrupt = std::process::Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert!(interrupt.success());
    let status = child.wait().unwrap();
    let mut message = String::new();
    child.stderr.take().unwrap().read_to_string(&mut message).unwrap();
    assert_eq!(status.code(), Some(130), "{message}");
    assert!(message.contains("go on with: steersman train --resume stopped"), "{message}");
    let page = std::fs::read_to_string(folder.path().join("stopped/report.html")).unwrap();
    assert!(page.contains("was stopped after"), "the page of a stopped run says so");
    assert_same_result(folder.path(), "stopped", &whole);
}

#[test]
fn a_run_whose_recording_has_changed_does_not_go_on() {
    let folder = tempfile::tempdir().unwrap();
    let log = painted_log::write(&folder.path().join("log"), 200, "");
    let mut child = start(folder.path(), "run");
    wait_for_second_epoch(folder.path(), "run");
    child.kill().unwrap();
    child.wait().unwrap();
    fs::remove_file(folder.path().join("run/result.json")).unwrap_or_default();
    let text = fs::read_to_string(&log).unwrap();
    let refused = |lines: Vec<String>| {
        fs::write(&log, lines.join("\n")).unwrap();
        let message = common::command::error(folder.path(), &["train", "--resume", "run"]);
        assert!(message.contains("the recordings have changed") && !message.contains("pictures of"), "{message}");
    };
    refused(text.lines().take(150).map(String::from).collect());
    // Other labels for the same pictures. Not all rows are used: some stand too near to the other side.
    let relabelled = text.lines().enumerate().map(|(line, text)| match line {
        60..80 => text.replace(&format!(", {}, 0.8,", painted_log::steering(line - 1)), ", 0.123, 0.8,"),
        _ => text.into(),
    });
    let relabelled: Vec<String> = relabelled.collect();
    assert_eq!(relabelled.iter().filter(|line| line.contains(", 0.123, 0.8,")).count(), 20);
    refused(relabelled);
}

#[test]
fn a_run_goes_on_only_with_the_same_pictures() {
    let folder = tempfile::tempdir().unwrap();
    painted_log::write(&folder.path().join("log"), 400, "");
    let whole = uninterrupted(folder.path());
    let mut child = start(folder.path(), "run");
    wait_for_second_epoch(folder.path(), "run");
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(!folder.path().join("run/result.json").exists(), "it was finished before it could be killed");
    // One picture of the centre camera becomes another one; names and labels stay.
    let images = folder.path().join("log/IMG");
    let names = fs::read_dir(&images).unwrap().map(|entry| entry.unwrap().path());
    let mut centre: Vec<_> = names.filter(|path| path.display().to_string().contains("center")).collect();
    centre.sort();
    // The label of the first row is 0, which the recipe balances away.
    let [first, second] = [&centre[1], &centre[2]].map(|path| fs::read(path).unwrap());
    fs::write(&centre[1], &second).unwrap();
    let message = common::command::error(folder.path(), &["train", "--resume", "run"]);
    assert!(message.contains("pictures of the recordings have changed since the run began"), "{message}");
    fs::write(&centre[1], first).unwrap();
    assert_same_result(folder.path(), "run", &whole);
}

#[test]
fn a_run_whose_recordings_were_moved_goes_on_where_they_are_now() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    painted_log::write(&dir.join("log"), 400, "");
    let whole = uninterrupted(dir);
    let mut child = start(dir, "run");
    wait_for_second_epoch(dir, "run");
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(!dir.join("run/result.json").exists(), "it was finished before it could be killed");
    fs::rename(dir.join("log"), dir.join("elsewhere")).unwrap();
    let message = common::command::error(dir, &["train", "--resume", "run"]);
    assert!(
        message.contains("log: the recording is not there any more") && message.contains("--recordings"),
        "{message}"
    );
    let message = common::command::error(dir, &["train", "--resume", "run", "--recordings", "elsewhere", "elsewhere"]);
    assert!(message.contains("the run has 1 recordings, --recordings names 2"), "{message}");
    // Another recording is no substitute.
    painted_log::write(&dir.join("other"), 300, "_b");
    let message = common::command::error(dir, &["train", "--resume", "run", "--recordings", "other"]);
    assert!(message.contains("the recordings have changed since the run began"), "{message}");
    let resumed = json(dir, &["train", "--resume", "run", "--recordings", "elsewhere", "--json"]);
    assert_eq!(resumed["weights_hash"], whole["weights_hash"]);
    // From now on it knows where they are.
    let info: serde_json::Value = serde_json::from_slice(&fs::read(dir.join("run/run.json")).unwrap()).unwrap();
    assert!(info["recordings"][0].as_str().unwrap().ends_with("elsewhere"), "{info}");
}
