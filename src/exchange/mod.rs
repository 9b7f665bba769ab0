//! Models of other programs, and ours for them: Keras files come in; ONNX files, and source code that needs nothing else, go
//! out.
//!
//! Every export begins with the network as a [`chain`] of operations without training; [`onnx`] and [`source`] write it down,
//! together with the preprocessing. [`keras`] reads; [`presets`] and [`fit`] find the preprocessing that such files lack.

pub(crate) mod chain;
pub mod fit;
pub mod keras;
pub mod onnx;
pub mod presets;
pub mod source;
