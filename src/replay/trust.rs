//! How far the warp of a recording's views can be trusted, by its own side cameras.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::log::{Frames, ReplayLog};
use super::side_cameras::{difference_on, rows_with_all_cameras, shared_ground};
use crate::dataset::View;
use crate::error::Result;
use crate::geometry::{Offset, PixelGrid, ViewWarp};

/// Rows that are looked at, spread over the recording.
const ROWS: usize = 200;

/// How well the side cameras' pictures are predicted from the centre camera's.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WarpCheck {
    /// Rows with all three pictures that were looked at.
    pub rows: usize,
    /// Mean difference in grey levels between the predicted and the real side pictures, over the ground that both show.
    pub warped: f64,
    /// The same difference for the centre picture as it is.
    pub unwarped: f64,
    /// Rows, from 0, where the warp halves no difference: bridges, walls, hills. Their number, and the first few.
    pub doubtful: usize,
    /// See `doubtful`.
    pub doubtful_rows: Vec<usize>,
}

impl WarpCheck {
    /// `warped` ÷ `unwarped`: below 0.5 the warp can be trusted.
    pub fn ratio(&self) -> f64 {
        self.warped / self.unwarped.max(1e-9)
    }
}

/// Predicts the left and the right picture of up to 200 rows from the centre one. `None` without side cameras.
///
/// # Errors
///
/// Pictures that cannot be read.
pub fn side_camera_check(log: &ReplayLog) -> Result<Option<WarpCheck>> {
    let looked_at = rows_with_all_cameras(log, ROWS);
    if looked_at.is_empty() {
        return Ok(None);
    }
    let found: Vec<[f64; 2]> = looked_at
        .par_iter()
        .map_init(Frames::default, |frames, &row| errors(log, frames, row))
        .collect::<Result<_>>()?;
    let mean = |side: usize| found.iter().map(|pair| pair[side]).sum::<f64>() / found.len() as f64;
    let doubtful: Vec<usize> =
        looked_at.iter().zip(&found).filter(|(_, pair)| pair[0] > 0.5 * pair[1]).map(|(&row, _)| row).collect();
    Ok(Some(WarpCheck {
        rows: found.len(),
        warped: mean(0),
        unwarped: mean(1),
        doubtful: doubtful.len(),
        doubtful_rows: doubtful.into_iter().take(20).collect(),
    }))
}

/// Mean difference in grey levels of both side pictures from the warped and from the unwarped centre picture.
fn errors<'a>(log: &ReplayLog<'a>, frames: &mut Frames<'a>, row: usize) -> Result<[f64; 2]> {
    let centre = frames.get(log.recording, row, View::Centre)?.clone();
    let size = [centre.height, centre.width];
    let grid = PixelGrid::whole(&log.geometry, size);
    let mut predicted = vec![0; centre.pixels.len()];
    let (mut sums, mut n) = ([0, 0], 0);
    for (camera, wanted_m) in [View::Left, View::Right].into_iter().zip(log.geometry.side_offsets_m) {
        let real = frames.get(log.recording, row, camera)?;
        if [real.height, real.width] != size {
            continue;
        }
        let warp = ViewWarp::between(&log.geometry, grid, 0.0, Offset::default(), wanted_m);
        warp.apply(&centre.pixels, &mut predicted);
        let ground = shared_ground(&warp, size);
        for (sum, guess) in sums.iter_mut().zip([&predicted, &centre.pixels]) {
            *sum += difference_on(&ground, &real.pixels, guess);
        }
        n += 3 * ground.iter().filter(|ground| **ground).count();
    }
    Ok(sums.map(|sum| sum as f64 / n.max(1) as f64))
}
