//! `steersman tracks`: what there is to drive on.

use std::fmt::Write as _;
use std::fs;
use std::io::Cursor;
use std::path::{Path, PathBuf};

use clap::Args;
use image::{ImageFormat, RgbImage};
use serde::Serialize;

use super::arguments::RecordingArgs;
use super::terminal::{print, print_json};
use crate::dataset::{Recording, View};
use crate::error::{Error, Result};
use crate::files::new_folder::NewFolder;
use crate::picture::{self, decode::decode_rgb};
use crate::simulator::camera::contact_sheet::contact_sheet;
use crate::simulator::road::builtin;
use crate::simulator::{Track, side_by_side};

/// Centre pictures on a sheet: columns and rows.
const SHEET: (usize, usize) = (4, 7);
/// Places with all three cameras on a sheet.
const TRIPLES: usize = 8;
/// Pairs of a recorded and a drawn picture on a sheet: columns and rows.
const PAIRS: (usize, usize) = (2, 7);

/// List tracks, and draw sheets of pictures of them
#[derive(Debug, Args)]
pub struct TracksArgs {
    /// lake, mountain, coast, forest, random:SEED, or a track file; all built-in ones without
    #[arg(value_name = "TRACK")]
    tracks: Vec<String>,
    /// Draw sheets of pictures (PNG) into a folder that must not exist: TRACK.png around the lap, TRACK-cameras.png with
    /// left, centre and right
    #[arg(long, value_name = "DIR")]
    sheet: Option<PathBuf>,
    /// Draw TRACK-beside.png too: pictures of this recording, each with one of the track beside it
    #[arg(long, value_name = "RECORDING", requires = "sheet")]
    beside: Option<PathBuf>,
    #[command(flatten)]
    reading: RecordingArgs,
    /// Light and texture of the pictures; 0 is the track's own
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Print one JSON array as the last line, one object a track
    #[arg(long)]
    json: bool,
}

/// What is told of a track.
#[derive(Serialize)]
struct Row {
    track: String,
    /// Whether training must not see it.
    held_out: bool,
    length_m: f64,
    width_min_m: f64,
    width_max_m: f64,
    /// Smallest radius of the reference line.
    radius_min_m: f64,
    /// From the lowest to the highest point of the road.
    climb_m: f64,
    /// Steepest slope.
    slope_max_percent: f64,
}

impl Row {
    fn of(track: &Track) -> Row {
        let range = |f: &dyn Fn(&crate::simulator::Station) -> f64| {
            let values = track.stations.iter().map(f);
            values.fold((f64::MAX, f64::MIN), |(low, high), v| (low.min(v), high.max(v)))
        };
        let (width_min_m, width_max_m) = range(&|s| s.width_m);
        let (low, high) = range(&|s| s.z);
        Row {
            track: track.name().to_string(),
            held_out: track.held_out(),
            length_m: track.length_m,
            width_min_m,
            width_max_m,
            radius_min_m: 1.0 / range(&|s| s.curvature.abs()).1,
            climb_m: high - low,
            slope_max_percent: 100.0 * range(&|s| s.slope.abs()).1,
        }
    }
}

pub fn run(args: TracksArgs) -> Result<()> {
    let names: Vec<&str> = match &args.tracks[..] {
        [] => builtin::names().collect(),
        named => named.iter().map(String::as_str).collect(),
    };
    let tracks = names.into_iter().map(Track::load).collect::<Result<Vec<Track>>>()?;
    let rows: Vec<Row> = tracks.iter().map(Row::of).collect();
    if let Some(out) = &args.sheet {
        let folder = NewFolder::create(out)?;
        let beside = args.beside.as_deref().map(|path| args.reading.load(path)).transpose()?;
        let given = beside.map(|recording| pictures(&recording, PAIRS.0 * PAIRS.1)).transpose()?;
        for track in &tracks {
            draw(track, given.as_deref(), args.seed, folder.unfinished()).map_err(|error| folder.explain(error))?;
        }
        folder.finish()?;
    }
    if args.json {
        return print_json(&rows);
    }
    let mut text = format!(
        "{:<16} {:>8}  {:>9}  {:>8}  {:>7}  {:>9}\n",
        "track", "lap m", "width m", "radius m", "climb m", "slope %"
    );
    for row in &rows {
        let width = format!("{:.1}-{:.1}", row.width_min_m, row.width_max_m);
        let note = if row.held_out { "  held out: training must not see it" } else { "" };
        let Row { track, length_m, radius_min_m, climb_m, slope_max_percent, .. } = row;
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "{track:<16} {length_m:>8.0}  {width:>9}  {radius_min_m:>8.1}  {climb_m:>7.1}  {slope_max_percent:>9.1}{note}"
        );
    }
    if args.tracks.is_empty() {
        text += "also random:SEED, held out from seed 1000000 up, and track files ending in .toml\n";
    }
    print(&text)?;
    if let Some(out) = &args.sheet {
        print(&format!("pictures in {}\n", out.display()))?;
    }
    Ok(())
}

/// Draws the sheets of a track into `folder`.
fn draw(track: &Track, given: Option<&[RgbImage]>, seed: u64, folder: &Path) -> Result<()> {
    let name = track.name().replace([':', '/'], "-");
    save(&contact_sheet(track, SHEET.0, SHEET.1, false, seed), &folder.join(format!("{name}.png")))?;
    save(&contact_sheet(track, 1, TRIPLES, true, seed), &folder.join(format!("{name}-cameras.png")))?;
    if let Some(given) = given {
        save(&side_by_side(track, PAIRS.0, given, seed), &folder.join(format!("{name}-beside.png")))?;
    }
    Ok(())
}

fn save(sheet: &RgbImage, path: &Path) -> Result<()> {
    let mut bytes = Cursor::new(Vec::new());
    sheet.write_to(&mut bytes, ImageFormat::Png).map_err(|e| Error::data(path, format!("cannot be drawn: {e}")))?;
    fs::write(path, bytes.into_inner()).map_err(Error::io(path))
}

/// Up to `most` pictures of the centre camera, at even distances through `recording`.
fn pictures(recording: &Recording, most: usize) -> Result<Vec<RgbImage>> {
    let rows: Vec<usize> =
        (0..recording.rows.len()).filter(|&row| recording.image_path(row, View::Centre).is_some()).collect();
    if rows.is_empty() {
        let message = "no row has a picture of the centre camera; name another recording";
        return Err(Error::data(&recording.path, message));
    }
    let n = most.min(rows.len());
    let (mut bytes, mut decoded) = (Vec::new(), picture::RgbImage::default());
    (0..n)
        .map(|k| {
            let row = rows[k * rows.len() / n];
            let path = recording.image_path(row, View::Centre).unwrap_or_default();
            recording.read_picture(row, View::Centre, &mut bytes)?;
            decode_rgb(&bytes, &mut decoded).map_err(|e| Error::data(&path, e))?;
            let (width, height) = (decoded.width as u32, decoded.height as u32);
            RgbImage::from_raw(width, height, decoded.pixels.clone()).ok_or_else(|| Error::data(&path, "has no pixels"))
        })
        .collect()
}
