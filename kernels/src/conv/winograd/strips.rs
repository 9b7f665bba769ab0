//! How the rows of maps are cut into tiles, and where the points of a tile lie.

use std::ops::Range;

use super::transform::{self, MOST_POINTS, MOST_ROWS};
use crate::simd::{MOST_LANES, Simd, put_first};

/// Images that are worked on together when each has few rows.
const MOST_IMAGES: usize = 8;

/// Tiles of rows, and how many of them go through a pass together.
///
/// A strip is `per_strip` tiles of each of `images` images. Its points are kept as planes `[point][plane][position]`: in a
/// plane the tiles follow each other image by image, each `pitch` positions wide, so vectors run on across tiles and
/// images and only the last is not full.
#[derive(Clone, Debug)]
pub(super) struct Strips {
    /// Rows of the output in a tile, M: 2 or 4.
    pub rows: usize,
    /// Tiles of a map.
    pub tiles: usize,
    /// Positions of a tile.
    pub pitch: usize,
    /// Tiles of an image in a strip, and images in it; more than one image only if all tiles are.
    pub per_strip: usize,
    pub images: usize,
    /// Elements of a plane: room for whole vectors shifted by every tap, which reach less than `reach` beyond the positions.
    pub plane: usize,
    reach: usize,
}

/// Where in a plane of points a strip lies, and how much there is in it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Strip {
    pub images: usize,
    pub first_tile: usize,
    pub tiles: usize,
}

impl Strips {
    /// Cuts maps of `height` rows into tiles of `rows`, `pitch` positions wide, of which up to `most`, but at least one, go into a
    /// strip. Taps shift vectors by less than `shifts`.
    pub fn new(rows: usize, height: usize, pitch: usize, shifts: usize, most: usize) -> Strips {
        let tiles = height.div_ceil(rows);
        let most = most.max(1);
        let per_strip = tiles.div_ceil(tiles.div_ceil(most));
        let images = if per_strip < tiles { 1 } else { (most / tiles).clamp(1, MOST_IMAGES) };
        let reach = MOST_LANES + shifts;
        let plane = (images * per_strip * pitch + reach).next_multiple_of(MOST_LANES);
        // An odd number of cache lines, so that the same positions of many planes do not compete for the same places.
        let plane = if (plane / MOST_LANES).is_multiple_of(2) { plane + MOST_LANES } else { plane };
        Strips { rows, tiles, pitch, per_strip, images, plane, reach }
    }

    /// How many points a tile has.
    pub fn points(&self) -> usize {
        self.rows + 2
    }

    /// The strips of up to [`Strips::images`] images.
    pub fn of(&self, images: usize) -> impl Iterator<Item = Strip> {
        let (tiles, per_strip) = (self.tiles, self.per_strip);
        (0..tiles).step_by(per_strip).map(move |first_tile| Strip {
            images,
            first_tile,
            tiles: per_strip.min(tiles - first_tile),
        })
    }

