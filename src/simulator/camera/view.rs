//! What one camera sees of the world: where the ground lies behind a pixel, and which colour it has.

use crate::simulator::camera::pinhole::{Camera, FOCAL_PX, HEIGHT, WIDTH};
use crate::simulator::math::Vec3;
use crate::simulator::scenery::light::Variant;
use crate::simulator::scenery::road_texture::{ACROSS_UNITS, ACROSS_UNITS_PER_M, ALONG_UNITS_PER_M, HALF_M, Level};
use crate::simulator::scenery::sky::{AROUND, SkyPlace};
use crate::simulator::scenery::terrain::{GROUND_FRACTION_BITS, GROUND_UNITS_PER_M, GroundLevel, NO_STATION};
use crate::simulator::scenery::texel::{clip, fixed};
use crate::simulator::scenery::world::World;

/// Pixels between marched columns.
pub(super) const SPAN: usize = 8;
/// Marched columns: one more than spans, so that the last span has two ends.
pub(super) const ANCHORS: usize = WIDTH / SPAN + 1;
/// Maximum distance at which land is drawn, m.
const MAX_DISTANCE_M: f32 = 380.0;
/// Up to this distance the light on the road is interpolated; beyond it, the nearest texel of the map gives the light, m.
const SMOOTH_LIGHT_M: f32 = 45.0;

/// Pixels of the own lens for a whole turn along the sky. In the middle of the picture they are 2 pi FOCAL_PX = 871, at its sides more.
const TURN_PX: f32 = 900.0;

/// Red and blue of a packed colour.
const RED_BLUE: u32 = 0x00ff_00ff;
/// Full light.
pub(super) const FULL: u32 = 256;
/// Offsets on the land's map, up to half a texel of its finest level, for the pixels of a span in each of four rows: the places of an
/// ordered dither, along x and, mirrored, along y.
static SCATTER: [[(i32, i32); SPAN]; 4] = {
    const ORDER: [[i32; 4]; 4] = [[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]];
    const STEP: i32 = (1 << GROUND_FRACTION_BITS) / 16;
    let mut offsets = [[(0, 0); SPAN]; 4];
    let mut at = 0;
    while at < 4 * SPAN {
        let (row, i) = (at / SPAN, at % SPAN);
        offsets[row][i] = ((ORDER[row][i % 4] * 2 - 15) * STEP / 2, (ORDER[i % 4][3 - row] * 2 - 15) * STEP / 2);
        at += 1;
    }
    offsets
};
/// Everything that finds and shades the ground of one frame.
pub(super) struct View<'a> {
    pub(super) world: &'a World,
    pub(super) variant: &'a Variant,
    pub(super) camera: &'a Camera,
    /// Grid coordinates of the eye; z is its height.
    pub(super) eye: Vec3,
    /// Height of the highest land above the eye, m.
    pub(super) rise: f32,
    /// Largest grid coordinates.
    pub(super) limit: (f32, f32),
    pub(super) columns: [Column; ANCHORS],
}

/// What the rays of one marched column have in common.
#[derive(Clone, Copy, Default)]
pub(super) struct Column {
    /// Ray at the middle row; each row adds its share of the camera's up.
    pub(super) middle: Vec3,
    /// One over the horizontal length of a ray.
    pub(super) level: f32,
    /// Place on the sky's picture.
    pub(super) turn: f32,
}

/// The ground at one place of the picture.
#[derive(Clone, Copy, Default)]
pub(super) struct Spot {
    /// Depth, m, and its inverse, which is 0 for the sky.
    pub(super) depth: f32,
    pub(super) inverse: f32,
    /// Place on the land's map, fixed-point.
    pub(super) x: i32,
    pub(super) y: i32,
    /// Whether a road is near. If so, the fields below hold its look, the fixed-point coordinates on its texture, the light
    /// there, and the cosine and sine of the angle between the road and the ray.
    pub(super) near_road: bool,
    pub(super) look: u32,
    pub(super) along: i32,
    pub(super) across: i32,
    pub(super) light: u32,
    pub(super) cos: f32,
    pub(super) sin: f32,
}

/// The haze between the eye and a place.
#[derive(Clone, Copy)]
pub(super) struct Air {
    /// Share of the place's own colour that remains, of 256.
    clear: u32,
    /// The haze's own red and blue, and green, times its share.
    red_blue: u32,
    green: u32,
}

/// The texture levels that fit the distance of a place, and the haze in front of it.
#[derive(Clone, Copy)]
pub(super) struct Levels<'a> {
    road: Level<'a>,
    ground: GroundLevel<'a>,
    /// Offsets of the row's pixels on the land's finest map.
    scatter: &'static [(i32, i32); SPAN],
    air: Air,
}

