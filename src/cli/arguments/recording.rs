//! What is said on the command line about recordings; every command that reads some takes these.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clap::Args;

use crate::dataset::{self, Column, ColumnRef, Description, Labels, Recording, Unit, parse_columns};
use crate::error::Result;

/// How recordings are read; the same can stand in steersman.toml beside a log, and goes behind what stands here
#[derive(Clone, Debug, Default, Args)]
#[command(next_help_heading = "Recordings")]
pub(crate) struct RecordingArgs {
    /// Which column holds what, by number from 1 or by name, as in steering=4,center=image
    #[arg(long, value_name = "COLUMN=WHICH,...", value_parser = parse_columns)]
    columns: Option<BTreeMap<Column, ColumnRef>>,
    /// Unit of the labels: lock (shares of full lock), degrees, radians (front wheels), servo (90 is straight), wheel-degrees or
    /// wheel-radians (steering wheel)
    #[arg(long, value_name = "UNIT")]
    unit: Option<Unit>,
    /// The angle in that unit, in degrees, that is full lock [default: 25; servo 45; steering wheel 400]
    #[arg(long, value_name = "DEG")]
    full_lock: Option<f64>,
    /// Rows a second, where a recording has no times
    #[arg(long, value_name = "HZ")]
    hz: Option<f64>,
    /// Of a tub, whose commands are the labels: user or pilot [default: user]
    #[arg(long, value_name = "WHO")]
    labels: Option<Labels>,
    /// Take all recordings below a folder
    #[arg(long)]
    recursive: bool,
}

impl RecordingArgs {
    /// Whether anything was said.
    pub fn is_given(&self) -> bool {
        self.recursive || !self.said().is_empty()
    }

    /// What was said.
    pub fn said(&self) -> Description {
        Description {
            columns: self.columns.clone().unwrap_or_default(),
            unit: self.unit,
            full_lock_deg: self.full_lock,
            hz: self.hz,
            labels: self.labels,
            exclude: Vec::new(),
            camera: None,
        }
    }

    /// The recordings at `paths`, or with `--recursive` all below them.
    pub fn expand(&self, paths: Vec<PathBuf>) -> Result<Vec<PathBuf>> {
        if !self.recursive {
            return Ok(paths);
        }
        let mut all = Vec::new();
        for path in paths {
            let found = dataset::recordings_below(&path)?;
            if found.len() > 1 {
                eprintln!("{}: {} recordings", path.display(), found.len());
            }
            all.extend(found);
        }
        Ok(all)
    }

    /// As [`expand`](Self::expand), where pictures may stand among the recordings.
    pub fn expand_recordings(&self, paths: &[PathBuf]) -> Result<Vec<PathBuf>> {
        let each = paths
            .iter()
            .map(|path| if path.is_dir() { self.expand(vec![path.clone()]) } else { Ok(vec![path.clone()]) });
        Ok(each.collect::<Result<Vec<_>>>()?.concat())
    }

    /// Reads the recording at `path` as was said; its labels are what they seem to be.
    pub fn load(&self, path: &Path) -> Result<Recording> {
        let recording = dataset::load_with(path, &self.said(), dataset::ImageCheck::Verify)?;
        recording.require_unit()?;
        Ok(recording)
    }
}
