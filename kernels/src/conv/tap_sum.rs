//! The sum over taps, with vectors along the positions of the output: the kernel of the direct algorithm.
//!
//! A tile is 8 output channels by 3 vectors: 24 accumulators. For each tap it loads 3 vectors of the input, shifted by
//! the offset of the tap, and multiplies them by 8 weights: 11 loads for 24 multiply-adds, so arithmetic is the limit.
//! With 16 registers a tile has 6 channels by 2 vectors, which leaves the compiler a register to spare. Each output is
//! one chain of multiply-adds in the order of the taps, whatever the tile it falls in, so it does not depend on the
//! number of images.

use std::ops::Range;

use super::span::Span;
use crate::Isa;
use crate::simd::Simd;

/// The weights of a block of taps, all channels together: half of a 32 KiB first-level cache. All positions of an image
/// go through a block before the next, so that its weights stay there; between blocks the sums wait in the output.
const BLOCK_WEIGHTS: usize = 4096;
/// Bounds of a block: enough work between reading a sum and writing it, and input of 1.3 to 1.6 cache lines a tap that
/// fits into the other half.
const BLOCK_TAPS: (usize, usize) = (48, 240);

/// Elements of input, 128 KiB, that go through all blocks of taps before the next.
const GROUP_INPUT: usize = 32_768;

/// The largest number of channels of a tile.
pub(super) const MAX_CHANNELS: usize = 8;

/// Channels of a tile, for `channels` in all: the height that leaves the fewest rows of tiles empty.
pub(super) fn tile_height(many_registers: bool, channels: usize) -> usize {
    let heights: &[usize] = if many_registers { &[8, 6, 4] } else { &[6, 4] };
    *heights.iter().min_by_key(|&&height| channels.div_ceil(height) * height).unwrap_or(&4)
}

/// Spans that are computed from the same taps.
#[derive(Clone, Debug)]
pub(crate) struct Band {
    /// The spans, as a range of [`TapSum::spans`].
    pub spans: Range<usize>,
    /// The taps, as a range of [`TapSum::taps`]; the others would multiply zeros.
    pub taps: Range<usize>,
}

/// `out[o][p] = bias[o] + sum over k of weight[o][k] * x[start(p) + taps[k]]`, for each image.
#[derive(Clone, Debug)]
pub(crate) struct TapSum {
    /// Offset of each tap.
    pub taps: Vec<usize>,
    /// Offset of the weight of each tap, for channel 0.
    pub weights: Vec<usize>,
    /// Distance between the weights of two channels.
    pub weight_stride: usize,
    /// The positions of one image, in ascending order.
    pub spans: Vec<Span>,
    /// The spans cut into bands.
    pub bands: Vec<Band>,
    /// Offset of the first window in an input image.
    pub origin: usize,
    /// Length of an input image.
    pub in_image: usize,
    /// Output channels.
    pub channels: usize,
    /// Length of an output plane; an output image is `channels` planes.
    pub plane: usize,
}

impl TapSum {
    /// Length of the packed weights and bias, enough for tiles of any height.
    pub fn packed_len(&self) -> usize {
        (self.channels + MAX_CHANNELS) * (self.taps.len() + 1)
    }

    /// Packs bias (`None`: 0) and weights for [`run`], see [`pack_panels`].
    pub fn pack(&self, isa: Isa, bias: Option<&[f32]>, weight: &[f32], packed: &mut [f32]) {
        let taps = self.weights.iter().copied();
        pack_panels(isa, self.channels, bias, weight, self.weight_stride, taps, packed);
    }

    /// The largest offset of a tap.
    #[inline(always)]
    pub fn farthest(&self) -> usize {
        self.taps.iter().max().copied().unwrap_or(0)
    }

