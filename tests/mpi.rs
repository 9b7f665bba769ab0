//! Several ranks of MPI work as one process does: the same weights for any number of them, also after one was killed. Skipped where
//! there is no `mpirun` of Open MPI.

mod common;

use std::fs;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use common::command::{json, run};
use common::painted_log;
use serde_json::Value;

/// `mpirun` of `ranks` on this machine, also as root, and more of them than cores; each rank computes with one thread.
fn mpirun(folder: &Path, ranks: usize) -> Command {
    let mut command = Command::new("mpirun");
    command.current_dir(folder).args(["--allow-run-as-root", "--oversubscribe", "-n", &ranks.to_string()]);
    command
}

fn of_ranks(folder: &Path, ranks: usize, args: &[&str]) -> Output {
    mpirun(folder, ranks).arg(env!("CARGO_BIN_EXE_steersman")).args(args).output().unwrap()
}

fn json_of_ranks(folder: &Path, ranks: usize, args: &[&str]) -> Value {
    let output = of_ranks(folder, ranks, args);
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{ranks} ranks, {args:?}: {error}");
    let text = String::from_utf8_lossy(&output.stdout);
    serde_json::from_str(text.lines().last().unwrap_or_default()).unwrap_or_else(|e| panic!("{e}: {text}{error}"))
}

/// Whether there is an MPI here; says so if not.
fn is_here() -> bool {
    let version = Command::new("mpirun").arg("--version").output();
    let here = version.is_ok_and(|output| String::from_utf8_lossy(&output.stdout).contains("Open MPI"));
    if !here {
        eprintln!("skipped: there is no mpirun of Open MPI");
    }
    here
}

/// Pictures of which one cannot be decoded, batch norm, an average of the weights, batches that are no multiple of anything.
const ARGS: [&str; 17] = [
    "train",
    "log",
    "--recipe",
    "hyper",
    "--set",
    "preprocessing.resize=[40, 44]",
    "--set",
    "epochs=3",
    "--set",
    "batch=54",
    "--set",
    "averaging={kind='ema', decay=0.9, from_share=0.0, refit_batches=2}",
    "--seed",
    "5",
    "--threads",
    "1",
    "--json",
];

/// What must not depend on the number of ranks.
const SAME: [&str; 7] =
    ["weights_hash", "val_mse", "train_mse", "val_center_mse", "near_twin_percent", "train_images", "val_images"];

fn log(folder: &Path) {
    painted_log::write(&folder.join("log"), 160, "");
    let images: Vec<_> = fs::read_dir(folder.join("log/IMG")).unwrap().map(|entry| entry.unwrap().path()).collect();
    let spoilt = images.iter().filter(|path| path.to_string_lossy().contains("left")).nth(7).unwrap();
    // Complete at both ends, so only decoding finds out.
    let mut bytes = fs::read(spoilt).unwrap();
    let middle = bytes.len() / 3;
    bytes[20..middle].fill(0xff);
    fs::write(spoilt, bytes).unwrap();
}

#[test]
fn any_number_of_ranks_trains_the_weights_of_one_process() {
    if !is_here() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    log(folder.path());
    let output = run(folder.path(), &[&ARGS[..], &["--out", "alone"]].concat());
    assert!(String::from_utf8_lossy(&output.stderr).contains("1 images cannot be decoded"));
    let alone: Value = serde_json::from_str(String::from_utf8_lossy(&output.stdout).lines().last().unwrap()).unwrap();
    for ranks in [1, 2, 4] {
        let out = format!("ranks-{ranks}");
        let together = json_of_ranks(folder.path(), ranks, &[&ARGS[..], &["--out", &out]].concat());
        for key in SAME {
            assert_eq!(together[key], alone[key], "{key} of {ranks} ranks");
        }
        let model = |run: &str| fs::read(folder.path().join(run).join("last.safetensors")).unwrap();
        assert!(model(&out) == model("alone"), "{ranks} ranks");
    }
}

