//! What a planned network promises: no allocation in the steady state, the same bits for any number of threads and any
//! capacity of the plan, and an evaluation that changes nothing.

use std::sync::{Mutex, PoisonError};

use ndarray::{Array1, ArrayView1, ArrayView4, Axis};
use planned::{NETWORKS, Setup, images};
use steersman::engine::loss::{Loss, PairTerms, Pairs, Smoothness};
use steersman::engine::network::{InferencePlan, LayerSpec, Network, Parameters, Predictor, StepInput, TrainingPlan};
use steersman::engine::optimizer::{AveragingSpec, Optimizer, WeightAverage};
use steersman::engine::random::{Purpose, rng, uniform};
use steersman::engine::tensor::Shape;
use steersman::recipe::Recipe;
use steersman_kernels::Isa;
use steersman_kernels::conv::ConvAlgorithm;

#[path = "common/planned.rs"]
mod planned;

#[global_allocator]
static ALLOCATOR: dhat::Alloc = dhat::Alloc;

/// Allocations are counted for the whole process: one test at a time.
static ALONE: Mutex<()> = Mutex::new(());

impl Setup {
    /// The same network with ELUs of `alpha` for its activations.
    fn with_elu(self, alpha: f32) -> Setup {
        let text = format!("{{ kind = 'elu', alpha = {alpha:?} }}");
        let elu: LayerSpec =
            toml::from_str::<toml::Table>(&format!("layer = {text}")).unwrap()["layer"].clone().try_into().unwrap();
        let name = elu.base_name();
        let layers: Vec<LayerSpec> = self
            .recipe
            .layers
            .iter()
            .map(|layer| if layer.base_name() == name { elu.clone() } else { layer.clone() })
            .collect();
        assert_ne!(layers.iter().filter(|layer| **layer == elu).count(), 0);
        Setup { network: Network::new(self.network.input(), &layers, Isa::best()).unwrap(), ..self }
    }

    fn images(&self) -> ArrayView4<'_, f32> {
        images(&self.network, &self.x)
    }

    fn step(&self, plan: &mut TrainingPlan, optimizer: &mut Optimizer, parameters: &mut Parameters) -> f64 {
        let input =
            StepInput { x: self.images(), labels: ArrayView1::from(&self.labels), seed: 1, step: optimizer.updates };
        let loss = plan.step(&self.network, parameters, &self.recipe.loss, input);
        let norm = plan.gradient_norm();
        optimizer.step(1e-3, &mut parameters.values, plan.gradient_mut(), norm);
        loss
    }

    /// Losses and weights after three steps in a pool of `threads`, with a plan for `capacity` images.
    fn train(&self, threads: usize, capacity: usize) -> (Vec<f64>, Parameters) {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let (mut plan, mut optimizer) = (TrainingPlan::new(&self.network, capacity), self.optimizer());
            let mut parameters = self.network.initialize(1);
            let losses = (0..3).map(|_| self.step(&mut plan, &mut optimizer, &mut parameters)).collect();
            (losses, parameters)
        })
    }
}

/// Fewest blocks that `work` allocates in five goes: what the threads of the test harness allocate meanwhile counts too.
fn allocations(mut work: impl FnMut()) -> u64 {
    let one_go = |_| {
        let before = dhat::HeapStats::get().total_blocks;
        work();
        dhat::HeapStats::get().total_blocks - before
    };
    (0..5).map(one_go).min().unwrap()
}

#[test]
fn a_training_step_allocates_nothing() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let _profiler = dhat::Profiler::builder().testing().build();
    for (recipe, size) in NETWORKS {
        let setup = Setup::new(recipe, size, 37);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap();
        let allocated = pool.install(|| {
            let (mut plan, mut optimizer) = (TrainingPlan::new(&setup.network, 37), setup.optimizer());
            let mut parameters = setup.network.initialize(1);
            let averaging = AveragingSpec::Ema { decay: 0.9, from_share: 0.0, refit_batches: 0 };
            let mut average = WeightAverage::new(averaging, &parameters, setup.network.isa());
            let mut step = || {
                setup.step(&mut plan, &mut optimizer, &mut parameters);
                average.take_in(&parameters, optimizer.updates, 1000);
            };
            (0..3).for_each(|_| step());
            allocations(|| (0..5).for_each(|_| step()))
        });
        assert_eq!(allocated, 0, "{recipe}");
    }
}

