//! The painted surface of a road, filtered for every distance.
//!
//! A texture covers 24 m along the road and 16 m across. Seen from a car a pixel is many times longer along the road
//! than across, so averages are kept for every pair of lengths (a *ripmap*): the picture picks the pair that fits the
//! pixel, lane lines stay sharp across while the grain along the road is averaged, and nothing flickers.

use std::ops::Range;

use crate::simulator::math::{hash2, lerp, smoothstep, value_noise};
use crate::simulator::road::spec::{Centre, Edge, Look, Rgb, Surface};
use crate::simulator::scenery::texel::pack;

/// Length of the pattern along the road, m.
pub const PERIOD_M: f32 = 24.0;
/// Half the width of the texture, m of a road that is 8 m wide; other widths are stretched.
pub const HALF_M: f32 = 8.0;
/// Half the width of the road for which the pattern is painted, m.
pub const HALF_ROAD_M: f32 = 4.0;
/// Logarithm of the number of texels along and across at the finest level.
pub const LOG2_SIZE: u32 = 9;
const SIZE: usize = 1 << LOG2_SIZE;
const LEVELS: usize = LOG2_SIZE as usize + 1;

/// A ripmap of one look. Texels are `0xAABBGGRR`; alpha is how much of the road covers the land.
pub struct RoadTexture {
    texels: Vec<u32>,
    offsets: [[u32; LEVELS]; LEVELS],
    /// Range of across coordinates where the road covers the land completely.
    paved: Range<i32>,
    /// Range of across coordinates where the road covers any land.
    covered: Range<i32>,
}

/// One pair of levels of a ripmap, ready for fetching.
#[derive(Clone, Copy)]
pub struct Level<'a> {
    texels: &'a [u32],
    /// Right shifts from fixed-point coordinates to texels of this level.
    along_shift: u32,
    across_shift: u32,
    along_mask: usize,
    log2_across: u32,
}

/// Fraction bits of fixed-point coordinates along the road; the unit is the finest texel. With these a lap of
/// 1,500 m stays below 2^22, which [`fixed`](crate::simulator::scenery::texel::fixed) needs.
const ALONG_BITS: u32 = 6;
/// The same across the road.
const ACROSS_BITS: u32 = 12;
/// Fixed-point units for each metre along the road.
pub const ALONG_UNITS_PER_M: f32 = (SIZE << ALONG_BITS) as f32 / PERIOD_M;
/// Fixed-point units for each metre across.
pub const ACROSS_UNITS_PER_M: f32 = (SIZE << ACROSS_BITS) as f32 / (2.0 * HALF_M);
/// Across coordinates at or above this lie beyond the texture.
pub const ACROSS_UNITS: u32 = (SIZE << ACROSS_BITS) as u32;

impl Level<'_> {
    /// The texel at fixed-point places `along` (any) and `across` (from the left rim of the texture, below
    /// [`ACROSS_UNITS`]).
    #[inline(always)]
    pub fn fetch(&self, along: i32, across: u32) -> u32 {
        let u = (along >> self.along_shift) as usize & self.along_mask;
        self.texels[u << self.log2_across | (across >> self.across_shift) as usize]
    }
}

impl RoadTexture {
    /// Paints a look, seen in light of colour `sun` (1 = white), and all its averages.
    ///
    /// `sun_from_right` is the share of the sun's horizontal direction that comes from the right of the road, -1 to 1: it lights the
    /// aprons, which face the road.
    pub fn paint(look: &Look, sun: [f32; 3], sun_from_right: f32, seed: u32) -> RoadTexture {
        use rayon::prelude::*;
        let texel = |at: usize| {
            let along = ((at / SIZE) as f32 + 0.5) * PERIOD_M / SIZE as f32;
            let across = ((at % SIZE) as f32 + 0.5) * 2.0 * HALF_M / SIZE as f32 - HALF_M;
            paint_texel(look, along, across, (sun, sun_from_right), seed)
        };
        let mut level: Vec<u32> = (0..SIZE * SIZE).into_par_iter().map(texel).collect();
        let (paved, covered) = extent(&level);
        let mut texels = Vec::with_capacity(4 * SIZE * SIZE);
        let mut offsets = [[0; LEVELS]; LEVELS];
        for (i, row) in offsets.iter_mut().enumerate() {
            let mut narrow = level.clone();
            for offset in row.iter_mut() {
                *offset = texels.len() as u32;
                texels.extend_from_slice(&narrow);
                narrow = narrow.chunks_exact(2).map(|p| average(p[0], p[1])).collect();
            }
            if SIZE >> i > 1 {
                level = level
                    .chunks_exact(2 * SIZE)
                    .flat_map(|rows| (0..SIZE).map(move |v| average(rows[v], rows[SIZE + v])))
                    .collect();
            }
        }
        RoadTexture { texels, offsets, paved, covered }
    }

