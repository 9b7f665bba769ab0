//! The forward pass.

use super::input_points::InputPoints;
use super::point_sum::{PointSum, Target};
use super::strips::head;
use super::{BUDGET, FEWEST_TAPS};
use crate::conv::ConvShape;
use crate::simd::{ALIGNMENT, Simd, align};

/// The forward pass of one shape.
#[derive(Clone, Debug)]
pub(crate) struct Forward {
    input: InputPoints,
    sum: PointSum,
}

impl Forward {
    /// The pass over `shape`, if it gains.
    pub fn new(shape: ConvShape) -> Option<Forward> {
        let most = |rows: usize, planes: usize, positions: usize| BUDGET / ((rows + 2) * planes * positions);
        let (input, taps) = InputPoints::new(shape, most)?;
        if taps.len() < FEWEST_TAPS {
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
        Some(Forward { input, sum })
    }

    /// Elements of [`Forward::run`]'s scratch.
    pub fn scratch_len(&self) -> usize {
        self.input.copy_len() + self.input.len() + ALIGNMENT
    }

    /// Elements of [`Forward::pack`]'s result.
    pub fn packed_len(&self) -> usize {
        self.sum.packed_len(self.input.strips.rows)
    }

    /// Packs the points of the filters, and the bias, for [`Forward::run`].
    #[inline(always)]
    pub fn pack<S: Simd>(&self, simd: S, weight: &[f32], bias: &[f32], packed: &mut [f32]) {
        match self.input.strips.rows {
            2 => self.sum.pack::<S, 2>(simd, Some(bias), weight, packed),
            _ => self.sum.pack::<S, 4>(simd, Some(bias), weight, packed),
        }
    }

    /// Computes the images in `x` with weights from [`Forward::pack`]; `y` is overwritten.
    #[inline(always)]
    pub fn run<S: Simd>(&self, simd: S, x: &[f32], packed: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        match self.input.strips.rows {
            2 => self.run_tiles::<S, 2>(simd, x, packed, y, scratch),
            _ => self.run_tiles::<S, 4>(simd, x, packed, y, scratch),
        }
    }

    #[inline(always)]
    fn run_tiles<S: Simd, const M: usize>(
        &self,
        simd: S,
        x: &[f32],
        packed: &[f32],
        y: &mut [f32],
        scratch: &mut [f32],
    ) {
        let InputPoints { shape, strips, .. } = &self.input;
        let (points, copy) = align(scratch).split_at_mut(self.input.len());
        let (x_group, y_group) = (strips.images * shape.x_len(), strips.images * shape.y_len());
        for (group, y) in y.chunks_mut(y_group).enumerate() {
            let (x, next) = head(&x[group * x_group..], x_group);
            let from = self.input.lay_out(simd, x, copy);
            for strip in strips.of(y.len() / shape.y_len()) {
                self.input.of_strip::<S, M>(simd, strip, from, points);
                let upcoming = strips.upcoming(strip, head(next, x_group).0);
                self.sum.run::<S, M>(simd, strips, strip, points, packed, y, upcoming);
            }
        }
    }
}
