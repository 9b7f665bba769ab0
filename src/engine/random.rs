//! Random numbers keyed by their purpose: they depend neither on the time nor on the thread of the draw.
//!
//! Every random choice of a run is keyed by (seed, epoch, sample, purpose). The key names one stream of the ChaCha8
//! block cipher in counter mode, so any thread can open any stream at any time and reads the same numbers: this is why
//! one seed gives the same weights for 1, 2 or 5 threads, with and without a cache.
//!
//! The few functions here ([`unit()`], [`uniform`], [`below`], [`shuffle`]) are written out, not taken from the `rand`
//! crate, so that an update of that crate cannot change the course of a run.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// The purpose of a random stream. The discriminants are part of the meaning of a seed and never change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u64)]
pub enum Purpose {
    /// Initial weights; the stream is the index of the parameter.
    Initialise = 1,
    /// Order of the training samples in an epoch.
    Shuffle = 2,
    /// Which rows are held out for validation.
    Split = 3,
    /// Which rows are left out to balance the steering labels.
    Balance = 4,
    /// Whether an image is mirrored in an epoch; the stream is the sample.
    Mirror = 5,
    /// Brightness, shadow and shift of an image; the stream is the sample.
    Augment = 6,
    /// Dropout masks; the stream is chosen by the layer.
    Dropout = 7,
    /// The simulator: tracks, disturbances, start positions.
    Simulate = 8,
    /// Tests and benchmarks.
    Test = 9,
    /// Where beside the driven path an image is shown from; the stream is the sample.
    View = 10,
}

/// Opens the random stream of `purpose` in `epoch` for `stream` (a sample, a parameter, a layer).
///
/// The 32-byte ChaCha key is `seed`, `purpose`, `epoch` and a constant, 8 bytes each, little endian; `stream` is the
/// nonce. Nothing is hashed, so different arguments always give different streams.
pub fn rng(seed: u64, purpose: Purpose, epoch: u64, stream: u64) -> ChaCha8Rng {
    let mut key = [0; 32];
    key[..8].copy_from_slice(&seed.to_le_bytes());
    key[8..16].copy_from_slice(&(purpose as u64).to_le_bytes());
    key[16..24].copy_from_slice(&epoch.to_le_bytes());
    key[24..].copy_from_slice(b"steersmn");
    let mut rng = ChaCha8Rng::from_seed(key);
    rng.set_stream(stream);
    rng
}

/// A number in [0, 1) with 53 random bits.
pub fn unit(rng: &mut impl Rng) -> f64 {
    (rng.next_u64() >> 11) as f64 / (1u64 << 53) as f64
}

/// A number in [low, high).
pub fn uniform(rng: &mut impl Rng, low: f64, high: f64) -> f64 {
    low + (high - low) * unit(rng)
}

/// A whole number in 0..`bound`; 0 when `bound` is 0.
///
/// Multiply-and-shift (Lemire, arXiv 1805.10941, without the rejection step): the bias is below `bound` / 2^64.
pub fn below(rng: &mut impl Rng, bound: usize) -> usize {
    ((u128::from(rng.next_u64()) * bound as u128) >> 64) as usize
}

/// Shuffles `items` in place (Fisher–Yates): every order is equally likely.
pub fn shuffle<T>(rng: &mut impl Rng, items: &mut [T]) {
    for last in (1..items.len()).rev() {
        items.swap(last, below(rng, last + 1));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_part_of_the_key_opens_another_stream() {
        let first = |seed, purpose, epoch, stream| rng(seed, purpose, epoch, stream).next_u64();
        let base = first(1, Purpose::Shuffle, 2, 3);
        assert_eq!(base, first(1, Purpose::Shuffle, 2, 3));
        for other in [
            first(2, Purpose::Shuffle, 2, 3),
            first(1, Purpose::Split, 2, 3),
            first(1, Purpose::Shuffle, 3, 3),
            first(1, Purpose::Shuffle, 2, 4),
        ] {
            assert_ne!(base, other);
        }
    }

    #[test]
    fn a_seed_means_the_same_in_every_release() {
        let mut rng = rng(832_289, Purpose::Augment, 7, 42);
        assert_eq!(rng.next_u64(), 18_220_346_227_173_604_597);
    }

    #[test]
    fn unit_numbers_fill_the_interval() {
        let mut rng = rng(5, Purpose::Test, 0, 0);
        let draws: Vec<f64> = (0..10_000).map(|_| unit(&mut rng)).collect();
        let mean = draws.iter().sum::<f64>() / draws.len() as f64;
        assert!((mean - 0.5).abs() < 0.015, "mean {mean}");
        assert!(draws.iter().all(|x| (0.0..1.0).contains(x)));
        assert!(draws.iter().any(|&x| x < 0.001) && draws.iter().any(|&x| x > 0.999));
    }

    #[test]
    fn shuffling_is_even_and_keeps_every_item() {
        // Each of the 6 orders of 3 items is expected 1000 times; 5 standard deviations are 144.
        let mut counts = std::collections::BTreeMap::new();
        let mut rng = rng(9, Purpose::Test, 0, 0);
        for _ in 0..6_000 {
            let mut items = [0, 1, 2];
            shuffle(&mut rng, &mut items);
            *counts.entry(items).or_insert(0_i32) += 1;
        }
        assert_eq!(counts.len(), 6);
        assert!(counts.values().all(|n| (n - 1000).abs() < 144), "{counts:?}");
    }

    #[test]
    fn below_nothing_is_zero() {
        assert_eq!(below(&mut rng(0, Purpose::Test, 0, 0), 0), 0);
        shuffle::<u8>(&mut rng(0, Purpose::Test, 0, 0), &mut []);
    }
}
