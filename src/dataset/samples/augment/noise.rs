//! Noise that is added to pictures: that of single pixels, and that of a JPEG's blocks.

use rand::Rng;
use steersman_kernels::{Isa, pixels};

use crate::engine::random::uniform;

/// Largest height and width of a block, pixels.
pub(super) const MAX_BLOCK: usize = 64;

/// Adds an error to each block of `block` (height, width) pixels: constant, and a half wave along each axis, each of up to `amplitude`
/// grey levels.
///
/// # Panics
/// If a block is higher or wider than [`MAX_BLOCK`].
pub(super) fn block_noise(rgb: &mut [u8], width: usize, block: [usize; 2], amplitude: f64, rng: &mut impl Rng) {
    let half_wave = |side: usize| -> [f64; MAX_BLOCK] {
        std::array::from_fn(|at| (std::f64::consts::PI * (at as f64 + 0.5) / side as f64).cos())
    };
    let [down_wave, along_wave] = block.map(half_wave);
    // Strips of as many blocks as fit into buffers of fixed size.
    let strip = MAX_BLOCK / block[1] * block[1];
    let (mut constants, mut slopes) = ([0.0; MAX_BLOCK], [0.0; MAX_BLOCK]);
    for rows in rgb.chunks_mut(block[0] * width * 3) {
        for left in (0..width).step_by(strip) {
            let columns = strip.min(width - left);
            let (constants, slopes) = (&mut constants[..columns], &mut slopes[..columns]);
            for (constants, slopes) in constants.chunks_mut(block[1]).zip(slopes.chunks_mut(block[1])) {
                let [constant, down, along] = [(); 3].map(|()| uniform(rng, -amplitude, amplitude));
                slopes.fill(down as f32);
                for (sum, wave) in constants.iter_mut().zip(&along_wave) {
                    *sum = (constant + along * wave) as f32;
                }
            }
            for (row, &wave) in rows.chunks_exact_mut(width * 3).zip(&down_wave) {
                pixels::add_grey(Isa::best(), constants, slopes, wave as f32, &mut row[3 * left..][..3 * columns]);
            }
        }
    }
}

