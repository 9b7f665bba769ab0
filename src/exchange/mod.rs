//! Models for other programs: ONNX files, and source code that needs nothing else.
//!
//! Every export begins with the network as a [`chain`] of operations without training; [`onnx`] and [`source`] write it down,
//! together with the preprocessing.

pub(crate) mod chain;
pub mod onnx;
pub mod source;
