//! The formula numbers of `tests/golden/README.md`, which Python and Rust evaluate alike.

/// The hash of a tensor's flat indices.
pub fn hash(name: &str) -> impl Fn(usize) -> u32 + use<> {
    let seed = name.bytes().fold(0x811c_9dc5_u32, |hash, byte| (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193));
    move |index| {
        let mut h = (index as u32).wrapping_mul(0x9e37_79b1).wrapping_add(seed);
        h ^= h >> 16;
        h = h.wrapping_mul(0x7feb_352d);
        h ^= h >> 15;
        h = h.wrapping_mul(0x846c_a68b);
        h ^ h >> 16
    }
}

/// A hash as a number in [−1, 1).
pub fn unit(hash: u32) -> f64 {
    f64::from(hash) / 4_294_967_296.0 * 2.0 - 1.0
}
