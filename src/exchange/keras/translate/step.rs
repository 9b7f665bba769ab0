//! What a Keras layer becomes: an operation, and the activation behind it.

use crate::engine::layers::{BatchNormSpec, Conv2dSpec, ResizeSpec};
use crate::engine::network::LayerSpec;

/// Order of the axes of a feature map.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::exchange::keras) enum AxisOrder {
    /// Height, width, channels (`tf`).
    ChannelsLast,
    /// Channels, height, width (`th`).
    ChannelsFirst,
}

/// Order of the axes of a convolution's kernel in the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::exchange::keras) enum KernelLayout {
    /// Height, width, inputs, outputs.
    HeightWidthInOut,
    /// Outputs, inputs, height, width: Keras 1 with `dim_ordering` `th`.
    OutInHeightWidth,
}

/// The operation of a layer, without its activation.
#[derive(Clone, Debug, PartialEq)]
pub(in crate::exchange::keras) enum Operation {
    /// No operation.
    Nothing,
    /// The input; extents without the batch, if the file gives them.
    Input,
    /// A layer without weights that is the same for every shape.
    Plain(LayerSpec),
    Conv {
        spec: Conv2dSpec,
        kernel: KernelLayout,
        bias: bool,
    },
    Dense {
        units: usize,
        bias: bool,
    },
    BatchNorm {
        spec: BatchNormSpec,
        axis: i64,
        center: bool,
        scale: bool,
    },
    PRelu,
    Pool {
        max: bool,
        window: [usize; 2],
        stride: [usize; 2],
        same: bool,
    },
    GlobalPool {
        max: bool,
    },
    /// A map of another height and width.
    Resize(ResizeSpec),
    Flatten,
}

impl Operation {
    /// Whether the file has tensors for it.
    pub fn has_weights(&self) -> bool {
        matches!(
            self,
            Operation::Conv { .. } | Operation::Dense { .. } | Operation::BatchNorm { .. } | Operation::PRelu
        )
    }
}

/// A translated layer.
#[derive(Clone, Debug, PartialEq)]
pub(in crate::exchange::keras) struct KerasStep {
    pub operation: Operation,
    /// What follows, without weights.
    pub activation: Option<LayerSpec>,
    /// Order of the axes, if the layer says.
    pub order: Option<AxisOrder>,
    /// Extents of the input without the batch, in the order of the file, if the layer says; 0 where they are open.
    pub input: Option<Vec<usize>>,
    /// A notice to the user about what the translation loses.
    pub notice: Option<&'static str>,
}
