//! The visible world of a track, prepared once so that rendering only looks values up.

use crate::simulator::math::{Rng, Vec3, lerp, sin_cos, smoothstep, value_noise, vec3};
use crate::simulator::road::line::{Road, Station, WALL_GAP_M};
use crate::simulator::road::spec::{Look, Plant, Wall};
use crate::simulator::scenery::pictures::Picture;
use crate::simulator::scenery::road_texture::{HALF_ROAD_M, PERIOD_M, RoadTexture, is_raised};
use crate::simulator::scenery::sky::Sky;
use crate::simulator::scenery::terrain::{GroundMap, NO_STATION, Terrain};

/// A station in the form the renderer needs.
#[derive(Clone, Copy)]
pub struct RoadCell {
    /// Grid coordinates, m.
    pub gx: f32,
    /// See `gx`.
    pub gy: f32,
    /// Direction of the line.
    pub tx: f32,
    /// See `tx`.
    pub ty: f32,
    /// Curvature, 1/m, + = right.
    pub curvature: f32,
    /// Place along the texture, m; runs from 0 to a whole number of periods.
    pub along_m: f32,
    /// Metres of texture per metre to the right.
    pub across_scale: f32,
    /// Index of the texture.
    pub look: u32,
}

/// A billboard: an upright picture that always faces the camera.
pub struct Sprite {
    /// Foot in the world.
    pub foot: Vec3,
    /// Index of the picture.
    pub picture: usize,
    /// Size relative to the picture's.
    pub scale: f32,
    /// Light that falls on it, 1 = full sun.
    pub light: f32,
    /// Whether the picture is mirrored.
    pub mirrored: bool,
}

/// One upright piece of wall between two points of its foot.
pub struct WallPiece {
    /// Foot of one end.
    pub from: Vec3,
    /// Foot of the other end.
    pub to: Vec3,
    /// Kind.
    pub wall: Wall,
    /// Distance along the wall at `from`, m.
    pub along_m: f32,
    /// Light that falls on it.
    pub light: f32,
}

/// The visible world of one track.
pub struct World {
    /// Heights.
    pub terrain: Terrain,
    /// Lit land from above.
    pub ground: GroundMap,
    /// Stations for the renderer.
    pub road: Vec<RoadCell>,
    /// Length of a lap in texture metres; a whole number of periods.
    pub road_length_m: f32,
    /// Surfaces: of each look one, or one for each `SUN_SIDES` if it has raised edges.
    pub textures: Vec<RoadTexture>,
    /// Objects beside the road.
    pub sprites: Vec<Sprite>,
    /// Their pictures.
    pub pictures: Vec<Picture>,
    /// Walls.
    pub walls: Vec<WallPiece>,
    /// Sky and the farthest hills.
    pub sky: Sky,
    /// Colour of distant air.
    pub haze: [f32; 3],
    /// Distance at which haze hides half of an object, m.
    pub haze_m: f32,
}

impl World {
    /// Prepares the world of a track.
    pub fn build(road: &Road) -> World {
        let (land, light) = (&road.spec.land, &road.spec.light);
        let terrain = Terrain::build(road);
        let sun = {
            let (sin_a, cos_a) = sin_cos(light.sun_azimuth_deg.to_radians());
            let (sin_e, cos_e) = sin_cos(light.sun_elevation_deg.clamp(5.0, 85.0).to_radians());
            vec3((cos_a * cos_e) as f32, (sin_a * cos_e) as f32, sin_e as f32)
        };
        let sunlight = light.sun.map(|c| f32::from(c) / 255.0);
        let lit = terrain.lit(sun, light.shade);
        let mut scenery = Scenery::new(road, &terrain, &lit);
        scenery.plant();
        scenery.post();
        scenery.wood();
        scenery.lead_power_line();
        let walls = walls(road, &terrain, &lit);
        let shadow = shadows(road, &terrain, &scenery.sprites, &scenery.kinds, sun);
        let ground = GroundMap::build(road, &terrain, &lit, &shadow);
        let periods = (road.length_m / f64::from(PERIOD_M)).round().max(1.0) as f32;
        let road_length_m = periods * PERIOD_M;
        let surfaces = surfaces(&road.spec.look);
        World {
            ground,
            road: road_cells(road, &terrain, road_length_m, sun, &surfaces),
            road_length_m,
            textures: surfaces
                .iter()
                .map(|(look, side)| {
                    let seed = land.seed * 31 + 97 * (*look as u32 + 1);
                    RoadTexture::paint(&road.spec.look[*look], sunlight, *side, seed)
                })
                .collect(),
            sprites: scenery.sprites,
            pictures: scenery.pictures,
            walls,
            sky: Sky::paint(road),
            haze: light.horizon.map(f32::from),
            haze_m: light.haze_m,
            terrain,
        }
    }
}

