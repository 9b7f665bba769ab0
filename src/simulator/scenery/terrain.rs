//! The land: one height for every square metre, shaped around the road, and its lit colours seen from above.

use rayon::prelude::*;

use crate::simulator::math::{Vec3, hash2, lerp, smoothstep, value_noise, vec3};
use crate::simulator::road::line::{Road, Station};
use crate::simulator::road::spec::{Land, Side, Stretch};
use crate::simulator::scenery::texel::{clip, pack, split};

/// Land kept around the road on every side, m.
const MARGIN_M: f64 = 110.0;
/// Land within this distance of the reference line takes its height from the nearest station, m.
const REACH_M: f64 = 70.0;
/// Marks a square metre that is far from the road.
pub const NO_STATION: u16 = u16::MAX;

/// Heights and nearest stations on a grid of 1 m.
pub struct Terrain {
    /// World coordinates of grid point (0, 0), m.
    pub x0: f32,
    /// See `x0`.
    pub y0: f32,
    /// Grid points from west to east.
    pub nx: usize,
    /// Grid points from south to north.
    pub ny: usize,
    heights: Vec<f32>,
    highest_m: f32,
    stations: Vec<u16>,
}

/// How the land beside one station rises, on one side.
#[derive(Clone, Copy, Default)]
struct Profile {
    rise_m: f32,
    from_m: f32,
    to_m: f32,
    hills: f32,
}

fn profile(side: Side) -> Profile {
    let (rise_m, from_m, to_m, hills) = match side {
        Side::Flat => (0.0, 2.0, 10.0, 1.0),
        Side::Hill => (5.0, 3.0, 22.0, 1.0),
        Side::Cliff => (13.0, 2.2, 8.0, 1.0),
        Side::Drop => (-9.0, 1.4, 11.0, 0.4),
        Side::Water => (-9.0, 1.3, 9.0, 0.0),
    };
    Profile { rise_m, from_m, to_m, hills }
}

/// Profiles of all stations on one side, blended over 12 m so that the land has no steps along the road.
fn profiles(road: &Road, what: impl Fn(&Stretch) -> Option<Side>) -> Vec<Profile> {
    const HALF: usize = 6;
    let n = road.stations.len();
    let raw: Vec<Profile> =
        (0..n).map(|i| profile(road.spec.setting_at(road.s_of(i), &what).unwrap_or_default())).collect();
    (0..n)
        .map(|i| {
            let mut sum = Profile::default();
            for k in 0..=2 * HALF {
                let p = raw[(i + n + k - HALF) % n];
                sum.rise_m += p.rise_m;
                sum.from_m += p.from_m;
                sum.to_m += p.to_m;
                sum.hills += p.hills;
            }
            let k = 1.0 / (2 * HALF + 1) as f32;
            Profile { rise_m: sum.rise_m * k, from_m: sum.from_m * k, to_m: sum.to_m * k, hills: sum.hills * k }
        })
        .collect()
}

impl Terrain {
    /// Shapes the land of a road.
    pub fn build(road: &Road) -> Terrain {
        let bound = |f: &dyn Fn(&Station) -> f64| {
            road.stations.iter().map(f).fold((f64::MAX, f64::MIN), |(lo, hi), v| (lo.min(v), hi.max(v)))
        };
        let ((x_min, x_max), (y_min, y_max)) = (bound(&|s| s.x), bound(&|s| s.y));
        let (x0, y0) = ((x_min - MARGIN_M).floor(), (y_min - MARGIN_M).floor());
        let (nx, ny) = ((x_max + MARGIN_M - x0) as usize + 2, (y_max + MARGIN_M - y0) as usize + 2);
        let stations = nearest_stations(road, x0, y0, nx, ny);
        let (x0, y0, heights) = (x0 as f32, y0 as f32, vec![0.0; nx * ny]);
        let mut terrain = Terrain { x0, y0, nx, ny, heights, highest_m: 0.0, stations };
        terrain.raise(road);
        terrain
    }