    /// The part of what comes after the strips of `images` images, `next`, that is to be fetched during `strip`.
    pub fn upcoming<'a>(&self, strip: Strip, next: &'a [f32]) -> &'a [f32] {
        let part = |tile: usize| next.len() * tile / self.tiles;
        &next[part(strip.first_tile)..part(strip.first_tile + strip.tiles)]
    }

    /// Positions of a plane that a strip fills.
    pub fn used(&self, strip: Strip) -> usize {
        strip.images * strip.tiles * self.pitch
    }

    /// The points of the input `from`, whose images are `per_image` maps each, into planes `[point][per_image][plane]`.
    ///
    /// Tile `t` is rows `t M - above` to `t M - above + M + 1` of a map, and column `i` is written to position `i + left`;
    /// what lies outside the map is 0.
    #[inline(always)]
    pub fn input<S: Simd, const M: usize>(
        &self,
        simd: S,
        strip: Strip,
        maps: Maps,
        per_image: usize,
        from: &[f32],
        points: &mut [f32],
    ) {
        let Maps { height, width, above, left } = maps;
        let stride = per_image * self.plane;
        for map in 0..per_image {
            for image in 0..strip.images {
                let from = &from[(image * per_image + map) * height * width..][..height * width];
                for tile in 0..strip.tiles {
                    let at = map * self.plane + self.position(strip, image, tile);
                    let top = (strip.first_tile + tile) * M;
                    if left > 0 || width < self.pitch {
                        for point in 0..M + 2 {
                            let to = &mut points[point * stride + at..][..self.pitch];
                            to[..left].fill(0.0);
                            to[left + width..].fill(0.0);
                        }
                    }
                    // Rows of the tile that the map has: all but at its border.
                    let has = above.saturating_sub(top).min(M + 2)..(height + above).saturating_sub(top).min(M + 2);
                    let first = (top + has.start).saturating_sub(above);
                    let to = &mut points[at + left..];
                    // A range known to be all needs no tests.
                    if has == (0..M + 2) {
                        input_tile::<S, M>(simd, &from[first * width..], width, 0..M + 2, stride, to);
                    } else {
                        input_tile::<S, M>(simd, &from[first * width..], width, has, stride, to);
                    }
                }
            }
        }
    }

    /// As [`Strips::input`] with the maps that a stride of 2 makes of those of `from`: `channels` of `height` times `width` in an
    /// image, each of which is four maps, even rows before odd ones and in these even columns before odd ones.
    #[inline(always)]
    pub fn input_of_pairs<S: Simd, const M: usize>(
        &self,
        simd: S,
        strip: Strip,
        [height, width]: [usize; 2],
        channels: usize,
        from: &[f32],
        points: &mut [f32],
    ) {
        let stride = 4 * channels * self.plane;
        for channel in 0..channels {
            for image in 0..strip.images {
                let from = &from[(image * channels + channel) * height * width..][..height * width];
                for tile in 0..strip.tiles {
                    let at = self.position(strip, image, tile);
                    for odd in 0..2 {
                        let top = 2 * (strip.first_tile + tile) * M + odd;
                        let rows = height.saturating_sub(top).div_ceil(2).min(M + 2);
                        let to = &mut points[(4 * channel + 2 * odd) * self.plane + at..];
                        let from = &from[top.min(height) * width..];
                        // A number known to be all needs no tests.
                        if rows == M + 2 {
                            pairs_tile::<S, M>(simd, from, width, M + 2, [self.pitch, self.plane, stride], to);
                        } else {
                            pairs_tile::<S, M>(simd, from, width, rows, [self.pitch, self.plane, stride], to);
                        }
                    }
                }
            }
        }
    }

    /// The points of the gradient `dy` of the output, whose images are `per_image` maps of `height` times `width` each,
    /// into planes `[point][per_image][plane]`, 0 between the tiles.
    #[inline(always)]
    pub fn output_gradient<S: Simd, const M: usize>(
        &self,
        simd: S,
        strip: Strip,
        [height, width]: [usize; 2],
        per_image: usize,
        dy: &[f32],
        points: &mut [f32],
    ) {
        let stride = per_image * self.plane;
        for map in 0..per_image {
            for image in 0..strip.images {
                let dy = &dy[(image * per_image + map) * height * width..][..height * width];
                for tile in 0..strip.tiles {
                    let at = map * self.plane + self.position(strip, image, tile);
                    let first = (strip.first_tile + tile) * M;
                    let rows = M.min(height - first);
                    let (dy, to) = (&dy[first * width..], &mut points[at..]);
                    // A number known to be all needs no tests.
                    if rows == M {
                        output_gradient_tile::<S, M>(simd, dy, width, M, stride, to);
                    } else {
                        output_gradient_tile::<S, M>(simd, dy, width, rows, stride, to);
                    }
                    for point in 0..M + 2 {
                        for at in (width..self.pitch).step_by(S::LANES) {
                            put_first(simd, to, point * stride + at, simd.splat(0.0), self.pitch - at);
                        }
                    }
                }
            }
        }
    }

    /// Where a tile begins in a plane.
    fn position(&self, strip: Strip, image: usize, tile: usize) -> usize {
        (image * strip.tiles + tile) * self.pitch
    }

    /// Zeros after the strip in a plane of each point, as far as the taps shift the last vector.
    #[inline(always)]
    pub fn clear_rest<S: Simd>(&self, simd: S, strip: Strip, points: &mut [f32]) {
        let used = self.used(strip);
        for plane in points.chunks_exact_mut(self.plane) {
            for at in (used..used + self.reach).step_by(S::LANES) {
                put_first(simd, plane, at, simd.splat(0.0), self.plane - at);
            }
        }
    }
}

/// The maps of an input, and where their first element lies in the first tile.
#[derive(Clone, Copy, Debug)]
pub(super) struct Maps {
    pub height: usize,
    pub width: usize,
    /// Rows of zeros above.
    pub above: usize,
    /// Columns of zeros on the left.
    pub left: usize,
}

/// The points of one tile, `stride` apart, from those of its rows that are there, one after the other in `from`.
#[inline(always)]
fn input_tile<S: Simd, const M: usize>(
    simd: S,
    from: &[f32],
    width: usize,
    has: Range<usize>,
    stride: usize,
    to: &mut [f32],
) {
    assert!(has.end <= M + 2 && from.len() >= has.len() * width, "winograd: a row is missing");
    assert!(to.len() >= (M + 1) * stride + width, "winograd: too little room for the points");
    for column in (0..width).step_by(S::LANES) {
        let count = S::LANES.min(width - column);
        // SAFETY: `from` holds `width` elements of every row, and `to` as many at every point.
        unsafe {
            // Two calls, of which the first knows that the vectors are whole.
            let (from, to) = (from.as_ptr().add(column), to.as_mut_ptr().add(column));
            if count == S::LANES {
                input_column::<S, M>(simd, from, width, &has, stride, to, S::LANES);
            } else {
                input_column::<S, M>(simd, from, width, &has, stride, to, count);
            }
        }
    }
}

