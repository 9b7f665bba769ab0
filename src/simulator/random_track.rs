//! Tracks without end: one for every seed.

use super::math::{Rng, sin_cos};
use super::spec::{Centre, Edge, Land, Light, Look, Plant, Rgb, Side, Stretch, Surface, TrackSpec, Wall};
use super::track::{FIRST_HELD_OUT_SEED, Track};
use crate::{Error, Result};

/// Lines that are drawn before a seed is given up.
const ATTEMPTS: usize = 400;

/// The track `random:SEED`: a closed line through bends of at least 25 m radius, with its own surface, edges, land and
/// light. Looks that only the built-in held-out tracks have are never drawn.
///
/// # Errors
/// If no line passes the checks of [`Track::from_spec`].
pub fn generate(seed: u64) -> Result<Track> {
    let mut rng = Rng::new(seed, "track");
    let spec = looks(seed, &mut rng);
    let mut reason = None;
    for _ in 0..ATTEMPTS {
        let mut spec = spec.clone();
        spec.points = line(&mut rng);
        match Track::from_spec(spec, &format!("random:{seed}")) {
            Ok(mut track) => {
                track.spec.stretch = stretches(&mut rng, track.length_m, &track.spec);
                return Ok(track);
            }
            Err(error) => reason = Some(error),
        }
    }
    let reason = reason.map(|e| e.to_string()).unwrap_or_default();
    Err(Error::Usage(format!("random:{seed}: no line found in {ATTEMPTS} attempts ({reason}); take another seed")))
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

fn look(rng: &mut Rng, name: &str, centre: Centre) -> Look {
    let surface = pick(rng, &[Surface::Asphalt, Surface::Asphalt, Surface::Patched, Surface::Patched, Surface::Cobble]);
    let base =
        pick(rng, &[[112, 110, 106], [84, 84, 86], [138, 134, 128], [136, 118, 102], [104, 92, 84], [160, 154, 144]]);
    let edges = [Edge::White, Edge::Yellow, Edge::YellowKerbstone, Edge::Kerb, Edge::Bare, Edge::Bare];
    let left = pick(rng, &edges);
    let right = if rng.unit() < 0.7 { left } else { pick(rng, &edges) };
    let soil =
        pick(rng, &[[120, 112, 70], [150, 112, 76], [96, 104, 58], [176, 160, 120], [110, 104, 96], [88, 78, 58]]);
    Look {
        name: name.to_string(),
        surface,
        tone: near(rng, base, 22.0),
        grain: rng.between(0.12, 0.6) as f32,
        centre,
        left,
        right,
        shoulder: near(rng, soil, 20.0),
        shoulder_m: rng.between(0.3, 3.0) as f32,
    }
}

fn looks(seed: u64, rng: &mut Rng) -> TrackSpec {
    let centre = pick(rng, &[Centre::None, Centre::None, Centre::Dashed, Centre::Dashed, Centre::Solid]);
    let look = vec![look(rng, "first", centre), look(rng, "second", centre), look(rng, "third", Centre::None)];
    let ground = pick(
        rng,
        &[
            [[150, 142, 48], [112, 118, 46]],
            [[84, 100, 44], [104, 106, 62]],
            [[176, 150, 104], [146, 128, 84]],
            [[70, 86, 40], [96, 82, 54]],
            [[190, 172, 132], [150, 146, 98]],
            [[112, 124, 66], [134, 120, 80]],
        ],
    );
    let all = [Plant::Pine, Plant::Broadleaf, Plant::Palm, Plant::Bush, Plant::Boulder];
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
            ground: ground.map(|g| near(rng, g, 18.0)),
            rock: near(rng, [120, 112, 96], 30.0),
            shore: near(rng, [176, 150, 112], 24.0),
            water: near(rng, [110, 146, 176], 32.0),
            plants: (0..4).map(|_| pick(rng, &all)).collect(),
            plants_per_100_m: rng.between(4.0, 30.0) as f32,
            plants_from_m: rng.between(2.2, 5.0) as f32,
            posts: pick(rng, &[None, Some(Plant::Post), Some(Plant::Board)]),
        },
        light: Light {
            sun_azimuth_deg: rng.between(0.0, 360.0),
            sun_elevation_deg: rng.between(22.0, 65.0),
            shade: rng.between(0.28, 0.6) as f32,
            sun: near(rng, [248, 242, 228], 8.0),
            zenith: near(rng, sky.0, 12.0),
            horizon: near(rng, sky.1, 12.0),
            haze_m: rng.between(180.0, 900.0) as f32,
            clouds: (rng.unit() * 1.4 - 0.5).clamp(0.0, 0.9) as f32,
        },
    }
}

/// Cuts the lap into stretches of 60 to 180 m, each with its own look, land and perhaps walls.
fn stretches(rng: &mut Rng, lap_m: f64, spec: &TrackSpec) -> Vec<Stretch> {
    let mut out = Vec::new();
    let mut from_m = 0.0;
    let water = spec.land.water_level_m.is_some();
    while from_m < lap_m - 30.0 {
        let to_m = (from_m + rng.between(60.0, 180.0)).min(lap_m);
        let mut side = || {
            let side =
                pick(rng, &[Side::Flat, Side::Flat, Side::Hill, Side::Hill, Side::Cliff, Side::Drop, Side::Water]);
            if side == Side::Water && !water { Side::Drop } else { side }
        };
        let (left, right) = (side(), side());
        let mut wall = |side: Side| {
            let open = matches!(side, Side::Drop | Side::Water);
            (rng.unit() < if open { 0.5 } else { 0.08 }).then(|| pick(rng, &[Wall::Rail, Wall::Parapet]))
        };
        let (left_wall, right_wall) = (wall(left), wall(right));
        let look = pick(rng, &["first", "first", "first", "second", "third"]);
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
