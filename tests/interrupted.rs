//! Two processes at once, killed ones, full disks, and damaged files: nothing is lost, and nothing is wrong without a word.

mod common;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use common::command::{error, json, run, steersman};
use common::painted_log;

const QUICK: [&str; 9] = ["train", "log", "--recipe", "lenet", "--set", "epochs=1", "--set", "batch=16", "--json"];
/// Long enough to meet it in the middle.
const LONG: [&str; 10] =
    ["train", "log", "--recipe", "lenet", "--set", "epochs=500", "--set", "batch=4", "--out", "run"];

fn folder_with_log(rows: usize) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    painted_log::write(&folder.path().join("log"), rows, "");
    folder
}

fn spawn(folder: &Path, args: &[&str]) -> Child {
    steersman(folder).args(args).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
}

fn wait_for(path: &Path) {
    let began = Instant::now();
    while !path.exists() {
        assert!(began.elapsed() < Duration::from_secs(150), "{} never appears", path.display());
        sleep(Duration::from_millis(5));
    }
}

/// Trains a run of one epoch in `run`.
fn finished_run() -> tempfile::TempDir {
    let folder = folder_with_log(300);
    json(folder.path(), &[&QUICK[..], &["--out", "run"]].concat());
    folder
}

#[test]
fn four_trainings_at_the_same_moment_each_get_their_folder() {
    let folder = folder_with_log(300);
    let children: Vec<_> = (0..4).map(|_| spawn(folder.path(), &QUICK)).collect();
    for child in children {
        let output = child.wait_with_output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }
    for n in 1..=4 {
        assert!(folder.path().join(format!("runs/lenet-{n}/result.json")).is_file(), "run {n}");
    }
    // A training that cannot begin leaves no folder behind.
    let said = error(folder.path(), &["train", "missing", "--recipe", "lenet"]);
    assert!(said.contains("missing") && !folder.path().join("runs/lenet-5").exists(), "{said}");
}

#[test]
fn a_second_resume_is_refused_until_the_first_ends_however_it_ends() {
    let folder = folder_with_log(200);
    let mut first = spawn(folder.path(), &LONG);
    wait_for(&folder.path().join("run/checkpoint.safetensors"));
    let said = error(folder.path(), &["train", "--resume", "run"]);
    assert!(said.contains("run: another process works on this run"), "{said}");
    first.kill().unwrap();
    first.wait().unwrap();
    fs::write(folder.path().join("run/.model.safetensors-unfinished-Xy12"), "half a model").unwrap();
    let mut second = spawn(folder.path(), &["train", "--resume", "run"]);
    let left = folder.path().join("run/.model.safetensors-unfinished-Xy12");
    let began = Instant::now();
    while left.exists() {
        assert!(second.try_wait().unwrap().is_none(), "the lock outlived its process");
        assert!(began.elapsed() < Duration::from_secs(150), "what was left behind is never removed");
        sleep(Duration::from_millis(5));
    }
    second.kill().unwrap();
    second.wait().unwrap();
}

#[test]
fn a_flipped_bit_in_any_file_of_a_run_is_an_error_that_names_it() {
    let folder = folder_with_log(200);
    let mut child = spawn(folder.path(), &LONG);
    wait_for(&folder.path().join("run/last.safetensors"));
    child.kill().unwrap();
    child.wait().unwrap();
    for name in ["checkpoint.safetensors", "run.json", "recipe.toml"] {
        let path = folder.path().join("run").join(name);
        let whole = fs::read(&path).unwrap();
        for at in [whole.len() / 3, whole.len() / 2, whole.len() - 9] {
            let mut flipped = whole.clone();
            flipped[at] ^= 1;
            fs::write(&path, flipped).unwrap();
            let said = error(folder.path(), &["train", "--resume", "run"]);
            assert!(said.contains(name), "{name}, byte {at}: {said}");
        }
        fs::write(&path, whole).unwrap();
    }
}

#[test]
fn damaged_results_and_histories_are_refused_and_old_runs_go_on_with_a_notice() {
    let folder = finished_run();
    let dir = folder.path();
    for (name, args) in [
        ("result.json", &["train", "--resume", "run"][..]),
        ("history.csv", &["compare", "run", "run", "--out", "page.html"]),
    ] {
        let path = dir.join("run").join(name);
        let whole = fs::read(&path).unwrap();
        let mut flipped = whole.clone();
        let digit = whole.iter().rposition(u8::is_ascii_digit).unwrap();
        flipped[digit] ^= 1;
        fs::write(&path, flipped).unwrap();
        let said = error(dir, args);
        assert!(said.contains(name) && said.contains("is damaged or was changed"), "{said}");
        fs::write(&path, whole).unwrap();
    }
    fs::remove_file(dir.join("run/checksums.txt")).unwrap();
    let output = run(dir, &["train", "--resume", "run"]);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(said.contains("has no checksums"), "{said}");
}

