//! Which instruction set the machine has, found once at run time.

use std::sync::OnceLock;

/// The instruction sets that kernels are compiled for, from the narrowest to the widest.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub(crate) enum Level {
    /// Plain Rust with the instructions every processor of the target architecture has.
    Portable,
    /// aarch64 with NEON: 4 lanes and fused multiply-add.
    #[cfg_attr(not(target_arch = "aarch64"), expect(dead_code, reason = "only found on aarch64"))]
    Neon,
    /// x86-64 with AVX2 and FMA: 8 lanes, 16 registers.
    #[cfg_attr(not(target_arch = "x86_64"), expect(dead_code, reason = "only found on x86-64"))]
    Avx2,
    /// x86-64 with AVX-512 F, BW, DQ and VL: 16 lanes, 32 registers.
    #[cfg_attr(not(target_arch = "x86_64"), expect(dead_code, reason = "only found on x86-64"))]
    Avx512,
}

/// A token that proves that this processor has an instruction set.
///
/// The only values are [`Isa::PORTABLE`] and those that detection returned, so calling code compiled for the
/// instruction set of an `Isa` is sound.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub struct Isa(Level);

static BEST: OnceLock<Isa> = OnceLock::new();

impl Isa {
    /// What every processor can run.
    pub const PORTABLE: Isa = Isa(Level::Portable);

    /// The widest instruction set of this processor, detected once.
    ///
    /// The environment variable `STEERSMAN_ISA` (`portable`, `neon`, `avx2` or `avx512`) lowers it, for tests; a name
    /// that this processor does not have, or that is unknown, is ignored.
    pub fn best() -> Isa {
        *BEST.get_or_init(Isa::wanted)
    }

    /// What [`best`](Isa::best) answers unless it is lowered.
    pub fn wanted() -> Isa {
        let available = Isa::available();
        let wanted = std::env::var("STEERSMAN_ISA").unwrap_or_default();
        let named = available.iter().find(|isa| isa.name() == wanted);
        *named.or(available.last()).unwrap_or(&Isa::PORTABLE)
    }

    /// Lowers the answer of [`best`](Isa::best) to this one, for processes that compute together; returns that answer, which is another
    /// if `best` has answered before.
    pub fn lower_best(self) -> Isa {
        *BEST.get_or_init(|| self.min(Isa::wanted()))
    }

    /// Every instruction set this processor can run, from [`Isa::PORTABLE`] to the widest.
    pub fn available() -> Vec<Isa> {
        #[cfg_attr(
            not(any(target_arch = "aarch64", target_arch = "x86_64")),
            expect(unused_mut, reason = "other architectures have the portable level alone")
        )]
        let mut found = vec![Isa::PORTABLE];
        #[cfg(target_arch = "aarch64")]
        if std::arch::is_aarch64_feature_detected!("neon") {
            found.push(Isa(Level::Neon));
        }
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            found.push(Isa(Level::Avx2));
            if is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512bw")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512vl")
            {
                found.push(Isa(Level::Avx512));
            }
        }
        found
    }

    /// The name that `STEERSMAN_ISA` understands.
    pub fn name(self) -> &'static str {
        match self.0 {
            Level::Portable => "portable",
            Level::Neon => "neon",
            Level::Avx2 => "avx2",
            Level::Avx512 => "avx512",
        }
    }

    /// Values of `f32` in a vector.
    pub(crate) fn lanes(self) -> usize {
        match self.0 {
            Level::Portable | Level::Neon => 4,
            Level::Avx2 => 8,
            Level::Avx512 => 16,
        }
    }

    /// Whether there are 32 vector registers and not 16; as [`MANY_REGISTERS`](crate::simd::Simd::MANY_REGISTERS).
    pub(crate) fn has_many_registers(self) -> bool {
        matches!(self.0, Level::Neon | Level::Avx512)
    }

    pub(crate) fn level(self) -> Level {
        self.0
    }
}

/// Writes a function that compiles its body once for each instruction set and picks one by an [`Isa`].
///
/// `fn name<S>(simd: S, x: T)` becomes `fn name(isa: Isa, x: T)`; in the body `S` is a [`crate::simd::Simd`] type and
/// `simd` its token. A body that ignores the token is a plain loop which the compiler vectorises for each set.
macro_rules! per_isa {
    ($(#[$meta:meta])* $vis:vis fn $name:ident<$s:ident>($simd:ident : $s2:ident $(, $arg:ident : $ty:ty)* $(,)?)
        $(-> $ret:ty)? $body:block) => {
        $(#[$meta])*
        $vis fn $name(isa: $crate::isa::Isa $(, $arg: $ty)*) $(-> $ret)? {
            #[inline(always)]
            fn body<$s: $crate::simd::Simd>($simd: $s $(, $arg: $ty)*) $(-> $ret)? $body

            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx2,fma")]
            fn avx512($($arg: $ty),*) $(-> $ret)? {
                body($crate::simd::x86::Avx512::new() $(, $arg)*)
            }

            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2,fma")]
            fn avx2($($arg: $ty),*) $(-> $ret)? {
                body($crate::simd::x86::Avx2::new() $(, $arg)*)
            }

            #[cfg(target_arch = "aarch64")]
            #[target_feature(enable = "neon")]
            fn neon($($arg: $ty),*) $(-> $ret)? {
                body($crate::simd::neon::Neon::new() $(, $arg)*)
            }

            match isa.level() {
                #[cfg(target_arch = "x86_64")]
                // SAFETY: an `Isa` of this level exists only after detection found its features.
                $crate::isa::Level::Avx512 => unsafe { avx512($($arg),*) },
                #[cfg(target_arch = "x86_64")]
                // SAFETY: an `Isa` of this level exists only after detection found its features.
                $crate::isa::Level::Avx2 => unsafe { avx2($($arg),*) },
                #[cfg(target_arch = "aarch64")]
                #[allow(unused_unsafe, reason = "targets that always have NEON may call this without `unsafe`")]
                // SAFETY: an `Isa` of this level exists only after detection found its features.
                $crate::isa::Level::Neon => unsafe { neon($($arg),*) },
                _ => body($crate::simd::portable::Portable $(, $arg)*),
            }
        }
    };
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_is_available_and_portable_always_is() {
        let available = Isa::available();
        assert_eq!(available[0], Isa::PORTABLE);
        assert!(available.contains(&Isa::best()));
        assert!(available.windows(2).all(|pair| pair[0] < pair[1]));
    }
}
