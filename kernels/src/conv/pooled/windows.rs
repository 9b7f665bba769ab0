//! Vectors along the windows.
//!
//! The lanes of a vector are neighbouring windows, not neighbouring positions of the map. For each place of the windows the
//! convolution is a sum over taps, as in [`tap_sum`](crate::conv::tap_sum), over the phases of the image modulo 4, in which
//! neighbouring windows lie side by side.

use super::{Output, PLACES, WINDOW};
use crate::Isa;
use crate::conv::direct::FORWARD_COPIES;
use crate::conv::layout::{Layout, group_of};
use crate::conv::span::{self, Span};
use crate::conv::tap_sum::{MAX_CHANNELS, pack_panels, tile, tile_height};
use crate::conv_shape::ConvShape;
use crate::simd::{MAX_LANES, Simd};

/// The tables of a shape.
#[derive(Clone, Debug)]
pub(super) struct Windows {
    shape: ConvShape,
    isa: Isa,
    /// Of the windows: their rows and columns reach over the kernel at all places.
    layout: Layout,
    /// The offsets of the taps in the layout, place by place.
    taps: Vec<usize>,
    /// The largest of them.
    farthest: usize,
    /// The windows of an image, a vector each.
    spans: Vec<Span>,
    /// For each span and lane, the index in an input plane of the window's first element.
    firsts: Vec<[f32; MAX_LANES]>,
    /// Windows of an image.
    windows: usize,
}

impl Windows {
    /// For convolutions with strides of 1 and no padding.
    pub fn new(shape: ConvShape, isa: Isa) -> Windows {
        let ConvShape { c, w, kh, kw, .. } = shape;
        let (reach_h, reach_w) = (kh + WINDOW - 1, kw + WINDOW - 1);
        let windows = ConvShape { kh: reach_h, kw: reach_w, stride_h: WINDOW, stride_w: WINDOW, ..shape };
        let layout = Layout::new(windows);
        let (out_h, out_w) = (windows.out_h(), windows.out_w());
        let offsets = layout.taps();
        let mut taps = Vec::with_capacity(PLACES * shape.taps());
        for place in 0..PLACES {
            for (channel, ky, kx) in (0..c * kh * kw).map(|tap| (tap / (kh * kw), tap / kw % kh, tap % kw)) {
                let (row, column) = (place / WINDOW + ky, place % WINDOW + kx);
                taps.push(offsets[(channel * reach_h + row) * reach_w + column]);
            }
        }
        let spans = span::spans(out_h, out_w, layout.pitch, isa.lanes());
        let first = |lane: usize| (lane / layout.pitch * WINDOW * w + lane % layout.pitch * WINDOW) as f32;
        let firsts = spans.iter().map(|span| std::array::from_fn(|lane| first(span.start + lane))).collect();
        let farthest = taps.iter().max().copied().unwrap_or(0);
        Windows { shape, isa, layout, taps, farthest, spans, firsts, windows: out_h * out_w }
    }

    /// The share of the lanes that hold a window.
    pub fn lanes_used(&self) -> f64 {
        self.windows as f64 / (self.spans.len() * self.isa.lanes()) as f64
    }

    fn y_len(&self) -> usize {
        self.shape.oc * self.windows
    }

    /// Length of the scratch of [`Windows::forward`].
    pub fn scratch_len(&self) -> usize {
        let image = self.layout.image();
        group_of(image, FORWARD_COPIES) * image + MAX_LANES
    }

    /// Length of the packed weights and bias.
    pub fn packed_len(&self) -> usize {
        (self.shape.oc + MAX_CHANNELS) * (self.shape.taps() + 1)
    }

    /// Packs weights and bias for [`Windows::forward`].
    pub fn pack(&self, weight: &[f32], bias: &[f32], packed: &mut [f32]) {
        let taps = self.shape.taps();
        pack_panels(self.isa, self.shape.oc, Some(bias), weight, taps, 0..taps, packed);
    }

