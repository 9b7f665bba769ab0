//! `steersman compare`: runs side by side.

use std::path::PathBuf;

use clap::Args;

use super::arguments::refuse_existing;
use crate::error::Result;
use crate::files::atomic_file;
use crate::report::pages::comparison;

/// Lay runs side by side on one page: curves, figures, recipes, drives
#[derive(Debug, Args)]
pub struct CompareArgs {
    /// Run folders. Drives below them, as `drive --out RUN/drives/NAME` writes them, are shown as maps
    #[arg(required = true, value_name = "RUN")]
    runs: Vec<PathBuf>,
    /// The page; must not exist
    #[arg(long, value_name = "FILE", default_value = "compare.html")]
    out: PathBuf,
}

pub fn run(args: CompareArgs) -> Result<()> {
    refuse_existing(&args.out)?;
    let page = comparison::page(&comparison::read(&args.runs)?)?;
    atomic_file::write(&args.out, page.as_bytes())?;
    println!("{}", args.out.display());
    Ok(())
}