    fn raise(&mut self, road: &Road) {
        let land = &road.spec.land;
        let sides = [profiles(road, |s| s.left), profiles(road, |s| s.right)];
        let far = FarLand::new(road, self.x0, self.y0, self.nx, self.ny);
        let (x0, y0, nx) = (f64::from(self.x0), f64::from(self.y0), self.nx);
        let stations = &self.stations;
        let mut rough = vec![0.0f32; nx * self.ny];
        // How much of the smoothing pass reaches a point: nothing on the road, all of it beyond 9 m from the edge.
        let mut soft = vec![1.0f32; nx * self.ny];
        rough.par_chunks_mut(nx).zip(soft.par_chunks_mut(nx)).enumerate().for_each(|(j, (row, soft))| {
            for (i, (height, soft)) in row.iter_mut().zip(soft).enumerate() {
                let (x, y) = (x0 + i as f64, y0 + j as f64);
                let away = far.height(i as f32, j as f32) + hills(land, x as f32, y as f32);
                let station = stations[j * nx + i];
                if station == NO_STATION {
                    *height = away;
                    continue;
                }
                let s = &road.stations[usize::from(station)];
                let (dx, dy) = (x - s.x, y - s.y);
                let along = dx * s.tx + dy * s.ty;
                let right = dx * s.ty - dy * s.tx;
                let offset = (right - s.curvature * along * along / 2.0) as f32;
                let edge = offset.abs() - s.width_m as f32 / 2.0;
                let plane = s.z + s.slope * along - s.crossfall * right.clamp(-s.width_m, s.width_m);
                let p = sides[usize::from(offset > 0.0)][usize::from(station)];
                let wobble = 0.7 + 0.6 * value_noise(x as f32 / 11.0, y as f32 / 11.0, None, land.seed + 1);
                let bumps = (value_noise(x as f32 / 7.0, y as f32 / 7.0, None, land.seed + 2) - 0.5) * 1.6;
                let near = plane as f32
                    + p.rise_m * wobble * smoothstep(p.from_m, p.to_m, edge)
                    + bumps * smoothstep(1.2, 9.0, edge)
                    + p.hills * mounds(land, x as f32, y as f32).0 * smoothstep(3.5, 11.0, edge)
                    + p.hills * hills(land, x as f32, y as f32) * smoothstep(9.0, 60.0, edge);
                *height = lerp(near, away, smoothstep(40.0, REACH_M as f32 - 4.0, edge + s.width_m as f32 / 2.0));
                *soft = smoothstep(1.0, 9.0, edge);
            }
        });
        self.heights = soften(&rough, &soft, nx, self.ny);
        if let Some(level) = land.water_level_m {
            self.heights.iter_mut().for_each(|h| *h = h.max(level));
        }
        self.highest_m = self.heights.iter().copied().fold(f32::MIN, f32::max);
    }

    /// Height of the land at grid coordinates (metres east and north of the grid's corner), interpolated.
    #[inline(always)]
    pub fn height_at_grid(&self, gx: f32, gy: f32) -> f32 {
        let (i, fx) = split(clip(gx, self.nx as f32 - 1.01));
        let (j, fy) = split(clip(gy, self.ny as f32 - 1.01));
        let from = j * self.nx + i;
        let (low, high) = (&self.heights[from..from + 2], &self.heights[from + self.nx..from + self.nx + 2]);
        let a = low[0] + (low[1] - low[0]) * fx;
        let b = high[0] + (high[1] - high[0]) * fx;
        a + (b - a) * fy
    }

    /// Height of the highest land, m.
    pub fn highest_m(&self) -> f32 {
        self.highest_m
    }

    /// Height of the land at a point of the world, m.
    pub fn height(&self, x: f32, y: f32) -> f32 {
        self.height_at_grid(x - self.x0, y - self.y0)
    }

    /// The station nearest to grid coordinates within the grid, or [`NO_STATION`].
    #[inline(always)]
    pub fn station_at_grid(&self, gx: f32, gy: f32) -> u16 {
        let (i, _) = split(clip(gx + 0.5, self.nx as f32 - 1.01));
        let (j, _) = split(clip(gy + 0.5, self.ny as f32 - 1.01));
        self.stations[j * self.nx + i]
    }