/// A place between two spots: on the land, and on the road.
#[derive(Clone, Copy)]
struct Place {
    x: i32,
    y: i32,
    along: i32,
    across: i32,
    /// Light in units of `1 / SPAN`, or 0 where the map of the land gives it.
    light: i32,
}

impl View<'_> {
    /// Ray through a marched column at a row.
    #[inline(always)]
    pub(super) fn ray(&self, k: usize, row: usize) -> Vec3 {
        self.columns[k].middle
            + self.camera.up * ((HEIGHT as f32 / 2.0 - 0.5 - row as f32) * (1.0 / self.camera.focal_px))
    }

    /// Follows a ray from `from` (a depth where it is known to be above the land) to where it enters the land.
    ///
    /// `last_fall` is the fall of the ray below, which met the land at `from`: on even land it predicts where this ray hits.
    #[inline(always)]
    pub(super) fn march(&self, ray: Vec3, from: f32, last_fall: f32) -> Option<f32> {
        let gap = |t: f32| {
            self.eye.z + t * ray.z - self.world.terrain.height_at_grid(self.eye.x + t * ray.x, self.eye.y + t * ray.y)
        };
        let (mut near, mut near_gap) = (from, from * (ray.z - last_fall));
        let mut step = 0.4 + 0.04 * near;
        if ray.z < -0.01 {
            let even = 1.25 * near * (last_fall / ray.z - 1.0);
            step = if even < step { even.abs() + 0.01 } else { step };
        }
        // Nothing is above the highest land.
        let farthest = if ray.z > 0.0 { (self.rise / ray.z).min(MAX_DISTANCE_M) } else { MAX_DISTANCE_M };
        loop {
            let far = near + step;
            let far_gap = gap(far);
            if far_gap <= 0.0 {
                return Some(near + step * near_gap / (near_gap - far_gap));
            }
            if far > farthest {
                return None;
            }
            (near, near_gap) = (far, far_gap);
            // Steps grow with the distance, where their length matters less.
            step = 0.2 + near * (0.032 + 2e-4 * near);
        }
    }

    /// The ground at the end of a ray; `level` is one over the ray's horizontal length.
    #[inline(always)]
    pub(super) fn spot(&self, ray: Vec3, level: f32, inverse: f32) -> Spot {
        if inverse == 0.0 {
            return Spot::default();
        }
        let depth = 1.0 / inverse;
        let gx = clip(self.eye.x + depth * ray.x, self.limit.0);
        let gy = clip(self.eye.y + depth * ray.y, self.limit.1);
        let (x, y) = (fixed(gx * GROUND_UNITS_PER_M), fixed(gy * GROUND_UNITS_PER_M));
        let mut spot = Spot { depth, inverse, x, y, ..Spot::default() };
        let station = self.world.terrain.station_at_grid(gx, gy);
        if station == NO_STATION {
            return spot;
        }
        let s = &self.world.road[usize::from(station)];
        let (dx, dy) = (gx - s.gx, gy - s.gy);
        let along = dx * s.tx + dy * s.ty;
        let right = dx * s.ty - dy * s.tx;
        // On the circle of the station's curvature; near enough for the short way to the nearest station.
        let arc = along * (1.0 + s.curvature * right);
        let across = (right - 0.5 * s.curvature * along * arc) * s.across_scale;
        if across.abs() > HALF_M + 4.0 {
            return spot;
        }
        spot.near_road = true;
        spot.look = s.look;
        spot.along = fixed((s.along_m + arc + self.variant.road_shift_m) * ALONG_UNITS_PER_M);
        spot.across = fixed((across + HALF_M) * ACROSS_UNITS_PER_M);
        spot.cos = ((ray.x * s.tx + ray.y * s.ty) * level).abs();
        spot.sin = ((ray.x * s.ty - ray.y * s.tx) * level).abs();
        if depth < SMOOTH_LIGHT_M && (spot.across as u32) < ACROSS_UNITS {
            spot.light = u32::from(self.variant.road_light[fixed(self.world.ground.light(gx, gy)) as usize & 255]);
        }
        spot
    }

    /// If the ground runs smoothly from `a` to `b`: the offset to add to `b.along` so that both lie on the same lap; `None`
    /// where the ground breaks off.
    #[inline(always)]
    pub(super) fn join(&self, a: &Spot, b: &Spot) -> Option<i32> {
        // The sky has inverse depth 0 and so never joins land.
        if a.inverse > 1.25 * b.inverse || b.inverse > 1.25 * a.inverse {
            return None;
        }
        let road = |spot: &Spot| spot.near_road && (spot.across as u32) < ACROSS_UNITS;
        if a.near_road != b.near_road && !road(a) && !road(b) || !a.near_road && !b.near_road {
            return Some(0);
        }
        if a.near_road != b.near_road || a.look != b.look {
            return None;
        }
        let length = fixed(self.world.road_length_m * ALONG_UNITS_PER_M);
        let way = b.along - a.along;
        let lap = if way > length / 2 {
            -length
        } else if way < -length / 2 {
            length
        } else {
            0
        };
        let reach_m = 1.5 + 0.9 * a.depth;
        let (along, across) = (fixed(reach_m * ALONG_UNITS_PER_M), fixed(reach_m * ACROSS_UNITS_PER_M));
        ((way + lap).abs() < along && (b.across - a.across).abs() < across).then_some(lap)
    }

    /// The levels of the road's texture and of the map for the resolution at `a` on `row`, and the haze there.
    #[inline(always)]
    pub(super) fn levels(&self, row: usize, a: &Spot, fall: f32) -> Levels<'_> {
        let wide = a.depth * (1.0 / self.camera.focal_px);
        let long = a.depth * a.depth * fall;
        let larger = |p: f32, q: f32| if p > q { p } else { q };
        let along = larger(a.cos * long, a.sin * wide);
        let across = larger(a.sin * long, a.cos * wide);
        let road = self.world.textures[a.look as usize].level(along, across);
        let ground = self.world.ground.level(wide * larger(2.0 * wide, long));
        Levels { road, ground, scatter: &SCATTER[row % SCATTER.len()], air: self.air(a.depth) }
    }

    /// The haze in front of an object at `depth`.
    #[inline(always)]
    pub(super) fn air(&self, depth: f32) -> Air {
        let share = fixed(255.0 * depth / (depth + self.world.haze_m)) as u32;
        let haze = self.variant.haze;
        Air { clear: 256 - share, red_blue: (haze & RED_BLUE) * share, green: (haze >> 8 & 255) * share }
    }

    /// Shades eight pixels between two marched columns.
    #[inline(always)]
    pub(super) fn shade_span(
        &self,
        a: &Spot,
        b: &Spot,
        lap: i32,
        levels: &Levels,
        out: &mut [[u8; 3]; SPAN],
        depths: &mut [f32; SPAN],
    ) {
        const SPAN_I32: i32 = SPAN as i32;
        let (dx, dy) = ((b.x - a.x) / SPAN_I32, (b.y - a.y) / SPAN_I32);
        let di = (b.inverse - a.inverse) * (1.0 / SPAN as f32);
        for (i, depth) in depths.iter_mut().enumerate() {
            *depth = a.inverse + di * i as f32;
        }
        let mut place = Place { x: a.x, y: a.y, along: a.along, across: a.across, light: a.light as i32 * SPAN_I32 };
        let near_road = a.near_road && b.near_road;
        let texture = &self.world.textures[a.look as usize];
        if !near_road || texture.is_beyond(a.across, b.across) {
            let (ground, air) = (levels.ground, levels.air);
            if ground.is_finest() {
                // Near land has texels larger than pixels; scattered places dissolve their corners.
                // They stay on the map: places end 2 texels before its upper rims, and are scattered by less than one.
                for (out, (sx, sy)) in out.iter_mut().zip(levels.scatter) {
                    self.finish(ground.fetch((place.x + sx).max(0), (place.y + sy).max(0)), FULL, &air, out);
                    place.x += dx;
                    place.y += dy;
                }
                return;
            }
            for out in out {
                self.finish(ground.fetch(place.x, place.y), FULL, &air, out);
                place.x += dx;
                place.y += dy;
            }
            return;
        }
        let (du, dv) = ((b.along + lap - a.along) / SPAN_I32, (b.across - a.across) / SPAN_I32);
        // Light where it is known at both ends, in 1/8 of its steps.
        let dl = if a.light != 0 && b.light != 0 { b.light as i32 - a.light as i32 } else { 0 };
        if a.light != 0 && b.light != 0 && texture.is_paved(a.across) && texture.is_paved(b.across) {
            let (road, air) = (levels.road, levels.air);
            for out in out {
                let texel = road.fetch(place.along, place.across as u32);
                self.finish(texel, place.light as u32 / SPAN as u32, &air, out);
                place.along += du;
                place.across += dv;
                place.light += dl;
            }
            return;
        }
        for out in out {
            self.put(place, true, levels, out);
            place.x += dx;
            place.y += dy;
            place.along += du;
            place.across += dv;
            place.light += dl;
        }
    }

    /// Shades one pixel of ground.
    #[inline(always)]
    fn put(&self, place: Place, near_road: bool, levels: &Levels, out: &mut [u8; 3]) {
        let mut texel = 0;
        if near_road && (place.across as u32) < ACROSS_UNITS {
            texel = levels.road.fetch(place.along, place.across as u32);
        }
        let (alpha, mut light) = (texel >> 24, place.light as u32 / SPAN as u32);
        if alpha == 255 && light != 0 {
            return self.finish(texel, light, &levels.air, out);
        }
        let land = levels.ground.fetch(place.x, place.y);
        if light == 0 {
            light = u32::from(self.variant.road_light[(land >> 24) as usize]);
        }
        // The land's colours are lit already.
        let (road, land_share) = ((alpha * light) >> 8, 256 - alpha);
        let red_blue = ((texel & RED_BLUE) * road + (land & RED_BLUE) * land_share) >> 8 & RED_BLUE;
        let green = ((texel >> 8 & 255) * road + (land >> 8 & 255) * land_share) >> 8;
        self.finish(red_blue | green << 8, FULL, &levels.air, out);
    }

    /// Writes a pixel: `colour` (`0x__BBGGRR`) in `light` of 256, seen through the haze, with the tone curve of the trial. Red and
    /// blue are computed in one word, green in another.
    #[inline(always)]
    pub(super) fn finish(&self, colour: u32, light: u32, air: &Air, out: &mut [u8; 3]) {
        let share = (light * air.clear) >> 8;
        let red_blue = ((colour & RED_BLUE) * share + air.red_blue) >> 8;
        let green = ((colour >> 8 & 255) * share + air.green) >> 8;
        self.tone(red_blue, green, out);
    }

    #[inline(always)]
    fn tone(&self, red_blue: u32, green: u32, out: &mut [u8; 3]) {
        let [red, middle, blue] = &self.variant.tone;
        *out = [red[(red_blue & 255) as usize], middle[(green & 255) as usize], blue[(red_blue >> 16 & 255) as usize]];
    }

    #[inline(never)]
    pub(super) fn shade_sky(&self, row: usize, k: usize, out: &mut [[u8; 3]; SPAN]) {
        let (a, b) = (&self.columns[k], &self.columns[k + 1]);
        let mut turn = b.turn - a.turn;
        if turn.abs() > AROUND as f32 / 2.0 {
            turn -= (AROUND as f32).copysign(turn);
        }
        let mut place = SkyPlace::new(a.turn, self.ray(k, row).z * a.level);
        let step = place.step_to(SkyPlace::new(a.turn + turn, self.ray(k + 1, row).z * b.level), SPAN as i32);
        for out in out {
            self.put_sky(place, out);
            place = place + step;
        }
    }

    #[inline(always)]
    fn put_sky(&self, place: SkyPlace, out: &mut [u8; 3]) {
        let colour = self.world.sky.fetch(place);
        self.tone(colour & RED_BLUE, colour >> 8 & 255, out);
    }

    /// Shades eight pixels between which the ground breaks off, one by one. `below` are the inverse depths of the
    /// pixels below.
    #[inline(never)]
    pub(super) fn shade_each(
        &self,
        row: usize,
        k: usize,
        below: &[f32; SPAN],
        out: &mut [[u8; 3]; SPAN],
        depths: &mut [f32; SPAN],
    ) {
        let level = self.columns[k].level;
        for (i, ((out, depth), below)) in out.iter_mut().zip(depths).zip(below).enumerate() {
            let ray = self.ray(k, row) + self.camera.right * (i as f32 / self.camera.focal_px);
            // Above the sky is only sky.
            let hit = if *below == 0.0 {
                None
            } else {
                self.march(ray, 1.0 / below, ray.z - self.camera.up.z / self.camera.focal_px)
            };
            let Some(hit) = hit else {
                *depth = 0.0;
                // Exactly 1 for the own lens.
                let finer = FOCAL_PX / self.camera.focal_px;
                let turn = self.columns[k].turn - i as f32 * AROUND as f32 / TURN_PX * finer;
                self.put_sky(SkyPlace::new(turn, ray.z * level), out);
                continue;
            };
            *depth = 1.0 / hit;
            let spot = self.spot(ray, level, *depth);
            // On level ground inverse depth grows with the fall of the ray.
            let fall = (self.camera.up.z / self.camera.focal_px / (ray.z - 1e-3).abs()).min(1.0) * spot.inverse;
            let levels = self.levels(row, &spot, fall);
            let Spot { x, y, along, across, light, .. } = spot;
            let place = Place { x, y, along, across, light: light as i32 * SPAN as i32 };
            self.put(place, spot.near_road, &levels, out);
        }
    }
}
