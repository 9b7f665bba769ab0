//! Matrix product.

use crate::Isa;

/// Elements of scratch that [`gemm`] needs.
pub fn gemm_scratch_len(_m: usize, _k: usize, _n: usize) -> usize {
    0
}

/// `C = alpha A B + beta C`.
pub fn gemm(
    _isa: Isa,
    m: usize,
    k: usize,
    n: usize,
    alpha: f32,
    a: &[f32],
    a_strides: (usize, usize),
    b: &[f32],
    b_strides: (usize, usize),
    beta: f32,
    c: &mut [f32],
    c_strides: (usize, usize),
    _scratch: &mut [f32],
) {
    crate::reference::gemm((m, k, n), alpha, (a, a_strides), (b, b_strides), beta, (c, c_strides));
}
