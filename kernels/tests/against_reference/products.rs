//! Matrix products.

use super::{Failures, isas, nans, numbers};
use steersman_kernels::gemm::{gemm, gemm_scratch_len};
use steersman_kernels::matrix::{Matrix, MatrixMut};
use steersman_kernels::sgemm::sgemm;
use steersman_kernels::{Isa, reference};

/// m, k, n: empty, one, the borders of tiles (8, 48) and of blocks (96, 256, 480), and dense layers.
const SIZES: &[(usize, usize, usize)] = &[
    (0, 3, 4),
    (3, 0, 4),
    (3, 4, 0),
    (1, 1, 1),
    (1, 300, 10),
    (1, 530, 23),
    (2, 33, 5),
    (5, 100, 4),
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
            let (a, b, c) = (numbers(1, m * k), numbers(2, k * n), numbers(3, m * n));
            let a = Matrix { values: &a, rows: m, columns: k, strides: strides(0, m, k) };
            let b = Matrix { values: &b, rows: k, columns: n, strides: strides(1, k, n) };
            for (alpha, beta) in [(1.0, 0.0), (1.0, 1.0), (-0.5, 0.3)] {
                let start = if beta == 0.0 { nans(m * n) } else { c.clone() };
                let (mut expected, mut actual) = (start.clone(), start.clone());
                fn matrix(values: &mut [f32], rows: usize, columns: usize, strides: (usize, usize)) -> MatrixMut<'_> {
                    MatrixMut { values, rows, columns, strides }
                }
                reference::gemm(alpha, a, b, beta, matrix(&mut expected, m, n, strides(2, m, n)));
                for isa in isas() {
                    let what = format!("gemm {} {m}x{k}x{n} layout {layout} beta {beta}", isa.name());
                    actual.copy_from_slice(&start);
                    let scratch = &mut nans(gemm_scratch_len(m, k, n));
                    gemm(isa, alpha, a, b, beta, matrix(&mut actual, m, n, strides(2, m, n)), scratch);
                    failures.compare(&what, &actual, &expected, 1e-5);
                }
                if alpha == 1.0 {
                    actual.copy_from_slice(&start);
                    sgemm(a, b, beta, matrix(&mut actual, m, n, strides(2, m, n)));
                    let what = format!("sgemm {m}x{k}x{n} layout {layout} beta {beta}");
                    failures.compare(&what, &actual, &expected, 1e-5);
                }
            }
        }
    }
    failures.report();
}

/// 5 x 6 and 6 x 7, with gaps between rows and between columns.
fn with_gaps<'a>(a: &'a [f32], b: &'a [f32]) -> [Matrix<'a>; 2] {
    let a = Matrix { values: a, rows: 5, columns: 6, strides: (13, 2) };
    [a, Matrix { values: b, rows: 6, columns: 7, strides: (3, 20) }]
}

#[test]
fn gaps_between_rows_and_columns_are_left_alone() {
    let (a, b, mut expected) = (numbers(1, 200), numbers(2, 200), numbers(3, 300));
    let [a, b] = with_gaps(&a, &b);
    let start = expected.clone();
    reference::gemm(1.0, a, b, 1.0, MatrixMut { values: &mut expected, rows: 5, columns: 7, strides: (31, 3) });
    let mut failures = Failures::default();
    for isa in isas() {
        let mut actual = start.clone();
        let scratch = &mut nans(gemm_scratch_len(5, 6, 7));
        gemm(isa, 1.0, a, b, 1.0, MatrixMut { values: &mut actual, rows: 5, columns: 7, strides: (31, 3) }, scratch);
        failures.compare(&format!("gemm with gaps {}", isa.name()), &actual, &expected, 1e-6);
    }
    let mut actual = start;
    sgemm(a, b, 1.0, MatrixMut { values: &mut actual, rows: 5, columns: 7, strides: (31, 3) });
    failures.compare("sgemm with gaps", &actual, &expected, 1e-6);
    failures.report();
}

/// The message of the panic of `work`.
fn panic_of(work: impl FnOnce() + std::panic::UnwindSafe) -> String {
    let panic = std::panic::catch_unwind(work).expect_err("no panic");
    panic.downcast_ref::<String>().cloned().or(panic.downcast_ref::<&str>().map(|s| s.to_string())).unwrap_or_default()
}

#[test]
fn products_refuse_matrices_that_do_not_fit() {
    let values = [1.0; 12];
    let matrix = |rows, columns, strides| Matrix { values: &values, rows, columns, strides };
    for (a, b, c_len, c_strides, expected) in [
        (matrix(3, 4, (4, 1)), matrix(3, 4, (4, 1)), 12, (4, 1), "A is 3 x 4, B 3 x 4"),
        (matrix(3, 5, (5, 1)), matrix(5, 2, (2, 1)), 6, (2, 1), "A has only 12 elements"),
        (matrix(3, 2, (2, 1)), matrix(2, 4, (9, 1)), 12, (4, 1), "B has only 12 elements"),
        (matrix(3, 2, (2, 1)), matrix(2, 4, (4, 1)), 11, (4, 1), "C has only 11 elements"),
        (matrix(3, 2, (2, 1)), matrix(2, 4, (4, 1)), 12, (1, 1), "elements of C share a place"),
    ] {
        let (rows, columns) = (3, b.columns);
        let message = panic_of(move || {
            sgemm(a, b, 0.0, MatrixMut { values: &mut vec![0.0; c_len], rows, columns, strides: c_strides });
        });
        assert!(message.contains(expected), "sgemm: {message}");
        let message = panic_of(move || {
            let c = MatrixMut { values: &mut vec![0.0; c_len], rows, columns, strides: c_strides };
            gemm(Isa::best(), 1.0, a, b, 0.0, c, &mut vec![0.0; gemm_scratch_len(3, a.columns, columns)]);
        });
        assert!(message.contains(expected), "gemm: {message}");
    }
}