    /// Computes the images in `x` with packed weights from [`Windows::pack`].
    pub fn forward(&self, x: &[f32], packed: &[f32], output: Output, scratch: &mut [f32]) {
        let Output { y, argmax } = output;
        let image = self.layout.image();
        let group = group_of(image, FORWARD_COPIES);
        let outputs = group * self.y_len();
        for (number, (x, y)) in x.chunks(group * self.shape.x_len()).zip(y.chunks_mut(outputs)).enumerate() {
            let used = y.len() / self.y_len() * image;
            split_phases(self.isa, &self.shape, &self.layout, x, &mut scratch[..used]);
            scratch[used..used + MAX_LANES].fill(0.0);
            let argmax = if argmax.is_empty() { &mut [] } else { &mut argmax[number * outputs..][..y.len()] };
            run(self.isa, self, &scratch[..used + MAX_LANES], packed, y, argmax);
        }
    }

    /// Checks what the tiles rely on: every load of a lane lies in `x`, every output in `y`.
    #[inline(always)]
    fn check<S: Simd>(&self, images: usize, x_len: usize, y_len: usize) {
        assert_eq!(y_len, images * self.y_len(), "pooled conv: not a whole number of output images");
        assert_eq!(self.taps.len(), PLACES * self.shape.taps(), "pooled conv: taps");
        let last = images.saturating_sub(1) * self.layout.image() + self.farthest + S::LANES;
        for span in &self.spans {
            assert!(span.start + last <= x_len, "pooled conv: input too short");
            assert!(span.out + span.lanes.count_ones() as usize <= self.windows, "pooled conv: output too short");
            assert!(span.lanes != 0 && span.reach() <= S::LANES, "pooled conv: a span is wider than a vector");
        }
    }

    #[inline(always)]
    fn run_height<S: Simd, const MR: usize>(
        &self,
        simd: S,
        x: &[f32],
        packed: &[f32],
        y: &mut [f32],
        argmax: &mut [u32],
    ) {
        let images = y.len() / self.y_len();
        self.check::<S>(images, x.len(), y.len());
        let tile_vectors = if S::MANY_REGISTERS { 3 } else { 2 };
        let (mut next, end) = (0, images * self.spans.len());
        while next < end {
            let count = (end - next).min(tile_vectors);
            // SAFETY: `check` holds for every image, and tiles are asked for only existing vectors.
            unsafe {
                match count {
                    3 if S::MANY_REGISTERS => self.column::<S, MR, 3>(simd, next, x, packed, y, argmax),
                    2 => self.column::<S, MR, 2>(simd, next, x, packed, y, argmax),
                    _ => self.column::<S, MR, 1>(simd, next, x, packed, y, argmax),
                }
            }
            next += count;
        }
    }

    /// Computes all channels of `NV` vectors of windows, counted through the images.
    ///
    /// # Safety
    /// Vectors `next..next + NV` exist, and `check` has passed.
    #[inline(always)]
    unsafe fn column<S: Simd, const MR: usize, const NV: usize>(
        &self,
        simd: S,
        next: usize,
        x: &[f32],
        packed: &[f32],
        y: &mut [f32],
        argmax: &mut [u32],
    ) {
        let mut starts = [x.as_ptr(); NV];
        let mut outs = [0; NV];
        let mut spans = [0; NV];
        for v in 0..NV {
            let image = (next + v) / self.spans.len();
            spans[v] = (next + v) % self.spans.len();
            let span = self.spans[spans[v]];
            starts[v] = x[image * self.layout.image() + span.start..].as_ptr();
            outs[v] = image * self.y_len() + span.out;
        }
        let taps = self.shape.taps();
        let panels = packed.chunks_exact(MR * (taps + 1));
        for (first, panel) in (0..self.shape.oc).step_by(MR).zip(panels) {
            let rows = MR.min(self.shape.oc - first);
            let (panel, _) = panel.as_chunks::<MR>();
            let mut bias = [[simd.splat(0.0); NV]; MR];
            for r in 0..MR {
                bias[r] = [simd.splat(panel[0][r]); NV];
            }
            let mut best = bias;
            let mut best_at = [[simd.splat(0.0); NV]; MR];
            for (place, taps) in self.taps.chunks_exact(taps).enumerate() {
                let mut sums = bias;
                // SAFETY: every lane of every tap lies in `x`, by `check`.
                unsafe { tile::<S, MR, NV, false>(simd, taps, starts, [S::LANES; NV], &panel[1..], &mut sums) };
                if place == 0 {
                    best = sums;
                    continue;
                }
                let at = simd.splat((place / WINDOW * self.shape.w + place % WINDOW) as f32);
                for r in 0..MR {
                    for v in 0..NV {
                        let larger = simd.greater(sums[r][v], best[r][v]);
                        best[r][v] = simd.select(larger, sums[r][v], best[r][v]);
                        best_at[r][v] = simd.select(larger, at, best_at[r][v]);
                    }
                }
            }
            for v in 0..NV {
                let lanes = self.spans[spans[v]].lanes;
                let count = lanes.count_ones() as usize;
                for r in 0..rows {
                    let out = outs[v] + (first + r) * self.windows;
                    // SAFETY: the outputs of the span lie in `y`, by `check`.
                    unsafe { simd.store_gathered(y.as_mut_ptr().add(out), best[r][v], lanes) };
                    if !argmax.is_empty() {
                        let mut indices = [0.0f32; MAX_LANES];
                        // SAFETY: both arrays have a place for every lane.
                        unsafe {
                            let firsts = simd.load(self.firsts[spans[v]].as_ptr());
                            let at = simd.mul_add(best_at[r][v], simd.splat(1.0), firsts);
                            simd.store_gathered(indices.as_mut_ptr(), at, lanes);
                        }
                        for (to, index) in argmax[out..][..count].iter_mut().zip(indices) {
                            *to = index as u32;
                        }
                    }
                }
            }
        }
    }
}