#[test]
fn ranks_end_soon_after_one_is_killed_and_any_number_of_them_goes_on() {
    if !is_here() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    log(folder.path());
    let args = [&ARGS[..], &["--set", "epochs=12"]].concat();
    let alone = json(folder.path(), &[&args[..], &["--out", "alone"]].concat());
    let program = env!("CARGO_BIN_EXE_steersman");
    let mut job = mpirun(folder.path(), 2);
    let mut job = job.arg(program).args(&args).args(["--out", "killed"]);
    job = job.stdout(Stdio::null()).stderr(Stdio::piped());
    let job = job.spawn().unwrap();
    let deadline = Instant::now() + Duration::from_secs(120);
    while !folder.path().join("killed/checkpoint.safetensors").exists() {
        assert!(Instant::now() < deadline, "no checkpoint");
        sleep(Duration::from_millis(5));
    }
    let ranks = children(&job);
    assert_eq!(ranks.len(), 2, "{ranks:?}");
    let killed = Instant::now();
    let status = Command::new("kill").args(["-9", &ranks[1].to_string()]).status().unwrap();
    assert!(status.success());
    let output = job.wait_with_output().unwrap();
    assert!(killed.elapsed() < Duration::from_secs(10), "it ended after {:?}", killed.elapsed());
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && error.contains("signal 9"), "{error}");
    fs::rename(folder.path().join("killed"), folder.path().join("whole")).unwrap();
    for ranks in [1, 3] {
        let out = format!("resumed-{ranks}");
        run_copy(folder.path(), "whole", &out);
        let resumed = json_of_ranks(folder.path(), ranks, &["train", "--resume", &out, "--threads", "1", "--json"]);
        assert_eq!(resumed["weights_hash"], alone["weights_hash"], "{ranks} ranks");
        assert_eq!(resumed["val_mse"], alone["val_mse"], "{ranks} ranks");
    }
}

fn run_copy(folder: &Path, from: &str, to: &str) {
    fs::create_dir(folder.join(to)).unwrap();
    for entry in fs::read_dir(folder.join(from)).unwrap() {
        let entry = entry.unwrap();
        fs::copy(entry.path(), folder.join(to).join(entry.file_name())).unwrap();
    }
}

/// The processes that `job` started, the oldest first.
fn children(job: &Child) -> Vec<u32> {
    let id = job.id();
    let list = fs::read_to_string(format!("/proc/{id}/task/{id}/children")).unwrap();
    list.split_whitespace().map(|id| id.parse().unwrap()).collect()
}

/// All but the speed of the simulation, which is measured.
#[test]
fn seeds_that_ranks_drive_come_to_the_same_bytes() {
    if !is_here() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let args = ["drive", "zero", "--track", "lake", "--runs", "6", "--against", "expert", "--json", "--out"];
    let alone = json(folder.path(), &[&args[..], &["alone"]].concat());
    let together = json_of_ranks(folder.path(), 3, &[&args[..], &["together"]].concat());
    let without_speed = |mut value: Value| {
        for drive in [value.clone(), value["against"].clone()] {
            assert!(drive["realtime_factor"].as_f64().unwrap() > 0.0);
        }
        value.as_object_mut().unwrap().remove("realtime_factor");
        value["against"].as_object_mut().unwrap().remove("realtime_factor");
        value
    };
    assert_eq!(without_speed(together), without_speed(alone));
    let mut compared = 0;
    for entry in fs::read_dir(folder.path().join("alone")).unwrap() {
        let path = entry.unwrap().path();
        // It is what was printed.
        if path.ends_with("summary.json") {
            continue;
        }
        let other = folder.path().join("together").join(path.file_name().unwrap());
        assert!(fs::read(&path).unwrap() == fs::read(&other).unwrap(), "{}", path.display());
        compared += 1;
    }
    assert!(compared >= 6, "{compared}");
}

