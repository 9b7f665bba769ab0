//! The input gradient of the direct algorithm, as a convolution of the output gradient.
//!
//! Forward is `y[o][oy][ox] = bias[o] + sum over c, ky, kx of weight[o][c][ky][kx] * x[c][oy * s + ky - pad][ox * s + kx - pad]`,
//! so `dx[c][iy][ix]` is the sum of `weight[o][c][ky][kx] * dy[o][oy][ox]` over all `oy * s + ky - pad = iy` and
//! `ox * s + kx - pad = ix`. With `iy + pad = q * s + r`, the taps that touch input row `iy` are `ky = r + j * s`, and they
//! meet the output rows `q - j`. So for each remainder `r` the gradient is a sum of stride 1 over the zero-padded output
//! gradient. The same holds for columns. With stride 1 there is one remainder, and the sum is written to `dx` directly; else each
//! phase is computed in scratch and then written to its rows and columns of `dx`.

use super::direct::FORWARD_COPIES;
use super::layout::{group_of, put_every};
use super::phase::{Phase, phases};
use super::span::{self, Span};
use super::tap_sum::{self, Band, TapSum};
use crate::Isa;
use crate::conv_shape::ConvShape;
use crate::simd::MAX_LANES;

/// The work of the bands: vectors times taps.
fn work(bands: &[Band]) -> usize {
    bands.iter().map(|band| band.spans.len() * band.taps.len()).sum()
}

/// The spans of a phase, and the bands they fall into; each row of the kernel has `row_taps` taps.
///
/// Row `q` of the phase meets the output rows `q - j`. Taps of output rows that do not exist would multiply zeros. So the rows that
/// meet all output rows are one band, and each row at the border is a band of its own, unless short rows would leave more
/// lanes idle than that saves.
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
            spans.extend(span::spans(end - from, columns, pitch, lanes).into_iter().map(|span| Span {
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

/// The input positions of one phase of rows and one of columns.
#[derive(Clone, Debug)]
struct Part {
    rows: Phase,
    columns: Phase,
    sum: TapSum,
}

/// How much work the sum over taps may do for each multiply-add that counts; the rest goes to zeros and idle lanes. Beyond
/// that, the matrix product of [`patch_gradient`](super::patch_gradient) is faster: by a quarter to a third on 3x18 and 3x20
/// maps. At 2.1 times, on a 5x22 map, it is slower by a quarter.
const MAX_WORK: f64 = 2.5;

/// The tables of the input gradient of one shape.
#[derive(Clone, Debug)]
pub(crate) struct InputGradient {
    shape: ConvShape,
    parts: Vec<Part>,
    /// Rows and columns of zeros before the output gradient.
    before: (usize, usize),
    /// Rows and columns of a padded plane.
    padded: (usize, usize),
    isa: Isa,
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
        InputGradient { shape, parts, before, padded, isa }
    }

    /// Whether the sum over taps would spend most of its work on zeros and idle lanes.
    pub fn mostly_multiplies_zeros(&self) -> bool {
        let ConvShape { c, .. } = self.shape;
        let work: usize = self.parts.iter().map(|part| work(&part.sum.bands) * self.isa.lanes() * c).sum();
        work as f64 > MAX_WORK * self.shape.multiply_adds() as f64
    }

    /// Length of one padded output gradient.
    fn image(&self) -> usize {
        self.shape.oc * self.padded.0 * self.padded.1
    }

    /// Length of the largest phase of one image.
    fn phase_len(&self) -> usize {
        let phase = self.parts.iter().map(|part| part.sum.channels * part.sum.plane).max().unwrap_or(0);
        if self.direct() { 0 } else { phase }
    }

    /// Whether the single part is the whole input gradient.
    fn direct(&self) -> bool {
        self.shape.stride_h == 1 && self.shape.stride_w == 1
    }

    /// Length of the scratch of [`InputGradient::run`].
    pub fn scratch_len(&self) -> usize {
        group_of(self.image(), FORWARD_COPIES) * (self.image() + self.phase_len()) + MAX_LANES
    }

    /// Length of the packed weights.
    pub fn packed_len(&self) -> usize {
        self.parts.iter().map(|part| part.sum.packed_len()).sum()
    }

    /// Packs the weights for [`InputGradient::run`].
    pub fn pack(&self, weight: &[f32], packed: &mut [f32]) {
        let mut rest = packed;
        for part in &self.parts {
            let (to, after) = rest.split_at_mut(part.sum.packed_len());
            rest = after;
            part.sum.pack(self.isa, None, weight, to);
        }
    }

    /// Copies output gradients `[oc][out_h][out_w]` into zero-padded planes.
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

    /// The input gradient of the images in `dy`, with packed weights from [`InputGradient::pack`]; `dx` is overwritten.
    pub fn run(&self, dy: &[f32], packed: &[f32], dx: &mut [f32], scratch: &mut [f32]) {
        let group = group_of(self.image(), FORWARD_COPIES);
        let (phase, copy) = scratch.split_at_mut(group * self.phase_len());
        // Input that no window touches keeps this zero; with stride 1 the single part writes everything.
        if !self.direct() || self.parts.is_empty() {
            dx.fill(0.0);
        }
        let groups = dy.chunks(group * self.shape.y_len()).zip(dx.chunks_mut(group * self.shape.x_len()));
        for (dy, dx) in groups {
            let images = dy.len() / self.shape.y_len();
            let used = images * self.image();
            self.pad(dy, &mut copy[..used]);
            copy[used..used + MAX_LANES].fill(0.0);
            let padded = &copy[..used + MAX_LANES];
            let mut rest = packed;
            for part in &self.parts {
                let (packed, after) = rest.split_at(part.sum.packed_len());
                rest = after;
                if self.direct() {
                    tap_sum::run(self.isa, &part.sum, padded, packed, dx);
                } else {
                    let phase = &mut phase[..images * self.shape.c * part.sum.plane];
                    tap_sum::run(self.isa, &part.sum, padded, packed, phase);
                    put_phase(self.isa, &self.shape, part, phase, dx);
                }
            }
        }
    }
}

per_isa! {
    /// Writes the rows and columns of one part into the images `dx`.
    fn put_phase<S>(simd: S, shape: &ConvShape, part: &Part, phase: &[f32], dx: &mut [f32]) {
        let &ConvShape { h, w, stride_h, stride_w, pad_top, pad_left, .. } = shape;
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
