//! The forward pass of minimal filtering.

use super::choice::{BUDGET, MIN_TAPS};
use super::input_points::InputPoints;
use super::point_sum::{self, PointSum, Target};
use super::strips::head;
use crate::Isa;
use crate::conv_shape::ConvShape;
use crate::simd::{ALIGNMENT, align};

/// The forward pass of one shape.
#[derive(Clone, Debug)]
pub(crate) struct Forward {
    isa: Isa,
    input: InputPoints,
    sum: PointSum,
}

impl Forward {
    /// The forward pass of `shape`, or `None` where the direct algorithm is as fast.
    pub fn new(shape: ConvShape, isa: Isa) -> Option<Forward> {
        let max_tiles = |rows: usize, planes: usize, positions: usize| BUDGET / ((rows + 2) * planes * positions);
        let (input, taps) = InputPoints::new(shape, max_tiles)?;
        if taps.len() < MIN_TAPS {
            return None;
        }
        let target = Target {
            rows: 0..shape.out_h(),
            columns: 0..shape.out_w(),
            first: 0,
            row_step: shape.out_w(),
            column_step: 1,
            map: shape.out_pixels(),
        };
        let sum = PointSum { taps, channels: shape.oc, stride: input.stride(), target };
        Some(Forward { isa, input, sum })
    }

    /// Length of the scratch of [`Forward::run`].
    pub fn scratch_len(&self) -> usize {
        self.input.copy_len() + self.input.len() + ALIGNMENT
    }

    /// Length of the packed weights and bias.
    pub fn packed_len(&self) -> usize {
        self.sum.packed_len(self.input.strips.rows)
    }

    /// Packs the points of the filters, and the bias, for [`Forward::run`].
    pub fn pack(&self, weight: &[f32], bias: &[f32], packed: &mut [f32]) {
        self.sum.pack(self.isa, self.input.strips.rows, Some(bias), weight, packed);
    }

    /// Computes the images in `x` with packed weights from [`Forward::pack`]; `y` is overwritten.
    pub fn run(&self, x: &[f32], packed: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        let InputPoints { shape, strips, .. } = &self.input;
        let (points, copy) = align(scratch).split_at_mut(self.input.len());
        let (x_group, y_group) = (strips.images * shape.x_len(), strips.images * shape.y_len());
        for (group, y) in y.chunks_mut(y_group).enumerate() {
            let (x, next) = head(&x[group * x_group..], x_group);
            let from = self.input.lay_out(self.isa, x, copy);
            for strip in strips.of(y.len() / shape.y_len()) {
                self.input.of_strip(self.isa, strip, from, points);
                let upcoming = strips.upcoming(strip, head(next, x_group).0);
                point_sum::run(self.isa, &self.sum, strips, strip, points, packed, y, upcoming);
            }
        }
    }
}
