//! The matrix product of the crate `matrixmultiply`, behind a safe function.
//!
//! It serves the textbook convolution ([`ConvAlgorithm::Im2col`](crate::conv::ConvAlgorithm)). Three things differ from
//! [`gemm`](crate::gemm):
//! - `matrixmultiply` detects the processor itself, so the [`Isa`](crate::Isa) does not lower its instruction set. Two
//!   machines may differ in rounding even when both run with `STEERSMAN_ISA=portable`.
//! - It allocates a packing buffer in every call.
//! - It adds up an element of `C` in an order that depends on the sizes alone. The feature that would use several threads
//!   is off. So the same call on the same machine gives the same bits.

use crate::matrix::{Matrix, MatrixMut, check_product};

/// `C = A B + beta C`. With `beta = 0`, the old values of `C` do not matter.
///
/// # Panics
/// If the sizes do not match, a matrix reaches beyond its slice, or two elements of `C` share a place.
pub fn sgemm(a: Matrix, b: Matrix, beta: f32, c: MatrixMut) {
    check_product("sgemm", &a, &b, &c);
    let stride = |stride: usize| isize::try_from(stride).expect("sgemm: a stride is larger than any slice");
    // SAFETY: `check_product` has asserted that the sizes agree, that every element the strides reach lies in its slice, and
    // that the elements of C are disjoint. C is a mutable slice, so it overlaps neither A nor B. With beta 0, C is only written.
    unsafe {
        matrixmultiply::sgemm(
            a.rows,
            a.columns,
            b.columns,
            1.0,
            a.values.as_ptr(),
            stride(a.strides.0),
            stride(a.strides.1),
            b.values.as_ptr(),
            stride(b.strides.0),
            stride(b.strides.1),
            beta,
            c.values.as_mut_ptr(),
            stride(c.strides.0),
            stride(c.strides.1),
        );
    }
}
