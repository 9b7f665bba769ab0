//! Random tracks, one for every seed.

use crate::simulator::math::{Rng, sin_cos};
use crate::simulator::road::line::Road;
use crate::simulator::road::spec::{
    Centre, Edge, Land, Light, Look, Plant, Rgb, Side, Stretch, Surface, TrackSpec, Wall,
};
use crate::{Error, Result};

/// Random tracks with this seed or a higher one are kept out of training.
pub const FIRST_HELD_OUT_SEED: u64 = 1_000_000;
/// Maximum number of lines drawn for one seed.
const MAX_ATTEMPTS: usize = 400;

/// The track `random:SEED`: a closed line through bends of at least 25 m radius, with its own surface, edges, land and
/// light. Looks that only the built-in held-out tracks have are never drawn.
///
/// # Errors
/// If no line passes the checks of [`Road::from_spec`].
pub fn generate(seed: u64) -> Result<Road> {
    let mut rng = Rng::new(seed, "track");
    let spec = looks(seed, &mut rng);
    let mut reason = None;
    for _ in 0..MAX_ATTEMPTS {
        let mut spec = spec.clone();
        spec.points = line(&mut rng);
        match Road::from_spec(spec, &format!("random:{seed}")) {
            Ok(mut road) => {
                road.spec.stretch = stretches(&mut rng, road.length_m, &road.spec);
                return Ok(road);
            }
            Err(error) => reason = Some(error),
        }
    }
    let reason = reason.map(|e| e.to_string()).unwrap_or_default();
    Err(Error::Usage(format!("random:{seed}: no line found in {MAX_ATTEMPTS} attempts ({reason}); take another seed")))
}

/// Control points around a circle with random radii, scaled to a random length.
fn line(rng: &mut Rng) -> Vec<[f64; 5]> {
    let n = 16 + rng.below(9);
    let lap_m = rng.between(720.0, 1250.0);
    let rough = rng.between(0.12, 0.38);
    let (phase, lobes) = (rng.between(0.0, std::f64::consts::TAU), 2.0 + rng.below(3) as f64);
    let (climb, waves) = (rng.between(0.0, 6.0) * rng.unit(), 1.0 + rng.below(3) as f64);
    let width = rng.between(6.8, 9.6);
    let bank = rng.between(0.0, 4.0);
    let squash = rng.between(0.6, 1.0);
    let turn = std::f64::consts::TAU / n as f64;
    let mut points: Vec<[f64; 5]> = (0..n)
        .map(|i| {
            let a = i as f64 * turn;
            let r = 1.0 + rough * sin_cos(lobes * a + phase).0 + rng.between(-0.5, 0.5) * rough;
            let (sin, cos) = sin_cos(a + rng.between(-0.3, 0.3) * turn);
            let z = 5.0 + climb * sin_cos(waves * a + 2.0 * phase).0;
            [r * cos, r * sin * squash, z, width + rng.between(-0.3, 0.3), 0.0]
        })
        .collect();
    let around: f64 = (0..n)
        .map(|i| {
            let (a, b) = (points[i], points[(i + 1) % n]);
            ((a[0] - b[0]) * (a[0] - b[0]) + (a[1] - b[1]) * (a[1] - b[1])).sqrt()
        })
        .sum();
    // The spline runs inside its control points and is a little shorter than the line through them.
    let scale = lap_m * 1.06 / around;
    let mirror = if rng.unit() < 0.5 { -1.0 } else { 1.0 };
    let plain = points.clone();
    for (i, p) in points.iter_mut().enumerate() {
        let (a, b, c) = (plain[(i + n - 1) % n], plain[i], plain[(i + 1) % n]);
        let cross = (b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0]);
        let dot = (b[0] - a[0]) * (c[0] - b[0]) + (b[1] - a[1]) * (c[1] - b[1]);
        p[4] = (-mirror * bank * 2.0 * cross / dot.abs().max(1e-6)).clamp(-5.0, 5.0);
        p[0] *= scale;
        p[1] *= scale * mirror;
    }
    points
}

fn near(rng: &mut Rng, rgb: Rgb, spread: f64) -> Rgb {
    let common = rng.between(-spread, spread);
    rgb.map(|c| (f64::from(c) + common + rng.between(-spread, spread) * 0.3).clamp(8.0, 247.0) as u8)
}

fn pick<T: Copy>(rng: &mut Rng, of: &[T]) -> T {
    of[rng.below(of.len())]
}

/// A road's colour: any grey from dark to light, a little tinted.
fn road_tone(rng: &mut Rng) -> Rgb {
    let grey = rng.between(62.0, 196.0);
    let warm = rng.between(-0.08, 0.16);
    [1.0 + warm, 1.0, 1.0 - warm].map(|tint| (grey * tint + rng.between(-6.0, 6.0)).clamp(8.0, 247.0) as u8)
}

/// A colour of soil, sand or grass: hue 20 to 110 degrees (orange to green), dark to light, dull to strong.
fn soil(rng: &mut Rng) -> Rgb {
    let (hue, saturation, value) = (rng.between(20.0, 110.0), rng.between(0.1, 0.68), rng.between(64.0, 226.0));
    // The largest channel is `value`, the smallest blue; the one between follows the hue.
    let low = value * (1.0 - saturation);
    let [red, green] = if hue < 60.0 { [1.0, (hue / 60.0)] } else { [1.0 - (hue - 60.0) / 60.0, 1.0] }
        .map(|k| low + (value - low) * k);
    [red, green, low].map(|c| c as u8)
}

