//! Takes the picture: finds the ground behind each pixel, then looks up what lies there.
//!
//! A picture is made in four passes, none of which calls a function of the mathematical library for a pixel:
//!
//! 1. *March*: in every fourth column, from the bottom up, the ray of each pixel is followed over the land until it goes
//!    below it. A ray is never blocked nearer than the ray below it, so each search starts where the last one ended, and a
//!    crest hides what is behind it.
//! 2. *Shade*: along each row the place on the land is interpolated between these columns (four pixels at a time) and the
//!    road's texture or the land's map is looked up at the resolution that fits. Where the ground breaks off between two
//!    columns, each pixel is marched on its own. Pixels without ground show the sky.
//! 3. *Stand*: walls and upright things are drawn where they are nearer than the ground.
//! 4. *Bonnet*: the car's own bonnet, which is always in the same place.

use super::bonnet;
use super::camera::{Camera, FOCAL_PX, HEIGHT, Mount, RgbFrame, WIDTH};
use super::light::Variant;
use super::math::{Vec3, atan2, vec3};
use super::objects;
use super::road_texture::{HALF_M, Level, RoadTexture};
use super::sky::AROUND;
use super::terrain::{GroundLevel, NO_STATION};
use super::world::World;

/// Pixels between marched columns.
const SPAN: usize = 4;
/// Marched columns: one more than spans, so that the last span has two ends.
const ANCHORS: usize = WIDTH / SPAN + 1;
/// Nothing farther than this is drawn as land, m.
const FARTHEST_M: f32 = 380.0;

/// Takes pictures; keeps its buffers from one to the next.
pub struct Renderer {
    /// Inverse depth (1/m) at each row and marched column; 0 = sky.
    anchors: Vec<f32>,
    /// Inverse depth at each pixel; 0 = sky.
    pub(super) depths: Vec<f32>,
}

impl Default for Renderer {
    fn default() -> Self {
        Renderer { anchors: vec![0.0; HEIGHT * ANCHORS], depths: vec![0.0; HEIGHT * WIDTH] }
    }
}

/// What is needed to find and colour the ground of one picture.
pub(super) struct View<'a> {
    pub(super) world: &'a World,
    pub(super) variant: &'a Variant,
    pub(super) camera: &'a Camera,
    /// Grid coordinates of the eye; z is its height.
    eye: Vec3,
}

/// The ground at one place of the picture.
#[derive(Clone, Copy, Default)]
struct Spot {
    /// Inverse depth, 1/m; 0 = sky.
    inverse: f32,
    /// Grid coordinates, m.
    gx: f32,
    gy: f32,
    /// Nearest station, or `NO_STATION`.
    station: u16,
    look: u32,
    /// Place on the road's texture, m.
    along: f32,
    across: f32,
}

impl Renderer {
    /// Takes the picture that `camera` (mounted at `mount`) sees of `world` under `variant`.
    pub fn render(&mut self, world: &World, variant: &Variant, camera: &Camera, mount: Mount, frame: &mut RgbFrame) {
        let eye = vec3(camera.eye.x - world.terrain.x0, camera.eye.y - world.terrain.y0, camera.eye.z);
        let view = View { world, variant, camera, eye };
        frame.pixels.resize(WIDTH * HEIGHT * 3, 0);
        for k in 0..ANCHORS {
            self.march_column(&view, k);
        }
        self.shade(&view, frame);
        objects::draw(self, &view, frame);
        bonnet::draw(mount, variant, frame);
    }

    fn march_column(&mut self, view: &View, k: usize) {
        let column = (k * SPAN) as f32 + 0.5;
        let (mut depth, mut fall) = (0.9, -1.0);
        for row in (0..HEIGHT).rev() {
            let ray = view.camera.ray(column, row as f32 + 0.5);
            match view.march(ray, depth, fall) {
                Some(hit) => {
                    self.anchors[row * ANCHORS + k] = 1.0 / hit;
                    (depth, fall) = (hit, ray.z);
                }
                None => {
                    for above in 0..=row {
                        self.anchors[above * ANCHORS + k] = 0.0;
                    }
                    return;
                }
            }
        }
    }

    fn shade(&mut self, view: &View, frame: &mut RgbFrame) {
        let camera = view.camera;
        let turns: [f32; ANCHORS] = std::array::from_fn(|k| {
            let ray = camera.ray((k * SPAN) as f32 + 0.5, 30.0);
            (atan2(f64::from(ray.y), f64::from(ray.x)) / std::f64::consts::TAU * AROUND as f64) as f32
        });
        let mut spots = [Spot::default(); ANCHORS];
        for row in 0..HEIGHT {
            let inverses = &self.anchors[row * ANCHORS..(row + 1) * ANCHORS];
            for (k, spot) in spots.iter_mut().enumerate() {
                *spot = view.spot(camera.ray((k * SPAN) as f32 + 0.5, row as f32 + 0.5), inverses[k]);
            }
            let below = (row + 1).min(HEIGHT - 1);
            let pixels = &mut frame.pixels[row * WIDTH * 3..(row + 1) * WIDTH * 3];
            let depths = &mut self.depths[row * WIDTH..(row + 1) * WIDTH];
            for (k, (out, depth)) in pixels.chunks_exact_mut(3 * SPAN).zip(depths.chunks_exact_mut(SPAN)).enumerate() {
                let (mut a, mut b) = (spots[k], spots[k + 1]);
                let fall = (self.anchors[below * ANCHORS + k] - a.inverse).abs().max(1e-5);
                if a.inverse == 0.0 && b.inverse == 0.0 {
                    depth.fill(0.0);
                    view.shade_sky(row, k, turns[k], turns[k + 1], out);
                } else if view.join(&mut a, &mut b) {
                    view.shade_span(&a, &b, fall, out, depth);
                } else {
                    view.shade_each(row, k, &a, &b, turns[k], out, depth);
                }
            }
        }
    }
}

