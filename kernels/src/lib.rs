//! The compute kernels of steersman: every `unsafe` line of the product, behind safe functions on slices.
//!
//! # Layouts
//! All tensors are `f32`, row-major and planar: a batch is `[n][c][h][w]`, a convolution weight `[oc][c][kh][kw]`.
//! A slice must have exactly the length its shape asks for. A wrong length panics: it is a bug of the caller, not an
//! input of the user.
//!
//! # Dispatch
//! Every kernel takes an [`Isa`], a token that only detection gives out. The body of a kernel is written once and
//! compiled once for each instruction set. All kernels are single-threaded. They allocate nothing and work in the buffer `scratch`
//! of the caller. The result depends only on the arguments and the `Isa`: the same call gives the same bits. Two instruction
//! sets may differ in rounding. The one exception is [`sgemm`], which is another crate's and says itself how it differs.
//!
//! # Where things are
//! [`isa`] detection · [`conv`] convolution and its gradients, with the menu of its algorithms · [`im2col`] an image as a
//! matrix of patches, and back · [`gemm`] and [`sgemm`] matrix products · [`pool`] max and average pooling · [`blur`] binomial blur · [`mod@dropout`] · [`activation`] ·
//! [`norm`] batch normalisation · [`norm_rectify`] batch normalisation, rectifier and pooling in one pass · [`update`]
//! optimiser steps · [`pixels`] bytes to floats · [`peak`] the multiply-add peak of a core · [`mod@reference`] the naive
//! loops that define each kernel.
//!
//! # Words
//! - **Tap**: one element of a convolution's kernel for one input channel.
//! - **Tile**: the outputs whose sums stay in registers at a time.
//! - **Panel**: the packed weights, or rows, of one tile.
//! - **Packed weights**: a copy of the weights in the order in which a kernel reads them.
//! - **Phase**: the rows, or columns, of an image whose position leaves the same remainder when divided by the stride.
//! - **Point**: a value of Winograd minimal filtering between its two transforms.
//! - **Strip**: the tiles whose points fit into the second-level cache.
//! - **Plane**: one channel of one image.
#![deny(unsafe_op_in_unsafe_fn)]
// The tests and the kernels are written in terms of rows, columns and taps: indices are the clearest notation.
#![allow(clippy::needless_range_loop, clippy::too_many_arguments)]

#[macro_use]
pub mod isa;
pub mod activation;
mod backend;
pub mod blur;
pub mod conv;
mod conv_algorithm;
mod conv_shape;
pub mod dropout;
pub mod gemm;
pub mod im2col;
pub mod matrix;
pub mod norm;
pub mod norm_rectify;
pub mod peak;
pub mod pixels;
pub mod pool;
pub mod reference;
pub mod sgemm;
mod simd;
pub mod update;

pub use backend::Backend;
pub use isa::Isa;