#[test]
fn a_step_by_im2col_allocates_nothing_but_the_packing_buffers_of_matrixmultiply() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let _profiler = dhat::Profiler::builder().testing().build();
    for (recipe, size) in NETWORKS {
        let setup = Setup::with(recipe, size, 9, ConvAlgorithm::Im2col);
        let convolutions = setup.network.layers().iter().filter(|l| matches!(l.spec, LayerSpec::Conv2d { .. })).count();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap();
        let allocated = pool.install(|| {
            let (mut plan, mut optimizer) = (TrainingPlan::new(&setup.network, 9), setup.optimizer());
            let mut parameters = setup.network.initialize(1);
            for _ in 0..3 {
                setup.step(&mut plan, &mut optimizer, &mut parameters);
            }
            allocations(|| {
                setup.step(&mut plan, &mut optimizer, &mut parameters);
            })
        });
        // One for each product of each image: forward and both gradients, without the input gradient of the first layer.
        assert_eq!(allocated, 9 * (3 * convolutions as u64 - 1), "{recipe}");
    }
}

#[test]
fn a_prediction_allocates_nothing() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let _profiler = dhat::Profiler::builder().testing().build();
    for (recipe, size) in NETWORKS {
        let setup = Setup::new(recipe, size, 1);
        let (parameters, mut plan) = (setup.network.initialize(1), InferencePlan::new(&setup.network, 1));
        let mut y = Array1::zeros(1);
        plan.run(&setup.network, &parameters, setup.images(), y.view_mut());
        let allocated = allocations(|| plan.run(&setup.network, &parameters, setup.images(), y.view_mut()));
        assert_eq!(allocated, 0, "{recipe}");
        let mut predictor = Predictor::new(setup.recipe.network(Isa::best()).unwrap(), parameters, 1);
        let allocated = allocations(|| predictor.run(setup.images(), y.view_mut()));
        assert_eq!(allocated, 0, "{recipe} with packed weights");
    }
}

#[test]
fn training_gives_the_same_bits_for_any_number_of_threads_and_any_capacity() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    for (recipe, size) in NETWORKS {
        for images in [1, 3, 16, 29, 37] {
            for conv in [ConvAlgorithm::Auto, ConvAlgorithm::Im2col] {
                let setup = Setup::with(recipe, size, images, conv);
                let one = setup.train(1, images);
                for (threads, capacity) in [(2, images), (5, images), (2, 40), (2, 64)] {
                    let same = one == setup.train(threads, capacity);
                    assert!(same, "{recipe}, {conv}, {images} images, {threads} threads");
                }
            }
        }
    }
}

#[test]
fn a_prediction_does_not_depend_on_the_other_images() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    for (recipe, size) in NETWORKS {
        let setup = Setup::new(recipe, size, 21);
        let parameters = setup.network.initialize(1);
        let (mut together, mut single) = (Array1::from_elem(21, f32::NAN), Array1::from_elem(21, f32::NAN));
        InferencePlan::new(&setup.network, 21).run(&setup.network, &parameters, setup.images(), together.view_mut());
        let mut plan = InferencePlan::new(&setup.network, 1);
        for (x, y) in setup.images().axis_chunks_iter(Axis(0), 1).zip(single.axis_chunks_iter_mut(Axis(0), 1)) {
            plan.run(&setup.network, &parameters, x, y);
        }
        for (a, b) in together.iter().zip(single) {
            approx::assert_relative_eq!(*a, b, max_relative = 1e-4, epsilon = 1e-5);
        }
    }
}

