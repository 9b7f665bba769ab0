//! The input gradient, as a convolution of the output gradient.
//!
//! With `iy + pad_top = q stride + r`, the taps that touch input row `iy` are `ky = r + j stride`, and they meet the
//! output rows `q - j`: for each remainder `r` the gradient is a sum of stride 1 over the zero-padded output gradient.
//! The same holds for columns. With stride 1 there is one remainder, and the sum is written to `dx` directly; else the
//! phases are computed side by side in scratch and woven into `dx`.
//!
//! A map of few rows is mostly border, where this sum multiplies zeros. There each window's gradient is computed once,
//! `dy' W`, as a matrix product, and the windows are added up where they overlap.

use super::direct::{Band, TapSum};
use super::grid::Span;
use super::prepare::put_every;
use super::{ConvShape, FORWARD_COPIES, grid, group_of};
use crate::Isa;
use crate::gemm::{gemm, gemm_scratch_len};
use crate::im2col::col2im;
use crate::simd::{MOST_LANES, Simd};

/// The rows, or columns, of the input that leave one remainder.
#[derive(Clone, Copy, Debug)]
pub(super) struct Phase {
    /// The remainder.
    pub remainder: usize,
    /// Number of taps that touch them.
    pub taps: usize,
    /// The first quotient `q`, and how many there are.
    pub first: usize,
    pub count: usize,
}

/// The phases of one direction that have any rows and taps.
pub(super) fn phases(len: usize, kernel: usize, stride: usize, pad: usize) -> Vec<Phase> {
    let phase = |remainder: usize| {
        let first = pad.saturating_sub(remainder).div_ceil(stride);
        let end = (len + pad).saturating_sub(remainder).div_ceil(stride);
        Phase { remainder, taps: (kernel - remainder).div_ceil(stride), first, count: end.saturating_sub(first) }
    };
    (0..stride.min(kernel)).map(phase).filter(|phase| phase.count > 0).collect()
}

/// Vectors times taps.
fn work(bands: &[Band]) -> usize {
    bands.iter().map(|band| band.spans.len() * band.taps.len()).sum()
}

/// The positions of a phase, and the bands they fall into, `row_taps` taps for each row of the kernel.
///
/// Row `q` of the phase meets the output rows `q - j`; where those do not exist, the taps would multiply zeros. Rows that
/// meet all are one band, those at the border one each, unless short rows then leave more lanes idle than that saves.
fn bands_of(
    rows: Phase,
    columns: usize,
    out_h: usize,
    row_taps: usize,
    pitch: usize,
    lanes: usize,
) -> (Vec<Span>, Vec<Band>) {
    let met = |q: usize| {
        let first = (q + 1).saturating_sub(out_h).min(rows.taps);
        first * row_taps..rows.taps.min(q + 1).max(first) * row_taps
    };
    let cut = |same: &dyn Fn(usize, usize) -> bool| {
        let (mut spans, mut bands, mut from) = (Vec::new(), Vec::new(), 0);
        while from < rows.count {
            let end = (from..rows.count).find(|&row| !same(from, row)).unwrap_or(rows.count);
            let first_span = spans.len();
            spans.extend(grid::spans(end - from, columns, pitch, lanes).into_iter().map(|span| Span {
                start: span.start + from * pitch,
                out: span.out + from * columns,
                lanes: span.lanes,
            }));
            let taps =
                (from..end).map(|row| met(rows.first + row)).reduce(|a, b| a.start.min(b.start)..a.end.max(b.end));
            bands.push(Band { spans: first_span..spans.len(), taps: taps.unwrap_or(0..0) });
            from = end;
        }
        (spans, bands)
    };
    let by_rows = cut(&|a, b| met(rows.first + a) == met(rows.first + b));
    let together = cut(&|_, _| true);
    if work(&by_rows.1) < work(&together.1) { by_rows } else { together }
}

/// Where one remainder of rows and one of columns meet.
#[derive(Clone, Debug)]
struct Part {
    rows: Phase,
    columns: Phase,
    sum: TapSum,
}

/// The share of multiplications that the sum over taps may waste on zeros and idle lanes: beyond 2.5 times the work
/// that counts, the matrix product wins in the benches (3x18 and 3x20 maps: by a quarter to a third; at 2.1 times, a
/// 5x22 map, it loses by a quarter).
const MOST_WORK: f64 = 2.5;

