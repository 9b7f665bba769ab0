//! The mount of a recording's cameras, fitted to its side cameras.
//!
//! From the centre camera to a side camera the ground moves sideways by the offset over the height for every row below the horizon. So
//! the pictures tell where the horizon lies (pitch and roll) and how high the camera stands beside a known offset; the focal length
//! and the offsets themselves they do not tell.

use rayon::prelude::*;

use super::log::{Frames, ReplayLog};
use super::side_cameras::{difference_on, rows_with_all_cameras, shared_ground};
use crate::dataset::View;
use crate::error::Result;
use crate::geometry::{CarGeometry, Offset, PixelGrid, ViewWarp};

/// Rows whose pictures are compared.
const ROWS: usize = 60;
/// First steps of height (as a share of it), pitch and roll (deg).
const STEPS: [f64; 3] = [0.1, 1.0, 0.5];
/// Rounds of the search; steps shrink from one to the next.
const ROUNDS: usize = 8;
/// What is left of a step in the next round.
const SHRINKAGE: f64 = 0.6;

/// The mount that predicts the side cameras' pictures best.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraFit {
    /// With the height, the pitch and the roll that were found.
    pub geometry: CarGeometry,
    /// Rows whose pictures were compared.
    pub rows: usize,
    /// Mean difference in grey levels between the predicted and the real side pictures over the ground, with the mount that was
    /// found.
    pub fitted: f64,
    /// The same with the mount that was assumed.
    pub assumed: f64,
    /// The same for the centre picture as it is.
    pub unwarped: f64,
}

/// The three pictures of a row.
struct Triple {
    centre: Vec<u8>,
    sides: [Vec<u8>; 2],
}

/// Fits height, pitch and roll to the side pictures of up to 60 rows. `None` without side cameras.
///
/// It looks for the smallest difference coordinate by coordinate, in steps that shrink, so it finds a mount near the one that is
/// assumed.
///
/// # Errors
///
/// Pictures that cannot be read.
pub fn fit_camera(log: &ReplayLog) -> Result<Option<CameraFit>> {
    let assumed = &log.geometry;
    let rows = rows_with_all_cameras(log, ROWS);
    let triples: Vec<Option<Triple>> =
        rows.par_iter().map_init(Frames::default, |frames, &row| triple(log, frames, row)).collect::<Result<_>>()?;
    let triples: Vec<Triple> = triples.into_iter().flatten().collect();
    let Some(size) = log.recording.image_size.filter(|_| !triples.is_empty()) else { return Ok(None) };
    // All candidates are judged by the same pixels.
    let masks = warps_to_sides(assumed, size).map(|warp| shared_ground(&warp, size));
    let mount = |found: [f64; 3]| CarGeometry {
        height_m: found[0].clamp(0.01, 100.0),
        pitch_deg: found[1].clamp(-80.0, 80.0),
        roll_deg: found[2].clamp(-80.0, 80.0),
        ..assumed.clone()
    };
    let error = |found: [f64; 3]| difference(&triples, &masks, size, Some(&mount(found)));
    let mut found = [assumed.height_m, assumed.pitch_deg, assumed.roll_deg];
    let mut steps = STEPS;
    steps[0] *= assumed.height_m;
    let before = error(found);
    let mut best = before;
    for _ in 0..ROUNDS {
        for i in 0..found.len() {
            for sign in [1.0, -1.0] {
                loop {
                    let mut next = found;
                    next[i] += sign * steps[i];
                    let here = error(next);
                    if here >= best {
                        break;
                    }
                    (best, found) = (here, next);
                }
            }
        }
        steps.iter_mut().for_each(|step| *step *= SHRINKAGE);
    }
    Ok(Some(CameraFit {
        geometry: mount(found),
        rows: triples.len(),
        fitted: best,
        assumed: before,
        unwarped: difference(&triples, &masks, size, None),
    }))
}

fn triple<'a>(log: &ReplayLog<'a>, frames: &mut Frames<'a>, row: usize) -> Result<Option<Triple>> {
    let mut pixels = |camera| -> Result<Option<Vec<u8>>> {
        let picture = frames.get(log.recording, row, camera)?;
        let fits = log.recording.image_size == Some([picture.height, picture.width]);
        Ok(fits.then(|| picture.pixels.clone()))
    };
    let [centre, left, right] = [pixels(View::Centre)?, pixels(View::Left)?, pixels(View::Right)?];
    Ok(match (centre, left, right) {
        (Some(centre), Some(left), Some(right)) => Some(Triple { centre, sides: [left, right] }),
        _ => None,
    })
}

/// The warps of the centre picture to the side cameras.
fn warps_to_sides(geometry: &CarGeometry, size: [usize; 2]) -> [ViewWarp; 2] {
    let grid = PixelGrid::whole(geometry, size);
    geometry.side_offsets_m.map(|wanted_m| ViewWarp::between(geometry, grid, 0.0, Offset::default(), wanted_m))
}

/// Mean difference in grey levels between the side pictures and what `geometry` makes of the centre picture, or the centre picture as it
/// is.
fn difference(triples: &[Triple], masks: &[Vec<bool>; 2], size: [usize; 2], geometry: Option<&CarGeometry>) -> f64 {
    let warps = geometry.map(|geometry| warps_to_sides(geometry, size));
    let compare = |predicted: &mut Vec<u8>, triple: &Triple| -> u64 {
        predicted.resize(triple.centre.len(), 0);
        let side = |i: usize| -> u64 {
            match &warps {
                Some(warps) => warps[i].apply(&triple.centre, predicted),
                None => predicted.copy_from_slice(&triple.centre),
            }
            difference_on(&masks[i], predicted, &triple.sides[i])
        };
        [0, 1].map(side).iter().sum()
    };
    let sum: u64 = triples.par_iter().map_init(Vec::new, compare).sum();
    let pixels = masks.iter().flatten().filter(|ground| **ground).count() * triples.len();
    sum as f64 / (3 * pixels).max(1) as f64
}
