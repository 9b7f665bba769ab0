//! The arithmetic peak of one core, the measure of every other kernel.

use crate::Isa;

use std::hint::black_box;
use std::time::{Duration, Instant};

/// Multiply-adds in flight for each vector register set: more than latency (4–5 cycles) times issue width (2).
const CHAINS: usize = 12;

per_isa! {
    /// Runs `rounds` of `CHAINS` independent vector multiply-adds and returns the floating-point operations done.
    fn run_chains<S>(simd: S, rounds: u64) -> u64 {
        let (factor, term) = (simd.splat(black_box(0.999)), simd.splat(black_box(1e-3)));
        let mut chains = [simd.splat(black_box(1.0)); CHAINS];
        for _ in 0..rounds {
            for chain in &mut chains {
                *chain = simd.mul_add(*chain, factor, term);
            }
        }
        for chain in chains {
            black_box(simd.sum(chain));
        }
        rounds * (CHAINS * S::LANES * 2) as u64
    }
}

/// Measures the `f32` multiply-add peak of the core it runs on, in 10^9 floating-point operations a second.
///
/// A multiply-add counts as 2 operations. `seconds` is how long to measure; the best of many short runs counts, so that
/// an interruption does not. A core that has just woken up needs some 0.1 s to reach its clock rate.
pub fn measure_peak_gflops(isa: Isa, seconds: f64) -> f64 {
    let end = Instant::now() + Duration::from_secs_f64(seconds.clamp(0.0, 3600.0));
    let mut best = 0.0f64;
    loop {
        let start = Instant::now();
        let operations = run_chains(isa, 200_000);
        best = best.max(operations as f64 / start.elapsed().as_secs_f64() / 1e9);
        if Instant::now() >= end {
            return best;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_peak_is_a_number_a_processor_can_have() {
        for isa in Isa::available() {
            let peak = measure_peak_gflops(isa, 0.0);
            assert!(peak > 0.01 && peak < 10_000.0, "{}: {peak} GFLOP/s", isa.name());
        }
    }
}
