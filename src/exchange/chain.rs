//! A network without its training: a chain of operations with their numbers.

use crate::engine::network::{LayerSpec, NamedLayer, Network, Parameters};
use crate::engine::tensor::Shape;
use crate::error::{Error, Result};

/// One operation of the chain.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ChainStep {
    /// Name of the layer.
    pub name: String,
    pub input: Shape,
    pub output: Shape,
    pub op: Op,
}

/// What a step computes. The formulas are those of the layers in [`layers`](crate::engine::layers).
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Op {
    /// `weight` is `[filters][channels][kernel height][kernel width]`.
    Conv {
        kernel: [usize; 2],
        stride: [usize; 2],
        pads: Pads,
        weight: Vec<f32>,
        bias: Vec<f32>,
    },
    /// `weight` is `[units][inputs]`.
    Dense {
        weight: Vec<f32>,
        bias: Vec<f32>,
    },
    BatchNorm {
        gamma: Vec<f32>,
        beta: Vec<f32>,
        mean: Vec<f32>,
        variance: Vec<f32>,
        epsilon: f32,
    },
    Scale {
        factor: f32,
        offset: f32,
    },
    Relu,
    Elu {
        alpha: f32,
    },
    LeakyRelu {
        slope: f32,
    },
    Tanh,
    Softsign,
    /// One slope for every element of the map, or one for each channel.
    PRelu {
        slopes: Vec<f32>,
    },
    MaxPool {
        window: [usize; 2],
        stride: [usize; 2],
    },
    AveragePool {
        window: [usize; 2],
        stride: [usize; 2],
    },
    /// The output is the window of the input that begins at this row and column.
    Crop {
        top: usize,
        left: usize,
    },
    /// The input lies in the output from this row and column on, with zeros around.
    ZeroPad {
        top: usize,
        left: usize,
    },
    Flatten,
}

/// Zeros around the input of a convolution.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Pads {
    pub top: usize,
    pub left: usize,
    pub bottom: usize,
    pub right: usize,
}

/// The operations of `network` with `parameters`; layers that do nothing in evaluation are left out.
pub(crate) fn chain(network: &Network, parameters: &Parameters) -> Vec<ChainStep> {
    let step = |layer: &NamedLayer| {
        let op = op(layer, parameters)?;
        Some(ChainStep { name: layer.name.clone(), input: layer.layer.input(), output: layer.layer.output(), op })
    };
    network.layers().iter().filter_map(step).collect()
}

fn op(layer: &NamedLayer, parameters: &Parameters) -> Option<Op> {
    let input = layer.layer.input();
    let params = &parameters.values[layer.params.clone()];
    let statistics = &parameters.statistics[layer.statistics.clone()];
    let halves = |values: &[f32]| {
        let (a, b) = values.split_at(values.len() / 2);
        (a.to_vec(), b.to_vec())
    };
    let weight_and_bias = |biases: usize| {
        let (weight, bias) = params.split_at(params.len() - biases);
        (weight.to_vec(), bias.to_vec())
    };
    Some(match layer.spec {
        LayerSpec::Conv2d { filters, kernel, stride, padding, .. } => {
            let (top, bottom) = padding.amounts(input.h, kernel[0], stride[0]);
            let (left, right) = padding.amounts(input.w, kernel[1], stride[1]);
            let (weight, bias) = weight_and_bias(filters);
            Op::Conv { kernel, stride, pads: Pads { top, left, bottom, right }, weight, bias }
        }
        LayerSpec::BatchNorm { epsilon, .. } => {
            let ((gamma, beta), (mean, variance)) = (halves(params), halves(statistics));
            Op::BatchNorm { gamma, beta, mean, variance, epsilon }
        }
        LayerSpec::Relu {} => Op::Relu,
        LayerSpec::Elu { alpha } => Op::Elu { alpha },
        LayerSpec::LeakyRelu { slope } => Op::LeakyRelu { slope },
        LayerSpec::Tanh {} => Op::Tanh,
        LayerSpec::Softsign {} => Op::Softsign,
        LayerSpec::PRelu { .. } => Op::PRelu { slopes: params.to_vec() },
        LayerSpec::MaxPool { window, stride } => Op::MaxPool { window, stride: stride.unwrap_or(window) },
        LayerSpec::AveragePool { window, stride } => Op::AveragePool { window, stride: stride.unwrap_or(window) },
        LayerSpec::Dropout { .. } => return None,
        LayerSpec::Flatten {} => Op::Flatten,
        LayerSpec::Dense { units, .. } => {
            let (weight, bias) = weight_and_bias(units);
            Op::Dense { weight, bias }
        }
        LayerSpec::Scale { factor, offset } => Op::Scale { factor, offset },
        LayerSpec::ZeroPad { rows: [top, _], columns: [left, _] } => Op::ZeroPad { top, left },
        LayerSpec::Crop { rows: [top, _], columns: [left, _] } => Op::Crop { top, left },
    })
}

/// Batch normalisation of evaluation is `x · scale + shift` in each channel.
pub(crate) fn scale_and_shift(
    gamma: &[f32],
    beta: &[f32],
    mean: &[f32],
    variance: &[f32],
    epsilon: f32,
) -> ChannelAffine {
    let channel = |i: usize| {
        let scale = f64::from(gamma[i]) / (f64::from(variance[i]) + f64::from(epsilon)).sqrt();
        (scale, f64::from(beta[i]) - f64::from(mean[i]) * scale)
    };
    let (scale, shift) = (0..gamma.len()).map(channel).unzip();
    ChannelAffine { scale, shift }
}

