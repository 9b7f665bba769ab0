//! Products of few rows with a transposed matrix: dot products of contiguous rows.

use crate::matrix::{Matrix, MatrixMut};
use crate::simd::Simd;

/// Length of the rows that a tile reads before the next tile: 8 such rows take half of a 32 KiB cache.
const BLOCK_K: usize = 512;

per_isa! {
    /// `C = alpha A B + beta C`, where rows of `A` and columns of `B` are contiguous and there is at least one. The caller has checked
    /// the lengths; an error here can only panic.
    pub(super) fn run<S>(simd: S, alpha: f32, a: Matrix, b: Matrix, beta: f32, c: &mut MatrixMut) {
        // A tile has as many rows as the product, up to 8 or 4; the fewer rows, the more columns, so that enough sums are under way.
        match (a.rows, S::MANY_REGISTERS) {
            (1, _) => run_tiles::<S, 1, 8>(simd, alpha, a, b, beta, c),
            (2, _) => run_tiles::<S, 2, 4>(simd, alpha, a, b, beta, c),
            (3..=4, _) | (_, false) => run_tiles::<S, 4, 3>(simd, alpha, a, b, beta, c),
            _ => run_tiles::<S, 8, 3>(simd, alpha, a, b, beta, c),
        }
    }
}

/// The product in tiles of `MR` rows and `NC` columns of `C`.
#[inline(always)]
fn run_tiles<S: Simd, const MR: usize, const NC: usize>(
    simd: S,
    alpha: f32,
    a: Matrix,
    b: Matrix,
    beta: f32,
    c: &mut MatrixMut,
) {
    let (m, k, n) = (a.rows, a.columns, b.columns);
    let (a, a_stride, b, b_stride) = (a.values, a.strides.0, b.values, b.strides.1);
    let (c, c_strides) = (&mut *c.values, c.strides);
    for first_k in (0..k).step_by(BLOCK_K) {
        let depth = BLOCK_K.min(k - first_k);
        let beta = if first_k == 0 { beta } else { 1.0 };
        for i in (0..m).step_by(MR) {
            for j in (0..n).step_by(NC) {
                // A tile at the edge repeats the last row or column and drops those results.
                let mut rows = [a; MR];
                for (r, row) in rows.iter_mut().enumerate() {
                    *row = &a[(i + r).min(m - 1) * a_stride + first_k..][..depth];
                }
                let mut columns = [b; NC];
                for (t, column) in columns.iter_mut().enumerate() {
                    *column = &b[(j + t).min(n - 1) * b_stride + first_k..][..depth];
                }
                let sums = tile(simd, depth, rows, columns);
                for (r, sums) in sums.iter().enumerate().take(m - i) {
                    for (t, &sum) in sums.iter().enumerate().take(n - j) {
                        let c = &mut c[(i + r) * c_strides.0 + (j + t) * c_strides.1];
                        let value = alpha * simd.sum(sum);
                        *c = if beta == 0.0 { value } else { beta * *c + value };
                    }
                }
            }
        }
    }
}

/// The products of `MR` rows and `NC` columns of `depth` elements, still spread over the lanes.
#[inline(always)]
fn tile<S: Simd, const MR: usize, const NC: usize>(
    simd: S,
    depth: usize,
    rows: [&[f32]; MR],
    columns: [&[f32]; NC],
) -> [[S::V; NC]; MR] {
    assert!(rows.iter().chain(&columns).all(|line| line.len() == depth), "gemm: a row is too short");
    let mut sums = [[simd.splat(0.0); NC]; MR];
    for at in (0..depth).step_by(S::LANES) {
        let count = S::LANES.min(depth - at);
        // SAFETY: `at + count <= depth`, the length of every row and column; whole vectors are read if there is one.
        unsafe {
            let load = |line: &[f32]| {
                let from = line.as_ptr().add(at);
                if count == S::LANES { simd.load(from) } else { simd.load_first(from, count) }
            };
            let mut of_columns = [simd.splat(0.0); NC];
            for t in 0..NC {
                of_columns[t] = load(columns[t]);
            }
            for r in 0..MR {
                let row = load(rows[r]);
                for t in 0..NC {
                    sums[r][t] = simd.mul_add(row, of_columns[t], sums[r][t]);
                }
            }
        }
    }
    sums
}
