//! `steersman runs`: what was trained so far.

use std::path::PathBuf;

use clap::Args;

use super::arguments::refuse_existing;
use super::terminal::{print, print_json};
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
    let rows: Vec<Vec<String>> = lines.iter().map(run_list::RunLine::row).collect();
    print(&columns(&run_list::HEADERS, &rows))
}

/// A table whose columns are as wide as they need to be. The last cell of a row that is shorter than the others may be longer.
fn columns(headers: &[&str], rows: &[Vec<String>]) -> String {
    let width = |column: usize| {
        let whole = rows.iter().filter(|row| row.len() == headers.len());
        let cells = whole.map(|row| row[column].chars().count());
        cells.chain([headers[column].chars().count()]).max().unwrap_or(0)
    };
    let widths: Vec<usize> = (0..headers.len()).map(width).collect();
    let line = |cells: &[&str]| {
        let cells: Vec<String> = cells.iter().zip(&widths).map(|(cell, width)| format!("{cell:<width$}")).collect();
        cells.join("  ").trim_end().to_string() + "\n"
    };
    let rows = rows.iter().map(|row| line(&row.iter().map(String::as_str).collect::<Vec<_>>()));
    line(headers) + &rows.collect::<String>()
}
