//! From the points of the input to the rows of the output.
//!
//! For each position and output channel, the value of the output at a point is a sum over the taps of one row. A tile is 8 channels
//! by 3 vectors of positions, or less, as in `tap_sum`. It goes through the points one after the other, with the kernel of
//! `tap_sum`. Its values at all points stay in the first-level cache until they are transformed to rows of the output. Each value
//! is one chain of multiply-adds in the order of the taps, whatever the tile it falls in.

use std::ops::Range;

use super::input_points::Taps;
use super::strips::{Strip, Strips};
use super::transform::{self, MAX_POINTS, POINT_ONE};
use crate::Isa;
use crate::conv::tap_sum::{MAX_CHANNELS, tile, tile_height};
use crate::simd::{MAX_LANES, Purpose, Simd, prefetch_part};

/// The place of the positions of the tiles in the output.
#[derive(Clone, Debug)]
pub(super) struct Target {
    /// The rows that the output has, counted from the first tile.
    pub rows: Range<usize>,
    /// The columns that the output has, counted from the first position.
    pub columns: Range<usize>,
    /// Offset of the first of these rows and columns in a map of the output.
    pub first: usize,
    /// Distance between two rows in a map of the output.
    pub row_step: usize,
    /// Distance between two columns in a map of the output.
    pub column_step: usize,
    /// Length of a map.
    pub map: usize,
}

/// The tables of the sums.
#[derive(Clone, Debug)]
pub(super) struct PointSum {
    pub taps: Taps,
    /// Output channels.
    pub channels: usize,
    /// Length of the planes of a point.
    pub stride: usize,
    pub target: Target,
}

/// Vectors of a strip, from number `next` on.
#[derive(Clone, Copy)]
struct Column<'a> {
    strips: &'a Strips,
    strip: Strip,
    next: usize,
}

/// A run of lanes that lie in one tile.
#[derive(Clone, Copy, Debug, Default)]
struct Segment {
    lane: usize,
    count: usize,
    /// The first row of the tile that the output has, and the one behind the last.
    rows: (usize, usize),
    /// Offset of the first of these rows in the output, for channel 0.
    out: usize,
}

/// The segments of a vector.
#[derive(Clone, Copy)]
struct Segments {
    list: [Segment; MAX_LANES],
    count: usize,
}

per_isa! {
    /// Computes the rows of a strip from the points of the input, with packed weights from [`PointSum::pack`]. Meanwhile it prefetches
    /// `upcoming`, the data that is read next.
    pub(super) fn run<S>(
        simd: S,
        sum: &PointSum,
        strips: &Strips,
        strip: Strip,
        points: &[f32],
        packed: &[f32],
        out: &mut [f32],
        upcoming: &[f32],
    ) {
        match strips.rows {
            2 => sum.run_tiles::<S, 2>(simd, strips, strip, points, packed, out, upcoming),
            _ => sum.run_tiles::<S, 4>(simd, strips, strip, points, packed, out, upcoming),
        }
    }
}

impl PointSum {
    /// Length of the packed weights and bias, enough for tiles of any height.
    pub fn packed_len(&self, rows: usize) -> usize {
        (self.channels + MAX_CHANNELS) * (self.taps.len() * (rows + 2) + 1)
    }

    /// Packs bias (`None`: 0) and the points of the filters for tiles of `rows` rows. Each tile of channels has a panel: the bias of
    /// its channels, then their weights, point by point and tap by tap.
    pub fn pack(&self, isa: Isa, rows: usize, bias: Option<&[f32]>, weight: &[f32], packed: &mut [f32]) {
        match rows {
            2 => self.pack_tiles::<2>(isa, bias, weight, packed),
            _ => self.pack_tiles::<4>(isa, bias, weight, packed),
        }
    }

    fn pack_tiles<const M: usize>(&self, isa: Isa, bias: Option<&[f32]>, weight: &[f32], packed: &mut [f32]) {
        let height = tile_height(isa.has_many_registers(), self.channels);
        let of_point = self.taps.len() * height;
        let panels = packed.chunks_exact_mut(height + of_point * (M + 2));
        for (first, panel) in (0..self.channels).step_by(height).zip(panels) {
            panel.fill(0.0);
            let channels = height.min(self.channels - first);
            let (to_bias, to) = panel.split_at_mut(height);
            if let Some(bias) = bias {
                to_bias[..channels].copy_from_slice(&bias[first..first + channels]);
            }
            for phase in &self.taps.phases {
                for tap in phase.taps.clone() {
                    for r in 0..channels {
                        let weight = &weight[self.taps.weights[tap] + (first + r) * self.taps.weight_stride..];
                        let mut filter = [0.0; 3];
                        for (row, at) in filter.iter_mut().zip(phase.rows) {
                            *row = at.map_or(0.0, |at| weight[at]);
                        }
                        let points = transform::filter::<M>(filter);
                        for u in 0..M + 2 {
                            to[u * of_point + tap * height + r] = points[u];
                        }
                    }
                }
            }
        }
    }

