//! Procedural pictures of the objects beside the road, with mipmaps for distant ones.

use crate::simulator::math::{hash2, lerp, smoothstep, value_noise};
use crate::simulator::road::spec::Plant;
use crate::simulator::scenery::texel::pack;

/// Width of a picture at its finest level, texels.
const W: usize = 64;
/// Height of a picture, texels.
const H: usize = 128;

/// The picture of one object: texels `0xAABBGGRR`, alpha at or above 128 is solid.
pub struct Picture {
    /// Finest first; each half as wide and high as the one before.
    levels: Vec<PictureLevel>,
    /// Width of the object, m.
    pub width_m: f32,
    /// Height of the object, m.
    pub height_m: f32,
}

/// A picture at one size.
pub struct PictureLevel {
    /// Row by row from the top.
    pub texels: Vec<u32>,
    /// Texels of a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// For each row the first solid texel and the one after the last; equal where none is.
    pub solid: Vec<(usize, usize)>,
}

impl PictureLevel {
    fn new(texels: Vec<u32>, width: usize, height: usize) -> PictureLevel {
        let extent = |row: &[u32]| {
            let solid = |t: &u32| t >> 31 == 1;
            row.iter().position(solid).map_or((0, 0), |first| (first, row.iter().rposition(solid).unwrap_or(first) + 1))
        };
        let solid = texels.chunks_exact(width).map(extent).collect();
        PictureLevel { texels, width, height, solid }
    }
}

impl Picture {
    /// The level for an object that is `high` by `wide` pixels in the frame.
    pub fn level(&self, high: f32, wide: f32) -> &PictureLevel {
        let pixels = high.max(wide * (H / W) as f32);
        let mut k = 0;
        while k + 1 < self.levels.len() && (H >> k) as f32 > pixels * 1.5 {
            k += 1;
        }
        &self.levels[k]
    }

    /// Paints a plant; `variant` changes details.
    pub fn paint(plant: Plant, variant: u32) -> Picture {
        let (width_m, height_m) = match plant {
            Plant::Pine => (5.0, 12.0),
            Plant::Broadleaf => (6.0, 7.5),
            Plant::Palm => (5.5, 6.5),
            Plant::Bush => (2.6, 1.3),
            Plant::Cypress => (1.8, 8.5),
            Plant::Fir => (5.0, 12.5),
            Plant::Birch => (4.4, 11.0),
            Plant::Reeds => (4.2, 2.3),
            Plant::Boulder => (3.4, 2.0),
            Plant::Pylon => (9.0, 30.0),
            Plant::Board => (0.9, 2.6),
            Plant::Post => (0.16, 0.95),
        };
        let mut texels = Vec::with_capacity(W * H);
        for v in 0..H {
            for u in 0..W {
                // x from -1 to 1, y from 0 at the foot to 1 at the top.
                let x = (u as f32 + 0.5) / (W as f32 / 2.0) - 1.0;
                let y = 1.0 - (v as f32 + 0.5) / H as f32;
                texels.push(texel(plant, x, y, u as i32, v as i32, variant));
            }
        }
        let mut levels = vec![texels];
        for k in 1..6 {
            let (w, h) = (W >> k, H >> k);
            let fine = &levels[k - 1];
            let coarse = (0..w * h)
                .map(|at| {
                    let (u, v) = (at % w, at / w);
                    let four = [0, 1, 2 * w, 2 * w + 1].map(|o| fine[2 * v * 2 * w + 2 * u + o]);
                    let weight: u32 = four.iter().map(|t| t >> 24).sum();
                    let channel = |s: u32| four.iter().map(|t| (t >> s & 255) * (t >> 24)).sum::<u32>() / weight.max(1);
                    // More than the mean, so that thin trunks stay visible at a distance.
                    channel(0) | channel(8) << 8 | channel(16) << 16 | (weight * 2 / 5).min(255) << 24
                })
                .collect();
            levels.push(coarse);
        }
        let levels =
            levels.into_iter().enumerate().map(|(k, texels)| PictureLevel::new(texels, W >> k, H >> k)).collect();
        Picture { levels, width_m, height_m }
    }
}

