//! Fusion: which neighbouring layers run as one stage.
//!
//! | layers | run as | because |
//! |---|---|---|
//! | batch norm, ReLU or PReLU, then max pool 2x2 if there is one, after a convolution or dense layer | [`NormRectify`] | one pass over the maps instead of three, and nothing between is written; the gradient of the convolution's output takes its place |
//! | convolution of stride 1 without padding, ReLU or ELU, max pool 4x4 | [`PooledConv`] | the activation of a 16th of the values; gradients from a 16th of the positions |
//!
//! Every other layer is a stage by itself, frozen batch norm too. A fused stage computes what its layers compute one by one, up to
//! rounding.

mod norm_rectify;
mod pooled_conv;

use std::ops::Range;

use norm_rectify::NormRectify;
use pooled_conv::{MonotonicActivation, PooledConv};

use super::{LayerSpec, NamedLayer, Network};
use crate::engine::layers::{
    BatchNorm, BatchNormSpec, BatchStatistics, Conv2d, Conv2dSpec, EluSpec, MaxPoolSpec, PReluSpec, Packing, Slopes,
};

/// Neighbouring layers that run as one; most stages are a single layer.
#[derive(Clone, Debug)]
pub(in crate::engine::network) struct FusedStage {
    /// Which layers.
    pub layers: Range<usize>,
    pub kind: Kind,
    /// Which earlier stage's output is its input; `None` is the batch itself.
    pub source: Option<usize>,
}

/// How a stage runs.
#[derive(Clone, Debug)]
pub(in crate::engine::network) enum Kind {
    /// A single layer, as it is.
    Layer,
    NormRectify(NormRectify),
    PooledConv(Box<PooledConv>),
}

impl FusedStage {
    /// The barrier of a stage that needs one. A frozen layer takes its running statistics and needs none.
    pub fn barrier<'a>(&'a self, network: &'a Network) -> Option<&'a dyn BatchStatistics> {
        self.batch_statistics(network).filter(|_| !network.layers()[self.layers.start].frozen)
    }

    /// The statistics of batch normalisation, frozen or not.
    pub fn batch_statistics<'a>(&'a self, network: &'a Network) -> Option<&'a dyn BatchStatistics> {
        match &self.kind {
            Kind::Layer => network.layers()[self.layers.start].layer.batch_statistics(),
            Kind::NormRectify(fused) => Some(fused.batch_statistics()),
            Kind::PooledConv(_) => None,
        }
    }

    /// Whether training changes any of its parameters.
    pub fn learns(&self, network: &Network) -> bool {
        network.layers()[self.layers.clone()].iter().any(|layer| !layer.params.is_empty() && !layer.frozen)
    }

    /// Where its parameters lie.
    pub fn params(&self, network: &Network) -> Range<usize> {
        network.layers()[self.layers.start].params.start..network.layers()[self.layers.end - 1].params.end
    }

    pub fn input_len(&self, network: &Network) -> usize {
        network.layers()[self.layers.start].layer.input().len()
    }

    pub fn output_len(&self, network: &Network) -> usize {
        network.layers()[self.layers.end - 1].layer.output().len()
    }

    /// Length of the scratch buffer that its passes need for `n` images.
    pub fn scratch_len(&self, network: &Network, n: usize) -> usize {
        match &self.kind {
            Kind::Layer => network.layers()[self.layers.start].layer.scratch_len(n),
            Kind::NormRectify(fused) => fused.scratch_len(),
            Kind::PooledConv(fused) => fused.scratch_len(n),
        }
    }

    /// How its weights are packed, if they are.
    pub fn packing<'a>(&'a self, network: &'a Network) -> Option<&'a dyn Packing> {
        match &self.kind {
            Kind::Layer => network.layers()[self.layers.start].layer.packing(),
            Kind::NormRectify(_) => None,
            Kind::PooledConv(fused) => Some(&**fused),
        }
    }

    /// Length of an image's argmax indices.
    pub fn argmax_len(&self, network: &Network) -> usize {
        if let Kind::PooledConv(_) = self.kind { self.output_len(network) } else { 0 }
    }