/// Shares of the sun's direction from the right for which a look with raised edges is painted.
const SUN_SIDES: [f32; 3] = [-0.8, 0.0, 0.8];

/// Index of the look and share of sun from the right of each texture.
fn surfaces(looks: &[Look]) -> Vec<(usize, f32)> {
    let of_look = |(k, look): (usize, &Look)| {
        let raised = is_raised(look.left) || is_raised(look.right);
        let sides: &[f32] = if raised { &SUN_SIDES } else { &[0.0] };
        sides.iter().map(move |side| (k, *side)).collect::<Vec<_>>()
    };
    looks.iter().enumerate().flat_map(of_look).collect()
}

fn road_cells(
    road: &Road,
    terrain: &Terrain,
    road_length_m: f32,
    sun: Vec3,
    surfaces: &[(usize, f32)],
) -> Vec<RoadCell> {
    let n = road.stations.len() as f32;
    let flat = (sun.x * sun.x + sun.y * sun.y).sqrt().max(1e-3);
    let cell = |(i, s): (usize, &Station)| {
        let name = road.spec.setting_at(road.s_of(i), |s| s.look.clone());
        let look = name.and_then(|n| road.spec.look.iter().position(|l| l.name == n)).unwrap_or(0);
        let from_right = (sun.x * s.ty as f32 - sun.y * s.tx as f32) / flat;
        let apart = |k: &usize| (surfaces[*k].1 - from_right).abs();
        let of_look = (0..surfaces.len()).filter(|k| surfaces[*k].0 == look);
        let texture = of_look.min_by(|a, b| apart(a).total_cmp(&apart(b))).unwrap_or(0);
        RoadCell {
            gx: s.x as f32 - terrain.x0,
            gy: s.y as f32 - terrain.y0,
            tx: s.tx as f32,
            ty: s.ty as f32,
            curvature: s.curvature as f32,
            along_m: road_length_m * i as f32 / n,
            across_scale: 2.0 * HALF_ROAD_M / s.width_m as f32,
            look: texture as u32,
        }
    };
    road.stations.iter().enumerate().map(cell).collect()
}

/// Light at a point, from the lit grid.
fn light_at(terrain: &Terrain, lit: &[(f32, f32)], x: f32, y: f32) -> f32 {
    let i = ((x - terrain.x0).max(0.0) as usize).min(terrain.nx - 1);
    let j = ((y - terrain.y0).max(0.0) as usize).min(terrain.ny - 1);
    lit[j * terrain.nx + i].0
}

fn walls(road: &Road, terrain: &Terrain, lit: &[(f32, f32)]) -> Vec<WallPiece> {
    const STEP: usize = 3;
    let n = road.stations.len();
    let mut pieces = Vec::new();
    for (side, sign) in [(0, -1.0), (1, 1.0)] {
        for i in (0..n).step_by(STEP) {
            let s_m = road.s_of(i);
            let Some(wall) = road.wall_at(s_m, side == 1) else { continue };
            let foot = |k: usize| {
                let s = &road.stations[k % n];
                let d = sign * (s.width_m / 2.0 + WALL_GAP_M);
                vec3((s.x + s.ty * d) as f32, (s.y - s.tx * d) as f32, (s.z - s.crossfall * d) as f32)
            };
            let (from, to) = (foot(i), foot((i + STEP).min(n)));
            let light = light_at(terrain, lit, from.x, from.y);
            pieces.push(WallPiece { from, to, wall, along_m: s_m as f32, light });
        }
    }
    pieces
}

/// Pictures of each kind of plant, so that neighbours differ.
const VARIANTS: usize = 3;

struct Scenery<'a> {
    road: &'a Road,
    terrain: &'a Terrain,
    lit: &'a [(f32, f32)],
    pictures: Vec<Picture>,
    kinds: Vec<Plant>,
    sprites: Vec<Sprite>,
}

impl<'a> Scenery<'a> {
    fn new(road: &'a Road, terrain: &'a Terrain, lit: &'a [(f32, f32)]) -> Self {
        Scenery { road, terrain, lit, pictures: Vec::new(), kinds: Vec::new(), sprites: Vec::new() }
    }

    /// Index of the first of the pictures of `plant`.
    fn pictures_of(&mut self, plant: Plant) -> usize {
        if let Some(at) = self.kinds.iter().position(|k| *k == plant) {
            return at;
        }
        for variant in 0..VARIANTS as u32 {
            self.pictures.push(Picture::paint(plant, self.road.spec.land.seed + 100 * variant));
            self.kinds.push(plant);
        }
        self.pictures.len() - VARIANTS
    }