    /// Unit normal of the land at a point of the grid.
    fn normal(&self, i: usize, j: usize) -> Vec3 {
        let at = |i: usize, j: usize| self.heights[j.min(self.ny - 1) * self.nx + i.min(self.nx - 1)];
        let east = (at(i + 1, j) - at(i.saturating_sub(1), j)) / 2.0;
        let north = (at(i, j + 1) - at(i, j.saturating_sub(1))) / 2.0;
        vec3(-east, -north, 1.0).unit()
    }

    /// Sunlight and steepness of every grid point: brightness relative to flat sunny ground, and the normal's up part.
    pub fn lit(&self, sun: Vec3, shade: f32) -> Vec<(f32, f32)> {
        let flat = 1.0 / (sun.x * sun.x + sun.y * sun.y).sqrt().max(1e-3);
        let (dx, dy, rise) = (sun.x * flat * 2.2, sun.y * flat * 2.2, sun.z * flat * 2.2);
        let mut sunny: Vec<f32> = vec![0.0; self.nx * self.ny];
        sunny.par_chunks_mut(self.nx).enumerate().for_each(|(j, row)| {
            for (i, sunny) in row.iter_mut().enumerate() {
                let from = self.heights[j * self.nx + i] + 0.15;
                let blocked = (1..22).any(|k| {
                    let k = k as f32;
                    self.height_at_grid(i as f32 + dx * k, j as f32 + dy * k) > from + rise * k
                });
                *sunny = f32::from(!blocked);
            }
        });
        let sunny = soften(&sunny, &vec![1.0; sunny.len()], self.nx, self.ny);
        let mut lit = vec![(0.0, 0.0); self.nx * self.ny];
        lit.par_chunks_mut(self.nx).enumerate().for_each(|(j, row)| {
            for (i, lit) in row.iter_mut().enumerate() {
                let normal = self.normal(i, j);
                let facing = (normal.dot(sun) / sun.z).clamp(0.0, 1.5);
                let sky = 0.6 + 0.4 * normal.z;
                *lit = (shade * sky + (1.0 - shade) * facing * sunny[j * self.nx + i], normal.z);
            }
        });
        lit
    }
}

/// For every grid point the nearest station within reach.
fn nearest_stations(road: &Road, x0: f64, y0: f64, nx: usize, ny: usize) -> Vec<u16> {
    let mut nearest = vec![NO_STATION; nx * ny];
    nearest.par_chunks_mut(nx).enumerate().for_each(|(j, row)| {
        let y = y0 + j as f64;
        let mut best = vec![REACH_M * REACH_M; nx];
        for (k, s) in road.stations.iter().enumerate() {
            let dy2 = (s.y - y) * (s.y - y);
            if dy2 >= REACH_M * REACH_M {
                continue;
            }
            let reach = (REACH_M * REACH_M - dy2).sqrt();
            let from = (s.x - reach - x0).max(0.0) as usize;
            let to = ((s.x + reach - x0) as usize).min(nx - 1);
            for i in from..=to {
                let dx = x0 + i as f64 - s.x;
                let square = dx * dx + dy2;
                if square < best[i] {
                    best[i] = square;
                    row[i] = k as u16;
                }
            }
        }
    });
    nearest
}

/// Mean of the 5x5 neighbourhood where `soft` is 1, the value itself where it is 0.
fn soften(values: &[f32], soft: &[f32], nx: usize, ny: usize) -> Vec<f32> {
    let mut wide = vec![0.0f32; nx * ny];
    wide.par_chunks_mut(nx).enumerate().for_each(|(j, row)| {
        let from = &values[j * nx..(j + 1) * nx];
        for (i, out) in row.iter_mut().enumerate() {
            let span = &from[i.saturating_sub(2)..(i + 3).min(nx)];
            *out = span.iter().sum::<f32>() / span.len() as f32;
        }
    });
    let mut out = values.to_vec();
    out.par_chunks_mut(nx).enumerate().for_each(|(j, row)| {
        let rows = j.saturating_sub(2)..(j + 3).min(ny);
        let k = 1.0 / rows.len() as f32;
        for (i, value) in row.iter_mut().enumerate() {
            let mean = rows.clone().map(|r| wide[r * nx + i]).sum::<f32>() * k;
            *value = lerp(*value, mean, soft[j * nx + i]);
        }
    });
    out
}

