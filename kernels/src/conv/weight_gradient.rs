//! The weight gradient of the direct algorithm, with vectors along the positions of the output.
//!
//! Forward is `y[o][p] = bias[o] + sum over k of weight[o][k] * x[start(p) + taps[k]]`, so
//! `dweight[o][k] = sum over p of dy[o][p] * x[start(p) + taps[k]]` and `dbias[o] = sum over p of dy[o][p]`. A tile is 8 output channels by 3 taps: for each
//! vector of positions it loads 8 vectors of `dy` and 3 of `x` for 24 multiply-adds. Sums stay spread over the lanes
//! until the end. So that `dy` comes from the first-level cache, a chunk of `CHUNK` vectors is packed once and all taps
//! run over it; the sums of a panel of channels wait in scratch meanwhile.

use super::tap_sum::{MAX_CHANNELS, TapSum};
use crate::simd::{ALIGNMENT, MAX_LANES, Simd, align};

/// Taps in a tile.
pub(super) const TILE_TAPS: usize = 3;
/// Vectors of positions that are packed at a time: 32 x 8 channels x 64 bytes, or 64 x 4 x 32, are at most half of a
/// 32 KiB cache.
const MAX_CHUNK: usize = 64;
const CHUNK_OF_MANY_REGISTERS: usize = 32;

const fn chunk_vectors<S: Simd>() -> usize {
    if S::MANY_REGISTERS { CHUNK_OF_MANY_REGISTERS } else { MAX_CHUNK }
}
/// The largest number of vectors of a packed chunk: 32 of 8 channels; 64 of 4, where there are 16 registers, are as many.
const MAX_PACKED: usize = CHUNK_OF_MANY_REGISTERS * MAX_CHANNELS;

/// Length of the scratch for `taps` taps.
pub(crate) fn scratch_len(taps: usize) -> usize {
    (MAX_PACKED + taps.next_multiple_of(TILE_TAPS) * MAX_CHANNELS) * MAX_LANES + ALIGNMENT
}

/// Channels of a tile, for `channels` in all: of the heights with 24 and 18 accumulators (12 and 9 where there are 16
/// registers), the one that leaves fewer rows of tiles empty.
pub(super) fn tile_height(many_registers: bool, channels: usize) -> usize {
    let heights = if many_registers { [8, 6] } else { [4, 3] };
    let rows = |height: usize| channels.div_ceil(height) * height;
    if rows(heights[0]) <= rows(heights[1]) { heights[0] } else { heights[1] }
}

per_isa! {
    /// Adds the gradient of the images in `dy` to `dweight` and `dbias`.
    ///
    /// `sum` is the forward pass: its taps, positions and sizes, `x` its input.
    pub(super) fn run<S>(
        simd: S,
        sum: &TapSum,
        x: &[f32],
        dy: &[f32],
        dweight: &mut [f32],
        dbias: &mut [f32],
        scratch: &mut [f32],
    ) {
        match (S::MANY_REGISTERS, tile_height(S::MANY_REGISTERS, sum.channels)) {
            (true, 8) => run_height::<S, 8>(simd, sum, x, dy, dweight, dbias, scratch),
            (true, _) => run_height::<S, 6>(simd, sum, x, dy, dweight, dbias, scratch),
            (false, 4) => run_height::<S, 4>(simd, sum, x, dy, dweight, dbias, scratch),
            (false, _) => run_height::<S, 3>(simd, sum, x, dy, dweight, dbias, scratch),
        }
    }
}

