//! The sky and the hills on the horizon, as one panorama.

use crate::simulator::math::{Rng, hash2, lerp, smoothstep, value_noise};
use crate::simulator::road::line::Road;
use crate::simulator::road::spec::Land;
use crate::simulator::scenery::texel::{clip, fixed, pack};

/// Texels around the horizon; a power of two.
pub const AROUND: usize = 2048;
/// Texels from the lowest to the highest direction.
const UP: usize = 176;
/// Tangent of the minimum elevation.
const MIN_TANGENT: f32 = -0.12;
/// Texels for each unit of the tangent of the elevation.
const PER_TANGENT: f32 = 160.0;

/// A panorama of all directions above the horizon.
pub struct Sky {
    texels: Vec<u32>,
}

impl Sky {
    /// Paints the sky of a track.
    pub fn paint(road: &Road) -> Sky {
        let (light, land) = (&road.spec.light, &road.spec.land);
        let rgb = |c: [u8; 3]| c.map(f32::from);
        let (zenith, horizon) = (rgb(light.zenith), rgb(light.horizon));
        let mut texels = vec![0; AROUND * UP];
        let mut ridges = Vec::with_capacity(AROUND);
        for i in 0..AROUND {
            // Two ranges of hills; the nearer one is wooded.
            let ridge = |cells: i32, seed: u32| {
                let at = |k: i32| {
                    value_noise(
                        i as f32 * (cells * k) as f32 / AROUND as f32,
                        0.5,
                        Some((cells * k, 2)),
                        land.seed + seed + k as u32,
                    )
                };
                0.6 * at(1) + 0.28 * at(3) + 0.12 * at(9)
            };
            let scale = land.hills_m / 45.0;
            let tops = 0.012 * hash2(i as i32 / 3, 1, land.seed + 60);
            let near = 0.02 + 0.16 * scale * ridge(9, 50) + tops;
            let far = 0.03 + 0.24 * scale * ridge(14, 70);
            for j in 0..UP {
                let tangent = MIN_TANGENT + (j as f32 + 0.5) / PER_TANGENT;
                let up = smoothstep(-0.05, 0.62, tangent);
                let mut c: [f32; 3] = std::array::from_fn(|k| lerp(horizon[k], zenith[k], up));
                if light.clouds > 0.0 && tangent > 0.0 {
                    // Clouds lie flat, so they crowd towards the horizon.
                    let high = 6.0 / (tangent + 0.18);
                    let a = value_noise(i as f32 * 48.0 / AROUND as f32, high, Some((48, 64)), land.seed + 80);
                    let b = value_noise(i as f32 * 160.0 / AROUND as f32, high * 3.0, Some((160, 192)), land.seed + 81);
                    let cloud = light.clouds * smoothstep(0.45, 0.85, 0.65 * a + 0.35 * b);
                    c = c.map(|v| lerp(v, 238.0, cloud));
                }
                let woods = 0.75 + 0.5 * hash2(i as i32 / 2, j as i32, land.seed + 61);
                let hill = |air: f32, k: usize| lerp(f32::from(land.ground[1][k]) * 0.75 * woods, horizon[k], air);
                if tangent < near {
                    c = std::array::from_fn(|k| hill(0.42, k));
                } else if tangent < far {
                    c = std::array::from_fn(|k| hill(0.68, k));
                }
                texels[j * AROUND + i] = pack(c, 1.0);
            }
            ridges.push([far, near]);
        }
        let mut sky = Sky { texels };
        sky.wood(&ridges, land, horizon);
        sky
    }

    /// Stands trees on the two ranges of hills, the farther one first. `ridges` are the tangents of their tops in each direction.
    fn wood(&mut self, ridges: &[[f32; 2]], land: &Land, horizon: [f32; 3]) {
        const TREES: f32 = 2600.0;
        const DARK: [f32; 3] = [44.0, 54.0, 34.0];
        const LIT: [f32; 3] = [140.0, 140.0, 74.0];
        let mut rng = Rng::new(u64::from(land.seed), "wooded horizon");
        for (range, air, size) in [(0, 0.66, 5.0), (1, 0.48, 7.0)] {
            for _ in 0..(TREES * land.woods) as usize {
                let i = rng.below(AROUND);
                // Woods grow in patches, more of them on the slope than along the top.
                let patch = value_noise(i as f32 * 24.0 / AROUND as f32, 0.5, Some((24, 2)), land.seed + 90 + range);
                let (down, high, shape) = (rng.unit() as f32, size * rng.between(0.6, 1.3) as f32, rng.unit() as f32);
                if rng.unit() as f32 > 1.6 * patch - 0.2 {
                    continue;
                }
                let foot = (ridges[i][range as usize] - 0.09 * down * down - MIN_TANGENT) * PER_TANGENT;
                for v in 0..high as usize {
                    let up = (v as f32 + 0.5) / high;
                    let half = if up < 0.25 { 0.3 } else { high * (0.16 + 0.1 * shape) * (1.3 - up) };
                    for u in -(half as i32)..=half as i32 {
                        let at = (i as i32 + u).rem_euclid(AROUND as i32) as usize;
                        let Some(texel) = self.texels.get_mut((foot as usize + v) * AROUND + at) else { continue };
                        let lit = (0.45 - 0.4 * u as f32 / half.max(1.0) + 0.5 * (up - 0.5)).clamp(0.0, 1.0);
                        *texel = pack(std::array::from_fn(|k| lerp(lerp(DARK[k], LIT[k], lit), horizon[k], air)), 1.0);
                    }
                }
            }
        }
    }

    /// The texel at a place.
    #[inline(always)]
    pub fn fetch(&self, place: SkyPlace) -> u32 {
        let i = (place.around >> FRACTION_BITS) as usize & (AROUND - 1);
        self.texels[(place.up >> FRACTION_BITS) as usize * AROUND + i]
    }
}

/// Fraction bits of a [`SkyPlace`].
const FRACTION_BITS: u32 = 9;

/// A position in the panorama, or an offset between two, in fixed-point texels.
#[derive(Clone, Copy)]
pub struct SkyPlace {
    around: i32,
    up: i32,
}

impl SkyPlace {
    /// The direction `around` (in texels, any value below 2^13) with the given tangent of the elevation.
    #[inline(always)]
    pub fn new(around: f32, tangent: f32) -> SkyPlace {
        let one = (1 << FRACTION_BITS) as f32;
        let up = clip((tangent - MIN_TANGENT) * PER_TANGENT, UP as f32 - 1.0);
        SkyPlace { around: fixed((around + 0.5) * one), up: fixed((up + 0.5) * one) }
    }

    /// One of `parts` equal steps from here to `other`.
    #[inline(always)]
    pub fn step_to(self, other: SkyPlace, parts: i32) -> SkyPlace {
        SkyPlace { around: (other.around - self.around) / parts, up: (other.up - self.up) / parts }
    }
}

impl std::ops::Add for SkyPlace {
    type Output = SkyPlace;

    #[inline(always)]
    fn add(self, way: SkyPlace) -> SkyPlace {
        SkyPlace { around: self.around + way.around, up: self.up + way.up }
    }
}