    /// Whether the place across shows nothing but road.
    #[inline(always)]
    pub fn is_paved(&self, across: i32) -> bool {
        self.paved.contains(&across)
    }

    /// Whether both places across are on the land on the same side of the road.
    #[inline(always)]
    pub fn is_beyond(&self, a: i32, b: i32) -> bool {
        a.max(b) < self.covered.start || a.min(b) >= self.covered.end
    }

    /// The finest level whose texels are not much smaller than the given lengths, m.
    #[inline(always)]
    pub fn level(&self, along_m: f32, across_m: f32) -> Level<'_> {
        let i = log2_floor(along_m * (SIZE as f32 / PERIOD_M));
        let j = log2_floor(across_m * (SIZE as f32 / (2.0 * HALF_M)));
        let from = self.offsets[i][j] as usize;
        Level {
            texels: &self.texels[from..from + (SIZE >> i) * (SIZE >> j)],
            along_shift: ALONG_BITS + i as u32,
            across_shift: ACROSS_BITS + j as u32,
            along_mask: (SIZE >> i) - 1,
            log2_across: LOG2_SIZE - j as u32,
        }
    }
}

/// Places across, fixed-point, between which a texture covers the land everywhere, and anywhere; with some room for the
/// wider texels of coarser levels.
fn extent(texels: &[u32]) -> (Range<i32>, Range<i32>) {
    const ROOM: usize = SIZE / 64;
    let (mut min, mut max) = ([255; SIZE], [0; SIZE]);
    for row in texels.chunks_exact(SIZE) {
        for ((min, max), texel) in min.iter_mut().zip(&mut max).zip(row) {
            *min = texel.to_be_bytes()[0].min(*min);
            *max = texel.to_be_bytes()[0].max(*max);
        }
    }
    let left = min[..SIZE / 2].iter().rposition(|a| *a < 255).map_or(0, |v| v + 1);
    let right = min[SIZE / 2..].iter().position(|a| *a < 255).map_or(SIZE, |v| v + SIZE / 2);
    let first = max.iter().position(|a| *a > 0).unwrap_or(SIZE / 2);
    let last = max.iter().rposition(|a| *a > 0).map_or(SIZE / 2, |v| v + 1);
    let fixed = |v: usize| (v << ACROSS_BITS) as i32;
    (
        fixed(left + ROOM)..fixed(right.saturating_sub(ROOM)),
        fixed(first.saturating_sub(ROOM))..fixed((last + ROOM).min(SIZE)),
    )
}

/// Logarithm to base 2, rounded down and kept within the levels, from the exponent bits of the number.
#[inline(always)]
fn log2_floor(x: f32) -> usize {
    let x = if x > 1.0 { x } else { 1.0 };
    ((x.to_bits() >> 23) as usize - 127).min(LEVELS - 1)
}

/// Mean of two texels, byte by byte, rounded to even pairs.
fn average(a: u32, b: u32) -> u32 {
    let even = ((a & 0x00ff_00ff) + (b & 0x00ff_00ff) + 0x0001_0001) >> 1;
    let odd = (((a >> 8) & 0x00ff_00ff) + ((b >> 8) & 0x00ff_00ff)) >> 1;
    (even & 0x00ff_00ff) | ((odd & 0x00ff_00ff) << 8)
}

const WHITE: [f32; 3] = [232.0, 232.0, 226.0];
const YELLOW: [f32; 3] = [196.0, 168.0, 50.0];

fn mix(a: [f32; 3], b: [f32; 3], t: f32) -> [f32; 3] {
    std::array::from_fn(|k| lerp(a[k], b[k], t))
}

