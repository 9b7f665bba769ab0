//! Tests that would notice: lines of the source are spoilt one by one, and the test that is named beside each must fail.
//!
//! `tests/mutants/` lists them by room. Of an entry, `right` is the first such text behind `after` in `file`, an expression or a
//! statement; `spoilt` stands in its place when the mutant runs; `test` is the target (`lib` or `kernels` for the tests within a
//! crate) and the name of the test that catches it. To add one, write an entry.
//!
//! ```text
//! cargo test --release --test mutants -- --ignored --nocapture
//! ```
//!
//! copies the source, puts `if mutant::on(NUMBER) { spoilt } else { right }` in all these places at once, builds the copy once, and
//! runs each test with its mutant switched on by an environment variable. The source itself has no trace of them. It ends with a
//! table; 97 of 100 must be caught. The build takes as long as that of the tests, each mutant some seconds.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Mutex;
use std::time::{Duration, Instant};

use serde::Deserialize;

/// Switches the mutant of this number on.
const VARIABLE: &str = "STEERSMAN_MUTANT";
/// A test that takes longer than this hangs: the mutant is caught.
const MAX_TIME: Duration = Duration::from_secs(300);
/// Mutants of 100 that must be caught.
const MIN_CAUGHT: usize = 97;
/// Folders and files of the source that are built.
const SOURCE: [&str; 8] = ["Cargo.toml", "Cargo.lock", "build.rs", "src", "kernels", "data", "tests", "benches"];

/// One spoilt line.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Mutant {
    file: String,
    after: String,
    right: String,
    spoilt: String,
    test: String,
    /// Room that it belongs to: the name of its list.
    #[serde(skip)]
    room: String,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct List {
    mutant: Vec<Mutant>,
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// All mutants; their numbers count from 1.
fn mutants() -> Vec<Mutant> {
    let mut files: Vec<PathBuf> =
        fs::read_dir(root().join("tests/mutants")).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    let mut all = Vec::new();
    for file in files {
        let list: List =
            toml::from_str(&fs::read_to_string(&file).unwrap()).unwrap_or_else(|e| panic!("{file:?}: {e}"));
        let room = file.file_stem().unwrap().to_str().unwrap().to_string();
        all.extend(list.mutant.into_iter().map(|mutant| Mutant { room: room.clone(), ..mutant }));
    }
    all
}

/// Where `right` stands in `text`.
fn place(mutant: &Mutant, text: &str) -> Option<(usize, usize)> {
    let after = text.find(&mutant.after)?;
    let begin = after + text[after..].find(&mutant.right)?;
    Some((begin, begin + mutant.right.len()))
}

/// A mutant in a text: begin, end, number, what stands there when it is on.
type Placed<'a> = (usize, usize, usize, &'a str);

/// `text` from `from` to `to` with all `placed` in it; where one lies within another, both are there.
fn spoilt(text: &str, from: usize, to: usize, placed: &[Placed], call: &str) -> String {
    let (mut result, mut at) = (String::new(), from);
    let mut rest = placed.to_vec();
    // The outer ones first.
    rest.sort_by_key(|(begin, end, number, _)| (*begin, std::cmp::Reverse(*end), *number));
    while let Some((begin, end, number, instead)) = rest.first().copied() {
        let (inside, outside): (Vec<Placed>, Vec<Placed>) =
            rest[1..].iter().partition(|(other_begin, other_end, ..)| begin <= *other_begin && *other_end <= end);
        let right = spoilt(text, begin, end, &inside, call);
        result += &format!("{}(if {call}({number}) {{ {instead} }} else {{ {right} }})", &text[at..begin]);
        at = end;
        rest = outside;
    }
    result + &text[at..to]
}

fn copy(from: &Path, to: &Path) {
    if from.is_dir() {
        fs::create_dir_all(to).unwrap();
        for entry in fs::read_dir(from).unwrap() {
            let name = entry.unwrap().file_name();
            if name != "recordings" && name != "target" {
                copy(&from.join(&name), &to.join(&name));
            }
        }
    } else {
        fs::copy(from, to).unwrap();
    }
}

