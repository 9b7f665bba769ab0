//! Evaluation: running statistics, no dropout, parameters shared and unchanged.

use std::ops::Range;

use ndarray::{Array2, ArrayView4};
use rayon::prelude::*;

use super::stages::{Kind, Stage, stages};
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
    stages: Vec<Stage>,
    /// How many stages there are before the first dense layer.
    maps: usize,
    /// What [`prepare`](InferencePlan::prepare) made of the parameters of each stage; empty where there is nothing to.
    prepared: Vec<Vec<f32>>,
    is_prepared: bool,
    workers: Vec<Worker>,
    capacity: usize,
    /// Gets the time of all workers.
    time: Stopwatch,
}

#[derive(Clone, Debug)]
struct Worker {
    /// Input and output of a stage for one image.
    image: [Vec<f32>; 2],
    /// What goes into the first dense layer.
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
        let is_dense = |stage: &Stage| network.layers()[stage.layers.start].spec.family() == Family::Dense;
        let maps = stages.iter().position(is_dense).unwrap_or(stages.len());
        let largest = |stages: &[Stage]| stages.iter().map(|stage| stage.output_len(network)).max().unwrap_or(0);
        let between = stages[..maps].last().map_or(0, |stage| stage.output_len(network));
        let (image, after) = (largest(&stages[..maps]), group * largest(&stages[maps..]));
        let scratch = stages.iter().map(|stage| stage.scratch_len(network, group)).max().unwrap_or(0);
        let worker = || Worker {
            image: [vec![0.0; image], vec![0.0; image]],
            rows: vec![0.0; group * between],
            group: [vec![0.0; after], vec![0.0; after]],
            scratch: vec![0.0; scratch],
        };
        let prepared_len = |stage: &Stage| stage.packing(network).map_or(0, |packing| packing.packed_len());
        InferencePlan {
            prepared: stages.iter().map(|stage| vec![0.0; prepared_len(stage)]).collect(),
            is_prepared: false,
            workers: (0..capacity.div_ceil(group)).map(|_| worker()).collect(),
            stages,
            maps,
            capacity,
            time: Stopwatch::default(),
        }
    }

    /// Adds the time that workers take from now on to `time`.
    pub fn measure(&mut self, time: Stopwatch) {
        self.time = time;
    }

    /// Runs the network on `x`, `[n][c][h][w]`, and fills `y`, `[n][outputs]`. An image's output does not depend on the
    /// others.
    ///
    /// # Panics
    ///
    /// Panics if the batch is larger than planned or the lengths do not fit the network.
    pub fn run(&mut self, network: &Network, parameters: &Parameters, x: &[f32], y: &mut [f32]) {
        self.prepare(network, parameters);
        self.run_prepared(network, parameters, x, y);
    }

    /// Puts the parameters in the order in which they are read: once, before many calls of
    /// [`run_prepared`](InferencePlan::run_prepared) with few images each.
    pub fn prepare(&mut self, network: &Network, parameters: &Parameters) {
        for (stage, to) in self.stages.iter().zip(&mut self.prepared) {
            if let Some(packing) = stage.packing(network) {
                packing.pack(&parameters.values[stage.params(network)], to);
            }
        }
        self.is_prepared = true;
    }

    /// As [`run`](InferencePlan::run), with the parameters that [`prepare`](InferencePlan::prepare) has last been given.
    ///
    /// # Panics
    ///
    /// As [`run`](InferencePlan::run), and if [`prepare`](InferencePlan::prepare) has not been called: all weights would be 0.
    pub fn run_prepared(&mut self, network: &Network, parameters: &Parameters, x: &[f32], y: &mut [f32]) {
        assert!(self.is_prepared, "run_prepared before prepare");
        let (input, output) = (network.input().len(), network.output().len());
        let n = x.len() / input;
        assert!(n <= self.capacity, "a batch of {n} images in a plan for {}", self.capacity);
        assert_eq!((x.len(), y.len()), (n * input, n * output));
        let InferencePlan { stages, maps, prepared, workers, time, .. } = self;
        let run = Run { network, parameters, stages, maps: *maps, prepared };
        if n <= GROUP {
            for ((x, y), worker) in x.chunks(GROUP * input).zip(y.chunks_mut(GROUP * output)).zip(workers) {
                time.time(|| run.group(worker, x, y));
            }
        } else {
            x.par_chunks(GROUP * input)
                .zip(y.par_chunks_mut(GROUP * output))
                .zip(workers)
                .for_each(|((x, y), worker)| time.time(|| run.group(worker, x, y)));
        }
    }
}