/// `count` positions of [`input_tile`].
///
/// # Safety
/// `count` elements of each row that is there are readable, `width` apart, and as many writable at each point.
#[inline(always)]
unsafe fn input_column<S: Simd, const M: usize>(
    simd: S,
    from: *const f32,
    width: usize,
    has: &Range<usize>,
    stride: usize,
    to: *mut f32,
    count: usize,
) {
    let mut d = [simd.splat(0.0); MOST_POINTS];
    // SAFETY: as the caller promises.
    unsafe {
        for i in 0..M + 2 {
            if has.contains(&i) {
                d[i] = simd.load_first(from.add((i - has.start) * width), count);
            }
        }
        let p = transform::input::<S, M>(simd, d);
        for u in 0..M + 2 {
            simd.store_first(to.add(u * stride), p[u], count);
        }
    }
}

/// The points of one tile of each of two maps, `plane` apart: that of the even columns and that of the odd ones of every second
/// row of `from`, of which there are `rows`. Maps have `pitch` columns; what `from` has not is 0.
#[inline(always)]
fn pairs_tile<S: Simd, const M: usize>(
    simd: S,
    from: &[f32],
    width: usize,
    rows: usize,
    [pitch, plane, stride]: [usize; 3],
    to: &mut [f32],
) {
    assert!(rows <= M + 2 && (rows == 0 || from.len() >= (2 * rows - 1) * width), "winograd: a row is missing");
    assert!(to.len() >= (M + 1) * stride + plane + pitch, "winograd: too little room for the points");
    assert!(pitch <= width.div_ceil(2), "winograd: maps wider than their columns");
    for column in (0..pitch).step_by(S::LANES) {
        let there = width - 2 * column;
        let mut d = [[simd.splat(0.0); MOST_POINTS]; 2];
        for i in 0..rows {
            // SAFETY: a row of `from` has as many elements as are there, and `ends` has room for two vectors.
            let [even, odd] = unsafe {
                let from = from.as_ptr().add(2 * i * width + 2 * column);
                if there >= 2 * S::LANES {
                    simd.load_pairs(from, S::LANES)
                } else {
                    let mut ends = [0.0; 2 * MOST_LANES];
                    simd.store(ends.as_mut_ptr(), simd.load_first(from, there.min(S::LANES)));
                    let rest = there.saturating_sub(S::LANES);
                    simd.store(ends.as_mut_ptr().add(S::LANES), simd.load_first(from.wrapping_add(S::LANES), rest));
                    simd.load_pairs(ends.as_ptr(), S::LANES)
                }
            };
            (d[0][i], d[1][i]) = (simd.to_memory_order(even), simd.to_memory_order(odd));
        }
        let count = S::LANES.min(pitch - column);
        for (map, d) in d.into_iter().enumerate() {
            let p = transform::input::<S, M>(simd, d);
            for u in 0..M + 2 {
                // SAFETY: `to` has `pitch` elements of each point of both maps.
                unsafe { simd.store_first(to.as_mut_ptr().add(u * stride + map * plane + column), p[u], count) };
            }
        }
    }
}

/// The points of the gradient of one tile, `stride` apart, from that of the `rows` rows it has.
#[inline(always)]
fn output_gradient_tile<S: Simd, const M: usize>(
    simd: S,
    dy: &[f32],
    width: usize,
    rows: usize,
    stride: usize,
    to: &mut [f32],
) {
    assert!(rows <= M && dy.len() >= rows * width, "winograd: a row is missing");
    assert!(to.len() >= (M + 1) * stride + width, "winograd: too little room for the points");
    for column in (0..width).step_by(S::LANES) {
        let count = S::LANES.min(width - column);
        // SAFETY: `dy` holds `width` elements of every row, and `to` as many at every point.
        unsafe {
            // Two calls, of which the first knows that the vectors are whole.
            let (dy, to) = (dy.as_ptr().add(column), to.as_mut_ptr().add(column));
            if count == S::LANES {
                output_gradient_column::<S, M>(simd, dy, width, rows, stride, to, S::LANES);
            } else {
                output_gradient_column::<S, M>(simd, dy, width, rows, stride, to, count);
            }
        }
    }
}

/// `count` positions of [`output_gradient_tile`].
///
/// # Safety
/// `count` elements of each of `rows` rows are readable, `width` apart, and as many writable at each point.
#[inline(always)]
unsafe fn output_gradient_column<S: Simd, const M: usize>(
    simd: S,
    dy: *const f32,
    width: usize,
    rows: usize,
    stride: usize,
    to: *mut f32,
    count: usize,
) {
    let mut d = [simd.splat(0.0); MOST_ROWS];
    // SAFETY: as the caller promises.
    unsafe {
        for i in 0..rows {
            d[i] = simd.load_first(dy.add(i * width), count);
        }
        let p = transform::output_gradient::<S, M>(simd, d);
        for u in 0..M + 2 {
            simd.store_first(to.add(u * stride), p[u], count);
        }
    }
}

/// The first `len` elements, or all there are, and the rest.
pub(super) fn head(all: &[f32], len: usize) -> (&[f32], &[f32]) {
    all.split_at(len.min(all.len()))
}
