//! Matrix product.
//!
//! | condition | algorithm |
//! |---|---|
//! | at most 32 rows; rows of `A` and columns of `B` contiguous | dot products (`dots`): nothing is packed |
//! | at most 32 rows; rows of `B` contiguous | blocks, with `B` read where it is |
//! | else | blocks that fit the caches, packed into panels (Goto and van de Geijn 2008) |
//!
//! Packing `B` costs about as much as multiplying it by 16 rows, so it does not pay for few rows.

mod dots;

use crate::matrix::{Matrix, MatrixMut, check_product};
use crate::simd::{ALIGNMENT, Simd, align};

/// Depth of a block: a panel of `A` and one of `B` of this depth stay in the first-level cache.
const BLOCK_K: usize = 256;
/// Rows of a block of `A`, which stays in the second-level cache (96 KiB).
const BLOCK_M: usize = 96;
/// Columns of a block of `B` (480 KiB).
const BLOCK_N: usize = 480;
/// The largest tile of any instruction set.
const MAX_ROWS: usize = 8;
const MAX_COLUMNS: usize = 48;

/// `B` is not packed for this number of rows of `A` or fewer.
const FEW_ROWS: usize = 32;

/// Length of the scratch of [`gemm`] for a product of `m x k` and `k x n`, at most 640 KiB.
pub fn gemm_scratch_len(m: usize, k: usize, n: usize) -> usize {
    // A product may be computed as that of the transposes, so either size may take either part.
    let depth = k.min(BLOCK_K);
    let a = |m: usize| (m.min(BLOCK_M) + MAX_ROWS) * depth;
    let b = |n: usize| n.min(BLOCK_N).next_multiple_of(MAX_COLUMNS) * depth;
    (a(m) + b(n)).max(a(n) + b(m)) + ALIGNMENT
}

/// `C = alpha A B + beta C`. With `beta = 0`, the old values of `C` do not matter.
///
/// The order in which an element of `C` is summed depends on the sizes, the strides and the instruction set alone.
///
/// # Panics
/// If the sizes do not match, a matrix reaches beyond its slice, two elements of `C` share a place, or `scratch` is shorter
/// than [`gemm_scratch_len`].
pub fn gemm(isa: crate::Isa, alpha: f32, a: Matrix, b: Matrix, beta: f32, mut c: MatrixMut, scratch: &mut [f32]) {
    check_product("gemm", &a, &b, &c);
    let (m, k, n) = (a.rows, a.columns, b.columns);
    if m == 0 || n == 0 {
        return;
    }
    assert!(scratch.len() >= gemm_scratch_len(m, k, n), "gemm: scratch is too short");
    if m <= FEW_ROWS && k > 0 && (a.strides.1 == 1 || k == 1) && (b.strides.0 == 1 || k == 1) {
        return dots::run(isa, alpha, a, b, beta, &mut c);
    }
    let (row, column) = c.strides;
    if column == 1 || row != 1 {
        return blocks(isa, alpha, a, b, beta, &mut c, scratch);
    }
    // The rows of C' are contiguous: C' = B' A'.
    let mut turned = MatrixMut { values: c.values, rows: c.columns, columns: c.rows, strides: (column, row) };
    blocks(isa, alpha, b.transposed(), a.transposed(), beta, &mut turned, scratch);
}

per_isa! {
    fn blocks<S>(simd: S, alpha: f32, a: Matrix, b: Matrix, beta: f32, c: &mut MatrixMut, scratch: &mut [f32]) {
        if S::MANY_REGISTERS {
            blocks_of::<S, 8, 3>(simd, alpha, a, b, beta, c, scratch);
        } else {
            blocks_of::<S, 6, 2>(simd, alpha, a, b, beta, c, scratch);
        }
    }
}

#[inline(always)]
fn blocks_of<S: Simd, const MR: usize, const NV: usize>(
    simd: S,
    alpha: f32,
    a: Matrix,
    b: Matrix,
    beta: f32,
    c: &mut MatrixMut,
    scratch: &mut [f32],
) {
    let (m, k, n) = (a.rows, a.columns, b.columns);
    let tile_columns = S::LANES * NV;
    let packs = m > FEW_ROWS || b.strides.1 != 1;
    let (packed_b, packed_a) =
        align(scratch).split_at_mut(n.min(BLOCK_N).next_multiple_of(tile_columns) * k.min(BLOCK_K));
    for first_n in (0..n).step_by(BLOCK_N) {
        let block_n = BLOCK_N.min(n - first_n);
        // A product over nothing still scales C: one empty block.
        for first_k in (0..k.max(1)).step_by(BLOCK_K) {
            let block_k = BLOCK_K.min(k - first_k);
            let beta = if first_k == 0 { beta } else { 1.0 };
            let b_origin = first_k * b.strides.0 + first_n * b.strides.1;
            if packs {
                let block = Block { values: b.values, origin: b_origin, step: b.strides.0, stride: b.strides.1 };
                pack(block, block_k, block_n, tile_columns, packed_b);
            }
            for first_m in (0..m).step_by(BLOCK_M) {
                let block_m = BLOCK_M.min(m - first_m);
                let origin = first_m * a.strides.0 + first_k * a.strides.1;
                let block = Block { values: a.values, origin, step: a.strides.1, stride: a.strides.0 };
                pack(block, block_k, block_m, MR, packed_a);
                for j in (0..block_n).step_by(tile_columns) {
                    for i in (0..block_m).step_by(MR) {
                        let panel_a = &packed_a[i * block_k..][..MR * block_k];
                        let (rows, columns) = (MR.min(block_m - i), tile_columns.min(block_n - j));
                        // An empty block has no panel, and an unpacked one ends with its last element.
                        let tile = if block_k == 0 {
                            [[simd.splat(0.0); NV]; MR]
                        } else if packs {
                            let panel_b = &packed_b[j * block_k..][..tile_columns * block_k];
                            tile::<S, MR, NV, false>(simd, panel_a, panel_b, tile_columns, tile_columns)
                        } else {
                            let panel_b = &b.values[b_origin + j..][..(block_k - 1) * b.strides.0 + columns];
                            if columns == tile_columns {
                                tile::<S, MR, NV, false>(simd, panel_a, panel_b, b.strides.0, tile_columns)
                            } else {
                                tile::<S, MR, NV, true>(simd, panel_a, panel_b, b.strides.0, columns)
                            }
                        };
                        let at = (first_m + i) * c.strides.0 + (first_n + j) * c.strides.1;
                        write(simd, &tile, alpha, beta, &mut c.values[at..], c.strides, rows, columns);
                    }
                }
            }
        }
    }
}