    #[inline(always)]
    fn run_tiles<S: Simd, const M: usize>(
        &self,
        simd: S,
        strips: &Strips,
        strip: Strip,
        points: &[f32],
        packed: &[f32],
        out: &mut [f32],
        upcoming: &[f32],
    ) {
        match tile_height(S::MANY_REGISTERS, self.channels) {
            8 if S::MANY_REGISTERS => {
                self.run_height::<S, M, 8>(simd, strips, strip, points, packed, out, upcoming);
            }
            6 => self.run_height::<S, M, 6>(simd, strips, strip, points, packed, out, upcoming),
            _ => self.run_height::<S, M, 4>(simd, strips, strip, points, packed, out, upcoming),
        }
    }

    #[inline(always)]
    fn run_height<S: Simd, const M: usize, const MR: usize>(
        &self,
        simd: S,
        strips: &Strips,
        strip: Strip,
        points: &[f32],
        packed: &[f32],
        out: &mut [f32],
        upcoming: &[f32],
    ) {
        let panel_len = MR * (1 + self.taps.len() * (M + 2));
        assert!(packed.len() >= self.channels.div_ceil(MR) * panel_len, "point sum: packed weights are too short");
        let vectors = strips.used(strip).div_ceil(S::LANES);
        let mut next = 0;
        let mut values = [[[simd.splat(0.0); 3]; MR]; MAX_POINTS];
        while next < vectors {
            // Four vectors are better two and two than three and one.
            let count = match vectors - next {
                1 => 1,
                3 | 5.. if S::MANY_REGISTERS => 3,
                _ => 2,
            };
            let place = Column { strips, strip, next };
            match count {
                3 if S::MANY_REGISTERS => self.column::<S, M, MR, 3>(simd, place, points, packed, out, &mut values),
                2 => self.column::<S, M, MR, 2>(simd, place, points, packed, out, &mut values),
                _ => self.column::<S, M, MR, 1>(simd, place, points, packed, out, &mut values),
            }
            (next..next + count).for_each(|vector| prefetch_part(simd, upcoming, vector, vectors));
            next += count;
        }
    }

    /// Computes all channels of the `NV` vectors from number `next` on.
    #[inline(always)]
    fn column<S: Simd, const M: usize, const MR: usize, const NV: usize>(
        &self,
        simd: S,
        place: Column,
        points: &[f32],
        packed: &[f32],
        out: &mut [f32],
        values: &mut [[[S::V; 3]; MR]; MAX_POINTS],
    ) {
        let Column { strips, strip, next } = place;
        let last = (M + 1) * self.stride + (next + NV) * S::LANES + self.taps.farthest;
        assert!(last <= points.len(), "point sum: too few points");
        let mut segments = [Segments { list: [Segment::default(); MAX_LANES], count: 0 }; NV];
        for v in 0..NV {
            segments[v] = self.segments::<S, M>(strips, strip, (next + v) * S::LANES, out.len());
        }
        // Whether the vectors are one run in whole tiles.
        let plain = self.target.column_step == 1
            && (0..NV).all(|v| {
                let segment = segments[v].list[0];
                segment.count == S::LANES
                    && segment.rows == (0, M)
                    && segment.out == segments[0].list[0].out + v * S::LANES
            });
        let taps = self.taps.len();
        for (first, panel) in (0..self.channels).step_by(MR).zip(packed.chunks_exact(MR * (1 + taps * (M + 2)))) {
            let rows = MR.min(self.channels - first);
            for r in 0..rows {
                for segments in &segments {
                    for segment in &segments.list[..segments.count] {
                        self.prefetch::<S>(simd, *segment, first + r, out);
                    }
                }
            }
            let (panel, _) = panel.as_chunks::<MR>();
            for u in 0..M + 2 {
                let mut sums = [[simd.splat(0.0); NV]; MR];
                if u == POINT_ONE {
                    for r in 0..MR {
                        sums[r] = [simd.splat(panel[0][r]); NV];
                    }
                }
                let mut starts = [points.as_ptr(); NV];
                for v in 0..NV {
                    starts[v] = points[u * self.stride + (next + v) * S::LANES..].as_ptr();
                }
                for phase in self.taps.phases.iter().filter(|phase| phase.points.contains(&u)) {
                    let weights = &panel[1 + u * taps..][phase.taps.clone()];
                    let taps = &self.taps.offsets[phase.taps.clone()];
                    // SAFETY: the last vector of the last point may be read in full at the farthest tap, as asserted.
                    unsafe { tile::<S, MR, NV, false>(simd, taps, starts, [S::LANES; NV], weights, &mut sums) };
                }
                for r in 0..MR {
                    values[u][r][..NV].copy_from_slice(&sums[r]);
                }
            }
            for r in 0..rows {
                let first_out = segments[0].list[0].out + (first + r) * self.target.map;
                for v in 0..NV {
                    let mut m = [simd.splat(0.0); MAX_POINTS];
                    for u in 0..M + 2 {
                        m[u] = values[u][r][v];
                    }
                    let rows = transform::output::<S, M>(simd, m);
                    if plain {
                        for i in 0..M {
                            // SAFETY: `segments` has checked that the last row of the last channel lies in `out`.
                            unsafe {
                                let to = out.as_mut_ptr().add(first_out + i * self.target.row_step + v * S::LANES);
                                simd.store(to, rows[i]);
                            }
                        }
                        continue;
                    }
                    for segment in &segments[v].list[..segments[v].count] {
                        let at = segment.out + (first + r) * self.target.map;
                        // SAFETY: `segments` has checked that the last row of the last channel lies in `out`.
                        unsafe { self.store::<S, M>(simd, *segment, rows, out.as_mut_ptr().add(at)) };
                    }
                }
            }
        }
    }

