//! Vectors along the output channels: for maps of so few windows that vectors along these would be half empty.
//!
//! A tile is one or two rows of places of a window by one or two vectors of channels. For each tap it loads the weights of the channels
//! and multiplies them by the input at each place.

use super::{Output, WINDOW};
use crate::Isa;
use crate::conv_shape::ConvShape;
use crate::simd::{MAX_LANES, Simd};

/// Vectors of channels in a tile.
const VECTORS: usize = 2;

/// The tables of a shape.
#[derive(Clone, Debug)]
pub(super) struct Channels {
    shape: ConvShape,
    isa: Isa,
    /// The offset of each tap in an image.
    taps: Vec<usize>,
    /// Where each window begins in a plane of the input.
    windows: Vec<usize>,
}

impl Channels {
    /// For convolutions with strides of 1 and no padding.
    pub fn new(shape: ConvShape, isa: Isa) -> Channels {
        let ConvShape { c, h, w, kh, kw, .. } = shape;
        let taps = (0..c * kh * kw).map(|tap| (tap / (kh * kw) * h + tap / kw % kh) * w + tap % kw).collect();
        let (out_h, out_w) = (shape.out_h() / WINDOW, shape.out_w() / WINDOW);
        let windows = (0..out_h * out_w).map(|at| (at / out_w * w + at % out_w) * WINDOW).collect();
        Channels { shape, isa, taps, windows }
    }

    /// The share of the lanes that hold a channel.
    pub fn lanes_used(&self) -> f64 {
        self.shape.oc as f64 / self.shape.oc.next_multiple_of(self.isa.lanes()) as f64
    }

    /// Length of the packed weights and bias.
    pub fn packed_len(&self) -> usize {
        self.shape.oc.next_multiple_of(self.isa.lanes()) * (self.taps.len() + 1)
    }

    /// Packs weights and bias for [`Channels::forward`]: for each vector of channels the bias, then the weights tap by tap.
    pub fn pack(&self, weight: &[f32], bias: &[f32], packed: &mut [f32]) {
        let (lanes, taps) = (self.isa.lanes(), self.taps.len());
        for (vector, to) in packed.chunks_exact_mut(lanes * (taps + 1)).enumerate() {
            for (row, to) in to.chunks_exact_mut(lanes).enumerate() {
                for (lane, to) in to.iter_mut().enumerate() {
                    let channel = vector * lanes + lane;
                    *to = match row {
                        _ if channel >= self.shape.oc => 0.0,
                        0 => bias[channel],
                        _ => weight[channel * taps + row - 1],
                    };
                }
            }
        }
    }

    /// Computes the images in `x` with packed weights from [`Channels::pack`].
    pub fn forward(&self, x: &[f32], packed: &[f32], output: Output) {
        run(self.isa, self, x, packed, output);
    }

    /// Computes `NV` vectors of channels, from the first one of `panels` on, of all windows of an image. `ROWS` rows of places make
    /// a tile.
    #[inline(always)]
    fn vectors<S: Simd, const NV: usize, const ROWS: usize>(
        &self,
        simd: S,
        x: &[f32],
        panels: &[f32],
        first_channel: usize,
        output: Output,
    ) {
        let Output { y, argmax } = output;
        let taps = self.taps.len();
        let panel = S::LANES * (taps + 1);
        assert!(panels.len() >= NV * panel, "pooled conv: packed weights are too short");
        let w = self.shape.w;
        let reach = (WINDOW - 1) * w + WINDOW - 1 + self.taps.last().copied().unwrap_or(0);
        let count = self.windows.len();
        for (number, &window) in self.windows.iter().enumerate() {
            // The last tap is the farthest, and the last place of a window as well.
            assert!(window + reach < x.len(), "pooled conv: input too short");
            let mut best = [simd.splat(f32::NEG_INFINITY); NV];
            let mut best_at = [simd.splat(window as f32); NV];
            for rows in 0..WINDOW / ROWS {
                let mut sums = [[[simd.splat(0.0); NV]; WINDOW]; ROWS];
                // SAFETY: a panel holds the bias and `taps` weights of `LANES` channels; every place of the window finds the
                // input of every tap in `x`, as asserted.
                unsafe {
                    let mut bias = [simd.splat(0.0); NV];
                    for v in 0..NV {
                        bias[v] = simd.load(panels.as_ptr().add(v * panel));
                    }
                    for row in 0..ROWS {
                        sums[row] = [bias; WINDOW];
                    }
                    for (number, &tap) in self.taps.iter().enumerate() {
                        let mut weights = [simd.splat(0.0); NV];
                        for v in 0..NV {
                            weights[v] = simd.load(panels.as_ptr().add(v * panel + (number + 1) * S::LANES));
                        }
                        for row in 0..ROWS {
                            let at = window + (rows * ROWS + row) * w + tap;
                            for column in 0..WINDOW {
                                let x = simd.splat(*x.get_unchecked(at + column));
                                for v in 0..NV {
                                    sums[row][column][v] = simd.mul_add(x, weights[v], sums[row][column][v]);
                                }
                            }
                        }
                    }
                }
                for row in 0..ROWS {
                    for column in 0..WINDOW {
                        let row_of_window = rows * ROWS + row;
                        let sums = sums[row][column];
                        if row_of_window == 0 && column == 0 {
                            best = sums;
                            continue;
                        }
                        let at = simd.splat((window + row_of_window * w + column) as f32);
                        for v in 0..NV {
                            let larger = simd.greater(sums[v], best[v]);
                            best[v] = simd.select(larger, sums[v], best[v]);
                            best_at[v] = simd.select(larger, at, best_at[v]);
                        }
                    }
                }
            }
            for v in 0..NV {
                let (mut largest, mut index) = ([0.0f32; MAX_LANES], [0.0f32; MAX_LANES]);
                // SAFETY: both arrays have a place for every lane.
                unsafe {
                    simd.store(largest.as_mut_ptr(), best[v]);
                    simd.store(index.as_mut_ptr(), best_at[v]);
                }
                let channels = first_channel + v * S::LANES..self.shape.oc.min(first_channel + (v + 1) * S::LANES);
                for (lane, channel) in channels.enumerate() {
                    y[channel * count + number] = largest[lane];
                    if !argmax.is_empty() {
                        argmax[channel * count + number] = index[lane] as u32;
                    }
                }
            }
        }
    }
}

per_isa! {
    /// Computes whole images; `y` and `argmax` are overwritten.
    fn run<S>(simd: S, conv: &Channels, x: &[f32], packed: &[f32], output: Output) {
        let Output { y, argmax } = output;
        let y_len = conv.shape.oc * conv.windows.len();
        let panel = S::LANES * (conv.taps.len() + 1);
        for (image, (x, y)) in x.chunks_exact(conv.shape.x_len()).zip(y.chunks_exact_mut(y_len)).enumerate() {
            for (number, panels) in packed.chunks(VECTORS * panel).enumerate() {
                let argmax = if argmax.is_empty() { &mut [] } else { &mut argmax[image * y_len..][..y_len] };
                let output = Output { y: &mut *y, argmax };
                let first = number * VECTORS * S::LANES;
                if panels.len() >= VECTORS * panel && S::MANY_REGISTERS {
                    conv.vectors::<S, VECTORS, 2>(simd, x, panels, first, output);
                } else if panels.len() >= VECTORS * panel {
                    conv.vectors::<S, VECTORS, 1>(simd, x, panels, first, output);
                } else {
                    conv.vectors::<S, 1, 2>(simd, x, panels, first, output);
                }
            }
        }
    }
}