/// The share of the labels' variance that is left after learning, as the mean of the last hundred steps.
fn unexplained_variance(setup: &Setup, network: &Network, seed: u64) -> f64 {
    let mut plan = TrainingPlan::new(network, 8);
    let mut optimizer = Optimizer::new(setup.recipe.optimizer, None, network.tensors(), network.isa());
    let mut parameters = network.initialize(seed);
    let losses: Vec<f64> = (0..1000)
        .map(|_| {
            let labels = ArrayView1::from(&setup.labels);
            let input = StepInput { x: setup.images(), labels, seed, step: optimizer.updates };
            let loss = plan.step(network, &mut parameters, &Loss::default(), input);
            let norm = plan.gradient_norm();
            optimizer.step(1e-3, &mut parameters.values, plan.gradient_mut(), norm);
            loss
        })
        .collect();
    let mean = setup.labels.iter().map(|label| f64::from(*label)).sum::<f64>() / 8.0;
    let variance = setup.labels.iter().map(|label| (f64::from(*label) - mean).powi(2)).sum::<f64>() / 8.0;
    losses[900..].iter().sum::<f64>() / 100.0 / variance
}

/// The best prediction that looks at no image is the mean of the labels: it leaves all of their variance. A network that
/// leaves less than a tenth tells the images apart. Every instruction set leaves less than a thousandth, so rounding cannot
/// decide; three seeds leave nothing to a lucky draw.
#[test]
fn a_network_can_learn_eight_images_by_heart() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    for (recipe, size) in NETWORKS {
        let setup = Setup::new(recipe, size, 8);
        // Dropout is there to prevent just this.
        let layers: Vec<_> =
            setup.recipe.layers.iter().filter(|layer| !matches!(layer, LayerSpec::Dropout(_))).cloned().collect();
        let network = Network::new(setup.network.input(), &layers, Isa::best()).unwrap();
        for seed in 1..=3 {
            let left = unexplained_variance(&setup, &network, seed);
            assert!(left < 0.1, "{recipe}, seed {seed}: {left} of the variance of the labels is left");
        }
    }
}

/// A network with batch norm or without, whose loss is smooth: no dropout, no ReLU.
fn smooth_network(batch_norm: bool) -> Network {
    let norm = if batch_norm { "{kind='batch_norm'}, " } else { "" };
    let layers = format!(
        "layers=[{{kind='conv2d', filters=4, kernel=[3, 3], stride=[2, 2]}}, {norm}{{kind='tanh'}}, {{kind='flatten'}}, \
         {{kind='dense', units=1}}]"
    );
    let overrides = [layers, "preprocessing.resize=[12, 14]".into()];
    Recipe::find("lenet", &overrides).unwrap().network(Isa::best()).unwrap()
}

