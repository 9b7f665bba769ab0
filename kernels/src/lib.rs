//! The compute kernels of steersman: every `unsafe` line of the product, behind safe functions on slices.
//!
//! # Layouts
//! All tensors are `f32`, row-major and planar: a batch is `[n][c][h][w]`, a convolution weight `[oc][c][kh][kw]`.
//! A slice must have exactly the length its shape asks for; a wrong length panics, for it is a broken invariant of the
//! caller and not an input of the user.
//!
//! # Dispatch
//! Every kernel takes an [`Isa`], a token that only detection gives out. The body of a kernel is written once and
//! compiled once for each instruction set. All kernels are single-threaded and, but for [`baseline`], allocate nothing; what they need to
//! work in is passed as `scratch`. The result depends on nothing but the arguments and the `Isa`: the same call gives
//! the same bits. Two instruction sets may differ in rounding.
//!
//! # Where things are
//! [`isa`] detection · [`gemm`] matrix product · [`im2col`] image to patch matrix and back · [`conv`] convolution and
//! its gradients · [`pool`] · [`activation`] · [`norm`] batch normalisation · [`update`] optimiser steps ·
//! [`pixels`] bytes to floats · [`peak`] what the core can do at best · [`mod@reference`] the naive loops that define
//! each kernel.
#![deny(unsafe_op_in_unsafe_fn)]
// The tests and the kernels are written in terms of rows, columns and taps: indices are the clearest notation.
#![allow(clippy::needless_range_loop, clippy::too_many_arguments)]

#[macro_use]
pub mod isa;
pub mod activation;
pub mod baseline;
pub mod conv;
pub mod gemm;
pub mod im2col;
pub mod norm;
pub mod norm_rectify;
pub mod peak;
pub mod pixels;
pub mod pool;
pub mod reference;
mod simd;
pub mod update;

pub use isa::Isa;
