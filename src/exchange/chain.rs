//! A trained network as a chain of operations with their weights; layers that act in training only are left out.

use crate::engine::layers::ExportForm;
use crate::engine::network::{NamedLayer, Network, Parameters};
use crate::engine::tensor::Shape;
use crate::error::{Error, Result};

/// One operation of the chain.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ChainStep {
    /// Name of the layer.
    pub name: String,
    pub input: Shape,
    pub output: Shape,
    /// What it computes; never [`ExportForm::Identity`].
    pub form: ExportForm,
}

impl ChainStep {
    /// Number of weights or slopes.
    pub fn weight_len(&self) -> usize {
        match &self.form {
            ExportForm::Conv { weight, .. } | ExportForm::Dense { weight, .. } => weight.len(),
            ExportForm::PRelu { slopes } => slopes.len(),
            ExportForm::Identity
            | ExportForm::Elementwise(_)
            | ExportForm::BatchNorm { .. }
            | ExportForm::MaxPool { .. }
            | ExportForm::AveragePool { .. }
            | ExportForm::Crop { .. }
            | ExportForm::ZeroPad { .. }
            | ExportForm::Resize { .. }
            | ExportForm::Flatten => 0,
        }
    }
}

/// The operations that `network` computes with `parameters`. Layers that do nothing in inference are left out.
pub(crate) fn chain(network: &Network, parameters: &Parameters) -> Vec<ChainStep> {
    let step = |layer: &NamedLayer| {
        let (input, output) = (layer.layer.input(), layer.layer.output());
        let params = &parameters.values[layer.params.clone()];
        let statistics = &parameters.statistics[layer.statistics.clone()];
        let form = layer.spec.export_form(input, params, statistics);
        (form != ExportForm::Identity).then(|| ChainStep { name: layer.name.clone(), input, output, form })
    };
    network.layers().iter().filter_map(step).collect()
}

/// Scale and shift of each channel: batch normalisation in inference is `x · scale + shift`.
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

/// Checks that all numbers are finite as 32-bit floats: weights after folding, and scales and shifts of the batch
/// normalisation that was not folded. An exported file cannot hold other numbers, or would compute nonsense with them.
///
/// # Errors
///
/// [`Error::Network`] names the layer.
pub(crate) fn check_finite(steps: &[ChainStep]) -> Result<()> {
    let all_finite = |values: &[f32]| values.iter().all(|value| value.is_finite());
    for ChainStep { name, form, .. } in steps {
        let is_finite = match form {
            ExportForm::Conv { weight, bias, .. } | ExportForm::Dense { weight, bias } => {
                all_finite(weight) && all_finite(bias)
            }
            ExportForm::BatchNorm { gamma, beta, mean, variance, epsilon } => {
                let ChannelAffine { scale, shift } = scale_and_shift(gamma, beta, mean, variance, *epsilon);
                scale.iter().chain(&shift).all(|value| (*value as f32).is_finite())
            }
            ExportForm::PRelu { slopes } => all_finite(slopes),
            ExportForm::Elementwise(formula) => all_finite(&formula.numbers()),
            ExportForm::Identity
            | ExportForm::MaxPool { .. }
            | ExportForm::AveragePool { .. }
            | ExportForm::Crop { .. }
            | ExportForm::ZeroPad { .. }
            | ExportForm::Resize { .. }
            | ExportForm::Flatten => true,
        };
        if !is_finite {
            let message = "its weights, with batch normalisation worked into them, are not finite".into();
            return Err(Error::Network { layer: name.clone(), message });
        }
    }
    Ok(())
}

/// Most bytes of weights. Protocol buffers and flatbuffers must stay below 2 GiB; the rest is for names and shapes.
const MAX_WEIGHT_BYTES: usize = (1 << 31) - (1 << 24);

/// Checks that the weights fit into `file`, the name of a kind of file that must stay below 2 GiB.
///
/// # Errors
///
/// [`Error::Network`] names the layer that is too much.
pub(crate) fn check_size(steps: &[ChainStep], file: &str) -> Result<()> {
    let mut bytes = 0;
    for step in steps {
        bytes += 4 * step.weight_len();
        if bytes > MAX_WEIGHT_BYTES {
            let message = format!("with its weights the file would pass the 2 GiB that {file} can have");
            return Err(Error::Network { layer: step.name.clone(), message });
        }
    }
    Ok(())
}

/// `x · scale + shift` in each channel.
pub(crate) struct ChannelAffine {
    pub scale: Vec<f64>,
    pub shift: Vec<f64>,
}

/// Folds each batch normalisation that directly follows a convolution or a dense layer into that layer's weights. Others
/// stay.
pub(crate) fn fold_batch_norm(chain: Vec<ChainStep>) -> Vec<ChainStep> {
    let mut folded: Vec<ChainStep> = Vec::with_capacity(chain.len());
    for step in chain {
        let before = folded.last_mut().map(|step| &mut step.form);
        match (before, &step.form) {
            (
                Some(ExportForm::Conv { weight, bias, .. } | ExportForm::Dense { weight, bias }),
                ExportForm::BatchNorm { gamma, beta, mean, variance, epsilon },
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
    use crate::engine::layers::Pads;
    use crate::engine::network::LayerSpec;
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
        let batch_norm = ExportForm::BatchNorm {
            gamma: vec![3.0],
            beta: vec![0.5],
            mean: vec![2.0],
            variance: vec![3.75],
            epsilon: 0.25,
        };
        let shape = Shape::vector(1);
        let step = |form| ChainStep { name: String::new(), input: shape, output: shape, form };
        let dense = ExportForm::Dense { weight: vec![4.0], bias: vec![1.0] };
        // (4 x + 1 − 2) · 3 / 2 + 0.5
        let expected = ExportForm::Dense { weight: vec![6.0], bias: vec![-1.0] };
        assert_eq!(fold_batch_norm(vec![step(dense), step(batch_norm)]), [step(expected)]);
    }

    #[test]
    fn each_channel_of_a_depthwise_convolution_takes_its_own_scale_and_shift() {
        let batch_norm = ExportForm::BatchNorm {
            gamma: vec![3.0, 4.0],
            beta: vec![0.5, -1.0],
            mean: vec![2.0, 1.0],
            variance: vec![3.75, 0.75],
            epsilon: 0.25,
        };
        let shape = Shape::new(2, 1, 2);
        let step = |form| ChainStep { name: String::new(), input: shape, output: shape, form };
        let pads = Pads { top: 0, left: 0, bottom: 0, right: 1 };
        let depthwise = |weight: [f32; 4], bias: [f32; 2]| ExportForm::Conv {
            depthwise: true,
            kernel: [1, 2],
            stride: [1, 1],
            pads,
            weight: weight.into(),
            bias: bias.into(),
        };
        let before = depthwise([1.0, 2.0, 3.0, 4.0], [1.0, 0.0]);
        // (x − 2) · 3 / 2 + 0.5 and (x − 1) · 4 − 1
        let expected = depthwise([1.5, 3.0, 12.0, 16.0], [-1.0, -5.0]);
        assert_eq!(fold_batch_norm(vec![step(before), step(batch_norm)]), [step(expected)]);
    }
}