/// Distant hills at a point, m above the plain.
fn hills(land: &Land, x: f32, y: f32) -> f32 {
    let a = value_noise(x / 90.0, y / 90.0, None, land.seed + 3);
    let b = value_noise(x / 34.0, y / 34.0, None, land.seed + 4);
    land.hills_m * ((a - 0.3).max(0.0) * 1.1 + (b - 0.5) * 0.25)
}

/// Mounds a few metres across, with level ground between them; the highest are domes of rock. Also how much of the ground is rock.
fn mounds(land: &Land, x: f32, y: f32) -> (f32, f32) {
    if land.mounds_m == 0.0 {
        return (0.0, 0.0);
    }
    let a = value_noise(x / 17.0, y / 17.0, None, land.seed + 5);
    let b = value_noise(x / 5.0, y / 5.0, None, land.seed + 6);
    let dome = smoothstep(0.68, 0.84, a + 0.08 * (b - 0.5));
    (land.mounds_m * ((a - 0.4).max(0.0) * (0.8 + 0.4 * b) + 0.42 * dome), smoothstep(0.05, 0.35, dome))
}

/// Height of the plain far from the road: a mean of the road's heights, weighted by nearness, on a grid of 16 m.
struct FarLand {
    nx: usize,
    heights: Vec<f32>,
}

impl FarLand {
    const CELL: f32 = 16.0;

    fn new(road: &Road, x0: f32, y0: f32, nx: usize, ny: usize) -> FarLand {
        let (nx, ny) = (nx / Self::CELL as usize + 2, ny / Self::CELL as usize + 2);
        let mut heights = vec![0.0; nx * ny];
        heights.par_chunks_mut(nx).enumerate().for_each(|(j, row)| {
            for (i, height) in row.iter_mut().enumerate() {
                let (x, y) = (f64::from(x0 + i as f32 * Self::CELL), f64::from(y0 + j as f32 * Self::CELL));
                let (mut sum, mut weights) = (0.0, 0.0);
                for s in road.stations.iter().step_by(6) {
                    let square = (s.x - x) * (s.x - x) + (s.y - y) * (s.y - y) + 100.0;
                    let weight = 1.0 / (square * square);
                    sum += weight * s.z;
                    weights += weight;
                }
                *height = (sum / weights) as f32;
            }
        });
        FarLand { nx, heights }
    }

    fn height(&self, gx: f32, gy: f32) -> f32 {
        let (u, v) = (gx / Self::CELL, gy / Self::CELL);
        let (i, j) = (u as usize, v as usize);
        let at = |i: usize, j: usize| self.heights[j * self.nx + i];
        let (fu, fv) = (u - i as f32, v - j as f32);
        lerp(lerp(at(i, j), at(i + 1, j), fu), lerp(at(i, j + 1), at(i + 1, j + 1), fu), fv)
    }
}

/// The lit land seen from above, 0.5 m a texel and coarser; alpha is the light that falls there (128 = full sun on flat
/// ground), with which the road is lit too.
pub struct GroundMap {
    levels: Vec<(Vec<u32>, usize, usize)>,
}

/// Colour of the light in the shade, which comes from the sky.
const SKYLIGHT: [f32; 3] = [0.9, 0.98, 1.12];

/// Alpha of a texel in full sun on flat ground.
pub const FULL_LIGHT: f32 = 128.0;

