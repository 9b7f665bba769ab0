//! The points of the input and the taps on them. The forward pass and the weight gradient share them.

use std::ops::Range;

use super::choice::rows_per_tile;
use super::strips::{Maps, Strip, Strips};
use super::tiles;
use crate::Isa;
use crate::conv::layout::{self, Layout};
use crate::conv_shape::ConvShape;

/// Taps of one row on the planes of a point. Each tap stands for a filter of up to 3 rows.
#[derive(Clone, Debug)]
pub(super) struct Taps {
    /// Offset of each tap in the planes of a point.
    pub offsets: Vec<usize>,
    /// Offset of the first weight of its filter, for output channel 0.
    pub weights: Vec<usize>,
    /// Distance between the weights of two output channels.
    pub weight_stride: usize,
    /// The filters, grouped by their rows.
    pub phases: Vec<Filters>,
    /// The largest offset.
    pub farthest: usize,
}

impl Taps {
    pub fn new(offsets: Vec<usize>, weights: Vec<usize>, weight_stride: usize, phases: Vec<Filters>) -> Taps {
        let farthest = offsets.iter().max().copied().unwrap_or(0);
        Taps { offsets, weights, weight_stride, phases, farthest }
    }

    pub fn len(&self) -> usize {
        self.offsets.len()
    }
}

/// Taps whose filters have the same rows: those of one phase.
#[derive(Clone, Debug)]
pub(super) struct Filters {
    /// The taps, as a range.
    pub taps: Range<usize>,
    /// Distance from the weight of a tap to each row of its filter; a missing row is 0.
    pub rows: [Option<usize>; 3],
    /// The points they need: a filter of 2 rows leaves one out.
    pub points: Range<usize>,
}

/// The transform of images to points.
#[derive(Clone, Debug)]
pub(super) struct InputPoints {
    pub shape: ConvShape,
    pub strips: Strips,
    layout: Layout,
    /// Whether strides of 2 make four maps of each map, all of them are used, and nothing is padded. Then no copy is needed.
    pairs: bool,
}

impl InputPoints {
    /// The points of `shape` and the taps on them, or `None` where the direct algorithm is as fast. `max_tiles` gives the number of
    /// tiles of a strip from the rows of a tile, the planes of a point and the positions of a tile.
    pub fn new(shape: ConvShape, max_tiles: impl FnOnce(usize, usize, usize) -> usize) -> Option<(InputPoints, Taps)> {
        let ConvShape { c, kh, kw, stride_h, stride_w, .. } = shape;
        let (row_phases, column_phases) = (stride_h.min(kh), stride_w.min(kw));
        let rows_of = |phase: usize| (kh - phase).div_ceil(stride_h);
        if shape.out_pixels() == 0 {
            return None;
        }
        let rows = rows_per_tile(shape.out_h(), &(0..row_phases).map(rows_of).collect::<Vec<_>>(), shape.out_h() * kh)?;
        let layout = Layout::new(shape);
        let planes = c * row_phases * column_phases;
        let max_tiles = max_tiles(rows, planes, layout.pitch);
        let strips = Strips::new(rows, shape.out_h(), layout.pitch, kw.div_ceil(stride_w), max_tiles);
        let (mut offsets, mut weights, mut phases) = (Vec::new(), Vec::new(), Vec::new());
        for phase in 0..row_phases {
            let first = offsets.len();
            for channel in 0..c {
                for kx in 0..kw {
                    let plane = (channel * row_phases + phase) * column_phases + kx % stride_w;
                    offsets.push(plane * strips.plane + kx / stride_w);
                    weights.push((channel * kh + phase) * kw + kx);
                }
            }
            let rows = rows_of(phase);
            phases.push(Filters {
                taps: first..offsets.len(),
                rows: std::array::from_fn(|j| (j < rows).then_some(j * stride_h * kw)),
                points: 0..strips.points() - usize::from(rows < 3),
            });
        }
        let taps = Taps::new(offsets, weights, shape.taps(), phases);
        let pairs = !shape.is_padded() && [stride_h, stride_w, row_phases, column_phases] == [2; 4];
        Some((InputPoints { shape, strips, layout, pairs }, taps))
    }

    /// Number of maps of an image in the layout, which are the planes of a point.
    pub fn planes(&self) -> usize {
        self.layout.image() / (self.layout.rows * self.layout.pitch)
    }

    /// Length of the planes of a point.
    pub fn stride(&self) -> usize {
        self.planes() * self.strips.plane
    }

    /// Length of all points of a strip.
    pub fn len(&self) -> usize {
        self.strips.points() * self.stride()
    }

    /// Whether images are copied into the layout first.
    fn copies(&self) -> bool {
        self.layout.copies && !self.pairs
    }

    /// Length of the copies of a group of images.
    pub fn copy_len(&self) -> usize {
        if self.copies() { self.strips.images * self.layout.image() } else { 0 }
    }

    /// A group of images in the layout, copied to `copy` where necessary.
    pub fn lay_out<'a>(&self, isa: Isa, x: &'a [f32], copy: &'a mut [f32]) -> &'a [f32] {
        if !self.copies() {
            return x;
        }
        let copy = &mut copy[..x.len() / self.shape.x_len() * self.layout.image()];
        layout::copy(isa, &self.layout, x, copy);
        copy
    }

    /// Writes the points of a strip of images in the layout.
    pub fn of_strip(&self, isa: Isa, strip: Strip, from: &[f32], points: &mut [f32]) {
        if self.pairs {
            let ConvShape { c, h, w, .. } = self.shape;
            return tiles::input_of_pairs(isa, &self.strips, strip, [h, w], c, from, points);
        }
        let maps = Maps { height: self.layout.rows, width: self.layout.pitch, above: 0, left: 0 };
        tiles::input(isa, &self.strips, strip, maps, self.planes(), from, points);
    }
}
