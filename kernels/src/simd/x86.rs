//! AVX2 with FMA (8 lanes) and AVX-512 (16 lanes).
//!
//! The tokens' constructors need the instruction set themselves, so whoever holds a token may run its instructions;
//! that is what every SAFETY line here without a pointer in it refers to.

use super::{Purpose, Simd};
use std::arch::x86_64::*;

/// Prefetches a cache line.
#[inline(always)]
fn prefetch(p: *const f32, purpose: Purpose) {
    // SAFETY: the instructions read and write nothing, whatever the address; those of the first and second level belong to
    // x86-64, and every processor with AVX2 has that for writing.
    unsafe {
        match purpose {
            Purpose::ReadSoon => _mm_prefetch::<_MM_HINT_T0>(p.cast()),
            Purpose::ReadLater => _mm_prefetch::<_MM_HINT_T1>(p.cast()),
            Purpose::Write => _mm_prefetch::<_MM_HINT_ET0>(p.cast()),
        }
    }
}

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
    type M = __m256;
    const LANES: usize = 8;
    const MANY_REGISTERS: bool = false;

    #[inline(always)]
    fn prefetch(self, p: *const f32, purpose: Purpose) {
        prefetch(p, purpose);
    }

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
    fn max(self, a: __m256, b: __m256) -> __m256 {
        // SAFETY: the token proves AVX2.
        unsafe { _mm256_max_ps(a, b) }
    }

    #[inline(always)]
    fn greater(self, a: __m256, b: __m256) -> __m256 {
        // SAFETY: the token proves AVX2.
        unsafe { _mm256_cmp_ps::<_CMP_GT_OQ>(a, b) }
    }

    #[inline(always)]
    fn equal(self, a: __m256, b: __m256) -> __m256 {
        // SAFETY: the token proves AVX2.
        unsafe { _mm256_cmp_ps::<_CMP_EQ_OQ>(a, b) }
    }

    #[inline(always)]
    fn and(self, a: __m256, b: __m256) -> __m256 {
        // SAFETY: the token proves AVX2.
        unsafe { _mm256_and_ps(a, b) }
    }

    #[inline(always)]
    fn and_not(self, a: __m256, b: __m256) -> __m256 {
        // SAFETY: the token proves AVX2.
        unsafe { _mm256_andnot_ps(b, a) }
    }

    #[inline(always)]
    fn select(self, mask: __m256, yes: __m256, no: __m256) -> __m256 {
        // SAFETY: the token proves AVX2.
        unsafe { _mm256_blendv_ps(no, yes, mask) }
    }

    #[inline(always)]
    unsafe fn load_pairs(self, p: *const f32, count: usize) -> [__m256; 2] {
        // SAFETY: the token proves AVX2; no more than `2 count` values are read, for which the caller vouches.
        unsafe {
            let low = self.load_first(p, 2 * count);
            let high = self.load_first(p.wrapping_add(8), (2 * count).saturating_sub(8));
            // Within each half of a vector, which costs less than to go beyond: two pairs of `low`, two of `high`.
            [_mm256_shuffle_ps::<0b10_00_10_00>(low, high), _mm256_shuffle_ps::<0b11_01_11_01>(low, high)]
        }
    }

    #[inline(always)]
    fn to_pair_order(self, v: __m256) -> __m256 {
        // SAFETY: the token proves AVX2.
        unsafe { _mm256_castpd_ps(_mm256_permute4x64_pd::<0b11_01_10_00>(_mm256_castps_pd(v))) }
    }

    #[inline(always)]
    fn to_memory_order(self, v: __m256) -> __m256 {
        self.to_pair_order(v)
    }

    #[inline(always)]
    unsafe fn store_pairs(self, p: *mut f32, v: [__m256; 2], count: usize) {
        // SAFETY: the token proves AVX2; no more than `2 count` places are written, for which the caller vouches.
        unsafe {
            self.store_first(p, _mm256_unpacklo_ps(v[0], v[1]), 2 * count);
            self.store_first(p.wrapping_add(8), _mm256_unpackhi_ps(v[0], v[1]), (2 * count).saturating_sub(8));
        }
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
    fn sums(self, v: [__m256; 8]) -> [f32; 8] {
        let mut sums = [0.0; 8];
        // SAFETY: the token proves AVX2; `sums` has 8 places.
        unsafe {
            // Each half of `low` then holds the sums of half of vectors 0 to 3, each half of `high` those of 4 to 7.
            let low = _mm256_hadd_ps(_mm256_hadd_ps(v[0], v[1]), _mm256_hadd_ps(v[2], v[3]));
            let high = _mm256_hadd_ps(_mm256_hadd_ps(v[4], v[5]), _mm256_hadd_ps(v[6], v[7]));
            let first = _mm256_permute2f128_ps::<0x20>(low, high);
            let second = _mm256_permute2f128_ps::<0x31>(low, high);
            _mm256_storeu_ps(sums.as_mut_ptr(), _mm256_add_ps(first, second));
        }
        sums
    }

    #[inline(always)]
    unsafe fn load(self, p: *const f32) -> __m256 {
        // SAFETY: the token proves AVX2, the caller vouches for the pointer.
        unsafe { _mm256_loadu_ps(p) }
    }

    #[inline(always)]
    unsafe fn load_first(self, p: *const f32, count: usize) -> __m256 {
        // SAFETY: the token proves AVX2; the mask admits only the values for which the caller vouches.
        unsafe { if count >= 8 { _mm256_loadu_ps(p) } else { _mm256_maskload_ps(p, self.first(count)) } }
    }

    #[inline(always)]
    unsafe fn store(self, p: *mut f32, v: __m256) {
        // SAFETY: the token proves AVX2, the caller vouches for the pointer.
        unsafe { _mm256_storeu_ps(p, v) }
    }

    // `vmaskmovps` to memory is many times slower than a plain store on some processors (Zen), and where lanes are few,
    // than one store a lane.
    #[inline(always)]
    unsafe fn store_first(self, p: *mut f32, v: __m256, count: usize) {
        // SAFETY: the token proves AVX2; only the values for which the caller vouches are written.
        unsafe {
            if count >= 8 {
                return _mm256_storeu_ps(p, v);
            }
            let (mut half, mut to) = (_mm256_castps256_ps128(v), p);
            if count & 4 != 0 {
                _mm_storeu_ps(to, half);
                (half, to) = (_mm256_extractf128_ps::<1>(v), to.add(4));
            }
            if count & 2 != 0 {
                _mm_storel_pd(to.cast(), _mm_castps_pd(half));
                (half, to) = (_mm_movehl_ps(half, half), to.add(2));
            }
            if count & 1 != 0 {
                _mm_store_ss(to, half);
            }
        }
    }

    #[inline(always)]
    unsafe fn load_spread(self, p: *const f32, mask: u32) -> __m256 {
        // SAFETY: the token proves AVX2; as many values are read as the mask has bits.
        unsafe {
            let values = self.load_first(p, mask.count_ones() as usize);
            let spread = _mm256_permutevar8x32_ps(values, lanes_of(&SPREAD, mask));
            let bits = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
            let held = _mm256_cmpeq_epi32(_mm256_and_si256(_mm256_set1_epi32(mask as i32), bits), bits);
            _mm256_and_ps(spread, _mm256_castsi256_ps(held))
        }
    }

    #[inline(always)]
    unsafe fn store_gathered(self, p: *mut f32, v: __m256, mask: u32) {
        // SAFETY: the token proves AVX2; as many values are written as the mask has bits.
        unsafe {
            let gathered = _mm256_permutevar8x32_ps(v, lanes_of(&GATHER, mask));
            self.store_first(p, gathered, mask.count_ones() as usize);
        }
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

    #[inline(always)]
    unsafe fn store_every_second(self, p: *mut f32, v: __m256, count: usize) {
        if count < 8 {
            let mut lanes = [0.0; 8];
            // SAFETY: the token proves AVX2; the last of `count` places is `2 count - 2`, for which the caller vouches.
            unsafe {
                _mm256_storeu_ps(lanes.as_mut_ptr(), v);
                for (i, lane) in lanes.into_iter().enumerate().take(count) {
                    *p.add(2 * i) = lane;
                }
            }
            return;
        }
        // SAFETY: the token proves AVX2; places 0 to 14, for which the caller vouches, are read and written back. The
        // second half begins at place 7, so that it ends at 14.
        unsafe {
            // Both are read first: a load that overlaps a store under way waits for it.
            let (from_0, from_7) = (_mm256_loadu_ps(p), _mm256_loadu_ps(p.add(7)));
            let low = _mm256_permutevar8x32_ps(v, _mm256_setr_epi32(0, 0, 1, 1, 2, 2, 3, 3));
            let high = _mm256_permutevar8x32_ps(v, _mm256_setr_epi32(4, 4, 4, 5, 5, 6, 6, 7));
            _mm256_storeu_ps(p, _mm256_blend_ps::<0b0101_0101>(from_0, low));
            _mm256_storeu_ps(p.add(7), _mm256_blend_ps::<0b1010_1010>(from_7, high));
        }
    }
}

/// For each mask of 8 lanes, which of consecutive values a held lane takes (`SPREAD`).
static SPREAD: [[u8; 8]; 256] = lane_table(false);
/// For each mask of 8 lanes, which lanes are held, in order (`GATHER`).
static GATHER: [[u8; 8]; 256] = lane_table(true);

const fn lane_table(gather: bool) -> [[u8; 8]; 256] {
    let mut table = [[0; 8]; 256];
    let mut mask = 0;
    while mask < 256 {
        let (mut lane, mut next) = (0, 0);
        while lane < 8 {
            if mask >> lane & 1 == 1 {
                let (at, value) = if gather { (next, lane) } else { (lane, next) };
                table[mask][at] = value as u8;
                next += 1;
            }
            lane += 1;
        }
        mask += 1;
    }
    table
}

/// The row of a lane table as 32-bit numbers.
#[inline]
#[target_feature(enable = "avx2,fma")]
fn lanes_of(table: &[[u8; 8]; 256], mask: u32) -> __m256i {
    _mm256_cvtepu8_epi32(_mm_cvtsi64_si128(i64::from_le_bytes(table[(mask & 255) as usize])))
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

    /// Writes the first `count <= 16` lanes without a mask: a load of what lies behind them, if it follows soon, would
    /// wait for a store with a mask that reaches over it.
    ///
    /// # Safety
    /// `p` must be valid for writing `count` values.
    #[inline(always)]
    unsafe fn store_pieces(self, p: *mut f32, v: __m512, count: usize) {
        // SAFETY: the token proves AVX-512 and with it AVX2; only the values for which the caller vouches are written.
        unsafe {
            if count >= 16 {
                return _mm512_storeu_ps(p, v);
            }
            let low = _mm512_castps512_ps256(v);
            if count < 8 {
                return Avx2(()).store_first(p, low, count);
            }
            _mm256_storeu_ps(p, low);
            Avx2(()).store_first(p.add(8), _mm512_extractf32x8_ps::<1>(v), count - 8);
        }
    }
}

impl Simd for Avx512 {
    type V = __m512;
    type M = __mmask16;
    const LANES: usize = 16;
    const MANY_REGISTERS: bool = true;

    #[inline(always)]
    fn prefetch(self, p: *const f32, purpose: Purpose) {
        prefetch(p, purpose);
    }

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
    fn max(self, a: __m512, b: __m512) -> __m512 {
        // SAFETY: the token proves AVX-512.
        unsafe { _mm512_max_ps(a, b) }
    }

    #[inline(always)]
    fn greater(self, a: __m512, b: __m512) -> __mmask16 {
        // SAFETY: the token proves AVX-512.
        unsafe { _mm512_cmp_ps_mask::<_CMP_GT_OQ>(a, b) }
    }

    #[inline(always)]
    fn equal(self, a: __m512, b: __m512) -> __mmask16 {
        // SAFETY: the token proves AVX-512.
        unsafe { _mm512_cmp_ps_mask::<_CMP_EQ_OQ>(a, b) }
    }

    #[inline(always)]
    fn and(self, a: __mmask16, b: __mmask16) -> __mmask16 {
        a & b
    }

    #[inline(always)]
    fn and_not(self, a: __mmask16, b: __mmask16) -> __mmask16 {
        a & !b
    }

    #[inline(always)]
    fn select(self, mask: __mmask16, yes: __m512, no: __m512) -> __m512 {
        // SAFETY: the token proves AVX-512.
        unsafe { _mm512_mask_blend_ps(mask, no, yes) }
    }

    #[inline(always)]
    unsafe fn load_pairs(self, p: *const f32, count: usize) -> [__m512; 2] {
        // SAFETY: the token proves AVX-512; the masks admit `2 count` values, for which the caller vouches.
        unsafe {
            let low = self.load_first(p, 2 * count);
            let high = self.load_first(p.wrapping_add(16), (2 * count).saturating_sub(16));
            // Within each quarter of a vector, which costs less than to go beyond: two pairs of `low`, two of `high`.
            [_mm512_shuffle_ps::<0b10_00_10_00>(low, high), _mm512_shuffle_ps::<0b11_01_11_01>(low, high)]
        }
    }

    #[inline(always)]
    fn to_pair_order(self, v: __m512) -> __m512 {
        // SAFETY: the token proves AVX-512.
        unsafe {
            let order = _mm512_setr_epi64(0, 4, 1, 5, 2, 6, 3, 7);
            _mm512_castpd_ps(_mm512_permutexvar_pd(order, _mm512_castps_pd(v)))
        }
    }

    #[inline(always)]
    fn to_memory_order(self, v: __m512) -> __m512 {
        // SAFETY: the token proves AVX-512.
        unsafe {
            let order = _mm512_setr_epi64(0, 2, 4, 6, 1, 3, 5, 7);
            _mm512_castpd_ps(_mm512_permutexvar_pd(order, _mm512_castps_pd(v)))
        }
    }

    #[inline(always)]
    unsafe fn store_pairs(self, p: *mut f32, v: [__m512; 2], count: usize) {
        // SAFETY: the token proves AVX-512; no more than `2 count` places are written, for which the caller vouches.
        unsafe {
            self.store_pieces(p, _mm512_unpacklo_ps(v[0], v[1]), 2 * count);
            let rest = (2 * count).saturating_sub(16);
            self.store_pieces(p.wrapping_add(16), _mm512_unpackhi_ps(v[0], v[1]), rest);
        }
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
