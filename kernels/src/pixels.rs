//! Grey levels of a picture, as bytes: to floats, and changed at random.
//!
//! All instruction sets give the same bytes: noise is made of integers, and products and sums of floats are never fused here.

use crate::dropout::random_bits;

/// Grey levels or pixels that are worked on at a time, in arrays of fixed size that vectors fit into.
const PIECE: usize = 64;

per_isa! {
    /// `dst = src * scale + offset` for each byte.
    pub fn u8_to_f32<S>(_simd: S, src: &[u8], scale: f32, offset: f32, dst: &mut [f32]) {
        assert_eq!(src.len(), dst.len(), "u8_to_f32: src and dst differ in length");
        for (dst, &src) in dst.iter_mut().zip(src) {
            *dst = f32::from(src) * scale + offset;
        }
    }
}

per_isa! {
    /// Adds to each grey level an error of its own, evenly spread over [-127, 127] `step` / 256 and rounded; 0 and 255 are the limits.
    /// `key` names the stream of random bits, of which the `i`-th 32 serve `greys[4 i..4 i + 4]`, lowest byte first. Of the 256 values
    /// of a byte, -128 counts as -127.
    ///
    /// # Panics
    /// If `step` is above 256: an error would not fit 16 bits.
    pub fn add_noise<S>(_simd: S, key: [u32; 2], step: u16, greys: &mut [u8]) {
        assert!(step <= 256, "add_noise: a step of {step} is more than 256");
        let error = |random: u8| (i16::from(random as i8).max(-127) * step as i16 + 128) >> 8;
        let mut random = [0u8; PIECE];
        for (piece, greys) in greys.chunks_mut(PIECE).enumerate() {
            for (word, bytes) in random.chunks_exact_mut(4).enumerate() {
                bytes.copy_from_slice(&random_bits(key, (piece * PIECE / 4 + word) as u32).to_le_bytes());
            }
            for (grey, &random) in greys.iter_mut().zip(&random) {
                *grey = (i16::from(*grey) + error(random)).clamp(0, 255) as u8;
            }
        }
    }
}

per_isa! {
    /// Adds `constant[x] + factor * slope[x]`, rounded, to the three grey levels of pixel `x`; 0 and 255 are the limits. The sum must lie
    /// within ±256.
    ///
    /// # Panics
    /// If the slices do not belong to as many pixels.
    pub fn add_grey<S>(_simd: S, constant: &[f32], slope: &[f32], factor: f32, rgb: &mut [u8]) {
        assert!(constant.len() == slope.len() && rgb.len() == 3 * slope.len(), "add_grey: lengths that do not fit");
        let (mut errors, mut spread) = ([0i16; PIECE], [0i16; 3 * PIECE]);
        let pieces = constant.chunks(PIECE).zip(slope.chunks(PIECE)).zip(rgb.chunks_mut(3 * PIECE));
        for ((constant, slope), rgb) in pieces {
            for ((error, &constant), &slope) in errors.iter_mut().zip(constant).zip(slope) {
                // Half a grey level more, as the conversion of what is not negative cuts off.
                *error = (constant + factor * slope + 256.5) as i16 - 256;
            }
            for (spread, &error) in spread.chunks_exact_mut(3).zip(&errors) {
                spread.fill(error);
            }
            for (grey, &error) in rgb.iter_mut().zip(&spread) {
                *grey = (i16::from(*grey) + error).clamp(0, 255) as u8;
            }
        }
    }
}

per_isa! {
    /// Multiplies the colour of each pixel, three bytes, by `matrix` and adds `offset` to each channel; what is behind the decimal point is
    /// cut off, and 0 and 255 are the limits. Bytes behind the last whole pixel stay as they are.
    pub fn recolour<S>(_simd: S, matrix: &[[f32; 3]; 3], offset: f32, rgb: &mut [u8]) {
        // The channels are taken apart, so that vectors hold one channel each.
        let (mut from, mut to) = ([[0u8; PIECE]; 3], [[0u8; PIECE]; 3]);
        for rgb in rgb.chunks_mut(3 * PIECE) {
            for (x, px) in rgb.chunks_exact(3).enumerate() {
                for (channel, &grey) in from.iter_mut().zip(px) {
                    channel[x] = grey;
                }
            }
            for (to, [wr, wg, wb]) in to.iter_mut().zip(matrix) {
                for x in 0..PIECE {
                    let [r, g, b] = [f32::from(from[0][x]), f32::from(from[1][x]), f32::from(from[2][x])];
                    to[x] = (wr * r + wg * g + wb * b + offset) as u8;
                }
            }
            for (x, px) in rgb.chunks_exact_mut(3).enumerate() {
                for (grey, channel) in px.iter_mut().zip(&to) {
                    *grey = channel[x];
                }
            }
        }
    }
}