/// What all workers share.
#[derive(Clone, Copy)]
struct Run<'a> {
    network: &'a Network,
    parameters: &'a Parameters,
    stages: &'a [Stage],
    maps: usize,
    prepared: &'a [Vec<f32>],
}

impl Run<'_> {
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
                Some(layer) => layer.infer_packed(&self.prepared[index], n, x, y, scratch),
                None => first.layer.infer(params, statistics, n, x, y, scratch),
            },
            Kind::NormRectify(fused) => fused.infer(params, statistics, n, x, y, scratch),
            Kind::PooledConv(fused) => fused.infer_packed(&self.prepared[index], n, x, y, scratch),
        }
    }
}

impl Network {
    /// Runs the network on images `[n, c, h, w]`; the result is `[n, outputs]`. Plans its buffers anew: for one-off use.
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
        let x = x.as_slice().expect("standard layout is contiguous");
        let mut y = Array2::zeros((n, self.output().len()));
        let y_slice = y.as_slice_mut().expect("a fresh array is contiguous");
        InferencePlan::new(self, n).run(self, parameters, x, y_slice);
        Ok(y)
    }
}

#[cfg(test)]
mod tests {
    use steersman_kernels::Isa;

    use super::super::{LayerSpec, NamedLayer};
    use super::*;

    #[derive(serde::Deserialize)]
    struct Layers {
        layers: Vec<LayerSpec>,
    }

    fn network(layers: &str, isa: Isa) -> Network {
        let specs = toml::from_str::<Layers>(&format!("layers = [{layers}]")).unwrap().layers;
        Network::new(Shape::new(2, 21, 19), &specs, isa).unwrap()
    }

    #[test]
    #[should_panic(expected = "run_prepared before prepare")]
    fn a_plan_without_weights_does_not_run() {
        let network = network("{ kind = 'dense', units = 1 }", Isa::PORTABLE);
        let parameters = network.initialize(1);
        let x = vec![0.0; network.input().len()];
        InferencePlan::new(&network, 1).run_prepared(&network, &parameters, &x, &mut [0.0]);
    }

    /// Convolution, activation and pooling as one, with weights that are prepared once: the bits of layer by layer.
    #[test]
    fn prepared_weights_of_a_pooled_convolution_change_no_bit() {
        let conv = "{ kind = 'conv2d', filters = 5, kernel = [3, 3] }";
        for activation in ["relu", "elu"] {
            let layers = format!(
                "{conv}, {{ kind = '{activation}' }}, {{ kind = 'max_pool', window = [4, 4] }}, {{ kind = 'dense', units = 1 }}"
            );
            for isa in Isa::available() {
                let network = network(&layers, isa);
                let parameters = network.initialize(2);
                let mut plan = InferencePlan::new(&network, 3);
                assert!(matches!(plan.stages[0].kind, Kind::PooledConv(_)));
                plan.prepare(&network, &parameters);
                let len = network.input().len();
                for seed in 0..3 {
                    let x: Vec<f32> = (0..3 * len).map(|i| ((i * 37 + seed * 11) % 101) as f32 / 50.0 - 1.0).collect();
                    let mut y = [0.0; 3];
                    plan.run_prepared(&network, &parameters, &x, &mut y);
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