    /// Whether the gradient of its output may take the place of its output.
    pub fn forgets_output(&self, network: &Network) -> bool {
        match &self.kind {
            Kind::Layer => network.layers()[self.layers.start].layer.linear().is_some(),
            Kind::NormRectify(_) => true,
            Kind::PooledConv(_) => false,
        }
    }
}

/// The stages of a network, in order; views are left out.
pub(in crate::engine::network) fn stages(network: &Network) -> Vec<FusedStage> {
    let layers = network.layers();
    let mut stages: Vec<FusedStage> = Vec::new();
    let mut next = 0;
    while next < layers.len() {
        let source = stages.len().checked_sub(1);
        if layers[next].layer.is_view() {
            next += 1;
            continue;
        }
        let after_linear =
            source.is_some_and(|at| matches!(stages[at].kind, Kind::Layer) && stages[at].forgets_output(network));
        let fused = match norm_rectify(network, &layers[next..]) {
            Some((count, fused)) if after_linear => Some((count, Kind::NormRectify(fused))),
            _ => pooled_conv(network, &layers[next..]).map(|fused| (3, Kind::PooledConv(Box::new(fused)))),
        };
        let (count, kind) = fused.unwrap_or((1, Kind::Layer));
        stages.push(FusedStage { layers: next..next + count, kind, source });
        next += count;
    }
    stages
}

/// Whether the gradient of the stage's input takes the place of that input.
pub(in crate::engine::network) fn replaces_input(network: &Network, stages: &[FusedStage], index: usize) -> bool {
    let Some(source) = stages[index].source else { return false };
    match &stages[index].kind {
        Kind::NormRectify(_) => true,
        Kind::PooledConv(_) => false,
        Kind::Layer => {
            let layer = &network.layers()[stages[index].layers.start].layer;
            layer.linear().is_some() && stages[source].forgets_output(network)
        }
    }
}

/// The [`NormRectify`] that computes the first of `layers`, and how many of them it computes.
fn norm_rectify(network: &Network, layers: &[NamedLayer]) -> Option<(usize, NormRectify)> {
    let LayerSpec::BatchNorm(BatchNormSpec { epsilon, running_old_weight }) = layers.first()?.spec else { return None };
    // The gradients of the slopes are computed at the barrier, and frozen batch norm has no barrier.
    if layers[0].frozen {
        return None;
    }
    let slopes = match layers.get(1)?.spec {
        LayerSpec::Relu(_) => None,
        LayerSpec::PRelu(PReluSpec { slopes, .. }) => Some(slopes),
        _ => return None,
    };
    let pooled = match layers.get(2).map(|layer| &layer.spec) {
        Some(LayerSpec::MaxPool(MaxPoolSpec { window: [2, 2], stride })) => {
            stride.is_none_or(|stride| stride == [2, 2])
        }
        _ => false,
    };
    let shape = layers[0].layer.input();
    // After a dense layer each unit is a channel of one position, so one slope per position is one slope per channel.
    let slopes = slopes.map(|slopes| if shape.positions() == 1 { Slopes::PerChannel } else { slopes });
    let norm = BatchNorm::new(shape, epsilon, running_old_weight, network.isa()).ok()?;
    Some((if pooled { 3 } else { 2 }, NormRectify::new(norm, slopes, pooled, network.isa())))
}

/// The [`PooledConv`] that computes the first three of `layers`, if they are such layers.
fn pooled_conv(network: &Network, layers: &[NamedLayer]) -> Option<PooledConv> {
    let [conv, activation, pool, ..] = layers else { return None };
    let LayerSpec::Conv2d(Conv2dSpec { filters, kernel, stride, padding, init }) = conv.spec else { return None };
    let activation = match activation.spec {
        LayerSpec::Relu(_) => MonotonicActivation::Relu,
        LayerSpec::Elu(EluSpec { alpha }) => MonotonicActivation::Elu(alpha),
        _ => return None,
    };
    let LayerSpec::MaxPool(MaxPoolSpec { window: [4, 4], stride: None | Some([4, 4]) }) = pool.spec else {
        return None;
    };
    let isa = network.isa();
    let conv = Conv2d::new(conv.layer.input(), filters, kernel, stride, padding, init, network.backend()).ok()?;
    PooledConv::new(conv, activation, isa)
}

