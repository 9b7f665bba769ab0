//! Light and texture of a trial; the seed draws both.

use crate::simulator::math::Rng;
use crate::simulator::scenery::terrain::FULL_LIGHT;
use crate::simulator::scenery::texel::pack;
use crate::simulator::scenery::world::World;

/// The light and texture of one trial. Seed 0 takes them from the track file; other seeds vary them.
#[derive(Clone, Debug)]
pub struct Variant {
    /// Shift of the road texture along the road, m.
    pub road_shift_m: f32,
    /// Factor (256 = 1, never more) of the road's colour for each value of the land's light.
    pub road_light: [u16; 256],
    /// Colour of distant air, `0x__BBGGRR`.
    pub haze: u32,
    /// Tone curves of red, green and blue, applied last.
    pub tone: [[u8; 256]; 3],
}

impl Variant {
    /// The variant of the trial `seed`: brightness ±15 %, contrast ±12 %, colour ±5 % a channel, road ±12 %, depth of
    /// shadows ±25 %. Seed 0 is the track as its file says.
    pub fn new(world: &World, seed: u64) -> Variant {
        let mut rng = Rng::new(seed, "light");
        let mut around = |spread: f64| if seed == 0 { 0.0 } else { rng.between(-spread, spread) as f32 };
        let (gain, contrast) = (1.0 + around(0.15), 1.0 + around(0.12));
        let tint = [0; 3].map(|_| 1.0 + around(0.05));
        let road = 1.0 + around(0.12);
        let depth = 1.0 + around(0.25);
        let road_shift_m = 24.0 + 12.0 * (1.0 + around(1.0));
        let road_light = std::array::from_fn(|a| {
            let light = a as f32 / FULL_LIGHT;
            (256.0 * (0.88 + (light - 1.0) * 0.88 * depth) * road).clamp(20.0, 256.0) as u16
        });
        let tone = tint.map(|tint| {
            std::array::from_fn(|v| {
                (((v as f32 - 110.0) * contrast + 110.0) * gain * tint + 0.5).clamp(0.0, 255.0) as u8
            })
        });
        Variant { road_shift_m, road_light, haze: pack(world.haze, 0.0), tone }
    }
}
