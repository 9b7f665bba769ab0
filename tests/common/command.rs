//! The binary as a black box.

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;

/// The program, to be run in `folder`.
pub fn steersman(folder: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_steersman"));
    command.current_dir(folder);
    command
}

/// Runs the program; it must succeed. The last line of its output, as JSON.
pub fn json(folder: &Path, args: &[&str]) -> Value {
    let output = run(folder, args);
    let text = String::from_utf8(output.stdout).unwrap();
    serde_json::from_str(text.lines().last().unwrap_or_default()).unwrap_or_else(|e| panic!("{args:?}: {e} in {text}"))
}

/// Runs the program; it must succeed.
pub fn run(folder: &Path, args: &[&str]) -> Output {
    let output = steersman(folder).args(args).output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{args:?} failed: {error}");
    output
}

/// Runs the program; it must fail with code 1. Its message.
pub fn error(folder: &Path, args: &[&str]) -> String {
    let output = steersman(folder).args(args).output().unwrap();
    let error = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{args:?}: {error}");
    assert!(!error.contains("panicked"), "{args:?}: {error}");
    error
}
