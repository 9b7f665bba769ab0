//! `steersman runs`: what was trained so far.

use std::path::PathBuf;

use clap::Args;

use super::arguments::refuse_existing;
use super::terminal::{left_aligned, print, print_json};
use crate::error::Result;
use crate::files::atomic_file;
use crate::report::pages::run_list;

/// List the runs in a folder: recipe, data, validation error, autonomy
#[derive(Debug, Args)]
pub struct RunsArgs {
    /// Folders that hold runs, at any depth
    #[arg(value_name = "FOLDER", default_value = "runs")]
    folders: Vec<PathBuf>,
    /// Write the list as a page; must not exist
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Print one JSON array as the last line, one object a run
    #[arg(long)]
    json: bool,
}

pub fn run(args: RunsArgs) -> Result<()> {
    args.out.as_deref().map_or(Ok(()), refuse_existing)?;
    let lines = run_list::read(&args.folders)?;
    if let Some(out) = &args.out {
        atomic_file::write(out, run_list::page(&lines).as_bytes())?;
        eprintln!("wrote {}", out.display());
    }
    if args.json {
        return print_json(&lines);
    }
    if lines.is_empty() {
        let places: Vec<String> = args.folders.iter().map(|folder| folder.display().to_string()).collect();
        return print(&format!("no run in {}; `steersman train` begins one\n", places.join(", ")));
    }
    let headers = run_list::HEADERS.map(String::from).to_vec();
    let rows: Vec<Vec<String>> = std::iter::once(headers).chain(lines.iter().map(run_list::RunLine::row)).collect();
    print(&left_aligned(&rows))
}