fn texel(plant: Plant, x: f32, y: f32, u: i32, v: i32, seed: u32) -> u32 {
    let leaf = value_noise(u as f32 / 5.0, v as f32 / 5.0, None, seed + 1) * 0.6 + hash2(u / 2, v / 2, seed + 2) * 0.4;
    // Sunlit tops, dark undersides.
    let shade = 0.55 + 0.5 * leaf + 0.3 * (y - 0.5);
    let solid = |rgb: [f32; 3], k: f32| pack(rgb.map(|c| c * k), 1.0);
    let lobe = |cx: f32, cy: f32, rx: f32, ry: f32| {
        let (dx, dy) = ((x - cx) / rx, (y - cy) / ry);
        dx * dx + dy * dy + (leaf - 0.5) * 1.1 < 1.0
    };
    let trunk = |half: f32, top: f32| x.abs() < half && y < top;
    // Light comes from the left.
    let side = 0.84 - 0.2 * x;
    match plant {
        Plant::Pine => {
            let tufts = (0..6).any(|k| {
                let h = hash2(k, 7, seed);
                lobe((h - 0.5) * 0.6, 0.5 + 0.08 * k as f32, 0.55 - 0.055 * k as f32, 0.075)
            });
            if tufts {
                // Needles are olive in the sun and nearly black beneath.
                let lit = smoothstep(0.35, 0.95, leaf + 0.25 * (0.2 - x));
                solid(std::array::from_fn(|k| lerp([34.0, 42.0, 26.0][k], [148.0, 142.0, 66.0][k], lit)), 1.0)
            } else if trunk(0.05, 0.85) {
                solid([74.0, 60.0, 46.0], 0.7 + 0.5 * leaf)
            } else {
                0
            }
        }
        Plant::Broadleaf => {
            let crown = lobe(0.0, 0.64, 0.72, 0.27) || lobe(-0.42, 0.52, 0.42, 0.18) || lobe(0.4, 0.56, 0.44, 0.22);
            if crown {
                solid([84.0, 100.0, 44.0], shade)
            } else if trunk(0.08, 0.5) {
                solid([80.0, 62.0, 46.0], 1.0)
            } else {
                0
            }
        }
        Plant::Palm => {
            let bend = 0.18 * y * y;
            let (dx, dy) = (x - bend, y - 0.74);
            // Each frond rises from the crown and bows down; long ones rise less.
            let fronds = (0..5).any(|k| {
                let reach = 0.92 - 0.13 * k as f32 - 0.12 * hash2(k, i32::from(dx > 0.0), seed);
                let t = dx.abs() / reach;
                let bow = (0.02 + 0.11 * k as f32) * t - (0.3 + 0.03 * k as f32) * t * t;
                t < 1.0 && (dy - bow).abs() < (0.012 + 0.03 * (1.0 - t)) * (0.4 + 1.2 * leaf)
            });
            if fronds {
                solid([74.0, 88.0, 46.0], shade * 0.9)
            } else if (x - bend).abs() < 0.055 && y < 0.76 {
                solid([104.0, 90.0, 70.0], 0.7 + 0.5 * leaf)
            } else {
                0
            }
        }
        Plant::Bush => {
            let clump =
                [(-0.5, 0.2, 0.36, 0.3), (-0.14, 0.36, 0.4, 0.4), (0.26, 0.28, 0.4, 0.36), (0.56, 0.14, 0.32, 0.26)];
            if clump.iter().any(|(cx, cy, rx, ry)| lobe(*cx, *cy, *rx, *ry)) {
                solid([66.0, 74.0, 32.0], shade * 0.8)
            } else {
                0
            }
        }
        Plant::Cypress => {
            let half = 0.85 * (1.0 - y) * (0.4 + 2.2 * y).min(1.0) + 0.06;
            if x.abs() + (leaf - 0.5) * 0.35 < half { solid([46.0, 66.0, 42.0], shade * side) } else { 0 }
        }
        Plant::Fir => {
            let tier = 1.0 - (y * 9.0).fract();
            let half = (1.0 - y) * (0.6 + 0.26 * tier);
            if y > 0.04 && x.abs() + (leaf - 0.5) * 0.3 < half {
                solid([48.0, 68.0, 46.0], (0.5 + 0.3 * tier + 0.35 * leaf) * side)
            } else if trunk(0.06, 0.1) {
                solid([72.0, 56.0, 44.0], 1.0)
            } else {
                0
            }
        }
        Plant::Birch => {
            let crown = lobe(0.0, 0.7, 0.7, 0.22) || lobe(0.2, 0.5, 0.5, 0.14);
            if crown && leaf > 0.3 {
                solid([134.0, 146.0, 70.0], shade)
            } else if trunk(0.06, 0.9) {
                let bark = if hash2(u / 4, v / 2, seed + 4) < 0.2 { 0.4 } else { 1.0 };
                solid([206.0, 204.0, 196.0], bark * side)
            } else {
                0
            }
        }
        Plant::Reeds => {
            // Blades that lean a little, lighter at their tips.
            let blade = (x * 17.0 + 3.0 * y * x).floor();
            let h = hash2(blade as i32, 3, seed);
            let tall = (0.45 + 0.55 * h) * (1.0 - 0.55 * x * x);
            let thin = ((x * 17.0 + 3.0 * y * x) - blade - 0.5).abs() < 0.5 * (1.0 - 0.7 * y / tall);
            if y < tall && (thin || y < 0.35 * tall) {
                solid([78.0, 84.0, 34.0], 0.38 + 0.62 * y / tall + 0.3 * (h - 0.5))
            } else {
                0
            }
        }
        Plant::Pylon => {
            // Four legs that meet, braces between them, and three arms.
            let half = 0.3 * (1.0 - y) + 0.05;
            let leg = (x.abs() - half).abs() < 0.045 && y < 0.97;
            let bay = (y * 11.0).fract();
            let brace = y < 0.9 && x.abs() < half && ((x / half).abs() - (2.0 * bay - 1.0).abs()).abs() < 0.16;
            let arm = [0.66, 0.78, 0.9].iter().any(|a| {
                let reach = 0.95 - 1.4 * (a - 0.66);
                x.abs() < reach && (y - a - 0.012 * (1.0 - x.abs() / reach)).abs() < 0.011
            });
            if leg || brace || arm { solid([58.0, 72.0, 92.0], side) } else { 0 }
        }
        Plant::Boulder => {
            if lobe(0.0, 0.22, 0.76, 0.55) {
                solid([150.0, 142.0, 126.0], (0.5 + 0.4 * leaf + 0.35 * y) * side)
            } else {
                0
            }
        }
        Plant::Board => {
            if y > 0.82 {
                let red = (0.87..0.91).contains(&y) || y > 0.96;
                solid(if red { [206.0, 70.0, 66.0] } else { [226.0, 220.0, 214.0] }, 1.0)
            } else if (x.abs() - 0.42).abs() < 0.16 {
                solid([206.0, 206.0, 206.0], side)
            } else {
                0
            }
        }
        Plant::Post => solid(if (0.72..0.86).contains(&y) { [40.0; 3] } else { [222.0; 3] }, side),
    }
}
