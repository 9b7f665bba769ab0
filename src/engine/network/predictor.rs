//! Evaluation with parameters that stay the same.

use std::sync::Arc;

use ndarray::{ArrayView4, ArrayViewMut1};

use super::{InferencePlan, Network, Parameters};

/// A trained network that answers many calls: it owns its parameters and packs their weights once.
///
/// Nobody can change the parameters behind the packed weights, so a prediction never mixes old weights with new ones; new
/// parameters take a new predictor. Clones share network and parameters and have buffers of their own: one for each thread.
#[derive(Clone, Debug)]
pub struct Predictor {
    model: Arc<(Network, Parameters)>,
    plan: InferencePlan,
}

impl Predictor {
    /// Packs the weights of `parameters` and plans buffers for batches of up to `capacity` images.
    ///
    /// # Panics
    ///
    /// Panics if `parameters` are not those of a network like `network`.
    pub fn new(network: Network, parameters: Parameters, capacity: usize) -> Predictor {
        let mut plan = InferencePlan::new(&network, capacity);
        plan.pack(&network, &parameters);
        Predictor { model: Arc::new((network, parameters)), plan }
    }

    /// The network.
    pub fn network(&self) -> &Network {
        &self.model.0
    }

    /// Its parameters.
    pub fn parameters(&self) -> &Parameters {
        &self.model.1
    }

    /// Runs the network on `x`, `(n, c, h, w)`, and fills `y`, `(n · outputs)`. Allocates nothing. An image's output does not
    /// depend on the others.
    ///
    /// # Panics
    ///
    /// As [`InferencePlan::run`].
    pub fn run(&mut self, x: ArrayView4<f32>, y: ArrayViewMut1<f32>) {
        let Predictor { model, plan } = self;
        plan.run_packed(&model.0, &model.1, x, y);
    }
}

#[cfg(test)]
mod tests {
    use ndarray::{Array1, Array4};
    use steersman_kernels::Isa;

    use super::*;
    use crate::engine::network::inference::testing::network;

    #[test]
    fn packed_weights_are_those_of_one_set_of_parameters_and_give_the_bits_of_packing_anew() {
        let layers =
            "{ kind = 'conv2d', filters = 5, kernel = [3, 3] }, { kind = 'relu' }, { kind = 'dense', units = 1 }";
        let build = || network(layers, Isa::best());
        let (old, new) = (build().initialize(1), build().initialize(2));
        let x =
            Array4::from_shape_fn(build().input().batch(3), |(n, c, h, w)| ((n * 7 + c * 5 + h * 3 + w) % 11) as f32);
        let mut plan = InferencePlan::new(&build(), 3);
        let mut expected = |parameters: &Parameters| {
            let mut y = Array1::zeros(3);
            plan.run(&build(), parameters, x.view(), y.view_mut());
            y
        };
        let mut predictor = Predictor::new(build(), old.clone(), 3);
        // Another predictor, and a clone of the first, with other weights in between: nobody's packed weights change.
        let mut other = Predictor::new(build(), new.clone(), 3);
        let answer = |predictor: &mut Predictor| {
            let mut y = Array1::zeros(3);
            predictor.run(x.view(), y.view_mut());
            y
        };
        let mut clone = predictor.clone();
        assert_eq!(answer(&mut predictor), expected(&old));
        assert_eq!(answer(&mut other), expected(&new));
        assert_eq!(answer(&mut clone), expected(&old));
        assert_ne!(expected(&old), expected(&new));
    }
}