per_isa! {
    /// Copies images into the layout, as [`layout::copy`](crate::conv::layout::copy) does: row by row, which suits the many short rows of
    /// 16 phases. `to` is overwritten.
    fn split_phases<S>(_simd: S, shape: &ConvShape, layout: &Layout, x: &[f32], to: &mut [f32]) {
        let &ConvShape { h, w, .. } = shape;
        let Layout { rows, pitch, .. } = *layout;
        let plane = rows * pitch;
        // The columns of all four phases.
        let whole = (w / WINDOW).min(pitch);
        for (x, planes) in x.chunks_exact(h * w).zip(to.chunks_exact_mut(PLACES * plane)) {
            for (phase_y, phases) in planes.chunks_exact_mut(WINDOW * plane).enumerate() {
                let [first, second, third, fourth] = {
                    let (upper, lower) = phases.split_at_mut(2 * plane);
                    let ((first, second), (third, fourth)) = (upper.split_at_mut(plane), lower.split_at_mut(plane));
                    [first, second, third, fourth]
                };
                for row in 0..rows {
                    let at = row * pitch..(row + 1) * pitch;
                    let to = [&mut first[at.clone()], &mut second[at.clone()], &mut third[at.clone()], &mut fourth[at]];
                    let y = row * WINDOW + phase_y;
                    if y >= h {
                        to.into_iter().for_each(|to| to.fill(0.0));
                        continue;
                    }
                    let x = &x[y * w..][..w];
                    let [first, second, third, fourth] = to;
                    let columns = first[..whole].iter_mut().zip(&mut second[..whole]);
                    let columns = columns.zip(third[..whole].iter_mut().zip(&mut fourth[..whole]));
                    for (x, ((first, second), (third, fourth))) in x.as_chunks::<WINDOW>().0.iter().zip(columns) {
                        [*first, *second, *third, *fourth] = *x;
                    }
                    for (phase, to) in [first, second, third, fourth].into_iter().enumerate() {
                        for column in whole..pitch {
                            to[column] = x.get(column * WINDOW + phase).copied().unwrap_or(0.0);
                        }
                    }
                }
            }
        }
    }
}

per_isa! {
    /// Computes the copied images in `x` with packed weights; `y` and `argmax` are overwritten.
    fn run<S>(simd: S, windows: &Windows, x: &[f32], packed: &[f32], y: &mut [f32], argmax: &mut [u32]) {
        match tile_height(S::MANY_REGISTERS, windows.shape.oc) {
            8 if S::MANY_REGISTERS => windows.run_height::<S, 8>(simd, x, packed, y, argmax),
            6 => windows.run_height::<S, 6>(simd, x, packed, y, argmax),
            _ => windows.run_height::<S, 4>(simd, x, packed, y, argmax),
        }
    }
}
