//! `steersman inspect`: what is in a recording.

use std::path::PathBuf;

use clap::Args;

use super::{print, print_json};
use crate::dataset::inspect::report;
use crate::error::Result;

/// Say what is in a recording: rows, sessions, labels, and what cannot be used
#[derive(Debug, Args)]
pub struct InspectArgs {
    /// Udacity logs (a folder or a CSV file) or donkeycar tubs
    #[arg(required = true, value_name = "RECORDING")]
    recordings: Vec<PathBuf>,
    /// Print one JSON array as the last line, one object a recording
    #[arg(long)]
    json: bool,
}

pub fn run(args: InspectArgs) -> Result<()> {
    let mut reports = Vec::new();
    for path in &args.recordings {
        let report = report(path)?;
        if !args.json {
            print(&format!("{report}\n"))?;
        }
        reports.push(report);
    }
    if args.json { print_json(&reports) } else { Ok(()) }
}