#[inline(always)]
fn run_height<S: Simd, const MR: usize>(
    simd: S,
    sum: &TapSum,
    x: &[f32],
    dy: &[f32],
    dweight: &mut [f32],
    dbias: &mut [f32],
    scratch: &mut [f32],
) {
    let taps = sum.taps.len();
    let image_len = sum.channels * sum.plane;
    let images = dy.len() / image_len;
    sum.check::<S>(images, x.len(), dy.len());
    assert!(dweight.len() == sum.channels * taps && dbias.len() == sum.channels, "weight gradient: wrong length");
    debug_assert!(chunk_vectors::<S>() * MR <= MAX_PACKED && MR <= MAX_CHANNELS && S::LANES <= MAX_LANES);
    let total = images * sum.spans.len();
    if total == 0 {
        return;
    }
    let (packed, sums) = align(scratch).split_at_mut(chunk_vectors::<S>() * MR * S::LANES);
    // A row of vectors, one for each tap, for each channel.
    let row = taps.next_multiple_of(TILE_TAPS);
    let sums = &mut sums[..MR * row * S::LANES];
    let farthest = sum.farthest();

    for first in (0..sum.channels).step_by(MR) {
        let rows = MR.min(sum.channels - first);
        packed.fill(0.0);
        let mut bias = [simd.splat(0.0); MR];
        for chunk in (0..total).step_by(chunk_vectors::<S>()) {
            let count = chunk_vectors::<S>().min(total - chunk);
            let mut starts = [0; MAX_CHUNK];
            let mut whole = 0;
            for i in 0..count {
                let image = (chunk + i) / sum.spans.len();
                let span = sum.spans[(chunk + i) % sum.spans.len()];
                starts[i] = image * sum.in_image + sum.origin + span.start;
                // Vectors come in ascending order: only the last ones of the last image may end outside `x`.
                whole += usize::from(starts[i] + farthest + S::LANES <= x.len());
                for r in 0..rows {
                    // SAFETY: the plane of an output channel holds the outputs of every span (`check`); `packed` holds
                    // `chunk_vectors() * MR` vectors.
                    unsafe {
                        let from = dy.as_ptr().add(image * image_len + (first + r) * sum.plane + span.out);
                        let full = span.lanes == (1 << S::LANES) - 1;
                        let values = if full { simd.load(from) } else { simd.load_spread(from, span.lanes) };
                        simd.store(packed.as_mut_ptr().add((i * MR + r) * S::LANES), values);
                        bias[r] = simd.mul_add(values, simd.splat(1.0), bias[r]);
                    }
                }
            }
            for group in (0..row).step_by(TILE_TAPS) {
                let mut offsets = [0; TILE_TAPS];
                for (t, offset) in offsets.iter_mut().enumerate() {
                    *offset = sum.taps.get(group + t).copied().unwrap_or(0);
                }
                let sums = &mut sums[group * S::LANES..];
                // SAFETY: the first `whole` vectors may be read in full for every tap, the rest up to their reach;
                // `packed` holds `count * MR` vectors and `sums` `MR` rows, but for what lies before the first tap.
                unsafe { tile::<S, MR>(simd, sum, x, packed, &starts[..count], chunk, whole, offsets, row, sums) };
            }
        }
        for r in 0..rows {
            let o = first + r;
            dbias[o] += simd.sum(bias[r]);
            // SAFETY: `sums` holds a vector for each tap.
            unsafe { add_lanes(simd, sums[r * row * S::LANES..].as_ptr(), &mut dweight[o * taps..][..taps]) };
        }
    }
}

/// Adds the sum over the lanes of each of the vectors from `sums` on to `to`.
///
/// # Safety
/// `sums` must be valid for reading as many vectors as `to` has elements.
#[inline(always)]
pub(super) unsafe fn add_lanes<S: Simd>(simd: S, sums: *const f32, to: &mut [f32]) {
    for (eight, to) in to.chunks_mut(8).enumerate() {
        let mut vectors = [simd.splat(0.0); 8];
        for (k, vector) in vectors.iter_mut().enumerate().take(to.len()) {
            // SAFETY: as the caller promises.
            *vector = unsafe { simd.load(sums.add((eight * 8 + k) * S::LANES)) };
        }
        for (to, sum) in to.iter_mut().zip(simd.sums(vectors)) {
            *to += sum;
        }
    }
}

/// Adds the products of `MR` channels and the taps at `offsets` over a chunk of positions to `sums`; the first chunk
/// overwrites them.
///
/// # Safety
/// - `packed` holds `starts.len() * MR` vectors.
/// - `sums` holds `MR` rows of `TILE_TAPS` vectors, `row` vectors apart.
/// - From each start plus each offset, `LANES` elements of `x` are readable for the first `whole` vectors, and as many as
///   the span reaches for the others.
#[inline(always)]
unsafe fn tile<S: Simd, const MR: usize>(
    simd: S,
    sum: &TapSum,
    x: &[f32],
    packed: &[f32],
    starts: &[usize],
    chunk: usize,
    whole: usize,
    offsets: [usize; TILE_TAPS],
    row: usize,
    sums: &mut [f32],
) {
    let mut acc = [[simd.splat(0.0); TILE_TAPS]; MR];
    let mut from = [x.as_ptr(); TILE_TAPS];
    for t in 0..TILE_TAPS {
        from[t] = from[t].wrapping_add(offsets[t]);
    }
    // SAFETY: as the caller promises.
    unsafe {
        if chunk > 0 {
            for r in 0..MR {
                for t in 0..TILE_TAPS {
                    acc[r][t] = simd.load(sums.as_ptr().add((r * row + t) * S::LANES));
                }
            }
        }
        for (i, &start) in starts.iter().enumerate().take(whole) {
            let mut x = [simd.splat(0.0); TILE_TAPS];
            for t in 0..TILE_TAPS {
                x[t] = simd.load(from[t].wrapping_add(start));
            }
            for r in 0..MR {
                let dy = simd.load(packed.as_ptr().add((i * MR + r) * S::LANES));
                for t in 0..TILE_TAPS {
                    acc[r][t] = simd.mul_add(x[t], dy, acc[r][t]);
                }
            }
        }
        for (i, &start) in starts.iter().enumerate().skip(whole) {
            let reach = sum.spans[(chunk + i) % sum.spans.len()].reach();
            let mut x = [simd.splat(0.0); TILE_TAPS];
            for t in 0..TILE_TAPS {
                x[t] = simd.load_first(from[t].wrapping_add(start), reach);
            }
            for r in 0..MR {
                let dy = simd.load(packed.as_ptr().add((i * MR + r) * S::LANES));
                for t in 0..TILE_TAPS {
                    acc[r][t] = simd.mul_add(x[t], dy, acc[r][t]);
                }
            }
        }
        for r in 0..MR {
            for t in 0..TILE_TAPS {
                simd.store(sums.as_mut_ptr().add((r * row + t) * S::LANES), acc[r][t]);
            }
        }
    }
}
