//! Networks of recipes with random images, to be planned and trained.

use ndarray::ArrayView4;
use steersman::engine::network::Network;
use steersman::engine::optimizer::Optimizer;
use steersman::engine::random::{Purpose, rng, uniform};
use steersman::recipe::Recipe;
use steersman_kernels::conv::ConvAlgorithm;
use steersman_kernels::{Backend, Isa};

/// Recipes, each with a small size of its pictures.
pub const NETWORKS: [(&str, &str); 3] = [("hyper", "[40, 44]"), ("lenet", "[30, 26]"), ("pilotnet", "[61, 65]")];

/// A network with images and labels.
pub struct Setup {
    pub recipe: Recipe,
    pub network: Network,
    pub x: Vec<f32>,
    pub labels: Vec<f32>,
}

impl Setup {
    pub fn new(recipe: &str, size: &str, images: usize) -> Setup {
        Setup::with(recipe, size, images, ConvAlgorithm::Auto)
    }

    pub fn with(recipe: &str, size: &str, images: usize, conv: ConvAlgorithm) -> Setup {
        let recipe = Recipe::find(recipe, &[format!("preprocessing.resize={size}")]).unwrap();
        let network = recipe.network(Backend { isa: Isa::best(), conv }).unwrap();
        let mut random = rng(1, Purpose::Test, 0, 0);
        // Grey levels where the network scales them itself.
        let (low, high) = if recipe.preprocessing.scale == 1.0 { (0.0, 255.0) } else { (-0.5, 0.5) };
        let x = (0..images * network.input().len()).map(|_| uniform(&mut random, low, high) as f32).collect();
        let labels = (0..images).map(|_| uniform(&mut random, -1.0, 1.0) as f32).collect();
        Setup { recipe, network, x, labels }
    }

    pub fn optimizer(&self) -> Optimizer {
        Optimizer::new(self.recipe.optimizer, Some(0.1), self.network.tensors(), self.network.isa())
    }
}

/// The images in `x` as an array.
pub fn images<'a>(network: &Network, x: &'a [f32]) -> ArrayView4<'a, f32> {
    ArrayView4::from_shape(network.input().batch(x.len() / network.input().len()), x).unwrap()
}
