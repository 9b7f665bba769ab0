//! `steersman inspect`: what is in a recording.

use std::path::PathBuf;

use clap::Args;

use super::share_bar::ShareBar;
use super::{RecipeArgs, new_folder, pool, print, print_json, refuse_existing, stop_on_ctrl_c};
use crate::dataset::inspect::inspect;
use crate::error::Result;
use crate::files::atomic_file;
use crate::report::pages::inspection;

/// Say what is in a recording: rows, sessions, labels, pictures, what cannot be used, and what to do about it
#[derive(Debug, Args)]
pub struct InspectArgs {
    /// Udacity logs (a folder or a CSV file) or donkeycar tubs
    #[arg(required = true, value_name = "RECORDING")]
    recordings: Vec<PathBuf>,
    /// Write a page with pictures, report.html, into this folder, which must not exist
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    recipe: RecipeArgs,
    /// Seed of the split that the page shows
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Threads; 0 is one for each core
    #[arg(long, default_value_t = 0)]
    threads: usize,
    /// Print one JSON array as the last line, one object a recording
    #[arg(long)]
    json: bool,
}

pub fn run(args: InspectArgs) -> Result<()> {
    let recipe = args.recipe.find()?;
    args.out.as_deref().map_or(Ok(()), refuse_existing)?;
    let (pool, stop) = (pool(args.threads)?, stop_on_ctrl_c()?);
    let mut inspections = Vec::new();
    for path in &args.recordings {
        let mut bar = ShareBar::new(format!("looking at {}", path.display()), &stop);
        let inspection = pool.install(|| inspect(path, &mut bar))?;
        drop(bar);
        if !args.json {
            print(&format!("{}\n", inspection.report))?;
        }
        inspections.push(inspection);
    }
    let reports: Vec<_> = inspections.iter().map(|inspection| inspection.report.clone()).collect();
    if let Some(out) = &args.out {
        let page = inspection::page(inspections, &recipe, args.seed);
        new_folder(out)?;
        let path = out.join("report.html");
        atomic_file::write(&path, page.as_bytes())?;
        eprintln!("wrote {}", path.display());
    }
    if args.json { print_json(&reports) } else { Ok(()) }
}
