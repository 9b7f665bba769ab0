//! Takes the picture: finds the ground behind each pixel, then looks up what lies there.
//!
//! A picture is made in four passes, none of which calls a function of the mathematical library for a pixel:
//!
//! 1. *March*: in every eighth column, from the bottom up, the ray of each pixel is followed over the land until it goes
//!    below it. A ray is never blocked nearer than the ray below it, so each search starts where the last one ended, and a
//!    crest hides what is behind it.
//! 2. *Shade*: along each row, again from the bottom up, the place on the land is interpolated between these columns (eight
//!    pixels at a time) and the road's texture or the land's map is looked up at the resolution that fits. Where the ground
//!    breaks off between two columns, each pixel is marched on its own, from where the ray of the pixel below ended. Pixels
//!    without ground show the sky.
//! 3. *Stand*: walls and upright things are drawn where they are nearer than the ground.
//! 4. *Bonnet*: the car's own bonnet, which is always in the same place.

use crate::simulator::camera::bonnet::Bonnet;
use crate::simulator::camera::objects;
use crate::simulator::camera::pinhole::{Camera, FOCAL_PX, HEIGHT, Mount, RgbFrame, WIDTH};
use crate::simulator::math::{Vec3, atan2, vec3};
use crate::simulator::scenery::light::Variant;
use crate::simulator::scenery::road_texture::{ACROSS_UNITS, ACROSS_UNITS_PER_M, ALONG_UNITS_PER_M, HALF_M, Level};
use crate::simulator::scenery::sky::{AROUND, SkyPlace};
use crate::simulator::scenery::terrain::{GROUND_UNITS_PER_M, GroundLevel, NO_STATION, clip, fixed};
use crate::simulator::scenery::world::World;

/// Pixels between marched columns.
pub(crate) const SPAN: usize = 8;
/// Marched columns: one more than spans, so that the last span has two ends.
const ANCHORS: usize = WIDTH / SPAN + 1;
/// Nothing farther than this is drawn as land, m.
const FARTHEST_M: f32 = 380.0;
/// Land this near takes the light at its very place, smoothly; farther the light of a texel of the map, m.
const SMOOTH_LIGHT_M: f32 = 45.0;

/// Red and blue of a packed colour.
const RED_BLUE: u32 = 0x00ff_00ff;
/// Full light.
pub(crate) const FULL: u32 = 256;
/// Depth and fall of the rays from which the search of the lowest row starts.
const NEAREST: (f32, f32) = (0.9, -1.0);
/// Inverse depths below the lowest row.
const BELOW_PICTURE: [f32; WIDTH] = [1.0 / NEAREST.0; WIDTH];

/// Takes pictures; keeps its buffers from one to the next.
pub struct Renderer {
    /// Inverse depth (1/m) at each row and marched column; 0 = sky.
    anchors: Vec<f32>,
    /// Inverse depth at each pixel; 0 = sky.
    pub(crate) depths: Vec<f32>,
    bonnet: Bonnet,
}

impl Default for Renderer {
    fn default() -> Self {
        Renderer { anchors: vec![0.0; HEIGHT * ANCHORS], depths: vec![0.0; HEIGHT * WIDTH], bonnet: Bonnet::default() }
    }
}

/// What is needed to find and colour the ground of one picture.
pub(crate) struct View<'a> {
    pub(crate) world: &'a World,
    pub(crate) variant: &'a Variant,
    pub(crate) camera: &'a Camera,
    /// Grid coordinates of the eye; z is its height.
    eye: Vec3,
    /// How much the highest land is above the eye, m.
    rise: f32,
    /// Largest grid coordinates.
    limit: (f32, f32),
    columns: [Column; ANCHORS],
}

/// What the rays of one marched column have in common.
#[derive(Clone, Copy, Default)]
struct Column {
    /// Ray at the middle row; each row adds its share of the camera's up.
    middle: Vec3,
    /// One over the horizontal length of a ray.
    level: f32,
    /// Place on the sky's picture.
    turn: f32,
}

/// The ground at one place of the picture.
#[derive(Clone, Copy, Default)]
struct Spot {
    /// Depth, m, and its inverse, which is 0 for the sky.
    depth: f32,
    inverse: f32,
    /// Place on the land's map, fixed-point.
    x: i32,
    y: i32,
    /// Whether a road is near, and then: its look, place on its texture, fixed-point, light there, and how much it runs
    /// along (cosine) and across (sine) the view.
    near_road: bool,
    look: u32,
    along: i32,
    across: i32,
    light: u32,
    cos: f32,
    sin: f32,
}

/// The air between the eye and a place.
#[derive(Clone, Copy)]
pub(crate) struct Air {
    /// Share of the place's own colour that comes through, of 256.
    clear: u32,
    /// The air's own red and blue, and green, times its share.
    red_blue: u32,
    green: u32,
}