    /// Prefetches the cache lines of a segment's rows, which are about to be written.
    #[inline(always)]
    fn prefetch<S: Simd>(&self, simd: S, segment: Segment, channel: usize, out: &[f32]) {
        let at = segment.out + channel * self.target.map;
        for row in 0..segment.rows.1 - segment.rows.0 {
            let at = at + row * self.target.row_step;
            simd.prefetch(out.as_ptr().wrapping_add(at), Purpose::Write);
            if self.target.column_step > 1 {
                simd.prefetch(out.as_ptr().wrapping_add(at + S::LANES), Purpose::Write);
            }
        }
    }

    /// Cuts the vector at `position` into runs of lanes that the output has, one tile each.
    #[inline(always)]
    fn segments<S: Simd, const M: usize>(
        &self,
        strips: &Strips,
        strip: Strip,
        position: usize,
        out_len: usize,
    ) -> Segments {
        let Target { rows, columns, first, row_step, column_step, map } = &self.target;
        let mut segments = Segments { list: [Segment::default(); MAX_LANES], count: 0 };
        let end = (position + S::LANES).min(strips.used(strip));
        let mut at = position;
        while at < end {
            let (tile, column) = (at / strips.pitch, at % strips.pitch);
            let next = end.min(at - column + strips.pitch);
            let (from, to) = (column.max(columns.start), (column + next - at).min(columns.end));
            let (image, first_row) = (tile / strip.tiles, (strip.first_tile + tile % strip.tiles) * M);
            let (top, bottom) = (first_row.max(rows.start), (first_row + M).min(rows.end));
            if from < to && top < bottom {
                let out = image * self.channels * map
                    + first
                    + (top - rows.start) * row_step
                    + (from - columns.start) * column_step;
                let last =
                    out + (self.channels - 1) * map + (bottom - 1 - top) * row_step + (to - 1 - from) * column_step;
                assert!(last < out_len && segments.count < MAX_LANES, "point sum: the output is too short");
                segments.list[segments.count] = Segment {
                    lane: at - position + from - column,
                    count: to - from,
                    rows: (top - first_row, bottom - first_row),
                    out,
                };
                segments.count += 1;
            }
            at = next;
        }
        segments
    }

    /// Writes the lanes of a segment of each row.
    ///
    /// # Safety
    /// All elements of the segment, from `to` on, lie in the output.
    #[inline(always)]
    unsafe fn store<S: Simd, const M: usize>(
        &self,
        simd: S,
        segment: Segment,
        rows: [S::V; transform::MAX_ROWS],
        to: *mut f32,
    ) {
        let Segment { lane, count, rows: (top, bottom), .. } = segment;
        let Target { row_step, column_step, .. } = self.target;
        for i in 0..M {
            if i < top || i >= bottom {
                continue;
            }
            // SAFETY: as the caller promises: row `i`, and `count` elements `column_step` apart.
            unsafe {
                let to = to.add((i - top) * row_step);
                if column_step == 1 && count == S::LANES {
                    simd.store(to, rows[i]);
                } else if column_step == 1 {
                    simd.store_gathered(to, rows[i], ((1u32 << count) - 1) << lane);
                } else if column_step == 2 && lane == 0 {
                    simd.store_every_second(to, rows[i], count);
                } else {
                    let mut lanes = [0.0; MAX_LANES];
                    simd.store(lanes.as_mut_ptr(), rows[i]);
                    for (step, value) in lanes[lane..lane + count].iter().enumerate() {
                        *to.add(step * column_step) = *value;
                    }
                }
            }
        }
    }
}
