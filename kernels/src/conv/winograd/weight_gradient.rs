//! The weight gradient of minimal filtering.
//!
//! Forward is `y = A' ((G g) * (B' d))` (see [`transform`]), so `dg = G' ((A dy) * (B' d))`, summed over all positions. At each point,
//! the gradient of the filters is the sum over all positions of a point of the output gradient times a point of the input, shifted by
//! each tap. Only the sum is transformed to the gradient of the weights. As in the direct algorithm, a tile is 8 channels by 3 taps, and
//! its sums stay spread over the lanes until the end of the strip.

use super::choice::GRADIENT_BUDGET;
use super::input_points::{InputPoints, Taps};
use super::strips::{Strip, Strips, head};
use super::tiles;
use super::transform::{self, MAX_POINTS, POINT_ONE};
use crate::Isa;
use crate::conv::tap_sum::MAX_CHANNELS;
use crate::conv::weight_gradient::{TILE_TAPS, add_lanes, tile_height};
use crate::conv_shape::ConvShape;
use crate::simd::{ALIGNMENT, MAX_LANES, Simd, align, prefetch_part};

/// Vectors of positions that all taps read before the next vectors: 8 channels of 48 vectors of 64 bytes are 24 KiB.
const CHUNK: usize = 48;
/// The smallest number of positions of a strip at which summing over lanes is a small part of the work.
const MIN_POSITIONS: usize = 768;
/// With fewer positions, as in maps of few rows, it is so large a part that the direct algorithm is faster.
const TOO_FEW_POSITIONS: usize = 512;

/// The weight gradient of one shape.
#[derive(Clone, Debug)]
pub(crate) struct WeightGradient {
    isa: Isa,
    input: InputPoints,
    taps: Taps,
}

impl WeightGradient {
    /// The weight gradient of `shape`, or `None` where the direct algorithm is as fast.
    pub fn new(shape: ConvShape, isa: Isa) -> Option<WeightGradient> {
        let max_tiles = |rows: usize, planes: usize, positions: usize| {
            let tile = (rows + 2) * (planes + shape.oc) * positions;
            (GRADIENT_BUDGET / tile).max(MIN_POSITIONS.div_ceil(positions))
        };
        let (input, taps) = InputPoints::new(shape, max_tiles)?;
        let strips = &input.strips;
        let positions = strips.images * strips.per_strip * strips.pitch;
        (positions >= TOO_FEW_POSITIONS).then_some(WeightGradient { isa, input, taps })
    }

    /// Length of the planes of a point of the output gradient.
    fn output_stride(&self) -> usize {
        self.input.shape.oc * self.input.strips.plane
    }

    /// Length of the gradients of the filters at one point.
    fn filters(&self) -> usize {
        self.input.shape.oc * self.taps.len()
    }

    /// Length of the scratch of [`WeightGradient::run`].
    pub fn scratch_len(&self) -> usize {
        let points = self.input.strips.points();
        let sums = self.taps.len().next_multiple_of(TILE_TAPS) * MAX_CHANNELS * MAX_LANES;
        self.input.len()
            + points * (self.output_stride() + self.filters())
            + sums
            + self.input.copy_len()
            + 2 * ALIGNMENT
    }

