//! Which shapes gain by minimal filtering, and how large its tiles and strips are.

/// Elements of points in a strip: 512 KiB.
pub(super) const BUDGET: usize = 1 << 17;
/// The same for the weight gradient, which sums over lanes once a strip: 1 MiB.
pub(super) const GRADIENT_BUDGET: usize = 1 << 18;

/// The smallest number of taps of a point at which the forward pass gains. The transform of the output costs the same for any
/// number of taps.
pub(super) const MIN_TAPS: usize = 12;

/// Rows of a tile, 2 or 4, for maps of `height` rows whose phases have `taps` taps; `None` where the direct algorithm, with `direct`
/// rows of products, is as fast.
///
/// F(m, r) has m + r - 1 points for each tile: one less than rows and taps together. The last tile may reach beyond the map. The
/// transforms cost time too, so products must fall by at least a fifth. Speed with vectors of 16 lanes, as a multiple of the
/// direct algorithm's (forward, input gradient, weight gradient):
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
pub(super) fn rows_per_tile(height: usize, taps: &[usize], direct: usize) -> Option<usize> {
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
