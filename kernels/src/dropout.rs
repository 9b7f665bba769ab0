//! Dropout: which elements are dropped follows from a key and the place of the element, so nothing is kept for the way back.
//!
//! The random bits of element `i` are two rounds of the finaliser of MurmurHash3 (Appleby 2011), a permutation of 32 bits that changes
//! half of them on average when one bit of its argument changes: a counter-based generator, as in Salmon et al., *Parallel random
//! numbers: as easy as 1, 2, 3* (2011). Integers alone decide what is dropped, so it is the same for every instruction set.

/// The finaliser of MurmurHash3.
#[inline(always)]
fn mixed(mut bits: u32) -> u32 {
    bits ^= bits >> 16;
    bits = bits.wrapping_mul(0x85eb_ca6b);
    bits ^= bits >> 13;
    bits = bits.wrapping_mul(0xc2b2_ae35);
    bits ^ bits >> 16
}

/// The random bits of element `index` in the stream that `key` names.
#[inline(always)]
pub(crate) fn random_bits(key: [u32; 2], index: u32) -> u32 {
    mixed(mixed(index ^ key[0]).wrapping_add(key[1]))
}

per_isa! {
    /// `to[i] = 0` where the 32 random bits of element `i`, in the stream that `key` names, are below `threshold`, else
    /// `from[i] * scale`.
    ///
    /// # Panics
    /// If the slices differ in length or have more than 2^32 elements.
    pub fn dropout<S>(_simd: S, key: [u32; 2], threshold: u32, scale: f32, from: &[f32], to: &mut [f32]) {
        assert_eq!(from.len(), to.len(), "dropout: two lengths");
        assert!(u32::try_from(from.len()).is_ok(), "dropout: too many elements for one stream");
        for (index, (to, &from)) in to.iter_mut().zip(from).enumerate() {
            *to = if random_bits(key, index as u32) < threshold { 0.0 } else { from * scale };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Isa;

    /// The bits of an element, at the places from 0 on.
    fn bits(key: [u32; 2], count: u32) -> Vec<u32> {
        (0..count).map(|index| random_bits(key, index)).collect()
    }

    #[test]
    fn a_key_means_the_same_in_every_release_and_on_every_instruction_set() {
        assert_eq!(mixed(1), 0x514e_28b7, "the published value of fmix32");
        let from: Vec<f32> = (0..1000).map(|i| i as f32 - 500.5).collect();
        let expected: Vec<f32> = bits([7, 9], 1000)
            .iter()
            .zip(&from)
            .map(|(&bits, from)| if bits < 1 << 30 { 0.0 } else { from * 1.25 })
            .collect();
        for isa in Isa::available() {
            let mut to = vec![f32::NAN; 1000];
            dropout(isa, [7, 9], 1 << 30, 1.25, &from, &mut to);
            assert_eq!(to, expected, "{}", isa.name());
        }
    }

    /// Counts of `count` values in `of` classes deviate from an even spread by chance alone: chi-squared over its degrees of freedom
    /// lies near 1, with a standard deviation of sqrt(2 / degrees).
    fn even(classes: impl Iterator<Item = usize>, of: usize) -> f64 {
        let mut counts = vec![0.0; of];
        let mut total = 0.0;
        for class in classes {
            counts[class] += 1.0;
            total += 1.0;
        }
        let expected = total / of as f64;
        counts.iter().map(|count| (count - expected) * (count - expected) / expected).sum::<f64>() / (of - 1) as f64
    }

    #[test]
    fn the_bits_are_even_and_neighbours_and_streams_do_not_tell_of_each_other() {
        let limits = 1.0 - 6.0 * (2.0f64 / 255.0).sqrt()..1.0 + 6.0 * (2.0f64 / 255.0).sqrt();
        for key in [[0, 0], [1, 0], [0, 1], [0xdead_beef, 0x0bad_cafe]] {
            let values = bits(key, 1 << 16);
            let top = |bits: u32, count: u32| (bits >> (32 - count)) as usize;
            let spread = even(values.iter().map(|&bits| top(bits, 8)), 256);
            assert!(limits.contains(&spread), "{key:?}: {spread}");
            for apart in [1, 2, 16, 160, 1024] {
                let pairs = values.iter().zip(&values[apart..]).map(|(&a, &b)| top(a, 4) << 4 | top(b, 4));
                let spread = even(pairs, 256);
                assert!(limits.contains(&spread), "{key:?}, elements {apart} apart: {spread}");
            }
            for other in [[key[0] ^ 1, key[1]], [key[0], key[1].wrapping_add(1)], [key[1], key[0] ^ 0x10]] {
                let others = bits(other, 1 << 16);
                let spread = even(values.iter().zip(&others).map(|(&a, &b)| top(a, 4) << 4 | top(b, 4)), 256);
                assert!(limits.contains(&spread), "{key:?} and {other:?}: {spread}");
            }
        }
    }
}
