//! What a command shows: results on standard output, everything else on standard error; on a terminal fitted to its width, with bars of
//! progress.

/// As that of the standard library, but foreign text reaches no terminal raw (see [`crate::text`]), and whoever reads may stop
/// before the end, as `head` does. All commands print through this macro, [`eprintln`], [`print`] and [`print_json`].
macro_rules! println {
    () => { $crate::cli::terminal::print_line(std::io::stdout(), "") };
    ($($arg:tt)+) => { $crate::cli::terminal::print_line(std::io::stdout(), &format!($($arg)+)) };
}

/// As [`println`], to standard error.
macro_rules! eprintln {
    ($($arg:tt)+) => { $crate::cli::terminal::print_line(std::io::stderr(), &format!($($arg)+)) };
}

mod fitted;
mod progress;
mod share_bar;
mod table;
mod words;

use std::io::{self, IsTerminal, Write};

use serde::Serialize;

pub(super) use progress::{JobDisplay, beside_steering};
pub(super) use share_bar::ShareBar;
pub(super) use table::{left_aligned, right_aligned};
pub(super) use words::{counted, duration, or_dash};

use crate::error::{Error, Result};
use crate::text::{escaped_json, escaped_lines};
use fitted::{Columns, fitted};

/// Prints a line to `out`, as [`println`] does.
pub(super) fn print_line(mut out: impl Write + IsTerminal + Columns, text: &str) {
    let text = fitted(&escaped_lines(text), &out);
    // A stream that is closed takes no complaint either.
    let _ = writeln!(out, "{text}");
}

/// Prints `text`. Whoever reads may stop before the end, as `head` does.
pub(super) fn print(text: &str) -> Result<()> {
    let stdout = std::io::stdout();
    let text = fitted(&escaped_lines(text), &stdout);
    match stdout.lock().write_all(text.as_bytes()) {
        Err(e) if e.kind() != io::ErrorKind::BrokenPipe => Err(Error::io("standard output")(e)),
        _ => Ok(()),
    }
}

/// Prints one JSON value as the last line.
pub(super) fn print_json(value: &impl Serialize) -> Result<()> {
    let text = serde_json::to_string(value).map_err(|e| Error::Fault(format!("cannot be written as JSON: {e}")))?;
    match std::io::stdout().lock().write_all((escaped_json(&text) + "\n").as_bytes()) {
        Err(e) if e.kind() != io::ErrorKind::BrokenPipe => Err(Error::io("standard output")(e)),
        _ => Ok(()),
    }
}