/// What one rank finds wrong must not leave the others waiting.
#[test]
fn a_drive_that_cannot_be_driven_ends_on_all_ranks() {
    if !is_here() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    for (args, expected) in [
        (["drive", "zero", "--track", "lake", "--runs", "0"], "at least 1"),
        (["drive", "zero", "--track", "lake", "--speed", "50"], "3 to 30 mph"),
        (["drive", "none.safetensors", "--track", "lake", "--runs", "2"], "none.safetensors"),
    ] {
        let mut job = mpirun(folder.path(), 2);
        let job = job.arg(env!("CARGO_BIN_EXE_steersman")).args(args).stdout(Stdio::null()).stderr(Stdio::piped());
        let mut job = job.spawn().unwrap();
        let deadline = Instant::now() + Duration::from_secs(60);
        while job.try_wait().unwrap().is_none() {
            assert!(Instant::now() < deadline, "{args:?} goes on");
            sleep(Duration::from_millis(20));
        }
        let output = job.wait_with_output().unwrap();
        let error = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success() && error.contains(expected), "{args:?}: {error}");
    }
}

/// Each rank begins in a folder of its own here, as on machines without a common disk.
#[test]
fn a_rank_with_other_recordings_or_another_program_is_named() {
    if !is_here() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let [first, second] = ["first", "second"].map(|name| folder.path().join(name));
    for (place, rows) in [(&first, 160), (&second, 150)] {
        fs::create_dir(place).unwrap();
        painted_log::write(&place.join("log"), rows, "");
    }
    let program = env!("CARGO_BIN_EXE_steersman");
    let two = |programs: [&str; 2], places: [&Path; 2]| {
        let mut command = mpirun(folder.path(), 1);
        command.arg("--wdir").arg(places[0]).arg(programs[0]).args(ARGS).args([":", "-n", "1", "--wdir"]);
        let output = command.arg(places[1]).arg(programs[1]).args(ARGS).output().unwrap();
        assert!(!output.status.success());
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!error.contains("panicked"), "{error}");
        error
    };
    let error = two([program; 2], [&first, &second]);
    assert!(error.contains("rank 1 of 2") && error.contains("other rows or pictures"), "{error}");
    let other = folder.path().join("other");
    fs::copy(program, &other).unwrap();
    // What follows the program in its file is no part of it, but makes it another file.
    let bytes = [fs::read(&other).unwrap(), vec![0]].concat();
    fs::write(&other, bytes).unwrap();
    let error = two([program, other.to_str().unwrap()], [&first, &first]);
    assert!(error.contains("rank 1 of 2") && error.contains("not that of rank 0"), "{error}");
}

#[test]
fn ranks_agree_on_the_lowest_instruction_set() {
    if !is_here() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    log(folder.path());
    let args = [&ARGS[..], &["--set", "epochs=1", "--out"]].concat();
    let mut command = mpirun(folder.path(), 1);
    command.arg(env!("CARGO_BIN_EXE_steersman")).args(&args).arg("mixed");
    command.args([":", "-n", "1", "-x", "STEERSMAN_ISA=portable", env!("CARGO_BIN_EXE_steersman")]).args(&args);
    let output = command.arg("mixed").output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && error.contains("2 ranks compute with portable vector code"), "{error}");
    let alone = common::command::steersman(folder.path())
        .env("STEERSMAN_ISA", "portable")
        .args(&args)
        .arg("alone")
        .output()
        .unwrap();
    let hash = |output: &Output| -> Value {
        let text = String::from_utf8_lossy(&output.stdout);
        serde_json::from_str::<Value>(text.lines().last().unwrap()).unwrap()["weights_hash"].clone()
    };
    assert_eq!(hash(&output), hash(&alone));
    // Without a launcher there is but this process, and it says nothing of ranks.
    let plain = run(folder.path(), &["tracks"]);
    assert!(!String::from_utf8_lossy(&plain.stderr).contains("rank"));
}
