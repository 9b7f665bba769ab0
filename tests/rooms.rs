//! The plan of the house: which rooms (modules) may use which. No two rooms use each other, directly or by a detour.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

/// The top-level rooms. A room may use those above it.
const ROOMS: [&str; 34] = [
    "error",
    "suggestion",
    "text",
    "observer",
    "metrics",
    "statistics",
    "calm",
    "picture",
    "geometry",
    "files",
    "net",
    "engine",
    "cluster",
    "dataset",
    "replay",
    "udacity",
    "recipe",
    "model_file",
    "training",
    "pilot",
    "evaluation",
    "simulator",
    "report",
    "exchange",
    "simulator_client",
    "donkeysim",
    "serve",
    "live",
    "coach",
    "main_job",
    "cli",
    "python",
    "lib",
    "main",
];

/// The rooms of the engine. A room may use those above it.
const ENGINE: [&str; 8] = ["random", "stopwatch", "loss", "tensor", "layers", "parameters", "network", "optimizer"];

/// Names at the root of the crate that are re-exports of a room.
const REEXPORTS: [(&str, &str); 2] = [("Error", "error"), ("Result", "error")];

fn source_files(folder: &Path, files: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            source_files(&path, files);
        } else if path.extension().is_some_and(|extension| extension == "rs") && !path.ends_with("tests.rs") {
            files.push(path);
        }
    }
}

/// The code of a file: without comments, and without the tests at its end. Tests may use any room.
fn code(text: &str) -> String {
    let lines = text.lines().take_while(|line| !line.starts_with("#[cfg(test)]"));
    lines.map(|line| line.split("//").next().unwrap_or_default()).collect::<Vec<_>>().join("\n")
}

/// The first names after each `prefix` in `code`: of `crate::a::X` and `crate::{a::X, b}` they are `a` and `b`.
fn names_after(code: &str, prefix: &str) -> Vec<String> {
    let mut names = Vec::new();
    for rest in code.split(prefix).skip(1) {
        match rest.strip_prefix('{') {
            None => names.push(first_name(rest)),
            Some(group) => {
                let mut depth = 0;
                let mut start = true;
                for (at, c) in group.char_indices() {
                    if depth == 0 && start && !c.is_whitespace() {
                        names.push(first_name(&group[at..]));
                        start = false;
                    }
                    match c {
                        '{' => depth += 1,
                        '}' if depth == 0 => break,
                        '}' => depth -= 1,
                        ',' if depth == 0 => start = true,
                        _ => {}
                    }
                }
            }
        }
    }
    names.retain(|name| !name.is_empty());
    names
}

fn first_name(text: &str) -> String {
    text.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect()
}

/// The arrows between the rooms of `folder` that go against `order`, and the rooms that `order` does not know.
fn wrong_arrows(folder: &str, prefix: &str, order: &[&str]) -> BTreeSet<String> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join(folder);
    let mut files = Vec::new();
    source_files(&folder, &mut files);
    let place = |room: &str| order.iter().position(|known| *known == room);
    let mut wrong = BTreeSet::new();
    let mut arrows = 0;
    for file in files {
        let inside = file.strip_prefix(&folder).unwrap();
        let room =
            inside.components().next().unwrap().as_os_str().to_str().unwrap().trim_end_matches(".rs").to_string();
        // The root of the crate and of a room declares the rooms; it is no room itself.
        if room == "mod" {
            continue;
        }
        let Some(from) = place(&room) else {
            wrong.insert(format!("`{room}` has no place in the order"));
            continue;
        };
        for name in names_after(&code(&fs::read_to_string(&file).unwrap()), prefix) {
            let used = REEXPORTS.iter().find(|(export, _)| *export == name).map_or(name.as_str(), |(_, room)| room);
            let complaint = match place(used) {
                _ if used == room => continue,
                Some(to) if to < from => {
                    arrows += 1;
                    continue;
                }
                Some(_) => format!("comes after `{room}`"),
                None => "has no place in the order".into(),
            };
            wrong.insert(format!("{} uses `{used}`, which {complaint}", inside.display()));
        }
    }
    assert!(arrows > 10, "the rooms must be found at all");
    wrong
}

#[test]
fn no_two_rooms_use_each_other() {
    let wrong = wrong_arrows("src", "crate::", &ROOMS);
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn no_two_rooms_of_the_engine_use_each_other() {
    let wrong = wrong_arrows("src/engine", "crate::engine::", &ENGINE);
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn names_are_found_in_every_form_of_a_path() {
    let code = "use crate::a::{b, c::D};\nuse crate::{e::F, g, h::{i, j}};\nlet x = crate::k::l();";
    assert_eq!(names_after(code, "crate::"), ["a", "e", "g", "h", "k"]);
}

/// Cargo runs only the tests and benches that its manifest names, and says nothing of the others.
#[test]
fn every_file_of_tests_and_benches_is_a_target() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let manifest = fs::read_to_string(root.join("Cargo.toml")).unwrap();
    for (folder, kind) in [("tests", "test"), ("benches", "bench")] {
        for entry in fs::read_dir(root.join(folder)).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_stem().unwrap().to_str().unwrap();
            if path.extension().is_some_and(|extension| extension == "rs") {
                let entry = format!("[[{kind}]]\nname = \"{name}\"\n");
                assert!(manifest.contains(&entry), "Cargo.toml has no [[{kind}]] for {}", path.display());
            }
        }
    }
}
