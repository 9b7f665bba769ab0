//! `steersman explain`: what a model looks at.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;

use super::arguments::{RecordingArgs, load_pilot, new_folder, refuse_existing};
use super::process::{pool, stop_on_ctrl_c};
use super::terminal::{ShareBar, print, print_json};
use crate::error::{Error, Result};
use crate::files::atomic_file;
use crate::report::explain::counterfactual::{Counterfactuals, examine};
use crate::report::explain::exhibits::{Exhibit, exhibits};
use crate::report::explain::findings::Finding;
use crate::report::explain::footage::Footage;
use crate::report::pages::explanation;
use crate::report::tone::Tone;

/// Show what a model looks at: saliency, filters, feature maps, and what happens when the picture is changed
#[derive(Debug, Args)]
pub struct ExplainArgs {
    /// Model file
    model: PathBuf,
    /// Images, or recordings: folders, logs, or .zip and .tar.gz archives of them
    #[arg(value_name = "IMAGE|RECORDING", required_unless_present = "track", conflicts_with = "track")]
    inputs: Vec<PathBuf>,
    #[command(flatten)]
    reading: RecordingArgs,
    /// Look at what the simulator's expert sees on a lap: lake, mountain, coast, forest, random:SEED, or a track file
    #[arg(long)]
    track: Option<String>,
    /// Draws start and light of that lap
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Folder for explain.html and the PNG files; must not exist
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Threads; 0 is one for each core
    #[arg(long, default_value_t = 0)]
    threads: usize,
    /// Print one JSON object as the last line
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Answer<'a> {
    #[serde(flatten)]
    found: &'a Counterfactuals,
    page: PathBuf,
    pictures_written: Vec<PathBuf>,
}

pub fn run(args: ExplainArgs) -> Result<()> {
    let pilot = load_pilot(&args.model)?;
    refuse_existing(&args.out)?;
    let footage = match &args.track {
        Some(track) => Footage::of_track(track, args.seed)?,
        None => Footage::of_paths(&args.reading.expand_recordings(&args.inputs)?, &args.reading.said())?,
    };
    let stop = stop_on_ctrl_c()?;
    let mut bar = ShareBar::new("changing pictures", &stop);
    let (found, steering) = pool(args.threads)?.install(|| examine(&pilot, &footage, &mut bar))?;
    drop(bar);
    let exhibits = exhibits(&pilot, &footage, &steering)?;
    let title = format!("{} on {}", args.model.display(), what(&args));
    let page = explanation::page(&title, &pilot, &found, &exhibits);

    new_folder(&args.out)?;
    let mut written = Vec::new();
    let pictures = exhibits.saliency.iter().chain(&exhibits.filters).chain(&exhibits.features).chain(&exhibits.changes);
    for Exhibit { name, picture, .. } in pictures {
        let path = args.out.join(format!("{name}.png"));
        std::fs::write(&path, picture.to_png()).map_err(Error::io(&path))?;
        written.push(path);
    }
    let path = args.out.join("explain.html");
    atomic_file::write(&path, page.as_bytes())?;
    if args.json {
        return print_json(&Answer { found: &found, page: path, pictures_written: written });
    }
    print(&text(&found))?;
    eprintln!("wrote {} and {} pictures", path.display(), written.len());
    Ok(())
}

fn what(args: &ExplainArgs) -> String {
    match (&args.track, &args.inputs[..]) {
        (Some(track), _) => track.clone(),
        (None, [only]) => only.display().to_string(),
        (None, inputs) => format!("{} inputs", inputs.len()),
    }
}

/// The table for the terminal, and the verdict.
fn text(found: &Counterfactuals) -> String {
    let (_, rows) = explanation::table(found);
    let mut text = format!("{} pictures; angles of the front wheels\n\n", found.pictures);
    text += "change                               moves by     error\n";
    for row in rows {
        let [change, moved, _, _, _, error, passed, verdict] = &row[..] else { continue };
        text += format!("{change:<34} {moved:>10} {error:>9}  {passed}").trim_end();
        text.push('\n');
        // What is as it should be needs no words; the page has them.
        if passed == "bad" {
            text += &format!("  {verdict}\n");
        }
    }
    text.push('\n');
    for Finding { tone, text: sentence } in &found.findings {
        let mark = match tone {
            Tone::Good => "good: ",
            Tone::Neutral => "note: ",
            Tone::Warning => "warning: ",
        };
        text += &format!("{mark}{sentence}\n");
    }
    text
}
