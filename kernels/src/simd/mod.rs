//! One trait for the vector instructions the kernels need, and a type for each instruction set.
//!
//! The types are tokens: those of [`x86`] and [`neon`] can only be made in code compiled for their instruction set, so
//! their arithmetic is safe. Methods that take a pointer are unsafe. Every method is `#[inline(always)]`, so that it lands in a
//! function compiled for its instruction set (see `per_isa!`).

#[cfg(target_arch = "aarch64")]
pub(crate) mod neon;
pub(crate) mod portable;
#[cfg(target_arch = "x86_64")]
pub(crate) mod x86;

/// Elements of a cache line. A vector that crosses from one line into the next costs two loads.
pub(crate) const ALIGNMENT: usize = 16;

/// The largest number of lanes of a vector, on any instruction set.
pub(crate) const MAX_LANES: usize = 16;

/// The part of `scratch` that begins on a cache line; up to `ALIGNMENT` elements are lost.
#[inline(always)]
pub(crate) fn align(scratch: &mut [f32]) -> &mut [f32] {
    let skip = scratch.as_ptr().align_offset(ALIGNMENT * size_of::<f32>());
    &mut scratch[skip.min(ALIGNMENT)..]
}

/// The `LANES` elements from `at` on.
#[inline(always)]
pub(crate) fn get<S: Simd>(simd: S, from: &[f32], at: usize) -> S::V {
    let from = &from[at..at + S::LANES];
    // SAFETY: the slice has `LANES` elements.
    unsafe { simd.load(from.as_ptr()) }
}

/// The first `count` elements from `at` on, at most `LANES`; the lanes after them are 0.
#[inline(always)]
pub(crate) fn get_first<S: Simd>(simd: S, from: &[f32], at: usize, count: usize) -> S::V {
    let from = &from[at..at + count.min(S::LANES)];
    // SAFETY: the slice has as many elements as are read.
    unsafe { simd.load_first(from.as_ptr(), from.len()) }
}

/// Writes the first `count` lanes, at most `LANES`, from `at` on.
#[inline(always)]
pub(crate) fn put_first<S: Simd>(simd: S, to: &mut [f32], at: usize, v: S::V, count: usize) {
    let to = &mut to[at..at + count.min(S::LANES)];
    // SAFETY: the slice has as many elements as are written.
    unsafe { simd.store_first(to.as_mut_ptr(), v, to.len()) };
}

/// `count` pairs of elements from `at` on, at most `LANES`: first elements first, in the order of [`Simd::load_pairs`].
#[inline(always)]
pub(crate) fn get_pairs<S: Simd>(simd: S, from: &[f32], at: usize, count: usize) -> [S::V; 2] {
    let from = &from[at..at + 2 * count.min(S::LANES)];
    // SAFETY: the slice has as many pairs as are read.
    unsafe { simd.load_pairs(from.as_ptr(), from.len() / 2) }
}

/// The reverse of [`get_pairs`].
#[inline(always)]
pub(crate) fn put_pairs<S: Simd>(simd: S, to: &mut [f32], at: usize, v: [S::V; 2], count: usize) {
    let to = &mut to[at..at + 2 * count.min(S::LANES)];
    // SAFETY: the slice has as many pairs as are written.
    unsafe { simd.store_pairs(to.as_mut_ptr(), v, to.len() / 2) };
}

/// The purpose of a prefetch.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Purpose {
    /// The data is read soon: into the first-level cache.
    ReadSoon,
    /// The data is read later: into the second-level cache.
    ReadLater,
    /// The line is written soon.
    Write,
}

/// Prefetches part `part` of `parts` equal parts of `upcoming` into the second-level cache.
#[inline(always)]
pub(crate) fn prefetch_part<S: Simd>(simd: S, upcoming: &[f32], part: usize, parts: usize) {
    let lines = upcoming.len() / ALIGNMENT;
    for line in lines * part / parts..lines * (part + 1) / parts {
        simd.prefetch(upcoming[line * ALIGNMENT..].as_ptr(), Purpose::ReadLater);
    }
}

/// Vectors of `LANES` values of `f32`.
pub(crate) trait Simd: Copy {
    /// A vector.
    type V: Copy;
    /// True or false for each lane.
    type M: Copy;
    /// Values in a vector, at most 16.
    const LANES: usize;
    /// Whether there are 32 registers (enough for 24 accumulators) and not 16 (enough for 12).
    const MANY_REGISTERS: bool;

