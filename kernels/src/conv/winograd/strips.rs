//! Tiles of rows, strips of tiles, and the places of their points.

use crate::simd::MAX_LANES;

/// The largest number of images in a strip.
const MAX_IMAGES: usize = 8;

/// The tiles of a map, and the strips of tiles that go through a pass together.
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
    /// Tiles of an image in a strip.
    pub per_strip: usize,
    /// Images in a strip; more than one only if the strip has all their tiles.
    pub images: usize,
    /// Length of a plane. It has room for whole vectors shifted by every tap.
    pub plane: usize,
    /// Vectors shifted by a tap read less than this beyond the positions.
    pub reach: usize,
}

/// One strip.
#[derive(Clone, Copy, Debug)]
pub(super) struct Strip {
    /// Number of images.
    pub images: usize,
    /// The first tile of each image.
    pub first_tile: usize,
    /// Number of tiles of each image.
    pub tiles: usize,
}

impl Strips {
    /// Cuts maps of `height` rows into tiles of `rows` rows and `pitch` positions. A strip has up to `max_tiles` tiles, and at least
    /// one. Taps shift vectors by less than `shifts`.
    pub fn new(rows: usize, height: usize, pitch: usize, shifts: usize, max_tiles: usize) -> Strips {
        let tiles = height.div_ceil(rows);
        let max_tiles = max_tiles.max(1);
        let per_strip = tiles.div_ceil(tiles.div_ceil(max_tiles));
        let images = if per_strip < tiles { 1 } else { (max_tiles / tiles).clamp(1, MAX_IMAGES) };
        let reach = MAX_LANES + shifts;
        let plane = (images * per_strip * pitch + reach).next_multiple_of(MAX_LANES);
        // An odd number of cache lines, so that the same position of many planes does not fall into the same cache set.
        let plane = if (plane / MAX_LANES).is_multiple_of(2) { plane + MAX_LANES } else { plane };
        Strips { rows, tiles, pitch, per_strip, images, plane, reach }
    }

    /// Number of points of a tile.
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

    /// The part of `next`, the data of the next images, that is prefetched during `strip`.
    pub fn upcoming<'a>(&self, strip: Strip, next: &'a [f32]) -> &'a [f32] {
        let part = |tile: usize| next.len() * tile / self.tiles;
        &next[part(strip.first_tile)..part(strip.first_tile + strip.tiles)]
    }

    /// Number of positions of a plane that a strip fills.
    pub fn used(&self, strip: Strip) -> usize {
        strip.images * strip.tiles * self.pitch
    }

    /// The first position of a tile in a plane.
    pub fn position(&self, strip: Strip, image: usize, tile: usize) -> usize {
        (image * strip.tiles + tile) * self.pitch
    }
}

/// The maps of an input, and the zeros before them.
#[derive(Clone, Copy, Debug)]
pub(super) struct Maps {
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// Rows of zeros above the first tile.
    pub above: usize,
    /// Columns of zeros on the left.
    pub left: usize,
}

/// Splits off the first `len` elements, or all if there are fewer.
pub(super) fn head(all: &[f32], len: usize) -> (&[f32], &[f32]) {
    all.split_at(len.min(all.len()))
}