#[test]
fn a_network_that_no_memory_holds_is_refused_before_anything_is_planned() {
    let folder = tempfile::tempdir().unwrap();
    let lenet = Path::new(env!("CARGO_MANIFEST_DIR")).join("data/recipes/lenet.toml");
    let dense = r#"{ kind = "dense", units = 120, init = "he_normal" },"#;
    let wide = dense.replace("120", "8000").repeat(40);
    let recipe = fs::read_to_string(lenet).unwrap();
    assert!(recipe.contains(dense));
    fs::write(folder.path().join("wide.toml"), recipe.replace(dense, &wide)).unwrap();
    let said = error(folder.path(), &["summary", "--recipe", "wide.toml"]);
    assert!(said.contains("more than 100000000 parameters"), "{said}");
}

#[test]
fn files_that_must_not_grow_are_errors_with_a_remedy() {
    let folder = finished_run();
    let limited = |blocks: u32, args: &str| {
        let script = format!("trap '' XFSZ; ulimit -f {blocks}; exec \"$0\" {args}");
        let mut command = Command::new("sh");
        command.args(["-c", &script, env!("CARGO_BIN_EXE_steersman")]).current_dir(folder.path());
        let output = command.output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(1), "{args}: {said}");
        assert!(said.contains("make room on that disk"), "{args}: {said}");
    };
    limited(64, "train log --recipe lenet --set epochs=1 --set batch=16 --out full");
    limited(8, "export run/model.safetensors model.onnx --to onnx");
    limited(0, "drive run/model.safetensors --track lake --laps 1 --runs 1 --out drive");
    assert!(!folder.path().join("drive").exists() && !folder.path().join("model.onnx").exists());
    let hidden = |folder: &Path| {
        fs::read_dir(folder).unwrap().any(|e| e.unwrap().file_name().to_string_lossy().contains("unfinished"))
    };
    assert!(!hidden(folder.path()) && !hidden(&folder.path().join("full")), "nothing is left behind");
}

/// A small file system of its own, where that is permitted.
struct SmallDisk(tempfile::TempDir);

impl SmallDisk {
    fn mount(options: &str) -> Option<SmallDisk> {
        let folder = tempfile::tempdir().unwrap();
        let mut mount = Command::new("mount");
        mount.args(["-t", "tmpfs", "-o", options, "tmpfs"]).arg(folder.path()).stderr(Stdio::null());
        let mounted = mount.status().is_ok_and(|status| status.success());
        if !mounted {
            println!("skipped: this machine permits no mount of a small disk");
        }
        mounted.then_some(SmallDisk(folder))
    }

    fn path(&self) -> PathBuf {
        self.0.path().to_path_buf()
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg(self.0.path()).status();
    }
}

/// The folder behind `words` in a message.
fn kept(said: &str, words: &str) -> PathBuf {
    let from = said.find(words).unwrap_or_else(|| panic!("no {words:?} in {said}")) + words.len();
    said[from..].split([';', '\n']).next().unwrap().trim().into()
}

#[test]
fn what_was_trained_and_driven_is_kept_elsewhere_when_the_disk_is_full() {
    let Some(disk) = SmallDisk::mount("size=300k") else { return };
    let folder = finished_run();
    let out = disk.path().join("run");
    let args = [&QUICK[..], &["--out", out.to_str().unwrap()]].concat();
    let said = error(folder.path(), &args);
    assert!(said.contains("make room on that disk"), "{said}");
    let run = kept(&said, "the run so far is kept in ");
    // The run goes on there, to the result of a run that was left alone.
    let resumed = json(folder.path(), &["train", "--resume", run.to_str().unwrap(), "--json"]);
    let whole = json(folder.path(), &["train", "--resume", "run", "--json"]);
    assert_eq!(resumed["weights_hash"], whole["weights_hash"]);
    fs::remove_dir_all(run).unwrap();

    fs::remove_dir_all(&out).unwrap();
    fs::write(disk.path().join("filler"), vec![0; 290_000]).unwrap();
    let out = disk.path().join("drive");
    let drive = ["drive", "zero", "--track", "lake", "--runs", "1", "--out", out.to_str().unwrap()];
    let said = error(folder.path(), &drive);
    let drive = kept(&said, "the drive is kept in ");
    assert!(drive.join("summary.json").is_file() && !out.exists(), "{said}");
    fs::remove_dir_all(drive.parent().unwrap()).unwrap();
}

#[test]
fn a_read_only_folder_is_an_error_with_a_remedy() {
    let Some(disk) = SmallDisk::mount("ro,size=300k") else { return };
    let folder = finished_run();
    for args in [
        &[&QUICK[..], &["--out", "OUT"]].concat()[..],
        &["export", "run/model.safetensors", "OUT.onnx", "--to", "onnx"],
        &["drive", "zero", "--track", "lake", "--runs", "1", "--out", "OUT"],
        &["record", "--track", "lake", "--laps", "0.1", "--out", "OUT"],
        &["serve", "run/model.safetensors", "--port", "0", "--record", "OUT"],
    ] {
        let out = disk.path().join("x").display().to_string();
        let args: Vec<String> = args.iter().map(|arg| arg.replace("OUT", &out)).collect();
        let said = error(folder.path(), &args.iter().map(String::as_str).collect::<Vec<_>>());
        assert!(said.contains("name a folder where you may write"), "{args:?}: {said}");
    }
}