impl View<'_> {
    /// Follows a ray from `from` (a depth where it is known to be above the land) to where it enters the land.
    ///
    /// `last_fall` is the fall of the ray below, which met the land at `from`: on even land it tells where this one will.
    #[inline(always)]
    fn march(&self, ray: Vec3, from: f32, last_fall: f32) -> Option<f32> {
        let gap = |t: f32| {
            self.eye.z + t * ray.z - self.world.terrain.height_at_grid(self.eye.x + t * ray.x, self.eye.y + t * ray.y)
        };
        let (mut near, mut near_gap) = (from, (from * (ray.z - last_fall)).max(1e-4));
        let mut step = (0.04 * near).max(0.4);
        if ray.z < -0.01 {
            step = step.min(1.25 * near * (last_fall / ray.z - 1.0)).max(0.01);
        }
        loop {
            let far = near + step;
            let far_gap = gap(far);
            if far_gap <= 0.0 {
                let t = near + step * near_gap / (near_gap - far_gap);
                return Some(t);
            }
            if far > FARTHEST_M {
                return None;
            }
            (near, near_gap) = (far, far_gap);
            step = (0.032 * near).max(0.3);
        }
    }

    /// The ground at the end of a ray.
    #[inline(always)]
    fn spot(&self, ray: Vec3, inverse: f32) -> Spot {
        if inverse == 0.0 {
            return Spot::default();
        }
        let depth = 1.0 / inverse;
        let (gx, gy) = (self.eye.x + depth * ray.x, self.eye.y + depth * ray.y);
        let station = self.world.terrain.station_at_grid(gx, gy);
        if station == NO_STATION {
            return Spot { inverse, gx, gy, station, look: 0, along: 0.0, across: 1e3 };
        }
        let s = &self.world.road[usize::from(station)];
        let (dx, dy) = (gx - s.gx, gy - s.gy);
        let along = dx * s.tx + dy * s.ty;
        let right = dx * s.ty - dy * s.tx;
        let stretch = (1.0 - s.curvature * right).max(0.3);
        let arc = along / stretch;
        let across = (right - s.curvature * along * arc * 0.5) * s.across_scale;
        Spot { inverse, gx, gy, station, look: s.look, along: s.along_m + arc + self.variant.road_shift_m, across }
    }

    /// Whether the ground runs smoothly from `a` to `b`; brings their places along the road to the same lap.
    #[inline(always)]
    fn join(&self, a: &mut Spot, b: &mut Spot) -> bool {
        if a.inverse == 0.0 || b.inverse == 0.0 || a.inverse > 1.2 * b.inverse || b.inverse > 1.2 * a.inverse {
            return false;
        }
        if a.across.abs() > HALF_M && b.across.abs() > HALF_M {
            // No road at either end; between them only if they lie on different sides of one.
            let far = a.station == NO_STATION || b.station == NO_STATION;
            if far || a.across * b.across > 0.0 {
                return true;
            }
        }
        let length = self.world.road_length_m;
        if a.along - b.along > length / 2.0 {
            b.along += length;
        } else if b.along - a.along > length / 2.0 {
            a.along += length;
        }
        // Four pixels at this depth cover four pixel widths of ground, or more if it runs away from the camera.
        let reach = (24.0 / (FOCAL_PX * a.inverse)).max(0.5) * 3.0;
        a.look == b.look && (a.along - b.along).abs() < reach && (a.across - b.across).abs() < reach
    }

    /// Looks up the resolution that fits: the road's texture and the land's map.
    #[inline(always)]
    fn levels(&self, a: &Spot, fall: f32) -> (Level<'_>, GroundLevel<'_>, u32) {
        let depth = 1.0 / a.inverse;
        let wide = depth / FOCAL_PX;
        let long = depth * depth * fall;
        let (mut cos, mut sin) = (1.0, 0.0);
        if a.station != NO_STATION {
            let s = &self.world.road[usize::from(a.station)];
            let (dx, dy) = (a.gx - self.eye.x, a.gy - self.eye.y);
            let norm = 1.0 / (dx * dx + dy * dy).sqrt().max(1e-3);
            cos = ((dx * s.tx + dy * s.ty) * norm).abs();
            sin = ((dx * s.ty - dy * s.tx) * norm).abs();
        }
        let texture: &RoadTexture = &self.world.textures[a.look as usize];
        let road = texture.level((cos * long).max(sin * wide), (sin * long).max(cos * wide));
        let ground = self.world.ground.level((wide * (2.0 * wide).max(long)).sqrt());
        let haze = (256.0 * depth / (depth + self.world.haze_m)) as u32;
        (road, ground, haze)
    }

    #[inline(always)]
    fn shade_span(&self, a: &Spot, b: &Spot, fall: f32, out: &mut [u8], depths: &mut [f32]) {
        let (road, ground, haze) = self.levels(a, fall);
        let quarter = 1.0 / SPAN as f32;
        let (dgx, dgy) = ((b.gx - a.gx) * quarter, (b.gy - a.gy) * quarter);
        let (du, dv) = ((b.along - a.along) * quarter, (b.across - a.across) * quarter);
        let di = (b.inverse - a.inverse) * quarter;
        for (k, (out, depth)) in out.chunks_exact_mut(3).zip(depths).enumerate() {
            let k = k as f32;
            *depth = a.inverse + di * k;
            let place = (a.gx + dgx * k, a.gy + dgy * k, a.along + du * k, a.across + dv * k);
            self.put(place, &road, &ground, haze, out);
        }
    }

    /// Colours one pixel of ground.
    #[inline(always)]
    fn put(&self, place: (f32, f32, f32, f32), road: &Level, ground: &GroundLevel, haze: u32, out: &mut [u8]) {
        let (gx, gy, along, across) = place;
        let land = ground.fetch(gx, gy);
        let mut rgb = [land & 255, land >> 8 & 255, land >> 16 & 255];
        if across.abs() < HALF_M {
            let texel = road.fetch(along, across);
            let alpha = texel >> 24;
            if alpha > 0 {
                let light = &self.variant.road_light[(land >> 24) as usize];
                let lit = [0, 1, 2].map(|c| (texel >> (8 * c) & 255) * light[c] >> 8);
                for c in 0..3 {
                    rgb[c] = if alpha == 255 { lit[c] } else { (lit[c] * alpha + rgb[c] * (255 - alpha)) / 255 };
                }
            }
        }
        self.finish(rgb, haze, out);
    }

    /// Adds air and the light of the run, and writes the pixel.
    #[inline(always)]
    pub(super) fn finish(&self, rgb: [u32; 3], haze: u32, out: &mut [u8]) {
        for c in 0..3 {
            let v = (rgb[c] * (256 - haze) + self.variant.haze[c] * haze) >> 8;
            out[c] = self.variant.tone[c][v.min(255) as usize];
        }
    }

    #[inline(always)]
    fn shade_sky(&self, row: usize, k: usize, turn_a: f32, turn_b: f32, out: &mut [u8]) {
        let tangent = |column: usize| {
            let ray = self.camera.ray(column as f32 + 0.5, row as f32 + 0.5);
            ray.z / (ray.x * ray.x + ray.y * ray.y).sqrt()
        };
        let (from, to) = (tangent(k * SPAN), tangent((k + 1) * SPAN));
        let mut dturn = turn_b - turn_a;
        if dturn.abs() > AROUND as f32 / 2.0 {
            dturn -= (AROUND as f32).copysign(dturn);
        }
        for (i, out) in out.chunks_exact_mut(3).enumerate() {
            let t = i as f32 / SPAN as f32;
            self.put_sky(turn_a + dturn * t, from + (to - from) * t, out);
        }
    }

    #[inline(always)]
    fn put_sky(&self, turn: f32, tangent: f32, out: &mut [u8]) {
        let texel = self.world.sky.fetch(turn + 2.0 * AROUND as f32, tangent);
        self.finish([texel & 255, texel >> 8 & 255, texel >> 16 & 255], 0, out);
    }

    /// Colours four pixels between which the ground breaks off, each on its own.
    #[allow(clippy::too_many_arguments, reason = "the two ends of a span, its place, and the two buffers it fills")]
    fn shade_each(&self, row: usize, k: usize, a: &Spot, b: &Spot, turn: f32, out: &mut [u8], depths: &mut [f32]) {
        let nearest = 0.93 / a.inverse.max(b.inverse);
        for (i, (out, depth)) in out.chunks_exact_mut(3).zip(depths).enumerate() {
            let ray = self.camera.ray((k * SPAN + i) as f32 + 0.5, row as f32 + 0.5);
            let hit = self.march(ray, nearest, ray.z - 0.02);
            *depth = hit.map_or(0.0, |t| 1.0 / t);
            if hit.is_none() {
                self.put_sky(turn, ray.z / (ray.x * ray.x + ray.y * ray.y).sqrt(), out);
                continue;
            }
            let spot = self.spot(ray, *depth);
            let lower = self.camera.ray((k * SPAN + i) as f32 + 0.5, row as f32 + 1.5);
            // On level ground inverse depth grows with the fall of the ray.
            let fall = ((lower.z / ray.z.min(-1e-3) - 1.0).abs() * spot.inverse).clamp(1e-5, 0.05);
            let (road, ground, haze) = self.levels(&spot, fall);
            self.put((spot.gx, spot.gy, spot.along, spot.across), &road, &ground, haze, out);
        }
    }
}
