//! The transforms of whole strips: from maps to planes of points.

use std::ops::Range;

use super::strips::{Maps, Strip, Strips};
use super::transform::{self, MAX_POINTS, MAX_ROWS};
use crate::simd::{MAX_LANES, Simd, put_first};

per_isa! {
    /// Writes the points of the input `from`, whose images are `per_image` maps each, into planes `[point][per_image][plane]`.
    ///
    /// With tiles of M rows, tile `t` needs rows `t * M - above` to `t * M - above + M + 1` of a map. Column `i` is written to position
    /// `i + left`; what lies outside the map is 0.
    pub(super) fn input<S>(
        simd: S,
        strips: &Strips,
        strip: Strip,
        maps: Maps,
        per_image: usize,
        from: &[f32],
        points: &mut [f32],
    ) {
        match strips.rows {
            2 => input_tiles::<S, 2>(simd, strips, strip, maps, per_image, from, points),
            _ => input_tiles::<S, 4>(simd, strips, strip, maps, per_image, from, points),
        }
    }
}

per_isa! {
    /// As [`input`], for strides of 2. An image of `from` has `channels` channels of `size` (height, width). Each channel becomes
    /// four maps: even rows before odd ones, and in these even columns before odd ones.
    pub(super) fn input_of_pairs<S>(
        simd: S,
        strips: &Strips,
        strip: Strip,
        size: [usize; 2],
        channels: usize,
        from: &[f32],
        points: &mut [f32],
    ) {
        match strips.rows {
            2 => input_of_pairs_tiles::<S, 2>(simd, strips, strip, size, channels, from, points),
            _ => input_of_pairs_tiles::<S, 4>(simd, strips, strip, size, channels, from, points),
        }
    }
}

per_isa! {
    /// Writes the points of the output gradient `dy`, whose images are `per_image` maps of `size` (height, width) each, into planes
    /// `[point][per_image][plane]`; positions between the tiles are 0.
    pub(super) fn output_gradient<S>(
        simd: S,
        strips: &Strips,
        strip: Strip,
        size: [usize; 2],
        per_image: usize,
        dy: &[f32],
        points: &mut [f32],
    ) {
        match strips.rows {
            2 => output_gradient_tiles::<S, 2>(simd, strips, strip, size, per_image, dy, points),
            _ => output_gradient_tiles::<S, 4>(simd, strips, strip, size, per_image, dy, points),
        }
    }
}

per_isa! {
    /// Writes zeros behind the strip in a plane of each point, as far as the taps shift the last vector.
    pub(super) fn clear_rest<S>(simd: S, strips: &Strips, strip: Strip, points: &mut [f32]) {
        let used = strips.used(strip);
        for plane in points.chunks_exact_mut(strips.plane) {
            for at in (used..used + strips.reach).step_by(S::LANES) {
                put_first(simd, plane, at, simd.splat(0.0), strips.plane - at);
            }
        }
    }
}

/// [`input`] with tiles of `M` rows.
#[inline(always)]
fn input_tiles<S: Simd, const M: usize>(
    simd: S,
    strips: &Strips,
    strip: Strip,
    maps: Maps,
    per_image: usize,
    from: &[f32],
    points: &mut [f32],
) {
    let Maps { height, width, above, left } = maps;
    let stride = per_image * strips.plane;
    for map in 0..per_image {
        for image in 0..strip.images {
            let from = &from[(image * per_image + map) * height * width..][..height * width];
            for tile in 0..strip.tiles {
                let at = map * strips.plane + strips.position(strip, image, tile);
                let top = (strip.first_tile + tile) * M;
                if left > 0 || width < strips.pitch {
                    for point in 0..M + 2 {
                        let to = &mut points[point * stride + at..][..strips.pitch];
                        to[..left].fill(0.0);
                        to[left + width..].fill(0.0);
                    }
                }
                // The rows of the tile that lie in the map: all but at its border.
                let has = above.saturating_sub(top).min(M + 2)..(height + above).saturating_sub(top).min(M + 2);
                let first = (top + has.start).saturating_sub(above);
                let to = &mut points[at + left..];
                // The compiler sees a constant range here and leaves out the tests.
                if has == (0..M + 2) {
                    input_tile::<S, M>(simd, &from[first * width..], width, 0..M + 2, stride, to);
                } else {
                    input_tile::<S, M>(simd, &from[first * width..], width, has, stride, to);
                }
            }
        }
    }
}

