//! Colours packed into texels, and quick conversions of the coordinates at which texels are looked up.

/// Packs a colour with coverage into a texel.
pub fn pack(rgb: [f32; 3], alpha: f32) -> u32 {
    let byte = |v: f32| v.clamp(0.0, 255.0) as u32;
    byte(rgb[0]) | byte(rgb[1]) << 8 | byte(rgb[2]) << 16 | byte(alpha * 255.0) << 24
}

/// Clamps `x` to [0, high]. Written as two comparisons, it compiles to two instructions.
#[inline(always)]
pub fn clip(x: f32, high: f32) -> f32 {
    let x = if x > 0.0 { x } else { 0.0 };
    if x < high { x } else { high }
}

/// Rounds to the nearest integer; `|x|` must be below 2^22. Avoids the range checks of a cast.
#[inline(always)]
pub fn fixed(x: f32) -> i32 {
    // 1.5 * 2^23: the low bits of the sum's mantissa are the integer, also for negative numbers.
    (x + 12_582_912.0).to_bits() as i32 - 0x4b40_0000
}

/// Integer and fractional part of a number in [0, 2^22).
///
/// Adding 2^23 leaves the rounded number in the low bits of the mantissa, which is much faster than a checked cast; adding
/// 2 more keeps 0 - 0.5 above 2^23. For an integer the result may be one less, with a fraction of 1.
#[inline(always)]
pub fn split(x: f32) -> (usize, f32) {
    const MAGIC: f32 = 8_388_610.0;
    let moved = (x - 0.5) + MAGIC;
    let whole = (moved.to_bits() & 0x007f_ffff) as usize - 2;
    (whole, x - (moved - MAGIC))
}
