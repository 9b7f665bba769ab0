//! The `steersman` command.
#![forbid(unsafe_code)]

use std::process::ExitCode;

fn main() -> ExitCode {
    steersman::cli::main()
}