impl GroundMap {
    /// Paints the map. `shadow` is the share of sunlight that trees let through at each texel, 0 to 255.
    pub fn build(road: &Road, terrain: &Terrain, lit: &[(f32, f32)], shadow: &[u8]) -> GroundMap {
        let land = &road.spec.land;
        let light = &road.spec.light;
        let (nx, ny) = (terrain.nx * 2, terrain.ny * 2);
        let tone = |rgb: [u8; 3]| rgb.map(f32::from);
        let mut texels = vec![0u32; nx * ny];
        texels.par_chunks_mut(nx).enumerate().for_each(|(j, row)| {
            for (i, texel) in row.iter_mut().enumerate() {
                let (gx, gy) = (i as f32 * 0.5, j as f32 * 0.5);
                // The middle of a texel lies a quarter of the way to one of the grid points around it.
                let (fx, fy) = (0.25 + 0.5 * (i % 2) as f32, 0.25 + 0.5 * (j % 2) as f32);
                let (west, south) = (i / 2, (j / 2) * terrain.nx);
                let (east, north) = ((west + 1).min(terrain.nx - 1), (j / 2 + 1).min(terrain.ny - 1) * terrain.nx);
                let smooth = |value: &dyn Fn(usize) -> f32| {
                    let low = lerp(value(south + west), value(south + east), fx);
                    lerp(low, lerp(value(north + west), value(north + east), fx), fy)
                };
                let (brightness, up) = (smooth(&|cell| lit[cell].0), smooth(&|cell| lit[cell].1));
                let through = f32::from(shadow[j * nx + i]) / 255.0;
                let brightness = light.shade * 0.9 + (brightness - light.shade * 0.9) * through;
                let height = smooth(&|cell| terrain.heights[cell]);
                let patches = value_noise(gx / 9.0, gy / 9.0, None, land.seed + 10);
                let tufts = value_noise(gx / 1.3, gy / 1.3, None, land.seed + 11);
                let grain = hash2(i as i32, j as i32, land.seed + 12);
                let mixing = smoothstep(0.3, 0.7, patches * 0.7 + tufts * 0.3);
                let bare = if land.sandy > 0.0 {
                    let banks = value_noise(gx / 26.0, gy / 26.0, None, land.seed + 15);
                    let max_noise = 0.1 + 0.8 * land.sandy;
                    smoothstep(max_noise + 0.04, max_noise - 0.04, 0.85 * banks + 0.15 * tufts)
                } else {
                    0.0
                };
                let mut rgb: [f32; 3] = std::array::from_fn(|k| {
                    lerp(lerp(tone(land.ground[0])[k], tone(land.ground[1])[k], mixing), tone(land.shore)[k], bare)
                });
                let steep = smoothstep(0.86, 0.62, up + 0.14 * (tufts - 0.5));
                let (_, dome) = mounds(land, gx + terrain.x0, gy + terrain.y0);
                let steep = steep.max(dome * smoothstep(0.35, 0.6, tufts * 0.3 + 0.7 * dome));
                let shade = 0.74 + (0.36 * tufts + 0.18 * grain) * (1.0 - 0.6 * bare) + 0.08 * bare;
                // Seen from the side of a rock face, what is painted from above runs down in streaks.
                let streaks = value_noise(gx / 0.9, gy / 0.9, None, land.seed + 14);
                let layers = value_noise(gx / 2.1, height / 1.4 + gy / 5.0, None, land.seed + 13);
                let rocky = 0.5 + 0.35 * layers + 0.45 * streaks + 0.15 * grain;
                let mut glare = 1.0;
                for (k, c) in rgb.iter_mut().enumerate() {
                    *c = lerp(*c * shade, tone(land.rock)[k] * rocky, steep);
                }
                if let Some(level) = land.water_level_m {
                    let shore = smoothstep(level + 1.3, level + 0.3, height + 0.5 * (tufts - 0.5));
                    let wet = height <= level + 0.02;
                    for (k, c) in rgb.iter_mut().enumerate() {
                        *c = lerp(*c, tone(land.shore)[k] * (0.85 + 0.3 * grain), shore);
                        if wet {
                            *c = tone(land.water)[k] * (0.95 + 0.08 * tufts);
                        }
                    }
                    if wet {
                        glare = 0.0;
                    }
                }
                let bright = lerp(1.0, brightness, glare);
                let sunny = ((brightness - light.shade) / (1.0 - light.shade).max(0.05)).clamp(0.0, 1.0);
                let coloured: [f32; 3] = std::array::from_fn(|k| {
                    let sun = lerp(SKYLIGHT[k], f32::from(light.sun[k]) / 255.0, sunny);
                    rgb[k] * bright * lerp(1.0, sun, glare)
                });
                *texel = pack(coloured, bright * FULL_LIGHT / 255.0);
            }
        });
        let mut levels = vec![(texels, nx, ny)];
        for _ in 0..5 {
            let (fine, fx, fy) = &levels[levels.len() - 1];
            let (nx, ny) = (fx / 2, fy / 2);
            let mut coarse = Vec::with_capacity(nx * ny);
            for j in 0..ny {
                for i in 0..nx {
                    let at = |a: usize, b: usize| fine[(2 * j + b) * fx + 2 * i + a];
                    coarse.push(mean4(at(0, 0), at(1, 0), at(0, 1), at(1, 1)));
                }
            }
            levels.push((coarse, nx, ny));
        }
        GroundMap { levels }
    }