/// A block of a matrix that is packed step by step: element `i` of a step is `values[origin + step_number * step + i * stride]`.
#[derive(Clone, Copy)]
struct Block<'a> {
    values: &'a [f32],
    origin: usize,
    step: usize,
    stride: usize,
}

/// Packs `depth` steps of `len` elements into panels of `width` elements a step; missing elements are 0.
#[inline(always)]
fn pack(block: Block, depth: usize, len: usize, width: usize, to: &mut [f32]) {
    let Block { values: from, origin, step: step_stride, stride } = block;
    if depth == 0 {
        return;
    }
    for (panel, to) in to.chunks_exact_mut(width * depth).take(len.div_ceil(width)).enumerate() {
        let first = panel * width;
        let count = width.min(len - first);
        let from = &from[origin + first * stride..];
        if stride == 1 {
            for (step, to) in to.chunks_exact_mut(width).enumerate() {
                to[..count].copy_from_slice(&from[step * step_stride..][..count]);
                to[count..].fill(0.0);
            }
        } else {
            // Step by step, so that writes are contiguous and the `count` reads walk along as many cache lines.
            for (step, to) in to.chunks_exact_mut(width).enumerate() {
                let from = from[step * step_stride..].iter().step_by(stride.max(1));
                for (to, &value) in to[..count].iter_mut().zip(from) {
                    *to = value;
                }
                to[count..].fill(0.0);
            }
        }
    }
}

/// The product of a panel of `A` and the `wide` columns of `B` that begin at `b[0]`, with rows `step` apart.
#[inline(always)]
fn tile<S: Simd, const MR: usize, const NV: usize, const MASKED: bool>(
    simd: S,
    a: &[f32],
    b: &[f32],
    step: usize,
    wide: usize,
) -> [[S::V; NV]; MR] {
    let (a, _) = a.as_chunks::<MR>();
    assert!(a.is_empty() || (a.len() - 1) * step + wide <= b.len(), "gemm: a panel is too short");
    assert!(MASKED || wide == S::LANES * NV, "gemm: a tile is too narrow");
    let mut sums = [[simd.splat(0.0); NV]; MR];
    let mut row = b.as_ptr();
    for a in a {
        let mut columns = [simd.splat(0.0); NV];
        for v in 0..NV {
            // SAFETY: each row has `wide` columns within `b`, as asserted; a tile that is not masked has all of them.
            columns[v] = unsafe {
                let from = row.wrapping_add(v * S::LANES);
                if MASKED {
                    simd.load_first(from, wide.saturating_sub(v * S::LANES).min(S::LANES))
                } else {
                    simd.load(from)
                }
            };
        }
        row = row.wrapping_add(step);
        for r in 0..MR {
            let weight = simd.splat(a[r]);
            for v in 0..NV {
                sums[r][v] = simd.mul_add(columns[v], weight, sums[r][v]);
            }
        }
    }
    sums
}

/// `C = alpha tile + beta C` for the first `rows` and `columns` of a tile that begins at `c[0]`.
#[inline(always)]
fn write<S: Simd, const MR: usize, const NV: usize>(
    simd: S,
    tile: &[[S::V; NV]; MR],
    alpha: f32,
    beta: f32,
    c: &mut [f32],
    (row_stride, column_stride): (usize, usize),
    rows: usize,
    columns: usize,
) {
    let (alpha_v, beta_v, zero) = (simd.splat(alpha), simd.splat(beta), simd.splat(0.0));
    for r in 0..MR {
        if r >= rows {
            break;
        }
        for v in 0..NV {
            let first = v * S::LANES;
            if first >= columns {
                break;
            }
            let count = S::LANES.min(columns - first);
            let scaled = simd.mul_add(tile[r][v], alpha_v, zero);
            if column_stride == 1 {
                let c = &mut c[r * row_stride + first..][..count];
                // SAFETY: `c` has `count` elements.
                unsafe {
                    if beta == 0.0 {
                        simd.store_first(c.as_mut_ptr(), scaled, count);
                    } else {
                        let old = simd.load_first(c.as_ptr(), count);
                        simd.store_first(c.as_mut_ptr(), simd.mul_add(old, beta_v, scaled), count);
                    }
                }
            } else {
                let mut lanes = [0.0; 16];
                // SAFETY: no vector is longer than 16.
                unsafe { simd.store(lanes.as_mut_ptr(), scaled) };
                for (lane, &value) in lanes[..count].iter().enumerate() {
                    let c = &mut c[r * row_stride + (first + lane) * column_stride];
                    *c = if beta == 0.0 { value } else { beta * *c + value };
                }
            }
        }
    }
}
