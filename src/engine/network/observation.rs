//! Evaluation of one image layer by layer, for whoever looks at the output of each layer.

use super::{Network, Parameters};

/// The buffers of an evaluation that shows the output of every layer. [`InferencePlan`](super::InferencePlan), which runs
/// neighbouring layers as one, is faster and sees only the last.
#[derive(Clone, Debug)]
pub struct ObservationPlan {
    /// Input and output of a layer.
    buffers: [Vec<f32>; 2],
    scratch: Vec<f32>,
}

impl ObservationPlan {
    /// Buffers for one image at a time.
    pub fn new(network: &Network) -> ObservationPlan {
        let layers = network.layers();
        let largest = layers.iter().map(|l| l.layer.output().len()).max().unwrap_or(0);
        let scratch = layers.iter().map(|l| l.layer.scratch_len(1)).max().unwrap_or(0);
        ObservationPlan { buffers: [vec![0.0; largest], vec![0.0; largest]], scratch: vec![0.0; scratch] }
    }

    /// Runs the network on the image `x`, `[c][h][w]`, fills `y`, `[outputs]`, and calls `seen` with the index in
    /// [`Network::layers`] and the output of each layer that computes something.
    ///
    /// # Panics
    ///
    /// Panics if the lengths do not fit the network.
    pub fn run(
        &mut self,
        network: &Network,
        parameters: &Parameters,
        x: &[f32],
        y: &mut [f32],
        seen: &mut dyn FnMut(usize, &[f32]),
    ) {
        assert_eq!((x.len(), y.len()), (network.input().len(), network.output().len()), "one image");
        let [current, next] = &mut self.buffers;
        let mut in_buffer = false;
        for (index, named) in network.layers().iter().enumerate() {
            let layer = &named.layer;
            if layer.is_view() {
                continue;
            }
            let input = if in_buffer { &current[..layer.input().len()] } else { x };
            let params = &parameters.values[named.params.clone()];
            let statistics = &parameters.statistics[named.statistics.clone()];
            let output = &mut next[..layer.output().len()];
            layer.infer(params, statistics, 1, input, output, &mut self.scratch);
            seen(index, output);
            std::mem::swap(current, next);
            in_buffer = true;
        }
        y.copy_from_slice(if in_buffer { &current[..y.len()] } else { x });
    }
}