    /// Distance from the edge of the nearest road, m; `None` far from any road.
    fn distance_from_edge(&self, x: f32, y: f32) -> Option<f32> {
        let station = self.terrain.station_at_grid(x - self.terrain.x0, y - self.terrain.y0);
        (station != NO_STATION).then(|| {
            let s = &self.road.stations[usize::from(station)];
            let (dx, dy) = (x - s.x as f32, y - s.y as f32);
            (dx * dx + dy * dy).sqrt() - s.width_m as f32 / 2.0
        })
    }

    fn stand(&mut self, x: f32, y: f32, picture: usize, scale: f32, mirrored: bool) {
        let z = self.terrain.height(x, y);
        if self.road.spec.land.water_level_m.is_some_and(|level| z < level + 0.3) {
            return;
        }
        let light = 0.35 + 0.65 * light_at(self.terrain, self.lit, x, y).min(1.1);
        self.sprites.push(Sprite { foot: vec3(x, y, z - 0.1), picture, scale, light, mirrored });
    }

    /// Groves on the land away from the road.
    fn wood(&mut self) {
        const GROVES: f32 = 44.0;
        const TREES: usize = 7;
        let land = &self.road.spec.land;
        let tall = land.plants.iter().copied().find(|p| !matches!(p, Plant::Bush | Plant::Boulder | Plant::Reeds));
        let Some(tree) = tall.filter(|_| land.woods > 0.0) else { return };
        let mut rng = Rng::new(u64::from(land.seed), "woods");
        let first = self.pictures_of(tree);
        for _ in 0..(GROVES * land.woods) as usize {
            let (x, y) = self.anywhere(&mut rng);
            for _ in 0..TREES {
                let (x, y) = (x + rng.normal() as f32 * 6.0, y + rng.normal() as f32 * 6.0);
                let (variant, scale, mirrored) = (rng.below(VARIANTS), rng.between(0.7, 1.15), rng.unit() < 0.5);
                if self.is_on_land(x, y) && self.distance_from_edge(x, y).is_none_or(|e| e >= 16.0) {
                    self.stand(x, y, first + variant, scale as f32, mirrored);
                }
            }
        }
    }

    /// Pylons in a straight line across the land, those near the road left out.
    fn lead_power_line(&mut self) {
        const STEP_M: f64 = 85.0;
        if !self.road.spec.land.pylons {
            return;
        }
        let mut rng = Rng::new(u64::from(self.road.spec.land.seed), "pylons");
        let picture = self.pictures_of(Plant::Pylon);
        let (nx, ny) = (self.terrain.nx as f64, self.terrain.ny as f64);
        let (sin, cos) = sin_cos(rng.between(0.0, std::f64::consts::PI));
        let (x, y) = (nx * rng.between(0.3, 0.7), ny * rng.between(0.3, 0.7));
        for k in -8..=8 {
            let along = f64::from(k) * STEP_M;
            let (x, y) = (self.terrain.x0 + (x + cos * along) as f32, self.terrain.y0 + (y + sin * along) as f32);
            if self.is_on_land(x, y) && self.distance_from_edge(x, y).is_none_or(|e| e >= 12.0) {
                self.stand(x, y, picture, 1.0, false);
            }
        }
    }

    /// A random place on the grid of the land.
    fn anywhere(&self, rng: &mut Rng) -> (f32, f32) {
        let (nx, ny) = (self.terrain.nx as f64, self.terrain.ny as f64);
        let (x, y) = (rng.between(2.0, nx - 2.0), rng.between(2.0, ny - 2.0));
        ((f64::from(self.terrain.x0) + x) as f32, (f64::from(self.terrain.y0) + y) as f32)
    }

    /// Whether the place lies on the grid of the land.
    fn is_on_land(&self, x: f32, y: f32) -> bool {
        let (gx, gy) = (x - self.terrain.x0, y - self.terrain.y0);
        (1.0..self.terrain.nx as f32 - 2.0).contains(&gx) && (1.0..self.terrain.ny as f32 - 2.0).contains(&gy)
    }