fn scaled(rgb: Rgb, k: f32) -> [f32; 3] {
    rgb.map(|c| f32::from(c) * k)
}

/// Noise with cells of `size_m`, repeating with the texture along the road.
fn grain(along: f32, across: f32, size_m: f32, stretch: f32, seed: u32) -> f32 {
    let cells = (PERIOD_M / (size_m * stretch)).round().max(1.0);
    let wide = (2.0 * HALF_M / size_m).round();
    value_noise(along * cells / PERIOD_M, (across + HALF_M) / size_m, Some((cells as i32, wide as i32 + 1)), seed) - 0.5
}

/// Maximum distance of a ragged border from the edge, m.
const MAX_RAGGED_M: f32 = 0.8;

/// Concrete of an apron that faces the road: in the sun, in light from along the road, and in its own shade.
const APRON: [[f32; 3]; 3] = [[255.0, 255.0, 240.0], [228.0, 222.0, 204.0], [146.0, 152.0, 158.0]];

/// Colour of a face that looks towards the road; `towards_sun` from -1 to 1.
fn apron(towards_sun: f32) -> [f32; 3] {
    let [lit, level, shaded] = APRON;
    if towards_sun > 0.0 { mix(level, lit, towards_sun) } else { mix(level, shaded, -towards_sun) }
}

/// Whether the edge has a face whose light depends on where the sun is.
pub fn is_raised(edge: Edge) -> bool {
    matches!(edge, Edge::Kerb | Edge::YellowKerbstone)
}

/// Width of the blocks of a kerb, and of the strip of asphalt beside a yellow line, m.
const BLOCKS_M: f32 = 1.35;
const STRIP_M: f32 = 0.35;

/// Width and colour of what lies beyond an edge at `out` m from it, before the shoulder.
fn beyond_edge(look: &Look, edge: Edge, along: f32, out: f32, towards_sun: f32) -> (f32, [f32; 3]) {
    let shade = 0.86 + 0.2 * towards_sun;
    match edge {
        Edge::Kerb => {
            let block = if along.rem_euclid(1.2) < 0.6 { [242.0, 112.0, 98.0] } else { [255.0, 248.0, 236.0] };
            (2.2, if out < BLOCKS_M { block.map(|c| c * shade) } else { apron(towards_sun) })
        }
        Edge::YellowKerbstone => (2.5, if out < STRIP_M { scaled(look.tone, 0.74) } else { apron(towards_sun) }),
        _ => (0.0, [0.0; 3]),
    }
}

fn paint_texel(look: &Look, along: f32, across: f32, (sun, sun_from_right): ([f32; 3], f32), seed: u32) -> u32 {
    let edge = if across < 0.0 { look.left } else { look.right };
    let out = across.abs() - HALF_ROAD_M;
    // Noise is the most expensive part, so it is computed only where it shows.
    let towards_sun = if across < 0.0 { sun_from_right } else { -sun_from_right };
    let (kerb_m, kerb) = beyond_edge(look, edge, along, out, towards_sun);
    let ragged = match edge {
        _ if (out - kerb_m).abs() > MAX_RAGGED_M => 0.0,
        Edge::Overgrown => {
            1.1 * grain(along, across, 0.7, 1.0, seed + 7) + 0.5 * grain(along, across, 0.12, 1.0, seed + 8)
        }
        Edge::Bare | Edge::White => 0.3 * grain(along, across, 0.4, 1.0, seed + 7),
        _ => 0.0,
    };
    // Beyond the edge: kerbs first, then the shoulder, then the land shows through.
    let rgb = if out > 0.0 && out < kerb_m {
        mix(kerb, [90.0; 3], 0.14 * (0.5 + grain(along, across, 0.3, 1.0, seed + 3)))
    } else if out + ragged > kerb_m {
        let n = 1.0 + 0.5 * grain(along, across, 0.15, 1.0, seed + 1) + 0.35 * grain(along, across, 1.1, 1.0, seed + 2);
        scaled(look.shoulder, n)
    } else {
        painted_surface(look, edge, along, across, seed)
    };
    let end = kerb_m + look.shoulder_m.min(HALF_M - HALF_ROAD_M - kerb_m - 0.05);
    let fringe = match out - end {
        inside if inside < -0.5 => out,
        _ => out + 0.5 * grain(along, across, 0.5, 1.0, seed + 9),
    };
    let coloured = std::array::from_fn(|k| rgb[k] * lerp(1.0, sun[k], 0.8));
    pack(coloured, 1.0 - smoothstep(end - 0.25, end, fringe))
}