/// The tables of the input gradient of one shape.
#[derive(Clone, Debug)]
pub(crate) struct InputGradient {
    shape: ConvShape,
    parts: Vec<Part>,
    /// Rows and columns of zeros before the output gradient, and the sizes of a padded plane.
    before: (usize, usize),
    padded: (usize, usize),
    /// Whether the matrix product is used instead.
    by_product: bool,
}

impl InputGradient {
    pub fn new(shape: ConvShape, isa: Isa) -> InputGradient {
        let ConvShape { c, h, w, oc, kh, kw, stride_h, stride_w, .. } = shape;
        let (all_rows, all_columns) = (phases(h, kh, stride_h, shape.pad_top), phases(w, kw, stride_w, shape.pad_left));
        let before = ((kh - 1) / stride_h, (kw - 1) / stride_w);
        let end = |phases: &[Phase]| phases.iter().map(|p| p.first + p.count).max().unwrap_or(0);
        let padded = (before.0 + end(&all_rows).max(shape.out_h()), before.1 + end(&all_columns).max(shape.out_w()));
        let mut parts = Vec::new();
        for &rows in &all_rows {
            for &columns in &all_columns {
                // Row by row of the kernel, so that the rows of an image that miss some of them miss a run of taps.
                let (mut taps, mut weights) = (Vec::new(), Vec::new());
                for j in 0..rows.taps {
                    for o in 0..oc {
                        for i in 0..columns.taps {
                            let (up, left) = (rows.taps - 1 - j, columns.taps - 1 - i);
                            taps.push((o * padded.0 + up) * padded.1 + left);
                            let (ky, kx) = (rows.remainder + j * stride_h, columns.remainder + i * stride_w);
                            weights.push((o * c * kh + ky) * kw + kx);
                        }
                    }
                }
                let (top, left) = (before.0 + 1 - rows.taps, before.1 + 1 - columns.taps);
                let (spans, bands) =
                    bands_of(rows, columns.count, shape.out_h(), oc * columns.taps, padded.1, isa.lanes());
                let sum = TapSum {
                    taps,
                    weights,
                    weight_stride: kh * kw,
                    spans,
                    bands,
                    origin: (rows.first + top) * padded.1 + columns.first + left,
                    in_image: oc * padded.0 * padded.1,
                    channels: c,
                    plane: rows.count * columns.count,
                };
                parts.push(Part { rows, columns, sum });
            }
        }
        let work: usize = parts.iter().map(|part| work(&part.sum.bands) * isa.lanes() * c).sum();
        let by_product = work as f64 > MOST_WORK * shape.multiply_adds() as f64;
        InputGradient { shape, parts, before, padded, by_product }
    }

    /// Elements of one padded output gradient.
    fn image(&self) -> usize {
        self.shape.oc * self.padded.0 * self.padded.1
    }

    /// Elements of the largest phase of one image.
    fn phase_len(&self) -> usize {
        let phase = self.parts.iter().map(|part| part.sum.channels * part.sum.plane).max().unwrap_or(0);
        if self.direct() { 0 } else { phase }
    }

    /// Whether the gradient is a matrix product.
    pub fn by_product(&self) -> bool {
        self.by_product
    }

    /// Whether the single part is the whole input gradient.
    fn direct(&self) -> bool {
        self.shape.stride_h == 1 && self.shape.stride_w == 1
    }

    /// Elements of [`run`]'s scratch.
    pub fn scratch_len(&self) -> usize {
        if self.by_product {
            let (pixels, taps) = (self.shape.out_pixels(), self.shape.taps());
            return pixels * taps + gemm_scratch_len(pixels, self.shape.oc, taps);
        }
        group_of(self.image(), FORWARD_COPIES) * (self.image() + self.phase_len()) + MOST_LANES
    }

    /// Elements of [`InputGradient::pack`]'s result.
    pub fn packed_len(&self) -> usize {
        if self.by_product {
            self.shape.oc * self.shape.taps()
        } else {
            self.parts.iter().map(|part| part.sum.packed_len()).sum()
        }
    }

