//! AVX2 with FMA (8 lanes) and AVX-512 (16 lanes).
//!
//! The tokens' constructors need the instruction set themselves, so whoever holds a token may run its instructions;
//! that is what every SAFETY line here without a pointer in it refers to.

use super::Simd;
use std::arch::x86_64::*;

/// The token of AVX2 and FMA.
#[derive(Clone, Copy)]
pub(crate) struct Avx2(());

impl Avx2 {
    /// Only code compiled for the instruction set can make the token.
    #[inline]
    #[target_feature(enable = "avx2,fma")]
    pub(crate) fn new() -> Self {
        Avx2(())
    }

    /// The mask of `vmaskmovps` for the first `count` lanes.
    #[inline(always)]
    fn first(self, count: usize) -> __m256i {
        // SAFETY: the token proves AVX2.
        unsafe { _mm256_cmpgt_epi32(_mm256_set1_epi32(count.min(8) as i32), _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7)) }
    }
}

impl Simd for Avx2 {
    type V = __m256;
    const LANES: usize = 8;
    const MANY_REGISTERS: bool = false;

    #[inline(always)]
    fn splat(self, value: f32) -> __m256 {
        // SAFETY: the token proves AVX2.
        unsafe { _mm256_set1_ps(value) }
    }

    #[inline(always)]
    fn mul_add(self, a: __m256, b: __m256, c: __m256) -> __m256 {
        // SAFETY: the token proves FMA.
        unsafe { _mm256_fmadd_ps(a, b, c) }
    }

    #[inline(always)]
    fn sum(self, v: __m256) -> f32 {
        // SAFETY: the token proves AVX2.
        unsafe {
            let four = _mm_add_ps(_mm256_castps256_ps128(v), _mm256_extractf128_ps::<1>(v));
            let two = _mm_add_ps(four, _mm_movehl_ps(four, four));
            _mm_cvtss_f32(_mm_add_ss(two, _mm_movehdup_ps(two)))
        }
    }

    #[inline(always)]
    unsafe fn load(self, p: *const f32) -> __m256 {
        // SAFETY: the token proves AVX2, the caller vouches for the pointer.
        unsafe { _mm256_loadu_ps(p) }
    }

    #[inline(always)]
    unsafe fn load_first(self, p: *const f32, count: usize) -> __m256 {
        // SAFETY: the token proves AVX2; the mask admits only the values for which the caller vouches.
        unsafe { _mm256_maskload_ps(p, self.first(count)) }
    }

    #[inline(always)]
    unsafe fn store(self, p: *mut f32, v: __m256) {
        // SAFETY: the token proves AVX2, the caller vouches for the pointer.
        unsafe { _mm256_storeu_ps(p, v) }
    }

    #[inline(always)]
    unsafe fn store_first(self, p: *mut f32, v: __m256, count: usize) {
        // SAFETY: the token proves AVX2; the mask admits only the values for which the caller vouches.
        unsafe { _mm256_maskstore_ps(p, self.first(count), v) }
    }

    #[inline(always)]
    unsafe fn load_every_second(self, p: *const f32, count: usize) -> __m256 {
        let values = 2 * count - 1;
        // SAFETY: the token proves AVX2; the masks admit `2 count - 1` values, for which the caller vouches.
        unsafe {
            let low = self.load_first(p, values);
            let high = self.load_first(p.wrapping_add(8), values.saturating_sub(8));
            // Within each half: two values of `low`, two of `high`; then the halves of each are brought together.
            let even = _mm256_castps_pd(_mm256_shuffle_ps::<0b10_00_10_00>(low, high));
            _mm256_castpd_ps(_mm256_permute4x64_pd::<0b11_01_10_00>(even))
        }
    }
}

/// The token of AVX-512 F, BW, DQ and VL.
#[derive(Clone, Copy)]
pub(crate) struct Avx512(());

impl Avx512 {
    /// Only code compiled for the instruction set can make the token.
    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx2,fma")]
    pub(crate) fn new() -> Self {
        Avx512(())
    }

    #[inline(always)]
    fn first(self, count: usize) -> __mmask16 {
        ((1u32 << count.min(16)) - 1) as __mmask16
    }
}