    fn plant(&mut self) {
        let land = &self.road.spec.land;
        if land.plants.is_empty() {
            return;
        }
        let mut rng = Rng::new(u64::from(land.seed), "plants");
        let near = (self.road.length_m / 100.0 * f64::from(land.plants_per_100_m) * 2.0) as usize;
        for k in 0..near * 2 {
            // The first half stands along the road, the second half anywhere on the land.
            let (x, y) = if k < near {
                let s = self.road.at(rng.between(0.0, self.road.length_m));
                let u = rng.unit();
                let d = s.width_m / 2.0 + f64::from(land.plants_from_m) + u * u * 38.0;
                let d = if rng.unit() < 0.5 { -d } else { d };
                (s.x + s.ty * d, s.y - s.tx * d)
            } else {
                let (nx, ny) = (self.terrain.nx as f64, self.terrain.ny as f64);
                (
                    f64::from(self.terrain.x0) + rng.between(2.0, nx - 2.0),
                    f64::from(self.terrain.y0) + rng.between(2.0, ny - 2.0),
                )
            };
            let plant = land.plants[rng.below(land.plants.len())];
            let (variant, scale, mirrored) = (rng.below(VARIANTS), rng.between(0.7, 1.25), rng.unit() < 0.5);
            let (x, y) = (x as f32, y as f32);
            let min_m = if k < near { land.plants_from_m } else { 20.0 };
            if self.distance_from_edge(x, y).is_none_or(|e| e >= min_m) {
                let picture = self.pictures_of(plant) + variant;
                self.stand(x, y, picture, scale as f32, mirrored);
            }
        }
    }

    /// Posts on the outside of bends.
    fn post(&mut self) {
        let Some(plant) = self.road.spec.land.posts else { return };
        let picture = self.pictures_of(plant);
        for i in (0..self.road.stations.len()).step_by(9) {
            let s = self.road.stations[i];
            if s.curvature.abs() > 1.0 / 70.0 {
                let d = (s.width_m / 2.0 + 1.6) * -s.curvature.signum();
                if self.road.wall_at(self.road.s_of(i), d > 0.0).is_none() {
                    self.stand((s.x + s.ty * d) as f32, (s.y - s.tx * d) as f32, picture, 1.0, false);
                }
            }
        }
    }
}

/// The part of sunlight, 0 to 255, that trees let through at each texel (0.5 m) of the ground map.
fn shadows(road: &Road, terrain: &Terrain, sprites: &[Sprite], kinds: &[Plant], sun: Vec3) -> Vec<u8> {
    let (nx, ny) = (terrain.nx * 2, terrain.ny * 2);
    let mut map = vec![255u8; nx * ny];
    let run = 1.0 / sun.z.max(0.1);
    let seed = road.spec.land.seed;
    for sprite in sprites {
        // Height of the crown's middle, its radius, half its height, and how dense it is.
        let (height, radius, half, dense) = match kinds[sprite.picture] {
            Plant::Pine => (7.6, 1.7, 2.9, 0.75),
            Plant::Broadleaf => (4.6, 2.6, 2.6, 0.85),
            Plant::Palm => (5.0, 2.3, 0.9, 0.6),
            Plant::Bush => (0.5, 1.1, 0.6, 0.7),
            Plant::Cypress => (4.2, 0.8, 4.2, 0.9),
            Plant::Fir => (5.6, 1.8, 5.6, 0.85),
            Plant::Birch => (7.4, 1.7, 2.8, 0.6),
            Plant::Boulder => (0.7, 1.4, 0.8, 0.9),
            Plant::Board => (2.3, 0.5, 0.3, 0.9),
            Plant::Reeds => (0.8, 1.8, 0.9, 0.7),
            Plant::Post | Plant::Pylon => continue,
        };
        let (height, radius, half) = (height * sprite.scale, radius * sprite.scale, half * sprite.scale);
        let (cx, cy) = (sprite.foot.x - sun.x * run * height, sprite.foot.y - sun.y * run * height);
        // The shadow of an upright ellipsoid: an ellipse, longer away from the sun.
        let flat = (sun.x * sun.x + sun.y * sun.y).sqrt().max(1e-3);
        let (ux, uy) = (sun.x / flat, sun.y / flat);
        let fall = half * (run * flat).min(3.0);
        let long = (radius * radius + fall * fall).sqrt();
        let reach = (long * 1.3 * 2.0) as i32 + 2;
        let (ci, cj) = (((cx - terrain.x0) * 2.0) as i32, ((cy - terrain.y0) * 2.0) as i32);
        for j in (cj - reach).max(0)..(cj + reach).min(ny as i32) {
            for i in (ci - reach).max(0)..(ci + reach).min(nx as i32) {
                let (dx, dy) = (i as f32 * 0.5 + terrain.x0 - cx, j as f32 * 0.5 + terrain.y0 - cy);
                let (a, b) = ((dx * ux + dy * uy) / long, (dx * uy - dy * ux) / radius);
                let leaves = value_noise(i as f32 / 2.2, j as f32 / 2.2, None, seed + 40) - 0.5;
                let inside = smoothstep(1.25, 0.7, a * a + b * b + leaves * 1.2);
                let texel = &mut map[j as usize * nx + i as usize];
                *texel = (f32::from(*texel) * lerp(1.0, 1.0 - dense, inside)) as u8;
            }
        }
    }
    map
}
