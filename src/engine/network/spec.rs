//! What a recipe says of a layer, and how it becomes one.

use serde::{Deserialize, Serialize};
use steersman_kernels::Backend;

use crate::engine::layers::{
    AveragePool, BatchNorm, Conv2d, Crop, Dense, Dropout, Elu, Flatten, Layer, LeakyRelu, MaxPool, PRelu, Padding,
    Relu, Scale, Slopes, Softsign, Tanh, ZeroPad,
};
use crate::engine::tensor::{Initializer, Shape};

/// Largest filters, units, kernel, window, stride.
const MAX_SIZE: usize = 65_536;

/// Most weights of a layer, and most numbers that one image has on its way: 256 MiB.
const MAX_NUMBERS: usize = 1 << 26;

/// One entry of a recipe's `layers`: `{ kind = "conv2d", filters = 8, kernel = [3, 3] }`.
///
/// Pairs are (height, width). Layers are named by their kind and a number from 1: `conv1`, `bn1`, `conv2`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum LayerSpec {
    /// [`Conv2d`].
    Conv2d {
        /// Output channels.
        filters: usize,
        /// Kernel size.
        kernel: [usize; 2],
        /// Step between windows.
        #[serde(default = "one_by_one", skip_serializing_if = "is_one_by_one")]
        stride: [usize; 2],
        /// `valid` (default) or `same`.
        #[serde(default)]
        padding: Padding,
        /// First weights: `glorot_uniform` (default), `he_normal` or `{ constant = … }`.
        #[serde(default)]
        init: Initializer,
    },
    /// [`BatchNorm`].
    BatchNorm {
        /// Added to the variance.
        #[serde(default = "default_epsilon")]
        epsilon: f32,
        /// Weight of the old value when the running statistics are updated (Keras' `momentum`).
        #[serde(default = "default_running_old_weight")]
        running_old_weight: f32,
    },
    /// [`Relu`].
    Relu {},
    /// [`Elu`].
    Elu {
        /// The negative side goes to −alpha.
        #[serde(default = "one")]
        alpha: f32,
    },
    /// [`LeakyRelu`].
    LeakyRelu {
        /// Slope below zero.
        slope: f32,
    },
    /// [`Tanh`].
    Tanh {},
    /// [`Softsign`].
    Softsign {},
    /// [`PRelu`].
    #[serde(rename = "prelu")]
    PRelu {
        /// `per_position` (default) or `per_channel`.
        #[serde(default)]
        slopes: Slopes,
        /// Slopes before training.
        #[serde(default)]
        initial_slope: f32,
    },
    /// [`MaxPool`].
    MaxPool {
        /// Window size.
        window: [usize; 2],
        /// Step between windows; the window's size when absent.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        stride: Option<[usize; 2]>,
    },
    /// [`AveragePool`].
    AveragePool {
        /// Window size.
        window: [usize; 2],
        /// Step between windows; the window's size when absent.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        stride: Option<[usize; 2]>,
    },
    /// [`Dropout`].
    Dropout {
        /// Fraction that is dropped, in [0, 1).
        drop_probability: f32,
    },
    /// [`Flatten`].
    Flatten {},
    /// [`Dense`].
    Dense {
        /// Outputs.
        units: usize,
        /// First weights: `glorot_uniform` (default), `he_normal` or `{ constant = … }`.
        #[serde(default)]
        init: Initializer,
    },
    /// [`Scale`]: x · factor + offset.
    Scale {
        /// Multiplies the input.
        factor: f32,
        /// Added after that.
        offset: f32,
    },
    /// [`Crop`].
    Crop {
        /// Rows cut off at the top and at the bottom.
        #[serde(default)]
        rows: [usize; 2],
        /// Columns cut off on the left and on the right.
        #[serde(default)]
        columns: [usize; 2],
    },
    /// [`ZeroPad`].
    ZeroPad {
        /// Rows added at the top and at the bottom.
        #[serde(default)]
        rows: [usize; 2],
        /// Columns added on the left and on the right.
        #[serde(default)]
        columns: [usize; 2],
    },
}

fn one() -> f32 {
    1.0
}

fn one_by_one() -> [usize; 2] {
    [1, 1]
}