impl Simd for Avx512 {
    type V = __m512;
    const LANES: usize = 16;
    const MANY_REGISTERS: bool = true;

    #[inline(always)]
    fn splat(self, value: f32) -> __m512 {
        // SAFETY: the token proves AVX-512.
        unsafe { _mm512_set1_ps(value) }
    }

    #[inline(always)]
    fn mul_add(self, a: __m512, b: __m512, c: __m512) -> __m512 {
        // SAFETY: the token proves AVX-512.
        unsafe { _mm512_fmadd_ps(a, b, c) }
    }

    #[inline(always)]
    fn sum(self, v: __m512) -> f32 {
        // SAFETY: the token proves AVX-512.
        unsafe { _mm512_reduce_add_ps(v) }
    }

    #[inline(always)]
    unsafe fn load(self, p: *const f32) -> __m512 {
        // SAFETY: the token proves AVX-512, the caller vouches for the pointer.
        unsafe { _mm512_loadu_ps(p) }
    }

    #[inline(always)]
    unsafe fn load_first(self, p: *const f32, count: usize) -> __m512 {
        // SAFETY: the token proves AVX-512; the mask admits only the values for which the caller vouches.
        unsafe { _mm512_maskz_loadu_ps(self.first(count), p) }
    }

    #[inline(always)]
    unsafe fn store(self, p: *mut f32, v: __m512) {
        // SAFETY: the token proves AVX-512, the caller vouches for the pointer.
        unsafe { _mm512_storeu_ps(p, v) }
    }

    #[inline(always)]
    unsafe fn store_first(self, p: *mut f32, v: __m512, count: usize) {
        // SAFETY: the token proves AVX-512; the mask admits only the values for which the caller vouches.
        unsafe { _mm512_mask_storeu_ps(p, self.first(count), v) }
    }

    #[inline(always)]
    unsafe fn load_spread(self, p: *const f32, mask: u32) -> __m512 {
        let (mask, count) = (mask as __mmask16, mask.count_ones() as usize);
        // SAFETY: the token proves AVX-512; `count` values are read, for which the caller vouches.
        unsafe { _mm512_maskz_expand_ps(mask, _mm512_maskz_loadu_ps(self.first(count), p)) }
    }

    #[inline(always)]
    unsafe fn store_gathered(self, p: *mut f32, v: __m512, mask: u32) {
        let (mask, count) = (mask as __mmask16, mask.count_ones() as usize);
        // SAFETY: the token proves AVX-512; `count` values are written, for which the caller vouches.
        unsafe { _mm512_mask_storeu_ps(p, self.first(count), _mm512_maskz_compress_ps(mask, v)) }
    }

    #[inline(always)]
    unsafe fn load_every_second(self, p: *const f32, count: usize) -> __m512 {
        let values = 2 * count - 1;
        // SAFETY: the token proves AVX-512; the masks admit `2 count - 1` values, for which the caller vouches.
        unsafe {
            let low = self.load_first(p, values);
            let high = self.load_first(p.wrapping_add(16), values.saturating_sub(16));
            let even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
            _mm512_permutex2var_ps(low, even, high)
        }
    }

    #[inline(always)]
    unsafe fn store_every_second(self, p: *mut f32, v: __m512, count: usize) {
        let places = 0x5555_5555u32 & (u32::MAX >> (32 - 2 * count.clamp(1, 16)));
        // SAFETY: the token proves AVX-512; the masks admit places 0, 2 .. 2 count - 2, for which the caller vouches.
        unsafe {
            let low = _mm512_setr_epi32(0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7);
            let high = _mm512_setr_epi32(8, 8, 9, 9, 10, 10, 11, 11, 12, 12, 13, 13, 14, 14, 15, 15);
            _mm512_mask_storeu_ps(p, places as __mmask16, _mm512_permutexvar_ps(low, v));
            let rest = p.wrapping_add(16);
            _mm512_mask_storeu_ps(rest, (places >> 16) as __mmask16, _mm512_permutexvar_ps(high, v));
        }
    }
}
