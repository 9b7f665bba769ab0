//! The pictures of the side cameras, with which those that are made of the centre camera's are compared.

use super::log::ReplayLog;
use crate::dataset::View;
use crate::geometry::ViewWarp;

/// Below this share of the picture's height lies the bonnet, which moves with the camera.
const MAX_ROW_SHARE: f64 = 135.0 / 160.0;

/// Up to `count` rows with the pictures of three cameras at different places, spread over the recording.
pub(super) fn rows_with_all_cameras(log: &ReplayLog, count: usize) -> Vec<usize> {
    let rows: Vec<usize> = (log.sessions.iter().flat_map(|session| session.rows.clone()))
        .filter(|&row| View::ALL.iter().all(|&camera| log.recording.row_has(row, camera)))
        .filter(|_| log.geometry.side_offsets_m != [0.0, 0.0])
        .collect();
    let step = rows.len().div_ceil(count).max(1);
    rows.into_iter().step_by(step).collect()
}

/// Which pixels of a picture of `[h, w]` pixels that `warp` makes show ground that the picture it is made of shows, too, without the
/// bonnet.
pub(super) fn shared_ground(warp: &ViewWarp, [h, w]: [usize; 2]) -> Vec<bool> {
    let seen = |i: usize| warp.sees_ground((i % w) as f64 + 0.5, (i / w) as f64 + 0.5);
    (0..h * w).map(|i| (i / w) as f64 <= MAX_ROW_SHARE * h as f64 && seen(i)).collect()
}

/// The differences in grey levels between the pictures `a` and `b`, summed over the pixels and channels of `ground`.
pub(super) fn difference_on(ground: &[bool], a: &[u8], b: &[u8]) -> u64 {
    let pixels = a.as_chunks::<3>().0.iter().zip(b.as_chunks::<3>().0);
    let of_ground = pixels.zip(ground).filter(|(_, ground)| **ground);
    of_ground.map(|((a, b), _)| (0..3).map(|c| u64::from(a[c].abs_diff(b[c]))).sum::<u64>()).sum()
}
