//! The direct kernel: a sum over taps, with vectors along the positions of the output.
//!
//! A tile is 8 output channels by 3 vectors: 24 accumulators. For each tap it loads 3 vectors of the input, shifted by
//! the offset of the tap, and multiplies them by 8 weights: 11 loads for 24 multiply-adds, so arithmetic is the limit.
//! With 16 registers a tile has 4 channels. Each output is one chain of multiply-adds in the order of the taps, whatever
//! the tile it falls in, so it does not depend on the number of images.

use super::grid::Span;
use crate::simd::Simd;

/// Vectors in a tile.
pub(crate) const TILE_VECTORS: usize = 3;

/// Output channels of a tile for `channels` in all: the height that leaves the fewest rows empty.
pub(crate) fn tile_height(many_registers: bool, channels: usize) -> usize {
    let heights: &[usize] = if many_registers { &[8, 6, 4] } else { &[4, 3] };
    *heights.iter().min_by_key(|&&height| channels.div_ceil(height) * height).unwrap_or(&4)
}

/// `out[o][p] = bias[o] + sum over k of weight[o][k] * x[start(p) + taps[k]]`, for each image.
#[derive(Clone, Debug)]
pub(crate) struct TapSum {
    /// Offset of each tap.
    pub taps: Vec<usize>,
    /// The positions of one image.
    pub spans: Vec<Span>,
    /// Where the first window begins in an input image.
    pub origin: usize,
    /// Elements of an input image.
    pub in_image: usize,
    /// Output channels.
    pub channels: usize,
    /// Elements of an output plane; an output image is `channels` planes.
    pub plane: usize,
}

impl TapSum {
    /// Elements that the packed weights and bias take for tiles of any height.
    pub fn packed_len(&self) -> usize {
        (self.channels + 8) * (self.taps.len() + 1)
    }

    /// Packs bias and weights into panels of `height` channels: first the bias, then tap by tap.
    #[inline(always)]
    pub fn pack(
        &self,
        height: usize,
        bias: impl Fn(usize) -> f32,
        weight: impl Fn(usize, usize) -> f32,
        packed: &mut [f32],
    ) {
        for (panel, to) in packed.chunks_exact_mut(height * (self.taps.len() + 1)).enumerate() {
            let first = panel * height;
            if first >= self.channels {
                break;
            }
            for r in 0..height {
                let o = first + r;
                if o < self.channels {
                    to[r] = bias(o);
                    for k in 0..self.taps.len() {
                        to[(k + 1) * height + r] = weight(o, k);
                    }
                } else {
                    to[r..].iter_mut().step_by(height).for_each(|to| *to = 0.0);
                }
            }
        }
    }

    /// Computes the images in `x` with weights packed for `tile_height`; `y` is overwritten.
    #[inline(always)]
    pub fn run<S: Simd>(&self, simd: S, x: &[f32], packed: &[f32], y: &mut [f32]) {
        match tile_height(S::MANY_REGISTERS, self.channels) {
            8 if S::MANY_REGISTERS => self.run_height::<S, 8>(simd, x, packed, y),
            6 if S::MANY_REGISTERS => self.run_height::<S, 6>(simd, x, packed, y),
            3 if !S::MANY_REGISTERS => self.run_height::<S, 3>(simd, x, packed, y),
            _ => self.run_height::<S, 4>(simd, x, packed, y),
        }
    }

    /// The largest offset of a tap.
    #[inline(always)]
    pub fn farthest(&self) -> usize {
        self.taps.iter().max().copied().unwrap_or(0)
    }

    /// What the tiles rely on: for each image, every lane that holds an output finds its input and its output.
    #[inline(always)]
    pub fn check<S: Simd>(&self, images: usize, x_len: usize, y_len: usize) {
        assert_eq!(y_len, images * self.channels * self.plane, "tap sum: not a whole number of output images");
        assert!(x_len >= images * self.in_image, "tap sum: too few input images");
        let farthest = self.farthest();
        for span in &self.spans {
            assert!(self.origin + span.start + span.reach() + farthest <= self.in_image, "tap sum: input too short");
            assert!(span.out + span.lanes.count_ones() as usize <= self.plane, "tap sum: output too short");
            assert!(span.lanes != 0 && span.reach() <= S::LANES, "tap sum: a span is wider than a vector");
        }
    }