/// 37 images are no multiple of shards, pairs or groups.
#[test]
fn pairs_add_the_mean_of_their_squares_with_its_gradient_and_the_same_bits_for_any_number_of_threads() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let smoothness = Smoothness { pairs_share: 0.5, spatial: 2.0, temporal: 3.0 };
    let terms = PairTerms::new(&smoothness, Pairs { spatial: 5, temporal: 6 });
    for network in [smooth_network(false), smooth_network(true)] {
        let mut random = rng(1, Purpose::Test, 0, 0);
        let mut draw = |n: usize| -> Vec<f32> { (0..n).map(|_| uniform(&mut random, -1.0, 1.0) as f32).collect() };
        let (x, labels) = (draw(37 * network.input().len()), draw(37));
        let parameters = network.initialize(1);
        let step = |parameters: &Parameters, terms: &PairTerms, threads: usize, capacity: usize| {
            let input = StepInput { x: images(&network, &x), labels: ArrayView1::from(&labels), seed: 1, step: 0 };
            let (mut plan, mut parameters) = (TrainingPlan::new(&network, capacity), parameters.clone());
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let loss = Loss::default();
            let value = pool.install(|| plan.step_with_pairs(&network, &mut parameters, &loss, terms, input));
            (value, plan.gradient().to_vec())
        };
        let (value, gradient) = step(&parameters, &terms, 1, 64);
        for (threads, capacity) in [(2, 64), (3, 96)] {
            assert!(step(&parameters, &terms, threads, capacity) == (value, gradient.clone()), "{threads} threads");
        }
        let (plain, _) = step(&parameters, &PairTerms::default(), 2, 37);
        if network.count(false) == 0 {
            let mut y = Array1::zeros(37);
            InferencePlan::new(&network, 37).run(&network, &parameters, images(&network, &x), y.view_mut());
            let mean = |pairs: std::ops::Range<usize>| {
                let error = |i: usize| f64::from(y[i]) - f64::from(labels[i]);
                let square = |pair: usize| (error(2 * pair) - error(2 * pair + 1)).powi(2);
                pairs.clone().map(square).sum::<f64>() / pairs.len() as f64
            };
            let expected = plain + 2.0 * mean(0..5) + 3.0 * mean(5..11);
            approx::assert_relative_eq!(value, expected, max_relative = 1e-5);
        }
        assert!(value > 1.5 * plain, "the terms count: {value}, {plain}");
        // Along the gradient the loss rises by its squared length.
        let along = |by: f32| {
            let mut moved = parameters.clone();
            moved.values.iter_mut().zip(&gradient).for_each(|(value, slope)| *value += by * slope);
            step(&moved, &terms, 2, 64).0
        };
        let square: f64 = gradient.iter().map(|g| f64::from(*g).powi(2)).sum();
        let h = 1e-2 / square.sqrt();
        let slope = (along(h as f32) - along(-h as f32)) / (2.0 * h);
        approx::assert_relative_eq!(slope, square, max_relative = 5e-3);
    }
}

/// With batch norm behind several layers (`hyper`), and none at all (`lenet`).
#[test]
fn a_pass_for_statistics_alone_moves_them_as_a_step_does_and_nothing_else() {
    for (recipe, size) in [NETWORKS[0], NETWORKS[1]] {
        let setup = Setup::new(recipe, size, 7);
        let (mut by_step, mut by_pass) = (setup.network.initialize(1), setup.network.initialize(1));
        let fresh = by_pass.clone();
        for step in 0..2 {
            let input = || StepInput { x: setup.images(), labels: ArrayView1::from(&setup.labels), seed: 1, step };
            TrainingPlan::new(&setup.network, 9).step(&setup.network, &mut by_step, &setup.recipe.loss, input());
            TrainingPlan::new(&setup.network, 9).pass_statistics(
                &setup.network,
                &mut by_pass,
                &PairTerms::default(),
                input(),
                7,
            );
        }
        assert_eq!(by_pass, by_step);
        assert_eq!(by_pass.statistics != fresh.statistics, recipe == "hyper");
        assert_eq!(by_pass.values, fresh.values);
    }
}

/// Two networks of the same sizes, with another slope: all buffers would fit, so nothing but the plan itself can tell.
#[test]
#[should_panic(expected = "a training plan for another network")]
fn a_training_plan_refuses_another_network_of_the_same_sizes() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let elu = |alpha| Setup::new("pilotnet", "[61, 65]", 2).with_elu(alpha);
    let (planned, other) = (elu(1.0), elu(0.5));
    let mut plan = TrainingPlan::new(&planned.network, 2);
    other.step(&mut plan, &mut other.optimizer(), &mut other.network.initialize(1));
}

/// Frozen layers have no barrier, so a plan from before the freeze would wait for one that never comes.
#[test]
#[should_panic(expected = "a training plan for another network")]
fn a_training_plan_refuses_its_network_once_layers_are_frozen() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let mut setup = Setup::new("hyper", "[40, 44]", 2);
    let mut plan = TrainingPlan::new(&setup.network, 2);
    setup.network.freeze(&["bn1".into()]).unwrap();
    setup.step(&mut plan, &mut setup.optimizer(), &mut setup.network.initialize(1));
}