    /// Checks what the tiles rely on: in each image, every lane that holds an output finds its input and its output.
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
        for band in &self.bands {
            let ends = band.spans.end <= self.spans.len() && band.taps.end <= self.taps.len();
            assert!(ends && !band.spans.is_empty(), "tap sum: a band of spans or taps that do not exist");
        }
    }

    #[inline(always)]
    fn run_height<S: Simd, const MR: usize>(&self, simd: S, x: &[f32], packed: &[f32], y: &mut [f32]) {
        let images = y.len() / (self.channels * self.plane);
        self.check::<S>(images, x.len(), y.len());
        let panel_len = MR * (self.taps.len() + 1);
        assert!(packed.len() >= self.channels.div_ceil(MR) * panel_len, "tap sum: packed weights are too short");
        let farthest = self.farthest();
        let tile_vectors = if S::MANY_REGISTERS { 3 } else { 2 };
        let most_taps = (BLOCK_WEIGHTS / self.channels).clamp(BLOCK_TAPS.0, BLOCK_TAPS.1);
        for band in &self.bands {
            let blocks = band.taps.len().div_ceil(most_taps).max(1);
            let block = band.taps.len().div_ceil(blocks);
            // Tiles may span images, so that few vectors are left over. But images that go through several blocks of taps
            // should stay in the cache meanwhile.
            let group = if blocks == 1 { images } else { (GROUP_INPUT / self.in_image).clamp(1, images) };
            for first_image in (0..images).step_by(group) {
                for number in 0..blocks {
                    let first_tap = band.taps.start + number * block;
                    let taps = first_tap..(first_tap + block).min(band.taps.end);
                    let end = group.min(images - first_image) * band.spans.len();
                    let mut next = 0;
                    while next < end {
                        let place = Place { band, first_image, next, taps: taps.clone(), begins: number == 0 };
                        let count = (end - next).min(tile_vectors);
                        // SAFETY: `check` holds for every image, and tiles are asked for only existing vectors.
                        unsafe {
                            match count {
                                3 if S::MANY_REGISTERS => self.column::<S, MR, 3>(simd, place, farthest, x, packed, y),
                                2 => self.column::<S, MR, 2>(simd, place, farthest, x, packed, y),
                                _ => self.column::<S, MR, 1>(simd, place, farthest, x, packed, y),
                            }
                        }
                        next += count;
                    }
                }
            }
        }
    }

    /// Computes all channels of `NV` vectors over a block of taps.
    ///
    /// # Safety
    /// Vectors `next..next + NV` of the place exist, its taps are some of the band's, and `check` has passed.
    #[inline(always)]
    unsafe fn column<S: Simd, const MR: usize, const NV: usize>(
        &self,
        simd: S,
        place: Place,
        farthest: usize,
        x: &[f32],
        packed: &[f32],
        y: &mut [f32],
    ) {
        let spans = &self.spans[place.band.spans.clone()];
        let mut starts = [x.as_ptr(); NV];
        let mut reaches = [0; NV];
        let mut outs = [0; NV];
        let mut lanes = [0; NV];
        let mut whole = true;
        for v in 0..NV {
            let image = place.first_image + (place.next + v) / spans.len();
            let span = spans[(place.next + v) % spans.len()];
            let start = image * self.in_image + self.origin + span.start;
            whole &= start + farthest + S::LANES <= x.len();
            starts[v] = x[start..].as_ptr();
            reaches[v] = span.reach();
            outs[v] = image * self.channels * self.plane + span.out;
            lanes[v] = span.lanes;
        }
        let full = (1u32 << S::LANES) - 1;
        let taps = &self.taps[place.taps.clone()];
        let panels = packed.chunks_exact(MR * (self.taps.len() + 1));
        for (first, panel) in (0..self.channels).step_by(MR).zip(panels) {
            let rows = MR.min(self.channels - first);
            let (panel, _) = panel.as_chunks::<MR>();
            let mut sums = [[simd.splat(0.0); NV]; MR];
            // SAFETY: every tap of every lane that holds an output lies in `x`, and its output in `y`, by `check`;
            // loads go no further unless `whole` says that all lanes may be read.
            unsafe {
                for r in 0..MR {
                    for v in 0..NV {
                        sums[r][v] = if place.begins {
                            simd.splat(panel[0][r])
                        } else if r < rows {
                            let from = y.as_ptr().add(outs[v] + (first + r) * self.plane);
                            if lanes[v] == full { simd.load(from) } else { simd.load_spread(from, lanes[v]) }
                        } else {
                            simd.splat(0.0)
                        };
                    }
                }
                let weights = &panel[1 + place.taps.start..][..taps.len()];
                if whole {
                    tile::<S, MR, NV, false>(simd, taps, starts, reaches, weights, &mut sums);
                } else {
                    tile::<S, MR, NV, true>(simd, taps, starts, reaches, weights, &mut sums);
                }
                for r in 0..rows {
                    for v in 0..NV {
                        let to = y.as_mut_ptr().add(outs[v] + (first + r) * self.plane);
                        if lanes[v] == full {
                            simd.store(to, sums[r][v]);
                        } else {
                            simd.store_gathered(to, sums[r][v], lanes[v]);
                        }
                    }
                }
            }
        }
    }
}