#[cfg(test)]
mod tests {
    use ndarray::{ArrayView1, ArrayView4};
    use steersman_kernels::Isa;

    use super::super::training::{GROUP_LIMITS, GroupLimits};
    use super::super::{Parameters, StepInput, TrainingPlan};
    use super::*;
    use crate::engine::loss::Loss;
    use crate::engine::random::{Purpose, rng, uniform};
    use crate::engine::tensor::Shape;

    #[derive(serde::Deserialize)]
    struct Layers {
        layers: Vec<LayerSpec>,
    }

    fn layer_by_layer(network: &Network) -> Vec<FusedStage> {
        let computes = (0..network.layers().len()).filter(|&layer| !network.layers()[layer].layer.is_view());
        let stage = |(index, layer): (usize, usize)| FusedStage {
            layers: layer..layer + 1,
            kind: Kind::Layer,
            source: index.checked_sub(1),
        };
        computes.enumerate().map(stage).collect()
    }

    /// Loss, gradient and parameters after a step.
    fn step(
        network: &Network,
        stages: Vec<FusedStage>,
        images: usize,
        limits: GroupLimits,
    ) -> (f64, Vec<f32>, Parameters) {
        let mut random = rng(3, Purpose::Test, 0, 0);
        let mut draw = |len: usize| (0..len).map(|_| uniform(&mut random, -1.0, 1.0) as f32).collect::<Vec<f32>>();
        let (x, labels) = (draw(images * network.input().len()), draw(images));
        let mut parameters = network.initialize(1);
        // Off their first values, so that slopes are not 0 and scales not 1.
        parameters.values.iter_mut().zip(draw(network.count(true))).for_each(|(p, d)| *p += 0.2 * d);
        parameters.statistics.iter_mut().zip(draw(network.count(false))).for_each(|(p, d)| *p += 0.2 * d);
        let mut plan = TrainingPlan::with_stages(network, images, stages, limits);
        let x = ArrayView4::from_shape(network.input().batch(images), &x).unwrap();
        let input = StepInput { x, labels: ArrayView1::from(&labels), seed: 1, step: 0 };
        let loss = plan.step(network, &mut parameters, &Loss::default(), input);
        (loss, plan.gradient().to_vec(), parameters)
    }