fn is_one_by_one(stride: &[usize; 2]) -> bool {
    *stride == [1, 1]
}

fn default_epsilon() -> f32 {
    1e-3
}

fn default_running_old_weight() -> f32 {
    0.99
}

impl LayerSpec {
    /// First part of the layer's name; a number from 1 follows.
    pub fn base_name(&self) -> &'static str {
        match self {
            LayerSpec::Conv2d { .. } => "conv",
            LayerSpec::BatchNorm { .. } => "bn",
            LayerSpec::Relu {} => "relu",
            LayerSpec::Elu { .. } => "elu",
            LayerSpec::LeakyRelu { .. } => "leaky_relu",
            LayerSpec::Tanh {} => "tanh",
            LayerSpec::Softsign {} => "softsign",
            LayerSpec::PRelu { .. } => "prelu",
            LayerSpec::MaxPool { .. } | LayerSpec::AveragePool { .. } => "pool",
            LayerSpec::Dropout { .. } => "dropout",
            LayerSpec::Flatten {} => "flatten",
            LayerSpec::Dense { .. } => "dense",
            LayerSpec::Scale { .. } => "scale",
            LayerSpec::Crop { .. } => "crop",
            LayerSpec::ZeroPad { .. } => "pad",
        }
    }

    /// What the layer does, for tables: `conv 3x3`, `max pool 2x2`, `dropout 0.5`.
    pub fn describe(&self) -> String {
        let pair = |[h, w]: [usize; 2]| format!("{h}x{w}");
        let stepped = |window: [usize; 2], stride: [usize; 2]| match stride == window {
            true => pair(window),
            false => format!("{} stride {}", pair(window), pair(stride)),
        };
        match self {
            LayerSpec::Conv2d { kernel, stride, padding, .. } => {
                let stride = if *stride == [1, 1] { String::new() } else { format!(" stride {}", pair(*stride)) };
                let padding = if *padding == Padding::Same { " same" } else { "" };
                format!("conv {}{stride}{padding}", pair(*kernel))
            }
            LayerSpec::BatchNorm { .. } => "batch norm".into(),
            LayerSpec::Relu {} => "ReLU".into(),
            LayerSpec::Elu { alpha: 1.0 } => "ELU".into(),
            LayerSpec::Elu { alpha } => format!("ELU alpha {alpha}"),
            LayerSpec::LeakyRelu { slope } => format!("leaky ReLU {slope}"),
            LayerSpec::Tanh {} => "tanh".into(),
            LayerSpec::Softsign {} => "softsign".into(),
            LayerSpec::PRelu { slopes: Slopes::PerPosition, .. } => "PReLU".into(),
            LayerSpec::PRelu { slopes: Slopes::PerChannel, .. } => "PReLU per channel".into(),
            LayerSpec::MaxPool { window, stride } => {
                format!("max pool {}", stepped(*window, stride.unwrap_or(*window)))
            }
            LayerSpec::AveragePool { window, stride } => {
                format!("average pool {}", stepped(*window, stride.unwrap_or(*window)))
            }
            LayerSpec::Dropout { drop_probability } => format!("dropout {drop_probability}"),
            LayerSpec::Flatten {} => "flatten".into(),
            LayerSpec::Dense { .. } => "dense".into(),
            LayerSpec::Scale { factor, offset } => format!("x * {factor} + {offset}").replace("+ -", "- "),
            LayerSpec::Crop { .. } => "crop".into(),
            LayerSpec::ZeroPad { .. } => "zero padding".into(),
        }
    }

    /// Refuses sizes that no network of this kind has, before anything is computed from them.
    fn check_sizes(&self, input: Shape) -> Result<(), String> {
        let sizes = match *self {
            LayerSpec::Conv2d { filters, kernel: [kh, kw], stride: [sh, sw], .. } => {
                let weights = filters.saturating_mul(input.c).saturating_mul(kh).saturating_mul(kw);
                let outputs = filters.saturating_mul(input.positions());
                if weights.max(outputs) > MAX_NUMBERS {
                    return Err(format!("weights or outputs would be more than {MAX_NUMBERS} numbers"));
                }
                vec![("filters", filters), ("kernel", kh), ("kernel", kw), ("stride", sh), ("stride", sw)]
            }
            LayerSpec::MaxPool { window: [h, w], stride } | LayerSpec::AveragePool { window: [h, w], stride } => {
                let [sh, sw] = stride.unwrap_or([1, 1]);
                vec![("window", h), ("window", w), ("stride", sh), ("stride", sw)]
            }
            LayerSpec::Dense { units, .. } => {
                if units.saturating_mul(input.len()) > MAX_NUMBERS {
                    return Err(format!("{units} units would have more than {MAX_NUMBERS} weights"));
                }
                vec![("units", units)]
            }
            LayerSpec::Crop { rows, columns } => {
                [rows, columns].concat().into_iter().map(|size| ("rows and columns", size)).collect()
            }
            LayerSpec::ZeroPad { rows, columns } => {
                let sum = |inside: usize, border: [usize; 2]| border.iter().fold(inside, |a, b| a.saturating_add(*b));
                let outputs = sum(input.h, rows).saturating_mul(sum(input.w, columns)).saturating_mul(input.c);
                if outputs > MAX_NUMBERS {
                    return Err(format!("the padded map would have more than {MAX_NUMBERS} numbers"));
                }
                vec![]
            }
            _ => vec![],
        };
        match sizes.iter().find(|(_, size)| *size > MAX_SIZE) {
            Some((key, size)) => Err(format!("{key} must be at most {MAX_SIZE}, not {size}")),
            None => Ok(()),
        }
    }

    /// Refuses first values that are not finite.
    fn check_first_values(&self) -> Result<(), String> {
        let first = match *self {
            LayerSpec::Conv2d { init: Initializer::Constant(value), .. }
            | LayerSpec::Dense { init: Initializer::Constant(value), .. } => value,
            LayerSpec::PRelu { initial_slope, .. } => initial_slope,
            _ => 0.0,
        };
        if first.is_finite() { Ok(()) } else { Err(format!("first values must be finite, not {first}")) }
    }

    /// The layer for inputs of shape `input`, or what does not fit.
    pub fn build(&self, input: Shape, backend: impl Into<Backend>) -> Result<Box<dyn Layer>, String> {
        let backend = backend.into();
        let isa = backend.isa;
        self.check_sizes(input)?;
        self.check_first_values()?;
        Ok(match *self {
            LayerSpec::Conv2d { filters, kernel, stride, padding, init } => {
                Box::new(Conv2d::new(input, filters, kernel, stride, padding, init, backend)?)
            }
            LayerSpec::BatchNorm { epsilon, running_old_weight } => {
                Box::new(BatchNorm::new(input, epsilon, running_old_weight, isa)?)
            }
            LayerSpec::Relu {} => Box::new(Relu::new(input, isa)),
            LayerSpec::Elu { alpha } => Box::new(Elu::new(input, alpha, isa)?),
            LayerSpec::LeakyRelu { slope } => Box::new(LeakyRelu::new(input, slope, isa)?),
            LayerSpec::Tanh {} => Box::new(Tanh::new(input, isa)),
            LayerSpec::Softsign {} => Box::new(Softsign::new(input, isa)),
            LayerSpec::PRelu { slopes, initial_slope } => Box::new(PRelu::new(input, slopes, initial_slope, isa)),
            LayerSpec::MaxPool { window, stride } => {
                Box::new(MaxPool::new(input, window, stride.unwrap_or(window), isa)?)
            }
            LayerSpec::AveragePool { window, stride } => {
                Box::new(AveragePool::new(input, window, stride.unwrap_or(window), isa)?)
            }
            LayerSpec::Dropout { drop_probability } => Box::new(Dropout::new(input, drop_probability)?),
            LayerSpec::Flatten {} => Box::new(Flatten::new(input)),
            LayerSpec::Dense { units, init } => Box::new(Dense::new(input, units, init, isa)?),
            LayerSpec::Scale { factor, offset } => Box::new(Scale::new(input, factor, offset)?),
            LayerSpec::Crop { rows, columns } => Box::new(Crop::new(input, rows, columns)?),
            LayerSpec::ZeroPad { rows, columns } => Box::new(ZeroPad::new(input, rows, columns)),
        })
    }
}