/// Packs bias (`None`: 0) and weights into one panel for each tile: first the bias of its channels, then their weights, tap by
/// tap. `taps` are the offsets of the taps' weights for channel 0, `stride` is the distance between two channels.
pub(super) fn pack_panels(
    isa: Isa,
    channels: usize,
    bias: Option<&[f32]>,
    weight: &[f32],
    stride: usize,
    taps: impl ExactSizeIterator<Item = usize> + Clone,
    packed: &mut [f32],
) {
    let height = tile_height(isa.has_many_registers(), channels);
    let panels = packed.chunks_exact_mut(height * (taps.len() + 1));
    for (first, to) in (0..channels).step_by(height).zip(panels) {
        let rows = height.min(channels - first);
        let (to_bias, to) = to.split_at_mut(height);
        to_bias.fill(0.0);
        if let Some(bias) = bias {
            to_bias[..rows].copy_from_slice(&bias[first..first + rows]);
        }
        for (to, from) in to.chunks_exact_mut(height).zip(taps.clone()) {
            let from = weight[from + first * stride..].iter().step_by(stride);
            to[rows..].fill(0.0);
            for (to, &weight) in to[..rows].iter_mut().zip(from) {
                *to = weight;
            }
        }
    }
}

per_isa! {
    /// Computes the images in `x` with packed weights from [`TapSum::pack`]; `y` is overwritten.
    pub(super) fn run<S>(simd: S, sum: &TapSum, x: &[f32], packed: &[f32], y: &mut [f32]) {
        match tile_height(S::MANY_REGISTERS, sum.channels) {
            8 if S::MANY_REGISTERS => sum.run_height::<S, 8>(simd, x, packed, y),
            6 => sum.run_height::<S, 6>(simd, x, packed, y),
            _ => sum.run_height::<S, 4>(simd, x, packed, y),
        }
    }
}

/// Vectors from number `next` of a band on, counted through the images from `first_image` on, and a block of taps.
struct Place<'a> {
    band: &'a Band,
    first_image: usize,
    next: usize,
    taps: Range<usize>,
    /// Whether this is the first block, which begins with the bias.
    begins: bool,
}

/// Adds the products of `MR` channels and `NV` vectors over the taps to `sums`.
///
/// # Safety
/// For every start and tap, `reach` elements from `start + tap` on are readable, and `LANES` unless `MASKED`.
#[inline(always)]
pub(super) unsafe fn tile<S: Simd, const MR: usize, const NV: usize, const MASKED: bool>(
    simd: S,
    taps: &[usize],
    starts: [*const f32; NV],
    reaches: [usize; NV],
    weights: &[[f32; MR]],
    sums: &mut [[S::V; NV]; MR],
) {
    // Loops over arrays, not `from_fn`: a closure might not be inlined into the function with the instruction set.
    let mut acc = *sums;
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
                acc[r][v] = simd.mul_add(x[v], weight, acc[r][v]);
            }
        }
    }
    *sums = acc;
}
