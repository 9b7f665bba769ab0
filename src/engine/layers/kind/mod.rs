//! The questions that the rest of the program asks a kind of layer.

mod check;
mod export_form;
mod formula;

use std::fmt::Debug;

use steersman_kernels::Backend;

pub use check::check_kind;
pub(super) use export_form::weight_and_bias;
pub use export_form::{ExportForm, Pads};
pub use formula::{Formula, Function};

use super::{Layer, ResizeMethod};
use crate::engine::tensor::Shape;

/// Largest number of filters or units, and largest side of a kernel, window or stride.
const MAX_SIZE: usize = 65_536;

/// Most weights of a layer, and most values of one image's output: 256 MiB.
pub(super) const MAX_NUMBERS: usize = 1 << 26;

/// What a layer is, asked of its options (`Conv2dSpec`, `EluSpec` …), which stand in the file of the layer.
///
/// No question has a default answer: a new kind of layer does not compile before it has answered every one.
/// [`check_kind`](super::check_kind) holds the answers against what the layer computes.
///
/// # To add a question
///
/// Add a method without a body here; the compiler names each layer that has to answer it.
pub trait LayerKind: Debug {
    /// First part of a layer's name, as `conv` of `conv1`: lower-case letters and `_`.
    fn base_name(&self) -> &'static str;

    /// What the layer does, in a few words for tables: `conv 3x3`, `max pool 2x2`, `dropout 0.5`.
    fn describe(&self) -> String;

    /// What sort of layer it is. Diagrams draw a block or a line of text by it.
    fn family(&self) -> Family;

    /// Which positions of the input an output sees in evaluation, for inputs of shape `input`.
    fn receptive_field(&self, input: Shape) -> ReceptiveField;

    /// Refuses sizes that no sensible network has, and first values that are not finite, before anything is computed from them.
    ///
    /// # Errors
    ///
    /// A sentence that names the option.
    fn check(&self, input: Shape) -> Result<(), String>;

    /// The layer for inputs of shape `input`; [`check`](LayerKind::check) has passed.
    ///
    /// # Errors
    ///
    /// A sentence that says what does not fit.
    fn layer(&self, input: Shape, backend: Backend) -> Result<Box<dyn Layer>, String>;

    /// What the layer computes in evaluation, in the elementary operations that every exporter knows. `params` and
    /// `statistics` are laid out as [`Layer::params`] and [`Layer::statistics`] say.
    fn export_form(&self, input: Shape, params: &[f32], statistics: &[f32]) -> ExportForm;
}

impl dyn LayerKind + '_ {
    /// The checked layer for inputs of shape `input`. `backend` is an instruction set, or one with an algorithm of convolution.
    ///
    /// # Errors
    ///
    /// A sentence that says which option is out of range or what does not fit.
    pub fn build(&self, input: Shape, backend: impl Into<Backend>) -> Result<Box<dyn Layer>, String> {
        self.check(input)?;
        self.layer(input, backend.into())
    }
}

/// What sort of layer a kind is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Family {
    /// Weights over a window of positions, the same at each place.
    Convolution,
    /// A statistic of a window of positions.
    Pooling,
    /// Weights over all positions.
    Dense,
    /// A function of each value alone.
    Activation,
    /// Shifts and scales values towards a common range.
    Normalization,
    /// Does something in training only.
    Regularization,
    /// Moves, cuts or adds values without changing any.
    Rearrangement,
}

/// Which positions of the input an output of a layer sees.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ReceptiveField {
    /// Output (c, i, j) sees input (c, i, j) alone, so the output has the input's shape.
    Element,
    /// Output (i, j) sees a window of the map, through one channel or through all.
    Window {
        /// Rows and columns of the window.
        size: [usize; 2],
        /// Rows and columns from one window to the next.
        stride: [usize; 2],
        /// Output (i, j) sees rows from `i · stride[0] − before[0]` on, columns likewise: rows and columns of padding before
        /// the input if positive, of input cut off if negative.
        before: [isize; 2],
    },
    /// The output is the map in another size: output (i, j) sees what the [`Taps`](super::Taps) of its row and of its column say.
    Resized {
        /// Height and width of the output.
        to: [usize; 2],
        /// How.
        method: ResizeMethod,
    },
    /// The output is a vector: its positions are not those of the input.
    All,
}

/// Refuses the first of `sizes`, options with their names, that is larger than any sensible network has.
pub(super) fn check_sizes(sizes: &[(&str, usize)]) -> Result<(), String> {
    match sizes.iter().find(|(_, size)| *size > MAX_SIZE) {
        Some((key, size)) => Err(format!("{key} must be at most {MAX_SIZE}, not {size}")),
        None => Ok(()),
    }
}

/// Refuses a first value of parameters that is not finite.
pub(super) fn check_first_value(value: f32) -> Result<(), String> {
    if value.is_finite() { Ok(()) } else { Err(format!("first values must be finite, not {value}")) }
}

/// `3x4`.
pub(super) fn pair([h, w]: [usize; 2]) -> String {
    format!("{h}x{w}")
}
