//! Evaluation: running statistics, no dropout, parameters shared and unchanged.

use std::ops::Range;

use ndarray::{Array2, ArrayView4, ArrayViewMut1};
use rayon::prelude::*;

use super::fused::{FusedStage, Kind, stages};
use super::{Network, Parameters};
use crate::engine::layers::{Family, Packing};
use crate::engine::stopwatch::Stopwatch;
use crate::engine::tensor::Shape;
use crate::error::{Error, Result};

/// Images that a worker takes through the dense layers at a time.
const GROUP: usize = 8;

/// The buffers of evaluation, planned once for a network and a largest batch.
///
/// Up to the first dense layer a worker takes one image at a time, so that its maps stay in the cache; from there on a
/// group of images, so that the weights are read once for all of them.
#[derive(Clone, Debug)]
pub struct InferencePlan {
    stages: Vec<FusedStage>,
    /// Number of stages before the first dense layer.
    maps: usize,
    /// The packed weights of each stage; empty for stages without any.
    packed: Vec<Vec<f32>>,
    workers: Vec<Worker>,
    capacity: usize,
    /// [`Network::fingerprint`] of the network it was planned for.
    fingerprint: u64,
    /// Gets the time of all workers.
    time: Stopwatch,
}

#[derive(Clone, Debug)]
struct Worker {
    /// Input and output of a stage for one image.
    image: [Vec<f32>; 2],
    /// Input of the first dense layer.
    rows: Vec<f32>,
    /// Input and output of a stage for a group.
    group: [Vec<f32>; 2],
    scratch: Vec<f32>,
}

impl InferencePlan {
    /// Buffers for batches of up to `capacity` images. With a capacity of up to 8 everything runs on the calling thread;
    /// larger batches are shared out over the rayon pool.
    pub fn new(network: &Network, capacity: usize) -> InferencePlan {
        let group = capacity.clamp(1, GROUP);
        let stages = stages(network);
        let is_dense = |stage: &FusedStage| network.layers()[stage.layers.start].spec.family() == Family::Dense;
        let maps = stages.iter().position(is_dense).unwrap_or(stages.len());
        let largest = |stages: &[FusedStage]| stages.iter().map(|stage| stage.output_len(network)).max().unwrap_or(0);
        let between = stages[..maps].last().map_or(0, |stage| stage.output_len(network));
        let (image, after) = (largest(&stages[..maps]), group * largest(&stages[maps..]));
        let scratch = stages.iter().map(|stage| stage.scratch_len(network, group)).max().unwrap_or(0);
        let worker = || Worker {
            image: [vec![0.0; image], vec![0.0; image]],
            rows: vec![0.0; group * between],
            group: [vec![0.0; after], vec![0.0; after]],
            scratch: vec![0.0; scratch],
        };
        let packed_len = |stage: &FusedStage| stage.packing(network).map_or(0, |packing| packing.packed_len());
        InferencePlan {
            packed: stages.iter().map(|stage| vec![0.0; packed_len(stage)]).collect(),
            workers: (0..capacity.div_ceil(group)).map(|_| worker()).collect(),
            stages,
            maps,
            capacity,
            fingerprint: network.fingerprint(),
            time: Stopwatch::default(),
        }
    }

    /// Adds the time that workers take from now on to `time`.
    pub fn measure(&mut self, time: Stopwatch) {
        self.time = time;
    }

    /// Runs the network on `x`, `(n, c, h, w)`, and fills `y`, `(n · outputs)`, image by image. An image's output does not
    /// depend on the others. Packs the weights first: for parameters that stay the same, a [`Predictor`](super::Predictor) does
    /// so once. Allocates nothing.
    ///
    /// # Panics
    ///
    /// Panics if `network` differs from the one the plan was made for, if `parameters` are not those of such a network, or if
    /// the batch is larger than planned, of the wrong shape or not in standard order.
    pub fn run(&mut self, network: &Network, parameters: &Parameters, x: ArrayView4<f32>, y: ArrayViewMut1<f32>) {
        self.pack(network, parameters);
        self.run_packed(network, parameters, x, y);
    }

    /// Packs the weights of `parameters`.
    pub(super) fn pack(&mut self, network: &Network, parameters: &Parameters) {
        assert_eq!(self.fingerprint, network.fingerprint(), "an inference plan for another network");
        network.check_parameters(parameters);
        for (stage, to) in self.stages.iter().zip(&mut self.packed) {
            if let Some(packing) = stage.packing(network) {
                packing.pack(&parameters.values[stage.params(network)], to);
            }
        }
    }