/// Refuses numbers that are not finite, which a file of an exported model could not say or would compute nonsense with: those
/// that folding made, and the scales and shifts of the batch normalisation that is left, as the 32-bit numbers they become.
pub(crate) fn check_finite(steps: &[ChainStep]) -> Result<()> {
    for ChainStep { name, op, .. } in steps {
        let is_finite = match op {
            Op::Conv { weight, bias, .. } | Op::Dense { weight, bias } => {
                weight.iter().chain(bias).all(|value| value.is_finite())
            }
            Op::BatchNorm { gamma, beta, mean, variance, epsilon } => {
                let ChannelAffine { scale, shift } = scale_and_shift(gamma, beta, mean, variance, *epsilon);
                scale.iter().chain(&shift).all(|value| (*value as f32).is_finite())
            }
            Op::PRelu { slopes } => slopes.iter().all(|value| value.is_finite()),
            Op::Scale { factor, offset } => factor.is_finite() && offset.is_finite(),
            _ => true,
        };
        if !is_finite {
            let message = "its weights, with batch normalisation worked into them, are not finite".into();
            return Err(Error::Network { layer: name.clone(), message });
        }
    }
    Ok(())
}

/// `x · scale + shift` in each channel.
pub(crate) struct ChannelAffine {
    pub scale: Vec<f64>,
    pub shift: Vec<f64>,
}

/// Merges every batch normalisation that directly follows a convolution or dense layer into its weights; others stay.
pub(crate) fn fold_batch_norm(chain: Vec<ChainStep>) -> Vec<ChainStep> {
    let mut folded: Vec<ChainStep> = Vec::with_capacity(chain.len());
    for step in chain {
        let before = folded.last_mut().map(|step| &mut step.op);
        match (before, &step.op) {
            (
                Some(Op::Conv { weight, bias, .. } | Op::Dense { weight, bias }),
                Op::BatchNorm { gamma, beta, mean, variance, epsilon },
            ) => {
                let ChannelAffine { scale, shift } = scale_and_shift(gamma, beta, mean, variance, *epsilon);
                let row = weight.len() / bias.len();
                for (row, scale) in weight.chunks_exact_mut(row).zip(&scale) {
                    row.iter_mut().for_each(|w| *w = (f64::from(*w) * scale) as f32);
                }
                for ((bias, scale), shift) in bias.iter_mut().zip(&scale).zip(&shift) {
                    *bias = (f64::from(*bias) * scale + shift) as f32;
                }
            }
            _ => folded.push(step),
        }
    }
    folded
}

#[cfg(test)]
mod tests {
    use super::*;
    use steersman_kernels::Isa;

    fn network(layers: &str) -> (Network, Parameters) {
        #[derive(serde::Deserialize)]
        struct Layers {
            layers: Vec<LayerSpec>,
        }
        let layers = toml::from_str::<Layers>(&format!("layers = [{layers}]")).unwrap().layers;
        let network = Network::new(Shape::new(2, 5, 5), &layers, Isa::PORTABLE).unwrap();
        let parameters = network.initialize(1);
        (network, parameters)
    }

    #[test]
    fn what_evaluation_does_not_need_is_left_out() {
        let (network, parameters) = network(
            "{kind='conv2d', filters=3, kernel=[3, 3]}, {kind='dropout', drop_probability=0.5}, {kind='batch_norm'}",
        );
        let chain = chain(&network, &parameters);
        assert_eq!(chain.iter().map(|step| step.name.as_str()).collect::<Vec<_>>(), ["conv1", "bn1"]);
        assert_eq!(fold_batch_norm(chain).len(), 1);
    }

    #[test]
    fn batch_norm_is_folded_only_into_what_stands_before_it() {
        let (network, parameters) = network(
            "{kind='batch_norm'}, {kind='conv2d', filters=3, kernel=[3, 3]}, {kind='relu'}, {kind='batch_norm'}",
        );
        let chain = chain(&network, &parameters);
        assert_eq!(fold_batch_norm(chain.clone()), chain);
    }

    #[test]
    fn numbers_that_are_not_finite_are_refused_folded_or_not() {
        let layers = "{kind='batch_norm'}, {kind='conv2d', filters=3, kernel=[3, 3]}, {kind='batch_norm'}";
        let (network, sound) = network(layers);
        check_finite(&fold_batch_norm(chain(&network, &sound))).unwrap();
        for (name, refused) in [("bn1", "bn1"), ("bn2", "conv1")] {
            let mut parameters = sound.clone();
            for tensor in network.tensors() {
                match tensor.name.strip_prefix(name) {
                    Some(".running_variance") => parameters.tensor_mut(tensor).fill(1e-20),
                    Some(".gamma" | ".running_mean") => parameters.tensor_mut(tensor).fill(3e38),
                    _ => {}
                }
            }
            let error = check_finite(&fold_batch_norm(chain(&network, &parameters))).unwrap_err().to_string();
            assert!(error.contains(refused) && error.contains("not finite"), "{error}");
        }
    }

    #[test]
    fn folded_weights_follow_the_formula() {
        let batch_norm =
            Op::BatchNorm { gamma: vec![3.0], beta: vec![0.5], mean: vec![2.0], variance: vec![3.75], epsilon: 0.25 };
        let shape = Shape::vector(1);
        let step = |op| ChainStep { name: String::new(), input: shape, output: shape, op };
        let dense = Op::Dense { weight: vec![4.0], bias: vec![1.0] };
        // (4 x + 1 − 2) · 3 / 2 + 0.5
        let expected = Op::Dense { weight: vec![6.0], bias: vec![-1.0] };
        assert_eq!(fold_batch_norm(vec![step(dense), step(batch_norm)]), [step(expected)]);
    }
}
