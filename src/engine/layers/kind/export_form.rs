//! What layers compute in evaluation, as data for exporters.

use super::Formula;
use crate::engine::layers::Taps;

/// A layer of evaluation with its numbers, in one of the elementary operations that every exporter knows.
///
/// A new layer says its form by these; only a layer that none of them can express adds one, and the compiler then names the
/// exporters that have to learn it.
#[derive(Clone, Debug, PartialEq)]
pub enum ExportForm {
    /// The output is the input; exporters leave the layer out.
    Identity,
    /// The same formula of each value.
    Elementwise(Formula),
    /// A convolution, `weight` `[filters][channels][kernel height][kernel width]`; a depthwise one has a filter for each channel, which
    /// sees that channel alone: `[channels][1][kernel height][kernel width]`.
    Conv {
        /// Whether each filter sees one channel.
        depthwise: bool,
        /// Height and width of the kernel.
        kernel: [usize; 2],
        /// Rows and columns from one window to the next.
        stride: [usize; 2],
        /// Zeros around the input.
        pads: Pads,
        /// The kernels.
        weight: Vec<f32>,
        /// One value for each filter.
        bias: Vec<f32>,
    },
    /// A fully connected layer, `weight` `[units][inputs]`.
    Dense {
        /// The weights.
        weight: Vec<f32>,
        /// One value for each unit.
        bias: Vec<f32>,
    },
    /// `gamma · (x − mean) / √(variance + epsilon) + beta` in each channel.
    BatchNorm {
        /// Scale of each channel.
        gamma: Vec<f32>,
        /// Shift of each channel.
        beta: Vec<f32>,
        /// Running mean of each channel.
        mean: Vec<f32>,
        /// Running variance of each channel.
        variance: Vec<f32>,
        /// Added to the variance.
        epsilon: f32,
    },
    /// `x` where `x > 0`, else `slope · x`.
    PRelu {
        /// One slope for each value of the map, or one for each channel.
        slopes: Vec<f32>,
    },
    /// The largest value of each window.
    MaxPool {
        /// Height and width of the window.
        window: [usize; 2],
        /// Rows and columns from one window to the next.
        stride: [usize; 2],
    },
    /// The mean of each window.
    AveragePool {
        /// Height and width of the window.
        window: [usize; 2],
        /// Rows and columns from one window to the next.
        stride: [usize; 2],
    },
    /// The output is the part of the input that begins at this row and column.
    Crop {
        /// First row that is kept.
        top: usize,
        /// First column that is kept.
        left: usize,
    },
    /// The input lies in the output from this row and column on, with zeros around.
    ZeroPad {
        /// Row of the output that holds the first row of the input.
        top: usize,
        /// Column of the output that holds the first column of the input.
        left: usize,
    },
    /// Each row of the output is a weighted sum of rows of the input, and each column of columns.
    Resize {
        /// The rows.
        rows: Taps,
        /// The columns.
        columns: Taps,
    },
    /// The map as a vector, in the order channel, row, column.
    Flatten,
}

/// Rows and columns of zeros around the input of a convolution.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
pub struct Pads {
    pub top: usize,
    pub left: usize,
    pub bottom: usize,
    pub right: usize,
}

/// `params` as a weight tensor and the bias of length `biases` behind it.
pub(crate) fn weight_and_bias(params: &[f32], biases: usize) -> (Vec<f32>, Vec<f32>) {
    let (weight, bias) = params.split_at(params.len() - biases);
    (weight.to_vec(), bias.to_vec())
}