    /// [`run`](InferencePlan::run) with the weights that are packed already: those of `parameters`, for which the caller answers.
    pub(super) fn run_packed(
        &mut self,
        network: &Network,
        parameters: &Parameters,
        x: ArrayView4<f32>,
        mut y: ArrayViewMut1<f32>,
    ) {
        let (input, output) = (network.input().len(), network.output().len());
        let x = network.image_slice(x);
        let n = x.len() / input;
        assert!(n <= self.capacity, "a batch of {n} images in a plan for {}", self.capacity);
        let y = y.as_slice_mut().expect("predictions must be contiguous");
        assert_eq!(y.len(), n * output, "predictions of a batch of {n} images");
        let InferencePlan { stages, maps, packed, workers, time, .. } = self;
        let context = InferenceContext { network, parameters, stages, maps: *maps, packed };
        if n <= GROUP {
            for ((x, y), worker) in x.chunks(GROUP * input).zip(y.chunks_mut(GROUP * output)).zip(workers) {
                time.time(|| context.group(worker, x, y));
            }
        } else {
            x.par_chunks(GROUP * input)
                .zip(y.par_chunks_mut(GROUP * output))
                .zip(workers)
                .for_each(|((x, y), worker)| time.time(|| context.group(worker, x, y)));
        }
    }
}

/// What all workers of an evaluation share.
#[derive(Clone, Copy)]
struct InferenceContext<'a> {
    network: &'a Network,
    parameters: &'a Parameters,
    stages: &'a [FusedStage],
    maps: usize,
    packed: &'a [Vec<f32>],
}

impl InferenceContext<'_> {
    fn group(&self, worker: &mut Worker, x: &[f32], y: &mut [f32]) {
        let Worker { image, rows, group, scratch } = worker;
        let input = self.network.input().len();
        let n = x.len() / input;
        let mut x = x;
        if let Some(last) = self.stages[..self.maps].last() {
            let rows = &mut rows[..n * last.output_len(self.network)];
            for (x, row) in x.chunks_exact(input).zip(rows.chunks_exact_mut(last.output_len(self.network))) {
                row.copy_from_slice(self.run(0..self.maps, 1, x, image, scratch));
            }
            x = rows;
        }
        y.copy_from_slice(self.run(self.maps..self.stages.len(), n, x, group, scratch));
    }

    /// The output of the last of `stages` for `n` images, which lies in one of the buffers; of no stages, `x`.
    fn run<'b>(
        &self,
        stages: Range<usize>,
        n: usize,
        x: &'b [f32],
        buffers: &'b mut [Vec<f32>; 2],
        scratch: &mut [f32],
    ) -> &'b [f32] {
        let [current, next] = buffers;
        let mut len = None;
        for index in stages {
            let stage = &self.stages[index];
            let input = len.map_or(x, |len| &current[..len]);
            let output = n * stage.output_len(self.network);
            self.stage(index, n, input, &mut next[..output], scratch);
            std::mem::swap(current, next);
            len = Some(output);
        }
        len.map_or(x, |len| &current[..len])
    }

    fn stage(&self, index: usize, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        let stage = &self.stages[index];
        let first = &self.network.layers()[stage.layers.start];
        let params = &self.parameters.values[stage.params(self.network)];
        let statistics = &self.parameters.statistics[first.statistics.clone()];
        match &stage.kind {
            Kind::Layer => match first.layer.packing() {
                Some(layer) => layer.infer_packed(&self.packed[index], n, x, y, scratch),
                None => first.layer.infer(params, statistics, n, x, y, scratch),
            },
            Kind::NormRectify(fused) => fused.infer(params, statistics, n, x, y, scratch),
            Kind::PooledConv(fused) => fused.infer_packed(&self.packed[index], n, x, y, scratch),
        }
    }
}

impl Network {
    /// The outputs, `(n, outputs)`, of `images`, `(n, c, h, w)` in any memory layout. Plans its buffers anew: for a single call.
    ///
    /// # Errors
    ///
    /// [`Error::Input`] if the images have another shape than the network's input.
    pub fn predict(&self, parameters: &Parameters, images: ArrayView4<f32>) -> Result<Array2<f32>> {
        let (n, c, h, w) = images.dim();
        if Shape::new(c, h, w) != self.input() {
            return Err(Error::Input(format!(
                "the network takes images of {}, not of {}",
                self.input(),
                Shape::new(c, h, w)
            )));
        }
        let x = images.as_standard_layout();
        let mut y = Array2::zeros((n, self.output().len()));
        let flat = y.view_mut().into_shape_with_order(n * self.output().len()).expect("a fresh array is contiguous");
        InferencePlan::new(self, n).run(self, parameters, x.view(), flat);
        Ok(y)
    }
}

