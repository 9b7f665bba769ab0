//! Several ranks of MPI work as one process does: the same weights, drives and recordings for any number of them, also after one was
//! killed. Skipped where there is no `mpirun` of Open MPI.

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
    spoil(folder, "left");
}

/// Spoils a picture of `camera` so that only decoding finds out: it is complete at both ends.
fn spoil(folder: &Path, camera: &str) {
    let images: Vec<_> = fs::read_dir(folder.join("log/IMG")).unwrap().map(|entry| entry.unwrap().path()).collect();
    let spoilt = images.iter().filter(|path| path.to_string_lossy().contains(camera)).nth(7).unwrap();
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

/// A run of two ranks that has saved something.
fn begun(folder: &Path, args: &[&str], out: &str) -> Child {
    let mut job = mpirun(folder, 2);
    let job = job.arg(env!("CARGO_BIN_EXE_steersman")).args(args).args(["--out", out]);
    let job = job.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let deadline = Instant::now() + Duration::from_secs(120);
    while !folder.join(out).join("checkpoint.safetensors").exists() {
        assert!(Instant::now() < deadline, "no checkpoint");
        sleep(Duration::from_millis(5));
    }
    job
}

/// What `job` says after the processes `to` have had `signal`; it must end with an error, and soon.
fn signalled(job: Child, signal: &str, to: &[u32]) -> String {
    let sent = Instant::now();
    assert!(Command::new("kill").arg(signal).args(to.iter().map(u32::to_string)).status().unwrap().success());
    let output = job.wait_with_output().unwrap();
    assert!(sent.elapsed() < Duration::from_secs(20), "it ended after {:?}", sent.elapsed());
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success() && !error.contains("panicked"), "{error}");
    error
}

