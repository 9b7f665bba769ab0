//! Evaluation: running statistics, no dropout, parameters shared and unchanged.

use ndarray::{Array2, ArrayView4};
use rayon::prelude::*;

use super::{Network, Parameters};
use crate::error::{Error, Result};
use crate::tensor::Shape;

/// Images that a worker takes through all layers at a time.
const GROUP: usize = 8;

/// The buffers of evaluation, planned once for a network and a largest batch.
#[derive(Clone, Debug)]
pub struct InferencePlan {
    workers: Vec<Worker>,
    capacity: usize,
}

#[derive(Clone, Debug)]
struct Worker {
    buffers: [Vec<f32>; 2],
    scratch: Vec<f32>,
}

impl InferencePlan {
    /// Buffers for batches of up to `capacity` images. With a capacity of up to 8 everything runs on the calling thread;
    /// larger batches are shared out over the rayon pool.
    pub fn new(network: &Network, capacity: usize) -> InferencePlan {
        let group = capacity.clamp(1, GROUP);
        let largest = network.layers().iter().map(|l| l.layer.output().len()).max().unwrap_or(0);
        let scratch = network.layers().iter().map(|l| l.layer.scratch_len(group)).max().unwrap_or(0);
        let worker = || Worker {
            buffers: [vec![0.0; group * largest], vec![0.0; group * largest]],
            scratch: vec![0.0; scratch],
        };
        InferencePlan { workers: (0..capacity.div_ceil(group)).map(|_| worker()).collect(), capacity }
    }

    /// Runs the network on `x`, `[n][c][h][w]`, and fills `y`, `[n][outputs]`. An image's output does not depend on the
    /// others.
    ///
    /// # Panics
    ///
    /// Panics if the batch is larger than planned or the lengths do not fit the network.
    pub fn run(&mut self, network: &Network, parameters: &Parameters, x: &[f32], y: &mut [f32]) {
        let (input, output) = (network.input().len(), network.output().len());
        let n = x.len() / input;
        assert!(n <= self.capacity, "a batch of {n} images in a plan for {}", self.capacity);
        assert_eq!((x.len(), y.len()), (n * input, n * output));
        let groups = x.chunks(GROUP * input).zip(y.chunks_mut(GROUP * output)).zip(&mut self.workers);
        if n <= GROUP {
            for ((x, y), worker) in groups {
                worker.run(network, parameters, x, y, &mut |_, _| ());
            }
        } else {
            x.par_chunks(GROUP * input)
                .zip(y.par_chunks_mut(GROUP * output))
                .zip(&mut self.workers)
                .for_each(|((x, y), worker)| worker.run(network, parameters, x, y, &mut |_, _| ()));
        }
    }

    /// As [`run`](Self::run) for one image, telling `seen` the place and the output of each layer that computes something.
    ///
    /// # Panics
    ///
    /// As [`run`](Self::run); also for more than one image.
    pub fn run_observed(
        &mut self,
        network: &Network,
        parameters: &Parameters,
        x: &[f32],
        y: &mut [f32],
        seen: &mut dyn FnMut(usize, &[f32]),
    ) {
        assert_eq!((x.len(), y.len()), (network.input().len(), network.output().len()), "one image");
        self.workers[0].run(network, parameters, x, y, seen);
    }
}

impl Worker {
    fn run(
        &mut self,
        network: &Network,
        parameters: &Parameters,
        x: &[f32],
        y: &mut [f32],
        seen: &mut dyn FnMut(usize, &[f32]),
    ) {
        let n = x.len() / network.input().len();
        let [current, next] = &mut self.buffers;
        let mut in_buffer = false;
        for (index, named) in network.layers().iter().enumerate() {
            let layer = &named.layer;
            if layer.is_view() {
                continue;
            }
            let input = if in_buffer { &current[..n * layer.input().len()] } else { x };
            let params = &parameters.values[named.params.clone()];
            let statistics = &parameters.statistics[named.statistics.clone()];
            let output = &mut next[..n * layer.output().len()];
            layer.infer(params, statistics, n, input, output, &mut self.scratch);
            seen(index, output);
            std::mem::swap(current, next);
            in_buffer = true;
        }
        y.copy_from_slice(if in_buffer { &current[..y.len()] } else { x });
    }
}

impl Network {
    /// Runs the network on images `[n, c, h, w]`; the result is `[n, outputs]`. Plans its buffers anew: for one-off use.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] if the images have another shape than the network's input.
    pub fn predict(&self, parameters: &Parameters, images: ArrayView4<f32>) -> Result<Array2<f32>> {
        let (n, c, h, w) = images.dim();
        if Shape::new(c, h, w) != self.input() {
            return Err(Error::Usage(format!(
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