    /// Puts the weights in the order in which [`run`] reads them.
    #[inline(always)]
    pub fn pack<S: Simd>(&self, simd: S, weight: &[f32], packed: &mut [f32]) {
        if self.by_product {
            packed.copy_from_slice(weight);
            return;
        }
        let mut rest = packed;
        for part in &self.parts {
            let (to, after) = rest.split_at_mut(part.sum.packed_len());
            rest = after;
            part.sum.pack(simd, None, weight, to);
        }
    }

    /// Copies output gradients `[oc][out_h][out_w]` into zero-padded planes.
    #[inline(always)]
    fn pad(&self, dy: &[f32], to: &mut [f32]) {
        let (out_h, out_w) = (self.shape.out_h(), self.shape.out_w());
        let planes = dy.chunks_exact(out_h * out_w);
        for (dy, to) in planes.zip(to.chunks_exact_mut(self.padded.0 * self.padded.1)) {
            to.fill(0.0);
            for (dy, to) in dy.chunks_exact(out_w).zip(to.chunks_exact_mut(self.padded.1).skip(self.before.0)) {
                to[self.before.1..][..out_w].copy_from_slice(dy);
            }
        }
    }

    /// Writes the rows and columns of one part into the images `dx`.
    #[inline(always)]
    fn weave<S: Simd>(&self, simd: S, part: &Part, phase: &[f32], dx: &mut [f32]) {
        let ConvShape { h, w, stride_h, stride_w, pad_top, pad_left, .. } = self.shape;
        let (rows, columns) = (part.rows, part.columns);
        let left = columns.first * stride_w + columns.remainder - pad_left;
        for (phase, dx) in phase.chunks_exact(part.sum.plane).zip(dx.chunks_exact_mut(h * w)) {
            for (q, from) in phase.chunks_exact(columns.count).enumerate() {
                let iy = (rows.first + q) * stride_h + rows.remainder - pad_top;
                put_every(simd, from, stride_w, &mut dx[iy * w + left..(iy + 1) * w]);
            }
        }
    }
}

/// The input gradient of the images in `dy`, with weights from [`InputGradient::pack`]; `dx` is overwritten.
pub(crate) fn run(isa: Isa, gradient: &InputGradient, dy: &[f32], packed: &[f32], dx: &mut [f32], scratch: &mut [f32]) {
    if !gradient.by_product {
        return by_taps(isa, gradient, dy, packed, dx, scratch);
    }
    let shape = &gradient.shape;
    let (pixels, taps) = (shape.out_pixels(), shape.taps());
    let (patches, scratch) = scratch.split_at_mut(pixels * taps);
    dx.fill(0.0);
    for (dy, dx) in dy.chunks_exact(shape.y_len()).zip(dx.chunks_exact_mut(shape.x_len())) {
        let (m, k, n) = (pixels, shape.oc, taps);
        gemm(isa, m, k, n, 1.0, dy, (1, pixels), packed, (taps, 1), 0.0, patches, (taps, 1), scratch);
        col2im(shape, patches, dx);
    }
}

per_isa! {
    fn by_taps<S>(
        simd: S,
        gradient: &InputGradient,
        dy: &[f32],
        packed: &[f32],
        dx: &mut [f32],
        scratch: &mut [f32],
    ) {
        let c = gradient.shape.c;
        let group = group_of(gradient.image(), FORWARD_COPIES);
        let (phase, copy) = scratch.split_at_mut(group * gradient.phase_len());

        // Input that no window touches keeps this zero; with stride 1 the single part writes everything.
        if !gradient.direct() || gradient.parts.is_empty() {
            dx.fill(0.0);
        }
        let groups = dy.chunks(group * gradient.shape.y_len()).zip(dx.chunks_mut(group * gradient.shape.x_len()));
        for (dy, dx) in groups {
            let images = dy.len() / gradient.shape.y_len();
            let used = images * gradient.image();
            gradient.pad(dy, &mut copy[..used]);
            copy[used..used + MOST_LANES].fill(0.0);
            let padded = &copy[..used + MOST_LANES];
            let mut rest = packed;
            for part in &gradient.parts {
                let (packed, after) = rest.split_at(part.sum.packed_len());
                rest = after;
                if gradient.direct() {
                    part.sum.run(simd, padded, packed, dx);
                } else {
                    let phase = &mut phase[..images * c * part.sum.plane];
                    part.sum.run(simd, padded, packed, phase);
                    gradient.weave(simd, part, phase, dx);
                }
            }
        }
    }
}