    /// The level for a pixel that covers `area_m2` of ground.
    #[inline(always)]
    pub fn level(&self, area_m2: f32) -> GroundLevel<'_> {
        // The side of a square of that area in finest texels, as a power of two: half the exponent of the area.
        let area = clip(area_m2 * 4.0 - 1.0, 1e6) + 1.0;
        let k = (((area.to_bits() >> 23) as usize - 127) / 2).min(self.levels.len() - 1);
        let (texels, nx, _) = &self.levels[k];
        GroundLevel { texels, nx: *nx, shift: GROUND_FRACTION_BITS + k as u32 }
    }

    /// Light (alpha, 0 to 255) at grid coordinates, interpolated.
    #[inline(always)]
    pub fn light(&self, gx: f32, gy: f32) -> f32 {
        let (texels, nx, ny) = &self.levels[0];
        let (i, fx) = split(clip(2.0 * gx - 0.5, *nx as f32 - 1.01));
        let (j, fy) = split(clip(2.0 * gy - 0.5, *ny as f32 - 1.01));
        let from = j * nx + i;
        let (low, high) = (&texels[from..from + 2], &texels[from + nx..from + nx + 2]);
        let alpha = |t: u32| (t >> 24) as i32 as f32;
        let a = lerp(alpha(low[0]), alpha(low[1]), fx);
        let b = lerp(alpha(high[0]), alpha(high[1]), fx);
        lerp(a, b, fy)
    }
}

/// Fraction bits of fixed-point coordinates on the map; the unit is the finest texel of 0.5 m.
pub const GROUND_FRACTION_BITS: u32 = 10;
/// Fixed-point units for each metre.
pub const GROUND_UNITS_PER_M: f32 = (2 << GROUND_FRACTION_BITS) as f32;

/// One level of a [`GroundMap`].
#[derive(Clone, Copy)]
pub struct GroundLevel<'a> {
    texels: &'a [u32],
    nx: usize,
    shift: u32,
}

impl GroundLevel<'_> {
    /// Whether its texels are as fine as the map has them, and so may be larger than pixels.
    #[inline(always)]
    pub fn is_finest(&self) -> bool {
        self.shift == GROUND_FRACTION_BITS
    }

    /// The texel at a fixed-point place within the grid.
    #[inline(always)]
    pub fn fetch(&self, x: i32, y: i32) -> u32 {
        let at = (y >> self.shift) as usize * self.nx + (x >> self.shift) as usize;
        // The rim of the land may be missing from coarse levels when the size is odd.
        self.texels[at.min(self.texels.len() - 1)]
    }
}

fn mean4(a: u32, b: u32, c: u32, d: u32) -> u32 {
    const LOW: u32 = 0x00ff_00ff;
    let part =
        |k: u32| (((a >> k) & LOW) + ((b >> k) & LOW) + ((c >> k) & LOW) + ((d >> k) & LOW) + 0x0002_0002) >> 2 & LOW;
    part(0) | part(8) << 8
}