/// The resolutions that fit the distance of a place, and the air before it.
#[derive(Clone, Copy)]
struct Levels<'a> {
    road: Level<'a>,
    ground: GroundLevel<'a>,
    air: Air,
}

/// A place between two spots: on the land, and on the road.
#[derive(Clone, Copy)]
struct Place {
    x: i32,
    y: i32,
    along: i32,
    across: i32,
    /// Light in units of `1 / SPAN`, or 0 where the land's map is to tell.
    light: i32,
}

impl Renderer {
    /// Takes the picture that `camera` (mounted at `mount`) sees of `world` under `variant`.
    pub fn render(&mut self, world: &World, variant: &Variant, camera: &Camera, mount: Mount, frame: &mut RgbFrame) {
        let eye = vec3(camera.eye.x - world.terrain.x0, camera.eye.y - world.terrain.y0, camera.eye.z);
        let columns = std::array::from_fn(|k| {
            let column = (k * SPAN) as f32 + 0.5;
            let ray = camera.ray(column, HEIGHT as f32 / 2.0);
            let sky = camera.ray(column, 30.0);
            let turn = atan2(f64::from(sky.y), f64::from(sky.x)) / std::f64::consts::TAU;
            Column {
                middle: ray,
                level: 1.0 / (ray.x * ray.x + ray.y * ray.y).sqrt(),
                turn: turn as f32 * AROUND as f32,
            }
        });
        let limit = (world.terrain.nx as f32 - 1.01, world.terrain.ny as f32 - 1.01);
        let rise = world.terrain.highest_m() - eye.z;
        let view = View { world, variant, camera, eye, rise, limit, columns };
        frame.pixels.resize(WIDTH * HEIGHT * 3, 0);
        self.march(&view, mount);
        self.shade(&view, mount, frame);
        objects::draw(&mut self.depths, &view, frame);
        self.bonnet.draw(mount, variant, frame);
    }

    /// Depth along the camera's axis at a pixel of the last picture, m; infinite for the sky.
    pub fn depth_m(&self, column: usize, row: usize) -> f32 {
        1.0 / self.depths[row * WIDTH + column]
    }

    /// Finds the depth at every row of the marched columns. Rows are the outer loop: the searches of a row do not depend
    /// on each other, so the processor works on several at once.
    fn march(&mut self, view: &View, mount: Mount) {
        let mut lasts = [Some(NEAREST); ANCHORS];
        for (row, anchors) in self.anchors.chunks_exact_mut(ANCHORS).enumerate().rev() {
            // Shading looks at the row below too, so only what is hidden in both rows is left out.
            let hidden = self.bonnet.hidden_spans(mount, row.saturating_sub(1));
            for (k, (anchor, last)) in anchors.iter_mut().zip(&mut lasts).enumerate() {
                // Above the first ray that meets no land none does.
                *anchor = 0.0;
                if hidden.start < k && k < hidden.end {
                    continue;
                }
                if let Some((depth, fall)) = *last {
                    let ray = view.ray(k, row);
                    *last = view.march(ray, depth, fall).map(|hit| (hit, ray.z));
                    if let Some((hit, _)) = *last {
                        *anchor = 1.0 / hit;
                    }
                }
            }
        }
    }

    fn shade(&mut self, view: &View, mount: Mount, frame: &mut RgbFrame) {
        let mut spots = [Spot::default(); ANCHORS];
        for row in (0..HEIGHT).rev() {
            let inverses = &self.anchors[row * ANCHORS..(row + 1) * ANCHORS];
            let below = &self.anchors[(row + 1).min(HEIGHT - 1) * ANCHORS..][..ANCHORS];
            let hidden = self.bonnet.hidden_spans(mount, row);
            for (k, spot) in spots.iter_mut().enumerate() {
                *spot = view.spot(view.ray(k, row), view.columns[k].level, inverses[k]);
            }
            let (pixels, _) = frame.pixels[row * WIDTH * 3..(row + 1) * WIDTH * 3].as_chunks_mut();
            let (depths, rest) = self.depths[row * WIDTH..].split_at_mut(WIDTH);
            let (depths, _) = depths.as_chunks_mut::<SPAN>();
            let (depths_below, _) = rest.get(..WIDTH).unwrap_or(&BELOW_PICTURE).as_chunks();
            let mut known = spots[0];
            let mut levels = view.levels(&known, (below[0] - known.inverse).abs());
            for (k, (out, depth)) in pixels.as_chunks_mut().0.iter_mut().zip(depths).enumerate() {
                let (a, b) = (&spots[k], &spots[k + 1]);
                if hidden.contains(&k) {
                    // Nearer than anything that might be drawn there.
                    depth.fill(1.0 / NEAREST.0);
                    continue;
                }
                if a.inverse == 0.0 && b.inverse == 0.0 {
                    depth.fill(0.0);
                    view.shade_sky(row, k, out);
                } else if let Some(lap) = view.join(a, b) {
                    // The resolution changes slowly along a row.
                    if a.look != known.look
                        || a.near_road != known.near_road
                        || (a.depth - known.depth).abs() > 0.08 * a.depth
                    {
                        levels = view.levels(a, (below[k] - a.inverse).abs());
                        known = *a;
                    }
                    view.shade_span(a, b, lap, &levels, out, depth);
                } else {
                    view.shade_each(row, k, &depths_below[k], out, depth);
                }
            }
        }
    }
}