/// Maximum width of a shoulder, m: the rest of the texture beyond an edge.
const SHOULDER_M: f64 = 3.5;

fn look(rng: &mut Rng, name: &str) -> Look {
    let surface = pick(
        rng,
        &[Surface::Asphalt, Surface::Asphalt, Surface::Patched, Surface::Seamed, Surface::Seamed, Surface::Cobble],
    );
    let centre = pick(rng, &[Centre::None, Centre::None, Centre::Dashed, Centre::Dashed, Centre::Solid]);
    let edges = [Edge::White, Edge::Yellow, Edge::YellowKerbstone, Edge::Kerb, Edge::Bare, Edge::Bare, Edge::Bare];
    let left = pick(rng, &edges);
    let right = if rng.unit() < 0.6 { left } else { pick(rng, &edges) };
    Look {
        name: name.to_string(),
        surface,
        tone: road_tone(rng),
        grain: rng.between(0.08, 0.7) as f32,
        centre,
        left,
        right,
        shoulder: soil(rng),
        shoulder_m: rng.between(0.2, SHOULDER_M) as f32,
    }
}

/// Names of the looks of a random track.
const LOOKS: [&str; 3] = ["first", "second", "third"];

fn looks(seed: u64, rng: &mut Rng) -> TrackSpec {
    let look = LOOKS.map(|name| look(rng, name)).to_vec();
    let ground = [soil(rng), soil(rng)];
    let all = [Plant::Pine, Plant::Broadleaf, Plant::Palm, Plant::Bush, Plant::Boulder, Plant::Pine, Plant::Reeds];
    // What was added later has numbers of its own, so that the roads of all seeds stay what they are.
    let mut more = Rng::new(seed, "looks");
    let sky = pick(
        rng,
        &[
            ([82, 116, 172], [168, 190, 214]),
            ([58, 84, 140], [118, 150, 196]),
            ([148, 164, 182], [200, 208, 214]),
            ([104, 132, 176], [226, 208, 186]),
            ([184, 190, 194], [214, 216, 214]),
        ],
    );
    TrackSpec {
        name: format!("random:{seed}"),
        held_out: seed >= FIRST_HELD_OUT_SEED,
        min_radius_m: 25.0,
        points: Vec::new(),
        look,
        stretch: Vec::new(),
        land: Land {
            seed: (seed % 1_000_003) as u32 + 101,
            hills_m: rng.between(6.0, 44.0) as f32,
            water_level_m: (rng.unit() < 0.5).then_some(-2.5),
            ground,
            rock: near(rng, [120, 112, 96], 30.0),
            shore: near(rng, [176, 150, 112], 24.0),
            water: near(rng, [110, 146, 176], 32.0),
            plants: (0..4).map(|_| pick(rng, &all)).collect(),
            plants_per_100_m: rng.between(2.0, 40.0) as f32,
            plants_from_m: rng.between(2.0, 5.0) as f32,
            posts: pick(rng, &[None, Some(Plant::Post), Some(Plant::Board)]),
            mounds_m: (more.unit() * 14.0 - 5.0).clamp(0.0, 9.0) as f32,
            sandy: (more.unit() * 0.7 - 0.25).clamp(0.0, 0.45) as f32,
            woods: (more.unit() * 1.6 - 0.5).clamp(0.0, 1.0) as f32,
            pylons: more.unit() < 0.4,
        },
        light: Light {
            sun_azimuth_deg: rng.between(0.0, 360.0),
            sun_elevation_deg: rng.between(20.0, 68.0),
            shade: rng.between(0.34, 0.72) as f32,
            sun: near(rng, [242, 236, 220], 14.0),
            zenith: near(rng, sky.0, 12.0),
            horizon: near(rng, sky.1, 12.0),
            haze_m: rng.between(120.0, 900.0) as f32,
            clouds: (rng.unit() * 1.4 - 0.5).clamp(0.0, 0.9) as f32,
        },
    }
}

/// Cuts the lap into stretches of 40 to 120 m, each with its own look, land and perhaps walls.
fn stretches(rng: &mut Rng, lap_m: f64, spec: &TrackSpec) -> Vec<Stretch> {
    let mut out = Vec::new();
    let mut from_m = 0.0;
    let water = spec.land.water_level_m.is_some();
    while from_m < lap_m - 30.0 {
        let to_m = (from_m + rng.between(40.0, 120.0)).min(lap_m);
        let mut side = || {
            let side =
                pick(rng, &[Side::Flat, Side::Flat, Side::Hill, Side::Hill, Side::Cliff, Side::Drop, Side::Water]);
            if side == Side::Water && !water { Side::Drop } else { side }
        };
        let (left, right) = (side(), side());
        let mut wall = |side: Side| {
            let open = matches!(side, Side::Drop | Side::Water);
            (rng.unit() < if open { 0.5 } else { 0.08 }).then(|| pick(rng, &[Wall::Rail, Wall::Parapet, Wall::Barrier]))
        };
        let (left_wall, right_wall) = (wall(left), wall(right));
        let look = pick(rng, &LOOKS);
        out.push(Stretch {
            from_m,
            to_m,
            look: Some(look.to_string()),
            left: Some(left),
            right: Some(right),
            left_wall,
            right_wall,
        });
        from_m = to_m;
    }
    out
}