    /// Adds the gradients of the images in `dy` to `dweight` and `dbias`.
    pub fn run(&self, x: &[f32], dy: &[f32], dweight: &mut [f32], dbias: &mut [f32], scratch: &mut [f32]) {
        let isa = self.isa;
        let InputPoints { shape, strips, .. } = &self.input;
        let points = strips.points();
        let (input, rest) = align(scratch).split_at_mut(self.input.len());
        let (output, rest) = rest.split_at_mut(points * self.output_stride());
        let (gradients, rest) = rest.split_at_mut(points * self.filters());
        let (copy, sums) = rest.split_at_mut(self.input.copy_len());
        let sums = align(sums);
        gradients.fill(0.0);
        let (x_group, y_group) = (strips.images * shape.x_len(), strips.images * shape.y_len());
        for group in 0..dy.len().div_ceil(y_group) {
            let (x, next_x) = head(&x[group * x_group..], x_group);
            let (dy, next_dy) = head(&dy[group * y_group..], y_group);
            let from = self.input.lay_out(isa, x, copy);
            for strip in strips.of(dy.len() / shape.y_len()) {
                self.input.of_strip(isa, strip, from, input);
                tiles::output_gradient(isa, strips, strip, [shape.out_h(), shape.out_w()], shape.oc, dy, output);
                tiles::clear_rest(isa, strips, strip, input);
                tiles::clear_rest(isa, strips, strip, output);
                for point in 0..points {
                    let upcoming = match point {
                        0 => strips.upcoming(strip, head(next_x, x_group).0),
                        1 => strips.upcoming(strip, head(next_dy, y_group).0),
                        _ => &[],
                    };
                    // The taps that do not need the point come last: those of the shorter filters.
                    let taps = self.taps.phases.iter().filter(|phase| phase.points.contains(&point));
                    let taps = taps.map(|phase| phase.taps.end).max().unwrap_or(0);
                    let at_point = AtPoint {
                        strips,
                        oc: shape.oc,
                        offsets: &self.taps.offsets[..taps],
                        stride: self.taps.len(),
                        farthest: self.taps.farthest,
                        input: &input[point * self.input.stride()..][..self.input.stride()],
                        output: &output[point * self.output_stride()..][..self.output_stride()],
                    };
                    let gradient = &mut gradients[point * self.filters()..][..self.filters()];
                    let dbias = (point == POINT_ONE).then_some(&mut *dbias);
                    sum_at_point(isa, &at_point, strip, gradient, dbias, sums, upcoming);
                }
            }
        }
        match strips.rows {
            2 => self.add_filters::<2>(gradients, dweight),
            _ => self.add_filters::<4>(gradients, dweight),
        }
    }

    /// Transforms the gradients of the filters' points to those of the weights, and adds these to `dweight`.
    fn add_filters<const M: usize>(&self, gradients: &[f32], dweight: &mut [f32]) {
        let taps = self.taps.len();
        for o in 0..self.input.shape.oc {
            for phase in &self.taps.phases {
                for tap in phase.taps.clone() {
                    let mut points = [0.0; MAX_POINTS];
                    for (u, point) in points.iter_mut().enumerate().take(M + 2) {
                        *point = gradients[u * self.filters() + o * taps + tap];
                    }
                    let at = o * self.taps.weight_stride + self.taps.weights[tap];
                    for (gradient, row) in transform::filter_gradient::<M>(points).into_iter().zip(phase.rows) {
                        if let Some(row) = row {
                            dweight[at + row] += gradient;
                        }
                    }
                }
            }
        }
    }
}

/// The operands of the sums at one point.
#[derive(Clone, Copy)]
struct AtPoint<'a> {
    strips: &'a Strips,
    /// Output channels.
    oc: usize,
    /// Offsets of the taps that need the point.
    offsets: &'a [usize],
    /// Distance between the gradients of two output channels: the number of all taps.
    stride: usize,
    /// The largest offset of a tap.
    farthest: usize,
    /// The planes of the input and of the output gradient.
    input: &'a [f32],
    output: &'a [f32],
}

per_isa! {
    /// Adds the gradient of the filters at one point to `gradient`, `[oc][taps]`, and the gradient of the bias to `dbias`. The bias
    /// comes with the point whose value is the sum of all rows.
    fn sum_at_point<S>(
        simd: S,
        at_point: &AtPoint,
        strip: Strip,
        gradient: &mut [f32],
        dbias: Option<&mut [f32]>,
        sums: &mut [f32],
        upcoming: &[f32],
    ) {
        match (S::MANY_REGISTERS, tile_height(S::MANY_REGISTERS, at_point.oc)) {
            (true, 8) => at_point.panels::<S, 8>(simd, strip, gradient, dbias, sums, upcoming),
            (true, _) => at_point.panels::<S, 6>(simd, strip, gradient, dbias, sums, upcoming),
            (false, 4) => at_point.panels::<S, 4>(simd, strip, gradient, dbias, sums, upcoming),
            (false, _) => at_point.panels::<S, 3>(simd, strip, gradient, dbias, sums, upcoming),
        }
    }
}