/// The surface with the paint on it.
fn painted_surface(look: &Look, edge: Edge, along: f32, across: f32, seed: u32) -> [f32; 3] {
    let line = |at: f32, half: f32| (across.abs() - HALF_ROAD_M + at).abs() < half;
    let centre = match look.centre {
        Centre::None => None,
        Centre::Dashed => (across.abs() < 0.1 && along.rem_euclid(12.0) < 4.5).then_some(WHITE),
        Centre::Solid => (across.abs() < 0.075).then_some(WHITE),
        Centre::Yellow => (across.abs() < 0.07).then_some(YELLOW),
    };
    let paint = match edge {
        Edge::White if line(0.24, 0.1) => Some(WHITE),
        Edge::Yellow | Edge::YellowKerbstone | Edge::Kerb if line(0.3, 0.07) => Some(YELLOW),
        Edge::Dashes if line(0.3, 0.08) && along.rem_euclid(3.0) < 1.0 => Some(WHITE),
        _ => centre,
    };
    let bare = surface(look, along, across, seed);
    paint.map_or(bare, |paint| mix(bare, paint, (0.85 + 0.4 * grain(along, across, 0.25, 1.0, seed + 5)).min(0.95)))
}

fn surface(look: &Look, along: f32, across: f32, seed: u32) -> [f32; 3] {
    let fine = grain(along, across, 0.07, 1.0, seed);
    let medium = grain(along, across, 0.35, 2.0, seed + 11);
    let large = grain(along, across, 2.0, 3.0, seed + 12);
    // Light stones between dark ones.
    let stones = 1.1 * fine + 0.9 * (fine - 0.2).max(0.0);
    let plain = 1.0 + look.grain * (stones + 0.2 * medium) + 0.18 * large;
    match look.surface {
        Surface::Asphalt => scaled(look.tone, plain),
        Surface::Patched => {
            let (i, j) = ((along / 4.0).floor(), ((across + HALF_M) / 1.9).floor());
            let patch = if hash2(i as i32, j as i32, seed + 20) < 0.25 { 0.84 } else { 1.0 };
            let torn = grain(along, across, 3.0, 1.0, seed + 22) > 0.04;
            let crack = if torn && grain(along, across, 1.3, 1.0, seed + 21).abs() < 0.01 { 0.65 } else { 1.0 };
            scaled(look.tone, plain * patch * crack)
        }
        Surface::Cobble => {
            let row = ((across + HALF_M) / 0.32).floor();
            let shift = hash2(row as i32, 0, seed + 30) * 0.5;
            let u = (along + shift) / 0.5;
            let (fu, fv) = (u - u.floor(), (across + HALF_M) / 0.32 - row);
            let column = (u.floor() as i32).rem_euclid((PERIOD_M / 0.5) as i32);
            let stone = 0.75 + 0.5 * hash2(column, row as i32, seed + 31);
            let joint = fu.min(1.0 - fu).min((fv.min(1.0 - fv)) * 0.64) < 0.05;
            scaled(look.tone, if joint { 0.5 } else { stone + look.grain * 0.5 * fine })
        }
        Surface::Seamed => {
            // Seams wander a little; where they lie and how dark they are differs from look to look.
            let drawn = |k: i32| hash2(k, 0, seed + 60);
            let wander = 0.25 * grain(along, across, 1.5, 4.0, seed + 61);
            let lane_m = 1.6 + 2.4 * drawn(0);
            let beside = (across + wander + lane_m * drawn(1)).rem_euclid(lane_m);
            let bays = 1.0 + (6.0 * drawn(2)).floor();
            let before = (along + wander + PERIOD_M * drawn(3)).rem_euclid(PERIOD_M / bays);
            let seam = beside < 0.03 + 0.08 * drawn(4) || before < 0.12 + 0.2 * drawn(5);
            scaled(look.tone, if seam { plain * (0.4 + 0.4 * drawn(6)) } else { plain })
        }
        Surface::Concrete => {
            let slab = (along / 6.0).floor() as i32;
            let tint = 0.95 + 0.1 * hash2(slab, i32::from(across > 0.0), seed + 40);
            let joint = (along.rem_euclid(6.0) < 0.06) || (across.abs() - 2.0).abs() < 0.03;
            scaled(look.tone, if joint { 0.55 } else { tint * plain })
        }
        Surface::Gravel => {
            let tracks = smoothstep(0.55, 0.15, (across.abs() - 0.95).abs());
            let middle = smoothstep(0.5, 0.0, across.abs() + 0.5 * grain(along, across, 0.6, 1.0, seed + 50));
            let n = 1.0 + look.grain * (1.3 * fine + 0.9 * medium) + 0.3 * large + 0.14 * tracks;
            mix(scaled(look.tone, n), scaled(look.shoulder, n), 0.45 * middle)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn look() -> Look {
        Look {
            name: "test".into(),
            surface: Surface::Asphalt,
            tone: [100, 100, 100],
            grain: 0.5,
            centre: Centre::Solid,
            left: Edge::Kerb,
            right: Edge::Bare,
            shoulder: [160, 100, 60],
            shoulder_m: 2.0,
        }
    }

    fn at(level: &Level, along_m: f32, across_m: f32) -> u32 {
        level.fetch((along_m * ALONG_UNITS_PER_M) as i32, ((across_m + HALF_M) * ACROSS_UNITS_PER_M) as u32)
    }

    #[test]
    fn averages_keep_the_mean_colour_and_lines_survive_along_the_road() {
        let texture = RoadTexture::paint(&look(), [1.0; 3], 0.0, 1);
        let red = |texel: u32| (texel & 255) as f32;
        let fine = texture.level(0.01, 0.01);
        let mean = |across: f32| {
            (0..512).map(|u| red(at(&fine, u as f32 * PERIOD_M / 512.0 + 0.01, across))).sum::<f32>() / 512.0
        };
        // A pixel 24 m long but narrow still separates the line from the asphalt beside it.
        let long = texture.level(30.0, 0.03);
        assert!((red(at(&long, 3.0, 0.01)) - mean(0.01)).abs() < 6.0);
        assert!(red(at(&long, 3.0, 0.01)) > red(at(&long, 3.0, 1.0)) + 40.0);
        // Far away everything is one colour, whatever the place.
        let far = texture.level(1e3, 1e3);
        assert_eq!(at(&far, 0.3, -7.9), at(&far, 22.0, 7.9));
    }

    #[test]
    fn the_land_shows_beyond_the_shoulder_and_the_pattern_repeats() {
        let texture = RoadTexture::paint(&look(), [1.0; 3], 0.0, 1);
        let fine = texture.level(0.01, 0.01);
        for along in [0.5, 7.0, 20.0] {
            assert_eq!(at(&fine, along, 0.5) >> 24, 255);
            assert_eq!(at(&fine, along, 7.5) >> 24, 0);
            assert_eq!(at(&fine, along, 0.5), at(&fine, along + 3.0 * PERIOD_M, 0.5));
        }
    }

    #[test]
    fn an_apron_is_lighter_where_it_faces_the_sun() {
        let look = Look { left: Edge::YellowKerbstone, right: Edge::YellowKerbstone, ..look() };
        // Mean brightness of the left and of the right apron, with the sun on the given side.
        let aprons = |sun_from_right: f32| {
            let texture = RoadTexture::paint(&look, [1.0; 3], sun_from_right, 1);
            let mean = texture.level(PERIOD_M, 0.5);
            [-5.5, 5.5].map(|across| at(&mean, 3.0, across) & 255)
        };
        let ([left, right], [level_left, level_right]) = (aprons(0.8), aprons(0.0));
        // The left apron looks to the right.
        assert!(left > level_left + 10 && level_right > right + 30, "{left} {level_left} {level_right} {right}");
        assert!(level_left.abs_diff(level_right) < 6);
        let [left, right] = aprons(-0.8);
        assert!(right > left + 40, "{left} {right}");
    }
}
