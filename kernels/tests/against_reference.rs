//! Each kernel on each instruction set of this machine, at many sizes, against the naive loops.

#[path = "against_reference/convolutions.rs"]
mod convolutions;
#[path = "against_reference/elementwise.rs"]
mod elementwise;
#[path = "against_reference/fused.rs"]
mod fused;
#[path = "against_reference/nan.rs"]
mod nan;
#[path = "against_reference/products.rs"]
mod products;

use steersman_kernels::Isa;

/// Collects what differs; [`Failures::report`] prints the first three and panics if there are any.
#[derive(Default)]
struct Failures(Vec<String>);

impl Failures {
    /// Compares a result with what it should be; the tolerance is relative to the largest expected value.
    fn compare(&mut self, what: &str, actual: &[f32], expected: &[f32], tolerance: f32) {
        assert_eq!(actual.len(), expected.len(), "{what}: length");
        let size = expected.iter().fold(1.0f32, |size, e| size.max(e.abs()));
        let good = |(a, e): (&f32, &f32)| a == e || (a - e).abs() <= tolerance * size;
        let bad: Vec<usize> = (0..actual.len()).filter(|&i| !good((&actual[i], &expected[i]))).collect();
        if let Some(&i) = bad.first() {
            let (a, e) = (actual[i], expected[i]);
            self.0.push(format!("{what}: {} of {} differ; [{i}] is {a}, not {e}", bad.len(), actual.len()));
        }
    }

    fn report(self) {
        for failure in self.0.iter().take(3) {
            eprintln!("{failure}");
        }
        assert!(self.0.is_empty(), "{} comparisons failed; the first three are above", self.0.len());
    }
}

/// The instruction sets to test; those that this machine lacks are named.
fn isas() -> Vec<Isa> {
    let available = Isa::available();
    for name in ["portable", "neon", "avx2", "avx512"] {
        if !available.iter().any(|isa| isa.name() == name) {
            eprintln!("not tested, this machine does not have it: {name}");
        }
    }
    available
}

/// `len` numbers in [-1, 1) that depend on `seed` alone (a linear congruential generator).
fn numbers(seed: u64, len: usize) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) + 1;
    let mut next = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1 << 23) as f32 - 1.0
    };
    (0..len).map(|_| next()).collect()
}

/// What outputs hold before a kernel overwrites them.
fn nans(len: usize) -> Vec<f32> {
    vec![f32::NAN; len]
}
