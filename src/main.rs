//! The `steersman` command.
#![forbid(unsafe_code)]

fn main() {}