    /// The value in every lane.
    fn splat(self, value: f32) -> Self::V;
    /// `a * b + c`, fused where the instruction set can.
    fn mul_add(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    /// Lane by lane, `a` where `a > b`, else (also for NaN) `b`.
    fn max(self, a: Self::V, b: Self::V) -> Self::V;
    /// Where `a > b`; false for NaN.
    fn greater(self, a: Self::V, b: Self::V) -> Self::M;
    /// Where `a == b`; false for NaN.
    fn equal(self, a: Self::V, b: Self::V) -> Self::M;
    /// Where both hold.
    fn and(self, a: Self::M, b: Self::M) -> Self::M;
    /// Where `a` holds and `b` does not.
    fn and_not(self, a: Self::M, b: Self::M) -> Self::M;
    /// Lane by lane, `yes` where `mask` holds, else `no`.
    fn select(self, mask: Self::M, yes: Self::V, no: Self::V) -> Self::V;
    /// Lane by lane, `yes` where `a > b`, else (also for NaN) `no`.
    #[inline(always)]
    fn select_greater(self, a: Self::V, b: Self::V, yes: Self::V, no: Self::V) -> Self::V {
        self.select(self.greater(a, b), yes, no)
    }
    /// The sum of all lanes, in a fixed order.
    fn sum(self, v: Self::V) -> f32;
    /// The sum of all lanes of each vector, in a fixed order.
    #[inline(always)]
    fn sums(self, v: [Self::V; 8]) -> [f32; 8] {
        let mut sums = [0.0; 8];
        for i in 0..8 {
            sums[i] = self.sum(v[i]);
        }
        sums
    }

    /// Prefetches the cache line of an address, which need not be valid.
    #[inline(always)]
    fn prefetch(self, p: *const f32, purpose: Purpose) {
        let _ = (p, purpose);
    }

    /// Reads `LANES` values.
    ///
    /// # Safety
    /// `p` must be valid for reading `LANES` values.
    unsafe fn load(self, p: *const f32) -> Self::V;
    /// Reads the first `count <= LANES` values; the other lanes are 0.
    ///
    /// # Safety
    /// `p` must be valid for reading `count` values.
    unsafe fn load_first(self, p: *const f32, count: usize) -> Self::V;
    /// Reads `count <= LANES` pairs of values: the first vector holds the first value of each pair, the second vector the second.
    /// The order of the pairs in the lanes depends on the instruction set, see [`Simd::to_pair_order`]; unused lanes are 0.
    ///
    /// # Safety
    /// `p` must be valid for reading `2 count` values.
    unsafe fn load_pairs(self, p: *const f32, count: usize) -> [Self::V; 2];
    /// Moves the lanes from the order of memory to the order of [`Simd::load_pairs`].
    #[inline(always)]
    fn to_pair_order(self, v: Self::V) -> Self::V {
        v
    }
    /// Moves the lanes from the order of [`Simd::load_pairs`] to the order of memory.
    #[inline(always)]
    fn to_memory_order(self, v: Self::V) -> Self::V {
        v
    }
    /// Writes `count <= LANES` pairs, the reverse of [`Simd::load_pairs`].
    ///
    /// # Safety
    /// `p` must be valid for writing `2 count` values.
    unsafe fn store_pairs(self, p: *mut f32, v: [Self::V; 2], count: usize);
    /// Writes `LANES` values.
    ///
    /// # Safety
    /// `p` must be valid for writing `LANES` values.
    unsafe fn store(self, p: *mut f32, v: Self::V);
    /// Writes the first `count <= LANES` lanes.
    ///
    /// # Safety
    /// `p` must be valid for writing `count` values.
    unsafe fn store_first(self, p: *mut f32, v: Self::V, count: usize);

    /// Reads as many consecutive values as `mask` has bits and spreads them over the lanes whose bits are set, in
    /// order; the other lanes are 0.
    ///
    /// # Safety
    /// `p` must be valid for reading `mask.count_ones()` values, and no bit at or above `LANES` may be set.
    #[inline(always)]
    unsafe fn load_spread(self, p: *const f32, mask: u32) -> Self::V {
        let mut lanes = [0.0; 16];
        let (mut rest, mut next) = (mask, p);
        while rest != 0 {
            // SAFETY: one step for each bit of the mask, for which the caller vouches.
            unsafe {
                lanes[rest.trailing_zeros() as usize & 15] = *next;
                next = next.add(1);
            }
            rest &= rest - 1;
        }
        // SAFETY: `lanes` holds 16 values, and no vector is longer.
        unsafe { self.load(lanes.as_ptr()) }
    }

    /// Writes the lanes whose bits are set in `mask` one after the other, leaving out the rest.
    ///
    /// # Safety
    /// `p` must be valid for writing `mask.count_ones()` values, and no bit at or above `LANES` may be set.
    #[inline(always)]
    unsafe fn store_gathered(self, p: *mut f32, v: Self::V, mask: u32) {
        let mut lanes = [0.0; 16];
        // SAFETY: `lanes` holds 16 values, and no vector is longer.
        unsafe { self.store(lanes.as_mut_ptr(), v) };
        let (mut rest, mut next) = (mask, p);
        while rest != 0 {
            // SAFETY: one step for each bit of the mask, for which the caller vouches.
            unsafe {
                *next = lanes[rest.trailing_zeros() as usize & 15];
                next = next.add(1);
            }
            rest &= rest - 1;
        }
    }

    /// Reads every second of the first `2 count - 1` values into the first `count <= LANES` lanes, `count` at least 1;
    /// the other lanes are unspecified.
    ///
    /// # Safety
    /// `p` must be valid for reading `2 count - 1` values.
    #[inline(always)]
    unsafe fn load_every_second(self, p: *const f32, count: usize) -> Self::V {
        let mut lanes = [0.0; 16];
        for (i, lane) in lanes.iter_mut().enumerate().take(count.min(Self::LANES)) {
            // SAFETY: the last is value `2 count - 2`, for which the caller vouches.
            *lane = unsafe { *p.add(2 * i) };
        }
        // SAFETY: `lanes` holds 16 values, and no vector is longer.
        unsafe { self.load(lanes.as_ptr()) }
    }

    /// Writes the first `count <= LANES` lanes to every second of the first `2 count - 1` places.
    ///
    /// # Safety
    /// `p` must be valid for writing `2 count - 1` values.
    #[inline(always)]
    unsafe fn store_every_second(self, p: *mut f32, v: Self::V, count: usize) {
        let mut lanes = [0.0; 16];
        // SAFETY: `lanes` holds 16 values, and no vector is longer.
        unsafe { self.store(lanes.as_mut_ptr(), v) };
        for (i, lane) in lanes.into_iter().enumerate().take(count.min(Self::LANES)) {
            // SAFETY: the last is place `2 count - 2`, for which the caller vouches.
            unsafe { *p.add(2 * i) = lane };
        }
    }
}
