//! Models from and for other programs: [`keras`] reads old models, with [`presets`] and [`fit`] for the preprocessing that their
//! files do not hold; [`onnx`], [`tflite`] and [`source`] write ours as ONNX files, as TensorFlow Lite files and as source code that
//! needs nothing else.
//!
//! Every export begins with the network as a chain of operations without training.

pub(crate) mod chain;
pub mod fit;
#[cfg(feature = "keras")]
pub mod keras;
pub mod onnx;
pub(crate) mod picture_graph;
pub mod presets;
pub mod source;
pub mod tflite;
