//! The whole way on real recordings, found through STEERSMAN_RECORDINGS; skipped with a word where there are none.

mod common;

use std::path::{Path, PathBuf};

use common::command::{json, steersman};

/// The folder of recordings, or a printed reason.
fn recordings() -> Option<PathBuf> {
    let folder = std::env::var_os("STEERSMAN_RECORDINGS").map(PathBuf::from);
    match folder.as_ref().map(|folder| folder.is_dir()) {
        Some(true) => folder,
        Some(false) => panic!("STEERSMAN_RECORDINGS is no folder: {folder:?}"),
        None => {
            eprintln!("skipped: STEERSMAN_RECORDINGS is not set");
            None
        }
    }
}

fn inspect(path: &Path) -> serde_json::Value {
    json(Path::new("."), &["inspect", path.to_str().unwrap(), "--json"])[0].clone()
}

/// The same for a log of which no row can be used: `inspect` tells all the same, and fails.
fn inspect_unusable(path: &Path) -> serde_json::Value {
    let output = steersman(Path::new(".")).args(["inspect", path.to_str().unwrap(), "--json"]).output().unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", path.display());
    let text = String::from_utf8(output.stdout).unwrap();
    let reports: serde_json::Value = serde_json::from_str(text.lines().last().unwrap_or_default()).unwrap();
    reports[0].clone()
}

#[test]
fn folders_load_with_their_known_counts() {
    let Some(folder) = recordings() else { return };
    for (name, rows, usable, sessions) in [
        ("lake-sample", 3000, 3000, 6),
        ("lake-windows-paths", 500, 500, 2),
        ("mountain-keyboard", 701, 700, 1),
        ("donkey-tub", 1000, 1000, 1),
    ] {
        let report = inspect(&folder.join(name));
        assert_eq!((report["rows"].as_u64(), report["usable"].as_u64()), (Some(rows), Some(usable)), "{name}");
        assert_eq!(report["sessions"].as_array().unwrap().len(), sessions, "{name}");
    }
}

#[test]
fn logs_without_images_are_parsed() {
    let Some(folder) = recordings() else { return };
    let mut counts: Vec<u64> = std::fs::read_dir(folder.join("csv-variants"))
        .unwrap()
        .map(|entry| inspect_unusable(&entry.unwrap().path())["rows"].as_u64().unwrap())
        .collect();
    counts.sort_unstable();
    assert_eq!(counts, [149, 149, 150, 150, 150, 150, 150, 150]);
}

#[test]
fn a_network_learns_from_a_tub_and_from_a_log() {
    let Some(folder) = recordings() else { return };
    let scratch = tempfile::tempdir().unwrap();
    for name in ["donkey-tub", "lake-windows-paths"] {
        let recording = folder.join(name);
        let out = scratch.path().join(name);
        let args = ["train", recording.to_str().unwrap(), "--recipe", "lenet", "--set", "epochs=3", "--json", "--out"];
        let result = json(scratch.path(), &[&args[..], &[out.to_str().unwrap()]].concat());
        let history = std::fs::read_to_string(out.join("history.csv")).unwrap();
        let losses: Vec<f64> = history.lines().skip(1).map(|l| l.split(',').nth(1).unwrap().parse().unwrap()).collect();
        assert!(losses[2] < losses[0], "{name}: {losses:?}");
        assert_eq!(result["leak_percent"], 0.0, "{name}");
    }
}