#[test]
fn ranks_end_soon_after_one_is_killed_or_all_are_interrupted_and_any_number_of_them_goes_on() {
    if !is_here() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    log(folder.path());
    let args = [&ARGS[..], &["--set", "epochs=12"]].concat();
    let alone = json(folder.path(), &[&args[..], &["--out", "alone"]].concat());
    let resumed = |out: &str, ranks: usize| {
        let resumed = json_of_ranks(folder.path(), ranks, &["train", "--resume", out, "--threads", "1", "--json"]);
        assert_eq!(resumed["weights_hash"], alone["weights_hash"], "{out}, {ranks} ranks");
        assert_eq!(resumed["val_mse"], alone["val_mse"], "{out}, {ranks} ranks");
    };
    let job = begun(folder.path(), &args, "killed");
    let ranks = children(&job);
    assert_eq!(ranks.len(), 2, "{ranks:?}");
    let error = signalled(job, "-9", &ranks[1..]);
    assert!(error.contains("signal 9"), "{error}");
    run_copy(folder.path(), "killed", "killed-too");
    resumed("killed", 1);
    resumed("killed-too", 3);
    // What launchers send at Ctrl-C, and Slurm before the time is over.
    let job = begun(folder.path(), &args, "interrupted");
    let ranks = children(&job);
    let error = signalled(job, "-TERM", &ranks);
    assert!(error.contains("stopped and saved; go on with: steersman train --resume interrupted"), "{error}");
    resumed("interrupted", 2);
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
fn without_speed(value: &mut Value) {
    match value {
        Value::Object(entries) => {
            if let Some(speed) = entries.remove("realtime_factor") {
                assert!(speed.as_f64().unwrap() > 0.0);
            }
            entries.values_mut().for_each(without_speed);
        }
        Value::Array(items) => items.iter_mut().for_each(without_speed),
        _ => {}
    }
}

/// Compares all files below two folders, byte for byte but for speeds in JSON. Their number.
fn same_files(one: &Path, other: &Path) -> usize {
    let entries = |folder: &Path| {
        let mut names: Vec<_> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        names.sort();
        names
    };
    assert_eq!(entries(one), entries(other), "{}", one.display());
    let same = |name: &std::ffi::OsString| {
        let [one, other] = [one, other].map(|folder| folder.join(name));
        if one.is_dir() {
            return same_files(&one, &other);
        }
        let [mut a, mut b] = [&one, &other].map(|path| fs::read(path).unwrap());
        if one.extension().is_some_and(|extension| extension == "json") {
            [&mut a, &mut b].into_iter().for_each(|bytes| {
                let mut value = serde_json::from_slice(bytes).unwrap();
                without_speed(&mut value);
                *bytes = value.to_string().into_bytes();
            });
        }
        assert!(a == b, "{} and {}", one.display(), other.display());
        1
    };
    entries(one).iter().map(same).sum()
}

/// Runs the same in one process and on these numbers of ranks, with `--out` and a name of its own; what is printed and what is written must be the
/// same. The number of files.
fn same_on(ranks: &[usize], folder: &Path, args: &[&str]) -> usize {
    let name = args[..2].join("-").replace(['/', '.'], "-");
    let mut files = 0;
    let mut alone = json(folder, &[args, &["--out", &format!("{name}-alone")]].concat());
    without_speed(&mut alone);
    for ranks in ranks {
        let out = format!("{name}-{ranks}");
        let mut together = json_of_ranks(folder, *ranks, &[args, &["--out", &out]].concat());
        without_speed(&mut together);
        assert_eq!(together, alone, "{ranks} ranks, {args:?}");
        let [one, other] = ["alone", &ranks.to_string()].map(|run| folder.join(format!("{name}-{run}")));
        files = match one.is_dir() {
            true => same_files(&one, &other),
            false => {
                assert!(fs::read(&one).unwrap() == fs::read(&other).unwrap(), "{ranks} ranks, {args:?}");
                1
            }
        };
    }
    files
}

#[test]
fn what_is_many_is_the_same_for_any_number_of_ranks() {
    if !is_here() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    log(folder);
    let model = "run/model.safetensors";
    let small = ["--recipe", "lenet", "--set", "epochs=1", "--set", "batch=54", "--threads", "1"];
    run(folder, &[&["train", "log"], &small[..], &["--out", "run"]].concat());

    let expert = ["drive", "zero", "--track", "lake", "--runs", "6", "--against", "expert", "--json"];
    // Of each run two trajectories; the map, and the summary.
    assert!(same_on(&[2, 4], folder, &expert) >= 12);
    let swept = ["drive", "expert", "--track", "lake", "--latency-ms", "0,150", "--noise=0.1", "--runs", "2", "--json"];
    assert!(same_on(&[2, 4], folder, &swept) >= 10);
    let recording = ["record", "--track=lake", "--laps", "0.15", "--recovery", "--camera", "udacity", "--json"];
    assert!(same_on(&[2, 4], folder, &recording) > 300);
    // Models drive here, which takes its time.
    let experiment = ["experiment", "split", "--quick", "--recording", "log", "--track", "lake", "--json"];
    assert_eq!(same_on(&[3], folder, &[&experiment[..], &small].concat()), 1);

    spoil(folder, "center");
    let judged = ["evaluate", model, "log", "log", "--json"];
    let alone = run(folder, &judged);
    let left_out = |output: &Output| String::from_utf8_lossy(&output.stderr).matches("left out: ").count();
    assert_eq!(left_out(&alone), 2);
    for ranks in [2, 4] {
        let together = of_ranks(folder, ranks, &judged);
        assert!(together.status.success() && together.stdout == alone.stdout, "{ranks} ranks");
        assert_eq!(left_out(&together), left_out(&alone));
    }
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

#[test]
fn a_drive_ends_soon_after_a_rank_is_killed() {
    if !is_here() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let args = ["drive", "zero", "--track", "lake", "--runs", "5000", "--out", "driven"];
    let mut job = mpirun(folder.path(), 2);
    let job = job.arg(env!("CARGO_BIN_EXE_steersman")).args(args).stdout(Stdio::null()).stderr(Stdio::piped());
    let job = job.spawn().unwrap();
    sleep(Duration::from_secs(3));
    let ranks = children(&job);
    assert_eq!(ranks.len(), 2, "{ranks:?}");
    let error = signalled(job, "-9", &ranks[1..]);
    assert!(error.contains("signal 9"), "{error}");
    assert!(!folder.path().join("driven").exists());
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
