//! Convolution with fewer multiplications: minimal filtering along the rows of the maps.
//!
//! Tiles of M rows of the output are computed from M + 2 *points* of the input rows they need (see [`transform`]). Between
//! the points of the input and those of the output stands, for each point, a sum over taps of one row each: the same kernel
//! as in the direct way, `direct`, with a third of the taps. Strips of tiles keep the points in the second-level cache.
//!
//! A stride splits the rows into phases whose filters have 2 or 3 taps; all phases share the points of the output. A filter
//! of 2 taps has no use for one of the points, and does without it.
//!
//! Which shapes gain is decided by [`rows_per_tile`], and for small maps and few channels by [`FEWEST_TAPS`] and
//! `weight_gradient::TOO_FEW_POSITIONS`.

mod forward;
mod input_gradient;
mod input_points;
mod point_sum;
mod strips;
mod transform;
mod weight_gradient;

pub(crate) use forward::Forward;
pub(crate) use input_gradient::InputGradient;
pub(crate) use weight_gradient::WeightGradient;

/// Elements of points in a strip: 512 KiB.
const BUDGET: usize = 1 << 17;
/// The same for the weight gradient, which sums over lanes once a strip: 1 MiB.
const GRADIENT_BUDGET: usize = 1 << 18;

/// The fewest taps of a point at which the forward pass gains: the rows of the output are made at a cost that does not depend
/// on the taps.
const FEWEST_TAPS: usize = 12;

/// Rows of a tile, 2 or 4, for maps of `height` rows whose phases have `taps` taps; `None` where the sum itself, with `direct`
/// rows of products, is as good.
///
/// Minimal filtering has a point more than rows and taps together for each tile, the last of which may stand over. Passes over
/// the points cost time too, so the gain must be more than a fifth. In the benches, with vectors of 16 (forward, input
/// gradient, weight gradient, times as fast as the sum):
///
/// | layer | | | |
/// |---|---|---|---|
/// | hyper conv2 8x38x158-16 | 1.3 | 1.3 | 1.4 |
/// | hyper conv3 16x18x78-24 | 1.5 | 1.3 | 1.4 |
/// | hyper conv4 24x8x38-32 | 1.1 | 1.2 | 1.0 |
/// | pilotnet conv1 3x66x200-24 | 1.3 | | 1.3 |
/// | pilotnet conv2 24x31x98-36 | 1.2 | 1.3 | 1.2 |
///
/// It does not pay for the single row of hyper conv5, nor for the 5 rows of pilotnet conv3.
fn rows_per_tile(height: usize, taps: &[usize], direct: usize) -> Option<usize> {
    if taps.iter().max() != Some(&3) {
        return None;
    }
    let products = |rows: usize| {
        let points = taps.iter().map(|&taps| if taps == 3 { rows + 2 } else { rows + 1 }).sum::<usize>();
        height.div_ceil(rows) * points
    };
    let rows = if products(4) <= products(2) { 4 } else { 2 };
    (5 * products(rows) <= 4 * direct).then_some(rows)
}