/// Mean squared error in evaluation.
fn evaluation_loss(network: &Network, parameters: &Parameters, x: &[f32], labels: &[f32]) -> f64 {
    let mut y = Array1::zeros(labels.len());
    InferencePlan::new(network, labels.len()).run(network, parameters, images(network, x), y.view_mut());
    y.iter().zip(labels).map(|(y, label)| f64::from(y - label).powi(2)).sum::<f64>() / labels.len() as f64
}

#[test]
fn gradients_around_frozen_layers_are_those_of_evaluation_and_frozen_layers_have_none() {
    #[derive(serde::Deserialize)]
    struct Layers {
        layers: Vec<LayerSpec>,
    }
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let text = "layers = [{kind='scale', factor=1.5, offset=0.1}, {kind='conv2d', filters=3, kernel=[3, 3]}, \
                {kind='batch_norm'}, {kind='elu'}, {kind='conv2d', filters=2, kernel=[2, 3]}, {kind='batch_norm'}, \
                {kind='elu'}, {kind='dense', units=1}]";
    let layers = toml::from_str::<Layers>(text).unwrap().layers;
    let mut random = rng(3, Purpose::Test, 0, 0);
    let mut numbers =
        |len: usize, low: f64| -> Vec<f32> { (0..len).map(|_| uniform(&mut random, low, 1.0) as f32).collect() };
    for frozen in [&["bn1", "bn2"][..], &["bn1", "bn2", "conv2"], &["bn1", "bn2", "conv1"]] {
        let mut network = Network::new(Shape::new(2, 6, 7), &layers, Isa::best()).unwrap();
        network.freeze(&frozen.iter().map(|name| name.to_string()).collect::<Vec<_>>()).unwrap();
        let mut parameters = network.initialize(5);
        let statistics = parameters.statistics.len();
        parameters.statistics = numbers(statistics, 0.3);
        let (x, labels) = (numbers(4 * network.input().len(), -1.0), numbers(4, -1.0));

        let mut plan = TrainingPlan::new(&network, 4);
        let before = parameters.clone();
        let input = StepInput { x: images(&network, &x), labels: ArrayView1::from(&labels), seed: 1, step: 0 };
        let loss = plan.step(&network, &mut parameters, &Loss::default(), input);
        assert!((loss - evaluation_loss(&network, &before, &x, &labels)).abs() < 1e-5);
        assert_eq!(parameters, before, "a step moves no frozen statistics");

        for tensor in network.tensors().iter().filter(|tensor| tensor.trainable) {
            let gradient = &plan.gradient()[tensor.range.clone()];
            if tensor.frozen {
                assert!(gradient.iter().all(|g| *g == 0.0), "{}", tensor.name);
                continue;
            }
            let numerical = tensor.range.clone().map(|index| {
                let mut moved = before.clone();
                let mut at = |value: f32| {
                    moved.values[index] = value;
                    evaluation_loss(&network, &moved, &x, &labels)
                };
                let (up, down) = (before.values[index] + 1e-2, before.values[index] - 1e-2);
                (at(up) - at(down)) / f64::from(up - down)
            });
            let (mut error, mut norm) = (0.0, 0.0);
            for (gradient, numerical) in gradient.iter().zip(numerical) {
                error += (f64::from(*gradient) - numerical).powi(2);
                norm += numerical.powi(2);
            }
            assert!(error.sqrt() <= 5e-3 * norm.sqrt(), "{}: {} of {}", tensor.name, error.sqrt(), norm.sqrt());
        }
        let norm = plan.gradient().iter().map(|g| f64::from(*g).powi(2)).sum::<f64>().sqrt();
        assert!((plan.gradient_norm() - norm).abs() < 1e-6 * norm, "the norm that clips leaves frozen layers out");
    }
}