impl AtPoint<'_> {
    #[inline(always)]
    fn panels<S: Simd, const MR: usize>(
        &self,
        simd: S,
        strip: Strip,
        gradient: &mut [f32],
        mut dbias: Option<&mut [f32]>,
        sums: &mut [f32],
        upcoming: &[f32],
    ) {
        let AtPoint { strips, oc, offsets, input, output, .. } = *self;
        let (plane, taps) = (strips.plane, offsets.len());
        let vectors = strips.used(strip).div_ceil(S::LANES);
        const { assert!(MR <= MAX_CHANNELS && S::LANES <= MAX_LANES) };
        assert!(vectors * S::LANES + self.farthest <= input.len(), "weight gradient: too few points");
        assert!(vectors * S::LANES <= plane && output.len() == oc * plane, "weight gradient: too few points");
        // A row of vectors, one for each tap, for each channel.
        let row = taps.next_multiple_of(TILE_TAPS);
        let sums = &mut sums[..MR * row * S::LANES];
        let (chunks, groups) = (vectors.div_ceil(CHUNK), row / TILE_TAPS);
        let parts = oc.div_ceil(MR) * chunks * groups;
        let mut part = 0;
        for first in (0..oc).step_by(MR) {
            let rows = MR.min(oc - first);
            // Rows beyond the last channel repeat it; their sums are not used.
            let mut from = [output.as_ptr(); MR];
            for r in 0..MR {
                from[r] = output[(first + r.min(rows - 1)) * plane..].as_ptr();
            }
            for chunk in (0..vectors).step_by(CHUNK) {
                let (count, at) = (CHUNK.min(vectors - chunk), chunk * S::LANES);
                for group in (0..row).step_by(TILE_TAPS) {
                    prefetch_part(simd, upcoming, part, parts);
                    part += 1;
                    let mut shifted = [input.as_ptr(); TILE_TAPS];
                    for t in 0..TILE_TAPS {
                        // Taps beyond the last repeat it; their sums are not used.
                        shifted[t] = input[at + offsets[(group + t).min(taps - 1)]..].as_ptr();
                    }
                    let sums = sums[group * S::LANES..].as_mut_ptr();
                    // SAFETY: as asserted, all vectors may be read in full, also at the farthest tap; `sums` has `MR` rows.
                    unsafe { tile::<S, MR>(simd, shifted, from, at, count, chunk > 0, row, sums) };
                }
            }
            for r in 0..rows {
                let o = first + r;
                // SAFETY: `sums` holds a vector for each tap.
                unsafe {
                    let sums = sums[r * row * S::LANES..].as_ptr();
                    add_lanes(simd, sums, &mut gradient[o * self.stride..][..taps]);
                }
                if let Some(dbias) = &mut dbias {
                    let mut sum = simd.splat(0.0);
                    for vector in 0..vectors {
                        // SAFETY: a plane holds all vectors.
                        let values = unsafe { simd.load(from[r].add(vector * S::LANES)) };
                        sum = simd.mul_add(values, simd.splat(1.0), sum);
                    }
                    dbias[o] += simd.sum(sum);
                }
            }
        }
    }
}

/// Adds the products of `MR` channels and three taps over `count` vectors to `sums`, or overwrites them unless `adds`.
///
/// # Safety
/// From each of `shifted`, and each of `from` plus `at`, `count` vectors are readable. `sums` has `MR` rows of
/// `TILE_TAPS` vectors, `row` vectors apart.
#[inline(always)]
unsafe fn tile<S: Simd, const MR: usize>(
    simd: S,
    shifted: [*const f32; TILE_TAPS],
    from: [*const f32; MR],
    at: usize,
    count: usize,
    adds: bool,
    row: usize,
    sums: *mut f32,
) {
    let mut acc = [[simd.splat(0.0); TILE_TAPS]; MR];
    // SAFETY: as the caller promises.
    unsafe {
        if adds {
            for r in 0..MR {
                for t in 0..TILE_TAPS {
                    acc[r][t] = simd.load(sums.add((r * row + t) * S::LANES));
                }
            }
        }
        for vector in 0..count {
            let mut x = [simd.splat(0.0); TILE_TAPS];
            for t in 0..TILE_TAPS {
                x[t] = simd.load(shifted[t].add(vector * S::LANES));
            }
            for r in 0..MR {
                let dy = simd.load(from[r].add(at + vector * S::LANES));
                for t in 0..TILE_TAPS {
                    acc[r][t] = simd.mul_add(x[t], dy, acc[r][t]);
                }
            }
        }
        for r in 0..MR {
            for t in 0..TILE_TAPS {
                simd.store(sums.add((r * row + t) * S::LANES), acc[r][t]);
            }
        }
    }
}
