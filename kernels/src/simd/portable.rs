//! Four lanes in plain Rust, for processors without a better instruction set.

use super::Simd;

/// The token of plain Rust; anyone may have it.
#[derive(Clone, Copy)]
pub(crate) struct Portable;

impl Simd for Portable {
    type V = [f32; 4];
    /// All bits of a lane are set, or none.
    type M = [u32; 4];
    const LANES: usize = 4;
    const MANY_REGISTERS: bool = false;

    #[inline(always)]
    fn splat(self, value: f32) -> [f32; 4] {
        [value; 4]
    }

    #[inline(always)]
    fn mul_add(self, a: [f32; 4], b: [f32; 4], c: [f32; 4]) -> [f32; 4] {
        // Not `f32::mul_add`: without the instruction that is a slow call to the C library.
        [a[0] * b[0] + c[0], a[1] * b[1] + c[1], a[2] * b[2] + c[2], a[3] * b[3] + c[3]]
    }

    #[inline(always)]
    fn max(self, a: [f32; 4], b: [f32; 4]) -> [f32; 4] {
        std::array::from_fn(|i| if a[i] > b[i] { a[i] } else { b[i] })
    }

    #[inline(always)]
    fn greater(self, a: [f32; 4], b: [f32; 4]) -> [u32; 4] {
        std::array::from_fn(|i| u32::from(a[i] > b[i]).wrapping_neg())
    }

    #[inline(always)]
    fn equal(self, a: [f32; 4], b: [f32; 4]) -> [u32; 4] {
        std::array::from_fn(|i| u32::from(a[i] == b[i]).wrapping_neg())
    }

    #[inline(always)]
    fn and(self, a: [u32; 4], b: [u32; 4]) -> [u32; 4] {
        std::array::from_fn(|i| a[i] & b[i])
    }

    #[inline(always)]
    fn and_not(self, a: [u32; 4], b: [u32; 4]) -> [u32; 4] {
        std::array::from_fn(|i| a[i] & !b[i])
    }

    #[inline(always)]
    fn select(self, mask: [u32; 4], yes: [f32; 4], no: [f32; 4]) -> [f32; 4] {
        std::array::from_fn(|i| f32::from_bits((mask[i] & yes[i].to_bits()) | (!mask[i] & no[i].to_bits())))
    }

    #[inline(always)]
    unsafe fn load_pairs(self, p: *const f32, count: usize) -> [[f32; 4]; 2] {
        let mut values = [0.0; 8];
        // SAFETY: the caller vouches for `2 count` values; no more than 8 are copied.
        unsafe { std::ptr::copy_nonoverlapping(p, values.as_mut_ptr(), 2 * count.min(4)) };
        let [a, b, c, d, e, f, g, h] = values;
        [[a, c, e, g], [b, d, f, h]]
    }

    #[inline(always)]
    unsafe fn store_pairs(self, p: *mut f32, v: [[f32; 4]; 2], count: usize) {
        let [[a, c, e, g], [b, d, f, h]] = v;
        // SAFETY: the caller vouches for `2 count` places; no more than 8 are copied.
        unsafe { std::ptr::copy_nonoverlapping([a, b, c, d, e, f, g, h].as_ptr(), p, 2 * count.min(4)) };
    }

    #[inline(always)]
    fn sum(self, v: [f32; 4]) -> f32 {
        (v[0] + v[1]) + (v[2] + v[3])
    }

    #[inline(always)]
    unsafe fn load(self, p: *const f32) -> [f32; 4] {
        // SAFETY: the caller vouches for 4 values; the read needs no alignment.
        unsafe { p.cast::<[f32; 4]>().read_unaligned() }
    }

    #[inline(always)]
    unsafe fn load_first(self, p: *const f32, count: usize) -> [f32; 4] {
        // SAFETY: only the first `count` values are read, for which the caller vouches.
        std::array::from_fn(|i| if i < count { unsafe { *p.add(i) } } else { 0.0 })
    }

    #[inline(always)]
    unsafe fn store(self, p: *mut f32, v: [f32; 4]) {
        // SAFETY: the caller vouches for 4 values; the write needs no alignment.
        unsafe { p.cast::<[f32; 4]>().write_unaligned(v) }
    }

    #[inline(always)]
    unsafe fn store_first(self, p: *mut f32, v: [f32; 4], count: usize) {
        for (i, value) in v.into_iter().enumerate().take(count) {
            // SAFETY: only the first `count` values are written, for which the caller vouches.
            unsafe { *p.add(i) = value };
        }
    }
}
