//! The input gradient of minimal filtering: a sum over the zero-padded output gradient, phase by phase, as in the direct
//! algorithm (`conv/input_gradient.rs`, which derives it from the forward pass).
//!
//! For its row `q`, each phase reads rows `q - 2` to `q` of the output gradient, so all phases share its points. A phase of 2 taps
//! has a first tap of 0 here, and its first point is left out.

use super::choice::{BUDGET, rows_per_tile};
use super::input_points::{Filters, Taps};
use super::point_sum::{self, PointSum, Target};
use super::strips::{Maps, Strips, head};
use super::tiles;
use crate::Isa;
use crate::conv::phase::{Phase, phases};
use crate::conv_shape::ConvShape;
use crate::simd::{ALIGNMENT, align};

/// Rows of the output gradient above row `q` that the points of row `q` need.
const ABOVE: usize = 2;

/// The tables of the input gradient of one shape.
#[derive(Clone, Debug)]
pub(crate) struct InputGradient {
    isa: Isa,
    shape: ConvShape,
    strips: Strips,
    /// Columns of zeros before the output gradient.
    left: usize,
    /// One sum for each phase of rows and of columns.
    parts: Vec<PointSum>,
}

impl InputGradient {
    /// The input gradient of `shape`, or `None` where the direct algorithm is as fast.
    pub fn new(shape: ConvShape, isa: Isa) -> Option<InputGradient> {
        let ConvShape { c, h, w, oc, kh, kw, stride_h, stride_w, .. } = shape;
        let (all_rows, all_columns) = (phases(h, kh, stride_h, shape.pad_top), phases(w, kw, stride_w, shape.pad_left));
        let end = |phases: &[Phase]| phases.iter().map(|phase| phase.first + phase.count).max().unwrap_or(0);
        let (height, left) = (end(&all_rows), (kw - 1) / stride_w);
        if height == 0 || end(&all_columns) == 0 || shape.out_pixels() == 0 {
            return None;
        }
        // The direct algorithm leaves out most of the zeros beyond the border.
        let direct = shape.out_h() * kh;
        let tile_rows = rows_per_tile(height, &all_rows.iter().map(|phase| phase.taps).collect::<Vec<_>>(), direct)?;
        let pitch = left + end(&all_columns).max(shape.out_w());
        let strips = Strips::new(tile_rows, height, pitch, left + 1, BUDGET / ((tile_rows + 2) * oc * pitch));
        let part = |rows: Phase, columns: Phase| {
            let (mut offsets, mut weights) = (Vec::new(), Vec::new());
            for o in 0..oc {
                for i in 0..columns.taps {
                    offsets.push(o * strips.plane + left - i);
                    weights.push((o * c * kh + rows.remainder) * kw + columns.remainder + i * stride_w);
                }
            }
            let filters = Filters {
                taps: 0..offsets.len(),
                rows: std::array::from_fn(|row| (ABOVE - row < rows.taps).then_some((ABOVE - row) * stride_h * kw)),
                points: usize::from(rows.taps < 3)..strips.points(),
            };
            let first_row = rows.first * stride_h + rows.remainder - shape.pad_top;
            let target = Target {
                rows: rows.first..rows.first + rows.count,
                columns: columns.first..columns.first + columns.count,
                first: first_row * w + columns.first * stride_w + columns.remainder - shape.pad_left,
                row_step: stride_h * w,
                column_step: stride_w,
                map: h * w,
            };
            let taps = Taps::new(offsets, weights, kh * kw, vec![filters]);
            PointSum { taps, channels: c, stride: oc * strips.plane, target }
        };
        let parts = all_rows.iter().flat_map(|&rows| all_columns.iter().map(move |&columns| (rows, columns)));
        let parts = parts.map(|(rows, columns)| part(rows, columns)).collect();
        Some(InputGradient { isa, shape, strips, left, parts })
    }

    /// Length of the points of the output gradient.
    fn points_len(&self) -> usize {
        self.strips.points() * self.strips.plane * self.shape.oc
    }

    /// Length of the scratch of [`InputGradient::run`].
    pub fn scratch_len(&self) -> usize {
        self.points_len() + ALIGNMENT
    }

    /// Length of the packed weights.
    pub fn packed_len(&self) -> usize {
        self.parts.iter().map(|part| part.packed_len(self.strips.rows)).sum()
    }

    /// Packs the points of the filters for [`InputGradient::run`].
    pub fn pack(&self, weight: &[f32], packed: &mut [f32]) {
        let mut rest = packed;
        for part in &self.parts {
            let (packed, after) = rest.split_at_mut(part.packed_len(self.strips.rows));
            rest = after;
            part.pack(self.isa, self.strips.rows, None, weight, packed);
        }
    }

    /// Computes the gradient of the images in `dy` with packed weights from [`InputGradient::pack`]; `dx` is overwritten.
    pub fn run(&self, dy: &[f32], packed: &[f32], dx: &mut [f32], scratch: &mut [f32]) {
        let &InputGradient { isa, ref shape, ref strips, left, ref parts } = self;
        let maps = Maps { height: shape.out_h(), width: shape.out_w(), above: ABOVE, left };
        let points = &mut align(scratch)[..self.points_len()];
        // Input that no window touches keeps this zero; with stride 1 the single part writes everything.
        if shape.stride_h > 1 || shape.stride_w > 1 {
            dx.fill(0.0);
        }
        let (x_group, y_group) = (strips.images * shape.x_len(), strips.images * shape.y_len());
        for (group, dx) in dx.chunks_mut(x_group).enumerate() {
            let (dy, next) = head(&dy[group * y_group..], y_group);
            for strip in strips.of(dy.len() / shape.y_len()) {
                tiles::input(isa, strips, strip, maps, shape.oc, dy, points);
                let mut rest = packed;
                let mut upcoming = strips.upcoming(strip, head(next, y_group).0);
                for part in parts {
                    let (packed, after) = rest.split_at(part.packed_len(strips.rows));
                    rest = after;
                    point_sum::run(isa, part, strips, strip, points, packed, dx, upcoming);
                    upcoming = &[];
                }
            }
        }
    }
}