/// Adds an error of up to `amplitude` grey levels to each grey level.
pub(super) fn pixel_noise(rgb: &mut [u8], amplitude: f64, rng: &mut impl Rng) {
    let bits = rng.next_u64();
    let step = (amplitude * 256.0 / 127.0).round() as u16;
    pixels::add_noise(Isa::best(), [bits as u32, (bits >> 32) as u32], step, rgb);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::augment::Augmentation;
    use crate::dataset::preprocess::Preprocessing;
    use crate::engine::random::{Purpose, rng};

    #[test]
    fn pixel_noise_is_fresh_for_each_grey_level_and_has_the_amplitude_that_was_asked_for() {
        let noise: Augmentation = toml::from_str("pixel_noise = 20").unwrap();
        let preprocessing = Preprocessing { source: [80, 160], rows: [0, 80], resize: [40, 80], ..Default::default() };
        let mut widest = 0.0_f64;
        for stream in 0..50 {
            let mut rgb = vec![128; 40 * 80 * 3];
            assert_eq!(noise.apply(&preprocessing, &mut rgb, &mut rng(1, Purpose::Test, 0, stream)), 0.0);
            let errors: Vec<f64> = rgb.iter().map(|grey| f64::from(*grey) - 128.0).collect();
            let count = errors.len() as f64;
            let square = errors.iter().map(|e| e * e).sum::<f64>() / count;
            let largest = errors.iter().fold(0.0, |a: f64, e| a.max(e.abs()));
            assert!(largest <= 20.0 && errors.iter().sum::<f64>().abs() / count < 0.5);
            // Evenly spread errors: the mean square is a third of that of the amplitude. Neighbours in channel, row and column know
            // nothing of each other.
            assert!((square / (largest * largest) - 1.0 / 3.0).abs() < 0.1 || largest < 4.0, "{square} {largest}");
            for apart in [1, 3, 240] {
                let together = errors.iter().zip(&errors[apart..]).map(|(a, b)| a * b).sum::<f64>() / count;
                assert!(together.abs() <= 0.06 * square, "{apart}: {together} of {square}");
            }
            widest = widest.max(largest);
        }
        assert!(widest > 17.0, "{widest}");
        assert!(
            Augmentation { pixel_noise: 65.0, ..noise }.validate().unwrap_err().to_string().contains("pixel_noise")
        );
        let mut limits = [0u8, 255].repeat(300);
        pixel_noise(&mut limits, 64.0, &mut rng(1, Purpose::Test, 0, 0));
        assert!(
            limits.iter().step_by(2).all(|grey| *grey <= 64)
                && limits.iter().skip(1).step_by(2).all(|grey| *grey >= 191)
        );
    }

    #[test]
    fn block_noise_is_grey_changes_from_block_to_block_and_has_the_amplitude_that_was_asked_for() {
        // Blocks of 8x8 source pixels are 4x4 pixels of the stage.
        let preprocessing = Preprocessing { source: [16, 40], rows: [0, 16], resize: [8, 20], ..Default::default() };
        let noise: Augmentation = toml::from_str("block_noise = 6").unwrap();
        assert!(noise.is_active() && noise.validate().is_ok());
        let (mut sum, mut largest, mut count) = (0.0, 0.0f64, 0);
        for stream in 0..500 {
            let mut rgb = vec![100; 8 * 20 * 3];
            assert_eq!(noise.apply(&preprocessing, &mut rgb, &mut rng(5, Purpose::Test, 0, stream)), 0.0);
            for (k, px) in rgb.chunks_exact(3).enumerate() {
                assert!(px[0] == px[1] && px[1] == px[2], "brightness alone");
                let error = f64::from(px[0]) - 100.0;
                (sum, largest, count) = (sum + error, largest.max(error.abs()), count + 1);
                // Within a block neighbours in a row differ by at most 2 cos(3 pi/8) = 0.77 of the amplitude, and by rounding.
                if k % 4 > 0 {
                    assert!((f64::from(px[0]) - f64::from(rgb[3 * k - 3])).abs() <= 6.0 * 0.77 + 1.0);
                }
            }
        }
        assert!((sum / f64::from(count)).abs() < 0.1, "no brighter, no darker on average");
        // Up to 6 · (1 + 2 cos(pi/8)) grey levels, where all three errors are as large as can be.
        assert!((8.0..=18.0).contains(&largest), "{largest}");
        assert!(
            Augmentation { block_noise: -1.0, ..noise }.validate().unwrap_err().to_string().contains("block_noise")
        );
        // Black and white are held: no error reaches 192 grey levels.
        let mut rgb = [0u8, 255].repeat(3 * 800);
        block_noise(&mut rgb, 40, [4, 4], 60.0, &mut rng(1, Purpose::Test, 0, 0));
        assert!(rgb.iter().step_by(2).all(|grey| *grey < 192) && rgb.iter().step_by(2).any(|grey| *grey == 0));
        assert!(
            rgb.iter().skip(1).step_by(2).all(|grey| *grey > 63)
                && rgb.iter().skip(1).step_by(2).any(|grey| *grey == 255)
        );
    }

    #[test]
    fn block_noise_follows_its_waves_in_blocks_that_are_cut_and_in_pictures_of_several_strips() {
        for (height, width, block) in [(13, 150, [5, 6]), (70, 130, [64, 64]), (3, 1, [1, 1]), (9, 65, [4, 4])] {
            let mut rgb = vec![128; height * width * 3];
            block_noise(&mut rgb, width, block, 20.0, &mut rng(3, Purpose::Test, 0, 0));
            // The same draws: rows of blocks, in each from left to right.
            let random = &mut rng(3, Purpose::Test, 0, 0);
            let wave = |at: usize, side: usize| (std::f64::consts::PI * (at as f64 + 0.5) / side as f64).cos();
            for top in (0..height).step_by(block[0]) {
                for left in (0..width).step_by(block[1]) {
                    let [constant, down, along] = [(); 3].map(|()| uniform(random, -20.0, 20.0));
                    for y in top..height.min(top + block[0]) {
                        for x in left..width.min(left + block[1]) {
                            let error = constant + down * wave(y - top, block[0]) + along * wave(x - left, block[1]);
                            let found = &rgb[(y * width + x) * 3..][..3];
                            let what = format!("{height}x{width} in {block:?} at {y}, {x}: {found:?} for {error}");
                            // Single precision may decide a half otherwise.
                            assert!(
                                found.iter().all(|grey| (f64::from(*grey) - 128.0 - error).abs() < 0.5001),
                                "{what}"
                            );
                        }
                    }
                }
            }
        }
    }
}