    #[test]
    fn stages_compute_what_their_layers_do() {
        let conv = "{ kind = 'conv2d', filters = 5, kernel = [3, 3] }";
        let cases = [
            (
                2,
                format!(
                    "{conv}, {{ kind = 'batch_norm' }}, {{ kind = 'relu' }}, {conv}, {{ kind = 'batch_norm' }}, {{ kind = 'prelu' }}, {{ kind = 'max_pool', window = [2, 2] }}, {{ kind = 'flatten' }}, {{ kind = 'dense', units = 1 }}"
                ),
            ),
            (
                2,
                format!(
                    "{conv}, {{ kind = 'batch_norm' }}, {{ kind = 'prelu', slopes = 'per_channel' }}, {{ kind = 'max_pool', window = [2, 2] }}, {{ kind = 'dropout', drop_probability = 0.3 }}, {{ kind = 'dense', units = 7 }}, {{ kind = 'batch_norm' }}, {{ kind = 'prelu' }}, {{ kind = 'dense', units = 1 }}"
                ),
            ),
            (
                2,
                format!(
                    "{conv}, {{ kind = 'elu' }}, {{ kind = 'max_pool', window = [4, 4] }}, {conv}, {{ kind = 'relu' }}, {{ kind = 'max_pool', window = [4, 4] }}, {{ kind = 'dense', units = 1 }}"
                ),
            ),
            (
                1,
                format!(
                    "{{ kind = 'batch_norm' }}, {{ kind = 'relu' }}, {conv}, {{ kind = 'batch_norm' }}, {{ kind = 'relu' }}, {{ kind = 'max_pool', window = [3, 3] }}, {{ kind = 'dense', units = 1 }}"
                ),
            ),
            (
                2,
                format!(
                    "{{ kind = 'blur', padding = [1, 1] }}, {conv}, {{ kind = 'batch_norm' }}, {{ kind = 'relu' }}, {{ kind = 'blur', padding = [1, 1] }}, {{ kind = 'conv2d', filters = 4, kernel = [3, 3], stride = [2, 2] }}, {{ kind = 'batch_norm' }}, {{ kind = 'relu' }}, {{ kind = 'blur' }}, {{ kind = 'dense', units = 1 }}"
                ),
            ),
        ];
        for (fused, layers) in cases {
            let specs = toml::from_str::<Layers>(&format!("layers = [{layers}]")).unwrap().layers;
            for isa in Isa::available() {
                let fresh = || Network::new(Shape::new(2, 29, 31), &specs, isa).unwrap();
                let network = fresh();
                assert_eq!(stages(&network).iter().filter(|stage| stage.layers.len() > 1).count(), fused, "{layers}");
                agrees(&network, &format!("{layers} on {}", isa.name()));
                agrees_in_groups(&network, &format!("{layers} in groups on {}", isa.name()));
                for frozen in [&["conv1"][..], &["bn1"], &["conv1", "bn1"], &["conv2"]] {
                    let names: Vec<String> = frozen.iter().map(|name| name.to_string()).collect();
                    let mut network = fresh();
                    if names.iter().all(|name| network.layers().iter().any(|layer| layer.name == *name)) {
                        network.freeze(&names).unwrap();
                        agrees(&network, &format!("{layers} with {frozen:?} frozen on {}", isa.name()));
                    }
                }
            }
        }
    }

    /// The stages of `network` make the same step as its layers one by one.
    fn agrees(network: &Network, what: &str) {
        let stages_step = step(network, stages(network), 19, GROUP_LIMITS);
        same(network, what, stages_step, step(network, layer_by_layer(network), 19, GROUP_LIMITS));
    }

    /// Shards of 4 images make the same step with 1 or 2 images at a time as with all.
    fn agrees_in_groups(network: &Network, what: &str) {
        let all = GroupLimits { segment_numbers: usize::MAX, group_numbers: usize::MAX, min_group: 4 };
        let whole = step(network, stages(network), 80, all);
        for images in [1, 2] {
            let numbers = |limit: usize| images * limit;
            let widest = stages(network).iter().map(|stage| stage.input_len(network) + stage.output_len(network)).max();
            let limits =
                GroupLimits { segment_numbers: numbers(widest.unwrap_or(1)), group_numbers: 1, min_group: images };
            same(network, what, step(network, stages(network), 80, limits), whole.clone());
        }
    }

    type Step = (f64, Vec<f32>, Parameters);

    fn same(network: &Network, what: &str, step: Step, plain: Step) {
        let (loss, gradient, parameters) = step;
        let (plain_loss, plain_gradient, plain_parameters) = plain;
        approx::assert_relative_eq!(loss, plain_loss, max_relative = 1e-5);
        let squares = |range: Range<usize>| plain_gradient[range].iter().map(|g| g * g).sum::<f32>();
        for tensor in network.tensors().iter().filter(|tensor| tensor.trainable && !tensor.frozen) {
            let pairs = gradient[tensor.range.clone()].iter().zip(&plain_gradient[tensor.range.clone()]);
            let distance: f32 = pairs.map(|(a, b)| (a - b).powi(2)).sum();
            // Batch norm takes the mean away, so a bias before it has no gradient but rounding: that of a map behind a blur was just above
            // the bound with a floor of 1e-6.
            let size = squares(tensor.range.clone()).max(1e-5 * squares(0..plain_gradient.len()));
            let error = (distance / size).sqrt();
            assert!(error < 2e-4, "{}: {error:e} in {what}", tensor.name);
        }
        let statistics = parameters.statistics.iter().zip(&plain_parameters.statistics);
        statistics.for_each(|(a, b)| approx::assert_relative_eq!(*a, *b, max_relative = 1e-5, epsilon = 1e-6));
    }
}