/// The copy of the source with all mutants in it.
fn write_copy(mutants: &[Mutant], to: &Path) {
    let _ = fs::remove_dir_all(to);
    fs::create_dir_all(to).unwrap();
    SOURCE.iter().for_each(|name| copy(&root().join(name), &to.join(name)));
    let mut by_file: BTreeMap<&str, Vec<Placed>> = BTreeMap::new();
    for (i, mutant) in mutants.iter().enumerate() {
        let text = fs::read_to_string(root().join(&mutant.file)).unwrap();
        let (begin, end) = place(mutant, &text).unwrap_or_else(|| panic!("{mutant:?} is not in the source"));
        by_file.entry(&mutant.file).or_default().push((begin, end, i + 1, &mutant.spoilt));
    }
    for (file, placed) in by_file {
        let text = fs::read_to_string(root().join(file)).unwrap();
        let call = if file.starts_with("kernels/") { "crate::mutant::on" } else { "steersman_kernels::mutant::on" };
        fs::write(to.join(file), spoilt(&text, 0, text.len(), &placed, call)).unwrap();
    }
    let kernels = to.join("kernels/src/lib.rs");
    let switch = format!(
        "\n/// Spoilt lines.\npub mod mutant {{\n    static ON: std::sync::OnceLock<u32> = std::sync::OnceLock::new();\n\n    \
         /// Whether this one runs.\n    pub fn on(number: u32) -> bool {{\n        *ON.get_or_init(|| std::env::var({VARIABLE:?})\
         .ok().and_then(|text| text.parse().ok()).unwrap_or(0)) == number\n    }}\n}}\n"
    );
    fs::write(&kernels, fs::read_to_string(&kernels).unwrap() + &switch).unwrap();
}

/// Builds the tests of `targets` in the copy; their programs.
fn build(source: &Path, targets: &BTreeSet<&str>) -> BTreeMap<String, PathBuf> {
    let mut command = Command::new(std::env::var_os("CARGO").unwrap_or("cargo".into()));
    command.current_dir(source).args([
        "test",
        "--release",
        "--workspace",
        "--no-run",
        "--message-format=json",
        "--lib",
    ]);
    for target in targets.iter().filter(|target| !matches!(**target, "lib" | "kernels")) {
        command.args(["--test", target]);
    }
    // A folder of its own: the programs of the true source stay where they are.
    let folder = source.parent().unwrap().join("mutants-target");
    let output = command.env("CARGO_TARGET_DIR", folder).stderr(Stdio::inherit()).output().unwrap();
    assert!(output.status.success(), "the copy does not compile");
    let mut programs = BTreeMap::new();
    for line in String::from_utf8_lossy(&output.stdout).lines() {
        let Ok(message) = serde_json::from_str::<serde_json::Value>(line) else { continue };
        let (Some(program), Some(name)) = (message["executable"].as_str(), message["target"]["name"].as_str()) else {
            continue;
        };
        let name = match name {
            "steersman" if message["target"]["kind"][0] == "lib" => "lib",
            "steersman_kernels" | "steersman-kernels" => "kernels",
            name => name,
        };
        programs.insert(name.to_string(), PathBuf::from(program));
    }
    programs
}

/// Whether the test passes with mutant `number` on; 0 is none.
fn passes(source: &Path, program: &Path, test: &str, number: usize) -> bool {
    let folder =
        if program.to_string_lossy().contains("steersman_kernels") { source.join("kernels") } else { source.into() };
    let mut command = Command::new(program);
    command.current_dir(folder).args([test, "--exact"]).env(VARIABLE, number.to_string());
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let began = Instant::now();
    loop {
        match child.try_wait().unwrap() {
            Some(status) => return status.success(),
            None if began.elapsed() > MAX_TIME => {
                child.kill().unwrap();
                child.wait().unwrap();
                return false;
            }
            None => std::thread::sleep(Duration::from_millis(20)),
        }
    }
}

