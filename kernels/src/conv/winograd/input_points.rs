//! The points of the input and the taps on them, which the forward pass and the weight gradient share.

use std::ops::Range;

use super::rows_per_tile;
use super::strips::{Maps, Strip, Strips};
use crate::conv::ConvShape;
use crate::conv::prepare::Layout;
use crate::simd::Simd;

/// Taps of one row on the planes of a point, and the filters they stand for.
#[derive(Clone, Debug)]
pub(super) struct Taps {
    /// Where each lies in the planes of a point.
    pub offsets: Vec<usize>,
    /// Where its weight is for output channel 0, and how far apart channels are.
    pub weights: Vec<usize>,
    pub weight_stride: usize,
    pub phases: Vec<Phase>,
    /// The largest offset.
    pub farthest: usize,
}

impl Taps {
    pub fn new(offsets: Vec<usize>, weights: Vec<usize>, weight_stride: usize, phases: Vec<Phase>) -> Taps {
        let farthest = offsets.iter().max().copied().unwrap_or(0);
        Taps { offsets, weights, weight_stride, phases, farthest }
    }

    pub fn len(&self) -> usize {
        self.offsets.len()
    }
}

/// Taps whose filters have the same rows.
#[derive(Clone, Debug)]
pub(super) struct Phase {
    /// Which taps.
    pub taps: Range<usize>,
    /// How far from the weight of a tap those of its filter's rows are; rows it has not are 0.
    pub rows: [Option<usize>; 3],
    /// The points they have a use for: a filter of 2 rows can do without one.
    pub points: Range<usize>,
}

/// How images become points.
#[derive(Clone, Debug)]
pub(super) struct InputPoints {
    pub shape: ConvShape,
    pub strips: Strips,
    layout: Layout,
    /// Whether the stride makes four maps of each, all of which are used, and nothing is padded: no copy is needed then.
    pairs: bool,
}

impl InputPoints {
    /// The points of `shape` and the taps on them, if it gains. `most` tells from the rows of a tile, the planes of a point and the
    /// positions of a tile how many tiles go into a strip.
    pub fn new(shape: ConvShape, most: impl FnOnce(usize, usize, usize) -> usize) -> Option<(InputPoints, Taps)> {
        let ConvShape { c, kh, kw, stride_h, stride_w, .. } = shape;
        let (row_phases, column_phases) = (stride_h.min(kh), stride_w.min(kw));
        let rows_of = |phase: usize| (kh - phase).div_ceil(stride_h);
        if shape.out_pixels() == 0 {
            return None;
        }
        let rows = rows_per_tile(shape.out_h(), &(0..row_phases).map(rows_of).collect::<Vec<_>>(), shape.out_h() * kh)?;
        let layout = Layout::new(shape);
        let planes = c * row_phases * column_phases;
        let most = most(rows, planes, layout.pitch);
        let strips = Strips::new(rows, shape.out_h(), layout.pitch, kw.div_ceil(stride_w), most);
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
            phases.push(Phase {
                taps: first..offsets.len(),
                rows: std::array::from_fn(|j| (j < rows).then_some(j * stride_h * kw)),
                points: 0..strips.points() - usize::from(rows < 3),
            });
        }
        let taps = Taps::new(offsets, weights, shape.taps(), phases);
        let padded = shape.pad_top + shape.pad_bottom + shape.pad_left + shape.pad_right > 0;
        let pairs = !padded && [stride_h, stride_w, row_phases, column_phases] == [2; 4];
        Some((InputPoints { shape, strips, layout, pairs }, taps))
    }

    /// Maps of an image in the layout, which are the planes of a point.
    pub fn planes(&self) -> usize {
        self.layout.image() / (self.layout.rows * self.layout.pitch)
    }

    /// Elements of the planes of a point.
    pub fn stride(&self) -> usize {
        self.planes() * self.strips.plane
    }

    /// Elements of all points of a strip.
    pub fn len(&self) -> usize {
        self.strips.points() * self.stride()
    }

    /// Whether images are brought into the layout first.
    fn copies(&self) -> bool {
        self.layout.copies && !self.pairs
    }

    /// Elements of the images that are brought into the layout.
    pub fn copy_len(&self) -> usize {
        if self.copies() { self.strips.images * self.layout.image() } else { 0 }
    }

    /// Brings a group of images into the layout.
    #[inline(always)]
    pub fn lay_out<'a, S: Simd>(&self, simd: S, x: &'a [f32], copy: &'a mut [f32]) -> &'a [f32] {
        if !self.copies() {
            return x;
        }
        let copy = &mut copy[..x.len() / self.shape.x_len() * self.layout.image()];
        self.layout.copy(simd, x, copy);
        copy
    }

    /// The points of a strip of images in the layout.
    #[inline(always)]
    pub fn of_strip<S: Simd, const M: usize>(&self, simd: S, strip: Strip, from: &[f32], points: &mut [f32]) {
        if self.pairs {
            let ConvShape { c, h, w, .. } = self.shape;
            return self.strips.input_of_pairs::<S, M>(simd, strip, [h, w], c, from, points);
        }
        let maps = Maps { height: self.layout.rows, width: self.layout.pitch, above: 0, left: 0 };
        self.strips.input::<S, M>(simd, strip, maps, self.planes(), from, points);
    }
}