impl View<'_> {
    /// Ray through a marched column at a row.
    #[inline(always)]
    fn ray(&self, k: usize, row: usize) -> Vec3 {
        self.columns[k].middle + self.camera.up * ((HEIGHT as f32 / 2.0 - 0.5 - row as f32) * (1.0 / FOCAL_PX))
    }

    /// Follows a ray from `from` (a depth where it is known to be above the land) to where it enters the land.
    ///
    /// `last_fall` is the fall of the ray below, which met the land at `from`: on even land it tells where this one will.
    #[inline(always)]
    fn march(&self, ray: Vec3, from: f32, last_fall: f32) -> Option<f32> {
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
        let farthest = if ray.z > 0.0 { (self.rise / ray.z).min(FARTHEST_M) } else { FARTHEST_M };
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
            // Longer steps where a step's length shows less.
            step = 0.2 + near * (0.032 + 2e-4 * near);
        }
    }

    /// The ground at the end of a ray; `level` is one over the ray's horizontal length.
    #[inline(always)]
    fn spot(&self, ray: Vec3, level: f32, inverse: f32) -> Spot {
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

    /// Whether the ground runs smoothly from `a` to `b`; then what to add to the place of `b` along the road so that both
    /// are on the same lap.
    #[inline(always)]
    fn join(&self, a: &Spot, b: &Spot) -> Option<i32> {
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

    /// The resolution that fits: the road's texture and the land's map; and the air's share of the colour.
    #[inline(always)]
    fn levels(&self, a: &Spot, fall: f32) -> Levels<'_> {
        let wide = a.depth * (1.0 / FOCAL_PX);
        let long = a.depth * a.depth * fall;
        let larger = |p: f32, q: f32| if p > q { p } else { q };
        let along = larger(a.cos * long, a.sin * wide);
        let across = larger(a.sin * long, a.cos * wide);
        let road = self.world.textures[a.look as usize].level(along, across);
        let ground = self.world.ground.level(wide * larger(2.0 * wide, long));
        Levels { road, ground, air: self.air(a.depth) }
    }

    /// The air before a thing at `depth`.
    #[inline(always)]
    pub(crate) fn air(&self, depth: f32) -> Air {
        let share = fixed(255.0 * depth / (depth + self.world.haze_m)) as u32;
        let haze = self.variant.haze;
        Air { clear: 256 - share, red_blue: (haze & RED_BLUE) * share, green: (haze >> 8 & 255) * share }
    }

    /// Colours eight pixels between two marched columns.
    fn shade_span(
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

    /// Colours one pixel of ground.
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

    /// Writes a pixel: `colour` (`0x__BBGGRR`) in `light` of 256, seen through the air, in the tone of the run. Red and
    /// blue are computed in one word, green in another.
    #[inline(always)]
    pub(crate) fn finish(&self, colour: u32, light: u32, air: &Air, out: &mut [u8; 3]) {
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
    fn shade_sky(&self, row: usize, k: usize, out: &mut [[u8; 3]; SPAN]) {
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

    /// Colours eight pixels between which the ground breaks off, each on its own. `below` are the inverse depths of the
    /// pixels below.
    #[inline(never)]
    fn shade_each(
        &self,
        row: usize,
        k: usize,
        below: &[f32; SPAN],
        out: &mut [[u8; 3]; SPAN],
        depths: &mut [f32; SPAN],
    ) {
        let level = self.columns[k].level;
        for (i, ((out, depth), below)) in out.iter_mut().zip(depths).zip(below).enumerate() {
            let ray = self.ray(k, row) + self.camera.right * (i as f32 / FOCAL_PX);
            // Above the sky is only sky.
            let hit =
                if *below == 0.0 { None } else { self.march(ray, 1.0 / below, ray.z - self.camera.up.z / FOCAL_PX) };
            let Some(hit) = hit else {
                *depth = 0.0;
                let turn = self.columns[k].turn - i as f32 * AROUND as f32 / 900.0;
                self.put_sky(SkyPlace::new(turn, ray.z * level), out);
                continue;
            };
            *depth = 1.0 / hit;
            let spot = self.spot(ray, level, *depth);
            // On level ground inverse depth grows with the fall of the ray.
            let fall = (self.camera.up.z / FOCAL_PX / (ray.z - 1e-3).abs()).min(1.0) * spot.inverse;
            let levels = self.levels(&spot, fall);
            let Spot { x, y, along, across, light, .. } = spot;
            let place = Place { x, y, along, across, light: light as i32 * SPAN as i32 };
            self.put(place, spot.near_road, &levels, out);
        }
    }
}
