//! How far the warp of a recording's views can be trusted, by its own side cameras.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::log::{Frames, ReplayLog};
use crate::dataset::View;
use crate::error::Result;
use crate::geometry::{Offset, PixelGrid, ViewWarp};

/// Rows that are looked at, spread over the recording.
const ROWS: usize = 200;
/// Below this share of the picture's height lies the bonnet, which moves with the camera.
pub(super) const MAX_ROW_SHARE: f64 = 135.0 / 160.0;

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

/// Up to `count` rows with the pictures of three cameras at different places, spread over the recording.
pub(super) fn rows_with_all_cameras(log: &ReplayLog, count: usize) -> Vec<usize> {
    let rows: Vec<usize> = (log.sessions.iter().flat_map(|session| session.rows.clone()))
        .filter(|&row| View::ALL.iter().all(|&camera| log.recording.row_has(row, camera)))
        .filter(|_| log.geometry.side_offsets_m != [0.0, 0.0])
        .collect();
    let step = rows.len().div_ceil(count).max(1);
    rows.into_iter().step_by(step).collect()
}

/// Mean difference in grey levels of both side pictures from the warped and from the unwarped centre picture.
fn errors<'a>(log: &ReplayLog<'a>, frames: &mut Frames<'a>, row: usize) -> Result<[f64; 2]> {
    let centre = frames.get(log.recording, row, View::Centre)?.clone();
    let grid = PixelGrid::whole(&log.geometry, [centre.height, centre.width]);
    let mut predicted = vec![0; centre.pixels.len()];
    let (mut sums, mut n) = ([0u64; 2], 0u64);
    for (camera, wanted_m) in [View::Left, View::Right].into_iter().zip(log.geometry.side_offsets_m) {
        let warp = ViewWarp::between(&log.geometry, grid, 0.0, Offset::default(), wanted_m);
        warp.apply(&centre.pixels, &mut predicted);
        let real = frames.get(log.recording, row, camera)?;
        if [real.height, real.width] != [centre.height, centre.width] {
            continue;
        }
        for y in 0..centre.height {
            for x in 0..centre.width {
                // The ground that both show, without the bonnet.
                let bonnet = y as f64 > MAX_ROW_SHARE * centre.height as f64;
                if bonnet || !warp.sees_ground(x as f64 + 0.5, y as f64 + 0.5) {
                    continue;
                }
                let at = (y * centre.width + x) * 3;
                let [real, predicted, centre] =
                    [&real.pixels, &predicted, &centre.pixels].map(|pixels| &pixels[at..at + 3]);
                for ((real, predicted), centre) in real.iter().zip(predicted).zip(centre) {
                    sums[0] += u64::from(real.abs_diff(*predicted));
                    sums[1] += u64::from(real.abs_diff(*centre));
                }
                n += 3;
            }
        }
    }
    Ok(sums.map(|sum| sum as f64 / n.max(1) as f64))
}