/// [`input_of_pairs`] with tiles of `M` rows.
#[inline(always)]
fn input_of_pairs_tiles<S: Simd, const M: usize>(
    simd: S,
    strips: &Strips,
    strip: Strip,
    [height, width]: [usize; 2],
    channels: usize,
    from: &[f32],
    points: &mut [f32],
) {
    let stride = 4 * channels * strips.plane;
    for channel in 0..channels {
        for image in 0..strip.images {
            let from = &from[(image * channels + channel) * height * width..][..height * width];
            for tile in 0..strip.tiles {
                let at = strips.position(strip, image, tile);
                for odd in 0..2 {
                    let top = 2 * (strip.first_tile + tile) * M + odd;
                    let rows = height.saturating_sub(top).div_ceil(2).min(M + 2);
                    let to = &mut points[(4 * channel + 2 * odd) * strips.plane + at..];
                    let from = &from[top.min(height) * width..];
                    // With a constant number the compiler leaves out the tests.
                    if rows == M + 2 {
                        pairs_tile::<S, M>(simd, from, width, M + 2, [strips.pitch, strips.plane, stride], to);
                    } else {
                        pairs_tile::<S, M>(simd, from, width, rows, [strips.pitch, strips.plane, stride], to);
                    }
                }
            }
        }
    }
}

/// [`output_gradient`] with tiles of `M` rows.
#[inline(always)]
fn output_gradient_tiles<S: Simd, const M: usize>(
    simd: S,
    strips: &Strips,
    strip: Strip,
    [height, width]: [usize; 2],
    per_image: usize,
    dy: &[f32],
    points: &mut [f32],
) {
    let stride = per_image * strips.plane;
    for map in 0..per_image {
        for image in 0..strip.images {
            let dy = &dy[(image * per_image + map) * height * width..][..height * width];
            for tile in 0..strip.tiles {
                let at = map * strips.plane + strips.position(strip, image, tile);
                let first = (strip.first_tile + tile) * M;
                let rows = M.min(height - first);
                let (dy, to) = (&dy[first * width..], &mut points[at..]);
                // With a constant number the compiler leaves out the tests.
                if rows == M {
                    output_gradient_tile::<S, M>(simd, dy, width, M, stride, to);
                } else {
                    output_gradient_tile::<S, M>(simd, dy, width, rows, stride, to);
                }
                for point in 0..M + 2 {
                    for at in (width..strips.pitch).step_by(S::LANES) {
                        put_first(simd, to, point * stride + at, simd.splat(0.0), strips.pitch - at);
                    }
                }
            }
        }
    }
}

/// Writes the points of one tile, `stride` apart. `from` holds the rows `has` of the tile, one after the other; the others are 0.
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
            // Two calls: in the first, the compiler knows that the vectors are whole.
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
/// `count` elements of each of the rows `has` are readable, `width` apart, and as many writable at each point.
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
    let mut d = [simd.splat(0.0); MAX_POINTS];
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

/// Writes the points of one tile of each of two maps, `plane` apart. The maps hold the even and the odd columns of every second row
/// of `from`, `rows` of them. Maps have `pitch` columns; what lies outside `from` is 0.
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
        let mut d = [[simd.splat(0.0); MAX_POINTS]; 2];
        for i in 0..rows {
            // SAFETY: a row of `from` has as many elements as are there, and `ends` has room for two vectors.
            let [even, odd] = unsafe {
                let from = from.as_ptr().add(2 * i * width + 2 * column);
                if there >= 2 * S::LANES {
                    simd.load_pairs(from, S::LANES)
                } else {
                    let mut ends = [0.0; 2 * MAX_LANES];
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

/// Writes the points of the output gradient of one tile, `stride` apart, from its `rows` rows.
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
            // Two calls: in the first, the compiler knows that the vectors are whole.
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
    let mut d = [simd.splat(0.0); MAX_ROWS];
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
