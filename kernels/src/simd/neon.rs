//! NEON: 4 lanes, 32 registers, fused multiply-add.
//!
//! The token's constructor needs the instruction set itself, so whoever holds it may run its instructions; that is what
//! every SAFETY line here without a pointer in it refers to.

#![allow(unused_unsafe, reason = "targets that always have NEON may call its instructions without `unsafe`")]

use super::Simd;
use std::arch::aarch64::*;

/// The token of NEON.
#[derive(Clone, Copy)]
pub(crate) struct Neon(());

impl Neon {
    /// Only code compiled for the instruction set can make the token.
    #[inline]
    #[target_feature(enable = "neon")]
    pub(crate) fn new() -> Self {
        Neon(())
    }
}

impl Simd for Neon {
    type V = float32x4_t;
    type M = uint32x4_t;
    const LANES: usize = 4;
    const MANY_REGISTERS: bool = true;

    #[inline(always)]
    fn splat(self, value: f32) -> float32x4_t {
        // SAFETY: the token proves NEON.
        unsafe { vdupq_n_f32(value) }
    }

    #[inline(always)]
    fn mul_add(self, a: float32x4_t, b: float32x4_t, c: float32x4_t) -> float32x4_t {
        // SAFETY: the token proves NEON. The accumulator comes first in this intrinsic.
        unsafe { vfmaq_f32(c, a, b) }
    }

    // Not `vmaxq_f32`, which gives NaN where either is.
    #[inline(always)]
    fn max(self, a: float32x4_t, b: float32x4_t) -> float32x4_t {
        // SAFETY: the token proves NEON.
        unsafe { vbslq_f32(vcgtq_f32(a, b), a, b) }
    }

    #[inline(always)]
    fn greater(self, a: float32x4_t, b: float32x4_t) -> uint32x4_t {
        // SAFETY: the token proves NEON.
        unsafe { vcgtq_f32(a, b) }
    }

    #[inline(always)]
    fn equal(self, a: float32x4_t, b: float32x4_t) -> uint32x4_t {
        // SAFETY: the token proves NEON.
        unsafe { vceqq_f32(a, b) }
    }

    #[inline(always)]
    fn and(self, a: uint32x4_t, b: uint32x4_t) -> uint32x4_t {
        // SAFETY: the token proves NEON.
        unsafe { vandq_u32(a, b) }
    }

    #[inline(always)]
    fn and_not(self, a: uint32x4_t, b: uint32x4_t) -> uint32x4_t {
        // SAFETY: the token proves NEON.
        unsafe { vbicq_u32(a, b) }
    }

    #[inline(always)]
    fn select(self, mask: uint32x4_t, yes: float32x4_t, no: float32x4_t) -> float32x4_t {
        // SAFETY: the token proves NEON.
        unsafe { vbslq_f32(mask, yes, no) }
    }

    #[inline(always)]
    unsafe fn load_pairs(self, p: *const f32, count: usize) -> [float32x4_t; 2] {
        let mut values = [0.0; 8];
        // SAFETY: the token proves NEON, the caller vouches for `2 count` values; `values` holds 8.
        let pairs = unsafe {
            if count >= 4 {
                vld2q_f32(p)
            } else {
                std::ptr::copy_nonoverlapping(p, values.as_mut_ptr(), 2 * count);
                vld2q_f32(values.as_ptr())
            }
        };
        [pairs.0, pairs.1]
    }

    #[inline(always)]
    unsafe fn store_pairs(self, p: *mut f32, v: [float32x4_t; 2], count: usize) {
        let pairs = float32x4x2_t(v[0], v[1]);
        let mut values = [0.0; 8];
        // SAFETY: the token proves NEON, the caller vouches for `2 count` places; `values` holds 8.
        unsafe {
            if count >= 4 {
                vst2q_f32(p, pairs);
            } else {
                vst2q_f32(values.as_mut_ptr(), pairs);
                std::ptr::copy_nonoverlapping(values.as_ptr(), p, 2 * count);
            }
        }
    }

    #[inline(always)]
    fn sum(self, v: float32x4_t) -> f32 {
        // SAFETY: the token proves NEON.
        unsafe { vaddvq_f32(v) }
    }

    #[inline(always)]
    unsafe fn load(self, p: *const f32) -> float32x4_t {
        // SAFETY: the token proves NEON, the caller vouches for the pointer.
        unsafe { vld1q_f32(p) }
    }

    #[inline(always)]
    unsafe fn load_first(self, p: *const f32, count: usize) -> float32x4_t {
        let mut lanes = [0.0; 4];
        // SAFETY: at most 4 values are copied, for which the caller vouches; the token proves NEON.
        unsafe {
            std::ptr::copy_nonoverlapping(p, lanes.as_mut_ptr(), count.min(4));
            vld1q_f32(lanes.as_ptr())
        }
    }

    #[inline(always)]
    unsafe fn store(self, p: *mut f32, v: float32x4_t) {
        // SAFETY: the token proves NEON, the caller vouches for the pointer.
        unsafe { vst1q_f32(p, v) }
    }

    #[inline(always)]
    unsafe fn store_first(self, p: *mut f32, v: float32x4_t, count: usize) {
        let mut lanes = [0.0; 4];
        // SAFETY: at most 4 values are copied, for which the caller vouches; the token proves NEON.
        unsafe {
            vst1q_f32(lanes.as_mut_ptr(), v);
            std::ptr::copy_nonoverlapping(lanes.as_ptr(), p, count.min(4));
        }
    }
}