    #[inline(always)]
    fn run_height<S: Simd, const MR: usize>(&self, simd: S, x: &[f32], packed: &[f32], y: &mut [f32]) {
        let images = y.len() / (self.channels * self.plane);
        self.check::<S>(images, x.len(), y.len());
        let panel_len = MR * (self.taps.len() + 1);
        assert!(packed.len() >= self.channels.div_ceil(MR) * panel_len, "tap sum: packed weights are too short");
        let farthest = self.farthest();
        let total = images * self.spans.len();
        let mut next = 0;
        while next < total {
            let count = (total - next).min(TILE_VECTORS);
            // SAFETY: `check` holds for every image, and tiles are asked for only existing vectors.
            unsafe {
                match count {
                    3 => self.column::<S, MR, 3>(simd, next, farthest, x, packed, y),
                    2 => self.column::<S, MR, 2>(simd, next, farthest, x, packed, y),
                    _ => self.column::<S, MR, 1>(simd, next, farthest, x, packed, y),
                }
            }
            next += count;
        }
    }

    /// All channels of `NV` vectors, the first of which is vector number `next` of the batch.
    ///
    /// # Safety
    /// Vectors `next..next + NV` exist, and `check` has passed.
    #[inline(always)]
    unsafe fn column<S: Simd, const MR: usize, const NV: usize>(
        &self,
        simd: S,
        next: usize,
        farthest: usize,
        x: &[f32],
        packed: &[f32],
        y: &mut [f32],
    ) {
        let mut starts = [x.as_ptr(); NV];
        let mut reaches = [0; NV];
        let mut outs = [0; NV];
        let mut lanes = [0; NV];
        let mut whole = true;
        for v in 0..NV {
            let image = (next + v) / self.spans.len();
            let span = self.spans[(next + v) % self.spans.len()];
            let start = image * self.in_image + self.origin + span.start;
            whole &= start + farthest + S::LANES <= x.len();
            starts[v] = x[start..].as_ptr();
            reaches[v] = span.reach();
            outs[v] = image * self.channels * self.plane + span.out;
            lanes[v] = span.lanes;
        }
        let full = (1u32 << S::LANES) - 1;
        for (panel, weights) in packed.chunks_exact(MR * (self.taps.len() + 1)).enumerate() {
            let first = panel * MR;
            if first >= self.channels {
                break;
            }
            // SAFETY: every tap of every lane that holds an output lies in `x`, by `check`; loads go
            // no further unless `whole` says that all lanes may be read.
            let tile = unsafe {
                if whole {
                    tile::<S, MR, NV, false>(simd, &self.taps, starts, reaches, weights)
                } else {
                    tile::<S, MR, NV, true>(simd, &self.taps, starts, reaches, weights)
                }
            };
            for r in 0..MR.min(self.channels - first) {
                for v in 0..NV {
                    let at = outs[v] + (first + r) * self.plane;
                    // SAFETY: `count_ones` outputs from `out` on lie in the plane, and the plane lies in `y`.
                    unsafe {
                        let to = y.as_mut_ptr().add(at);
                        if lanes[v] == full {
                            simd.store(to, tile[r][v]);
                        } else {
                            simd.store_gathered(to, tile[r][v], lanes[v]);
                        }
                    }
                }
            }
        }
    }
}

/// `MR` channels of `NV` vectors.
///
/// # Safety
/// For every start and tap, `reach` elements from `start + tap` on are readable, and `LANES` unless `MASKED`.
#[inline(always)]
unsafe fn tile<S: Simd, const MR: usize, const NV: usize, const MASKED: bool>(
    simd: S,
    taps: &[usize],
    starts: [*const f32; NV],
    reaches: [usize; NV],
    weights: &[f32],
) -> [[S::V; NV]; MR] {
    let (weights, _) = weights.as_chunks::<MR>();
    let (bias, weights) = weights.split_first().expect("a panel begins with the bias");
    // Loops over arrays, not `from_fn`: a closure might not be inlined into the function with the instruction set.
    let mut sums = [[simd.splat(0.0); NV]; MR];
    for r in 0..MR {
        sums[r] = [simd.splat(bias[r]); NV];
    }
    for (&tap, weights) in taps.iter().zip(weights) {
        let mut x = [simd.splat(0.0); NV];
        for v in 0..NV {
            // SAFETY: as the caller promises.
            unsafe {
                let from = starts[v].add(tap);
                x[v] = if MASKED { simd.load_first(from, reaches[v]) } else { simd.load(from) };
            }
        }
        for r in 0..MR {
            let weight = simd.splat(weights[r]);
            for v in 0..NV {
                sums[r][v] = simd.mul_add(x[v], weight, sums[r][v]);
            }
        }
    }
    sums
}
