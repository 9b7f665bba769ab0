//! Matrix products.

use super::{Failures, isas, nans, numbers};
use steersman_kernels::gemm::{gemm, gemm_scratch_len};
use steersman_kernels::reference;

/// m, k, n: empty, one, the borders of tiles (8, 48) and of blocks (96, 256, 480), and dense layers.
const SIZES: &[(usize, usize, usize)] = &[
    (0, 3, 4),
    (3, 0, 4),
    (3, 4, 0),
    (1, 1, 1),
    (1, 300, 10),
    (7, 5, 47),
    (8, 16, 48),
    (9, 17, 49),
    (4, 31, 8),
    (3, 255, 15),
    (97, 257, 33),
    (95, 256, 481),
    (8, 1024, 100),
    (32, 513, 50),
    (33, 40, 50),
    (128, 1024, 100),
    (100, 128, 50),
];

#[test]
fn products_agree_with_the_loops() {
    let mut failures = Failures::default();
    for &(m, k, n) in SIZES {
        for layout in 0..8 {
            // Each matrix in rows or in columns.
            let strides = |bit: u32, rows: usize, columns: usize| match layout >> bit & 1 {
                0 => (columns.max(1), 1),
                _ => (1, rows.max(1)),
            };
            let (a_strides, b_strides, c_strides) = (strides(0, m, k), strides(1, k, n), strides(2, m, n));
            let (a, b, c) = (numbers(1, m * k), numbers(2, k * n), numbers(3, m * n));
            for (alpha, beta) in [(1.0, 0.0), (1.0, 1.0), (-0.5, 0.3)] {
                let start = if beta == 0.0 { nans(m * n) } else { c.clone() };
                let mut expected = start.clone();
                reference::gemm((m, k, n), alpha, (&a, a_strides), (&b, b_strides), beta, (&mut expected, c_strides));
                for isa in isas() {
                    let what = format!("gemm {} {m}x{k}x{n} layout {layout} beta {beta}", isa.name());
                    let mut actual = start.clone();
                    let scratch = &mut nans(gemm_scratch_len(m, k, n));
                    gemm(isa, m, k, n, alpha, &a, a_strides, &b, b_strides, beta, &mut actual, c_strides, scratch);
                    failures.compare(&what, &actual, &expected, 1e-5);
                }
            }
        }
    }
    failures.report();
}

#[test]
fn gaps_between_rows_and_columns_are_left_alone() {
    for isa in isas() {
        let (m, k, n) = (5, 6, 7);
        let (a, b) = (numbers(1, 200), numbers(2, 200));
        let mut expected = numbers(3, 300);
        let mut actual = expected.clone();
        reference::gemm((m, k, n), 1.0, (&a, (13, 2)), (&b, (3, 20)), 1.0, (&mut expected, (31, 3)));
        let scratch = &mut nans(gemm_scratch_len(m, k, n));
        gemm(isa, m, k, n, 1.0, &a, (13, 2), &b, (3, 20), 1.0, &mut actual, (31, 3), scratch);
        let mut failures = Failures::default();
        failures.compare(&format!("gemm with gaps {}", isa.name()), &actual, &expected, 1e-6);
        failures.report();
    }
}