#[test]
#[ignore = "builds all tests anew and takes some minutes"]
fn spoilt_lines_are_caught_by_the_tests_named_beside_them() {
    let mutants = mutants();
    let source = Path::new(env!("CARGO_TARGET_TMPDIR")).join("mutants");
    write_copy(&mutants, &source);
    let split = |mutant: &Mutant| -> (String, String) {
        let (target, name) = mutant.test.split_once(' ').unwrap_or_else(|| panic!("{mutant:?}"));
        (target.into(), name.into())
    };
    let tests: Vec<(String, String)> = mutants.iter().map(split).collect();
    let programs = build(&source, &tests.iter().map(|(target, _)| target.as_str()).collect());
    let program = |target: &str| programs.get(target).unwrap_or_else(|| panic!("no program of {target}: {programs:?}"));
    // Without a mutant every test passes.
    for (target, name) in tests.iter().collect::<BTreeSet<_>>() {
        assert!(passes(&source, program(target), name, 0), "{target} {name} fails without a mutant");
    }
    let next = Mutex::new(0..mutants.len());
    let survivors = Mutex::new(BTreeSet::new());
    std::thread::scope(|scope| {
        for _ in 0..std::thread::available_parallelism().map_or(1, |cores| cores.get().div_ceil(2)) {
            scope.spawn(|| {
                while let Some(i) = { next.lock().unwrap().next() } {
                    let (target, name) = &tests[i];
                    let survives = passes(&source, program(target), name, i + 1);
                    let Mutant { room, file, right, spoilt, .. } = &mutants[i];
                    let verdict = if survives { "SURVIVED" } else { "caught" };
                    println!(
                        "{:>3} {verdict:<8} {room:<10} {file}: `{right}` becomes `{spoilt}`; {target} {name}",
                        i + 1
                    );
                    if survives {
                        survivors.lock().unwrap().insert(i);
                    }
                }
            });
        }
    });
    let survivors = survivors.into_inner().unwrap();
    let rooms: BTreeSet<&str> = mutants.iter().map(|mutant| mutant.room.as_str()).collect();
    for room in rooms {
        let of: Vec<usize> = (0..mutants.len()).filter(|&i| mutants[i].room == room).collect();
        println!("{room:<10} {} of {} caught", of.iter().filter(|i| !survivors.contains(i)).count(), of.len());
    }
    let caught = mutants.len() - survivors.len();
    println!("all        {caught} of {} caught", mutants.len());
    assert!(caught * 100 >= MIN_CAUGHT * mutants.len(), "survivors: {survivors:?}");
}

#[test]
fn every_spoilt_line_is_in_the_source_and_every_test_exists() {
    let mutants = mutants();
    assert!(mutants.len() >= 100, "{} spoilt lines", mutants.len());
    let mut tests = String::new();
    let mut folders: Vec<PathBuf> = ["src", "tests", "kernels"].map(|folder| root().join(folder)).to_vec();
    while let Some(folder) = folders.pop() {
        for path in fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()) {
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                tests += &fs::read_to_string(path).unwrap();
            }
        }
    }
    for mutant in &mutants {
        let text = fs::read_to_string(root().join(&mutant.file)).unwrap_or_else(|e| panic!("{mutant:?}: {e}"));
        assert!(place(mutant, &text).is_some(), "mend the list, this is not in the source any more: {mutant:?}");
        assert_ne!(mutant.right, mutant.spoilt, "{mutant:?}");
        let name = mutant.test.rsplit([':', ' ']).next().unwrap();
        assert!(tests.contains(&format!("fn {name}()")), "there is no test `{name}`: {mutant:?}");
    }
}

#[test]
fn mutants_within_mutants_are_all_there() {
    let text = "let a = f(x + 1) * 2;";
    let placed: Vec<Placed> = vec![(8, 20, 1, "0"), (10, 15, 2, "x"), (10, 15, 3, "1")];
    let expected =
        "let a = (if on(1) { 0 } else { f((if on(2) { x } else { (if on(3) { 1 } else { x + 1 }) })) * 2 });";
    assert_eq!(spoilt(text, 0, text.len(), &placed, "on"), expected);
}