#[cfg(test)]
pub(super) mod testing {
    use steersman_kernels::Isa;

    use super::super::LayerSpec;
    use super::*;

    #[derive(serde::Deserialize)]
    struct Layers {
        layers: Vec<LayerSpec>,
    }

    /// A network of `layers`, as in a recipe, over images of 2 channels, 21 rows and 19 columns.
    pub fn network(layers: &str, isa: Isa) -> Network {
        let specs = toml::from_str::<Layers>(&format!("layers = [{layers}]")).unwrap().layers;
        Network::new(Shape::new(2, 21, 19), &specs, isa).unwrap()
    }
}

#[cfg(test)]
mod tests {
    use ndarray::{Array1, Array4};
    use steersman_kernels::Isa;

    use super::super::{NamedLayer, Predictor};
    use super::testing::network;
    use super::*;

    /// A convolution and an activation fill the same buffers with other options: only the fingerprint tells them apart.
    #[test]
    #[should_panic(expected = "an inference plan for another network")]
    fn a_plan_refuses_another_network_of_the_same_sizes() {
        let layers = |alpha: f32| format!("{{ kind = 'elu', alpha = {alpha:?} }}, {{ kind = 'dense', units = 1 }}");
        let (planned, other) = (network(&layers(1.0), Isa::PORTABLE), network(&layers(0.5), Isa::PORTABLE));
        let x = Array4::zeros(other.input().batch(1));
        let mut y = Array1::zeros(1);
        InferencePlan::new(&planned, 1).run(&other, &other.initialize(1), x.view(), y.view_mut());
    }

    #[test]
    fn images_in_another_memory_order_are_predicted_alike() {
        let network = network("{ kind = 'relu' }, { kind = 'dense', units = 1 }", Isa::PORTABLE);
        let parameters = network.initialize(1);
        let x = Array4::from_shape_fn(network.input().batch(2), |(n, c, h, w)| (n + 2 * c + 3 * h + 5 * w) as f32);
        let columns_first = x.view().reversed_axes().as_standard_layout().into_owned();
        let same = columns_first.view().reversed_axes();
        assert!(!same.is_standard_layout());
        assert_eq!(network.predict(&parameters, same).unwrap(), network.predict(&parameters, x.view()).unwrap());
    }

    /// Convolution, activation and pooling as one, with weights that are packed once: the bits of layer by layer.
    #[test]
    fn packed_weights_of_a_pooled_convolution_change_no_bit() {
        let conv = "{ kind = 'conv2d', filters = 5, kernel = [3, 3] }";
        for activation in ["relu", "elu"] {
            let layers = format!(
                "{conv}, {{ kind = '{activation}' }}, {{ kind = 'max_pool', window = [4, 4] }}, {{ kind = 'dense', units = 1 }}"
            );
            for isa in Isa::available() {
                let network = network(&layers, isa);
                let parameters = network.initialize(2);
                assert!(matches!(stages(&network)[0].kind, Kind::PooledConv(_)));
                let mut predictor = Predictor::new(super::testing::network(&layers, isa), parameters.clone(), 3);
                let len = network.input().len();
                for seed in 0..3 {
                    let x: Vec<f32> = (0..3 * len).map(|i| ((i * 37 + seed * 11) % 101) as f32 / 50.0 - 1.0).collect();
                    let mut y = Array1::zeros(3);
                    let images = ArrayView4::from_shape(network.input().batch(3), &x).unwrap();
                    predictor.run(images, y.view_mut());
                    for (x, y) in x.chunks_exact(len).zip(y) {
                        let mut maps = x.to_vec();
                        for NamedLayer { layer, params, .. } in network.layers() {
                            let mut next = vec![0.0; layer.output().len()];
                            let mut scratch = vec![0.0; layer.scratch_len(1)];
                            layer.infer(&parameters.values[params.clone()], &[], 1, &maps, &mut next, &mut scratch);
                            maps = next;
                        }
                        assert_eq!(maps[0].to_bits(), y.to_bits(), "{activation} on {}", isa.name());
                    }
                }
            }
        }
    }
}
