//! Finite differences through whole networks: the three recipes at reduced size, dropout frozen by its key.
//!
//! Each tensor is moved along several random directions of ±1, the loss must change as the gradient says, and the difference
//! is measured against the norm of the tensor's gradient, which is what a random direction of signs sees of it on average.

use ndarray::{Array1, Array4, ArrayView1, ArrayView4};
use rand::Rng;
use steersman::engine::loss::Loss;
use steersman::engine::network::{LayerSpec, Network, Parameters, StepInput, Tensor, TrainingPlan};
use steersman::engine::random::{Purpose, rng, uniform, unit};
use steersman::engine::tensor::Shape;
use steersman::recipe::Recipe;
use steersman_kernels::conv::ConvAlgorithm;
use steersman_kernels::{Backend, Isa};

const IMAGES: usize = 6;
const DIRECTIONS: u64 = 4;
/// How much a step changes the loss, as a share of itself. A short step drowns in rounding, a long one crosses kinks of ReLU
/// and pooling; where the two meet depends on the tensor. A right gradient is right for one of them, a wrong one for none.
const STEPS: [f64; 3] = [2e-3, 5e-4, 1e-4];

/// Stripes of random direction, width and contrast. Plain noise would look alike to the network from image to image, and batch
/// norm would blow the small differences up until only rounding is left.
fn image(shape: Shape, low: f64, high: f64, random: &mut impl Rng) -> Vec<f32> {
    let (dx, dy, contrast) = (uniform(random, -0.6, 0.6), uniform(random, -0.6, 0.6), uniform(random, 0.2, 1.0));
    let mut pixels = Vec::new();
    for _channel in 0..shape.c {
        let phase = uniform(random, 0.0, 6.0);
        for y in 0..shape.h {
            for x in 0..shape.w {
                let stripe = (dx * x as f64 + dy * y as f64 + phase).sin();
                let value = 0.5 + 0.4 * contrast * stripe + uniform(random, -0.1, 0.1);
                pixels.push((low + (high - low) * value) as f32);
            }
        }
    }
    pixels
}

fn norm(gradient: &[f32]) -> f64 {
    gradient.iter().map(|g| f64::from(*g).powi(2)).sum::<f64>().sqrt()
}

struct Check {
    network: Network,
    plan: TrainingPlan,
    x: Vec<f32>,
    labels: Vec<f32>,
    loss: Loss,
    /// Largest root-mean-square error over the directions.
    tolerance: f64,
}

impl Check {
    fn new(recipe: &str, size: &str, outputs: &[String], loss: Loss, backend: Backend) -> Check {
        let settings = [&[format!("preprocessing.resize={size}")], outputs].concat();
        let recipe = Recipe::find(recipe, &settings).unwrap();
        let network = recipe.network(backend).unwrap();
        let count = recipe.outputs.count();
        let mut random = rng(11, Purpose::Test, 0, 0);
        // Grey levels where the network scales them itself.
        let (low, high) = if recipe.preprocessing.scale == 1.0 { (0.0, 255.0) } else { (-0.5, 0.5) };
        Check {
            plan: match recipe.outputs.loss_weights() {
                None => TrainingPlan::new(&network, IMAGES),
                Some(weights) => TrainingPlan::new(&network, IMAGES).with_output_weights(&weights),
            },
            x: (0..IMAGES).flat_map(|_| image(network.input(), low, high, &mut random)).collect(),
            labels: (0..IMAGES * count).map(|_| uniform(&mut random, -1.0, 1.0) as f32).collect(),
            // Batch norm multiplies the rounding noise, and a step crosses more kinks.
            tolerance: if network.count(false) > 0 { 5e-2 } else { 1e-2 },
            network,
            loss,
        }
    }

    fn loss(&mut self, parameters: &Parameters) -> f64 {
        let x = ArrayView4::from_shape(self.network.input().batch(IMAGES), &self.x).unwrap();
        let input = StepInput { x, labels: ArrayView1::from(&self.labels), seed: 3, step: 4 };
        self.plan.step(&self.network, &mut parameters.clone(), &self.loss, input)
    }

    /// Root-mean-square difference, over the directions, of the finite difference from what `gradient` says, as a share of
    /// `scale`.
    fn error(
        &mut self,
        parameters: &Parameters,
        tensor: &Tensor,
        index: u64,
        gradient: &[f32],
        scale: f64,
        step: f32,
    ) -> f64 {
        let mut squares = 0.0;
        for direction in 0..DIRECTIONS {
            let mut random = rng(13, Purpose::Test, direction, index);
            let signs: Vec<f32> = gradient.iter().map(|_| if unit(&mut random) < 0.5 { -1.0 } else { 1.0 }).collect();
            let mut moved = |factor: f32| {
                let mut parameters = parameters.clone();
                for (p, sign) in parameters.tensor_mut(tensor).iter_mut().zip(&signs) {
                    *p += factor * step * sign;
                }
                self.loss(&parameters)
            };
            let numerical = (moved(1.0) - moved(-1.0)) / (2.0 * f64::from(step));
            let analytic: f64 = gradient.iter().zip(&signs).map(|(g, s)| f64::from(g * s)).sum();
            squares += ((numerical - analytic) / scale).powi(2);
        }
        (squares / DIRECTIONS as f64).sqrt()
    }

    /// Tensor names whose gradient is wrong, with the error.
    fn failures(&mut self) -> Vec<String> {
        // With these weights no value lies so near a kink that a step crosses it.
        let mut parameters = self.network.initialize(6);
        let mut random = rng(12, Purpose::Test, 0, 0);
        // Off the first values: biases of 0 and slopes of 0 hide mistakes.
        parameters.values.iter_mut().for_each(|p| *p += uniform(&mut random, -0.05, 0.05) as f32);
        let loss = self.loss(&parameters);
        let gradient = self.plan.gradient().to_vec();
        let whole_norm = norm(&gradient);
        let tensors: Vec<_> = self.network.tensors().iter().filter(|t| t.trainable).cloned().collect();
        let mut failures = Vec::new();
        for (index, tensor) in tensors.iter().enumerate() {
            let gradient = &gradient[tensor.range.clone()];
            // A gradient of zero has to be found to be zero on the scale of the others.
            let scale = norm(gradient).max(1e-3 * whole_norm);
            let layer = self.network.layers().iter().position(|l| l.params.contains(&tensor.range.start)).unwrap();
            let cancelled = self.network.layers().get(layer + 1).is_some_and(|l| l.layer.batch_statistics().is_some());
            if cancelled && tensor.spec.name == "bias" {
                continue; // batch norm takes away what a bias right before it adds
            }
            let error = STEPS
                .iter()
                .map(|share| {
                    self.error(&parameters, tensor, index as u64, gradient, scale, (share * loss / scale) as f32)
                })
                .fold(f64::INFINITY, f64::min);
            let ok = error <= self.tolerance;
            if !ok {
                failures.push(format!("{}: {error:.1e}", tensor.name));
            }
        }
        failures
    }
}

const LOSSES: [Loss; 2] = [Loss::MeanSquaredError {}, Loss::Huber { delta: 0.3 }];

fn check(recipe: &str, size: &str) {
    check_outputs(recipe, size, &[], &LOSSES);
}

fn check_outputs(recipe: &str, size: &str, outputs: &[String], losses: &[Loss]) {
    for conv in [ConvAlgorithm::Auto, ConvAlgorithm::Im2col] {
        for &loss in losses {
            let failures = Check::new(recipe, size, outputs, loss, Backend { isa: Isa::best(), conv }).failures();
            assert!(failures.is_empty(), "{recipe}, {conv}, {loss:?}: gradients off: {failures:?}");
        }
    }
}

#[test]
fn hyper_at_reduced_width() {
    check("hyper", "[40, 44]");
}

#[test]
fn hyper_prelu_at_reduced_width() {
    check("hyper-prelu", "[80, 44]");
}

#[test]
fn lenet_at_reduced_size() {
    check("lenet", "[26, 30]");
}

#[test]
fn pilotnet_at_reduced_size() {
    check("pilotnet", "[61, 65]");
}

/// With batch norm and without, whose steps go different ways.
#[test]
fn two_outputs_of_unequal_weights() {
    let outputs = "outputs=[{ name = 'steering', loss_weight = 0.7 }, { name = 'throttle', loss_weight = 2.5 }]";
    let outputs = ["layers.last.units=2", outputs].map(String::from);
    check_outputs("lenet", "[26, 30]", &outputs, &LOSSES);
    // The kinks of Huber's loss and of PReLU together leave 6 % of noise with so many labels.
    check_outputs("hyper", "[40, 44]", &outputs, &LOSSES[..1]);
}

/// The loss is the sum over the outputs of weight · mean over the images, and one output of weight 1 has the bits of none.
#[test]
fn the_weighted_loss_is_the_sum_of_the_means() {
    let backend = Backend { isa: Isa::best(), conv: ConvAlgorithm::Auto };
    let loss_of = |weights: [f64; 2]| {
        let [a, b] = weights;
        let outputs = format!(
            "outputs=[{{ name = 'steering', loss_weight = {a:?} }}, {{ name = 'throttle', loss_weight = {b:?} }}]"
        );
        let outputs = ["layers.last.units=2".to_string(), outputs];
        let mut check = Check::new("lenet", "[26, 30]", &outputs, Loss::MeanSquaredError {}, backend);
        let parameters = check.network.initialize(5);
        check.loss(&parameters)
    };
    let (equal, first, second) = (loss_of([1.0, 1.0]), loss_of([2.0, 1.0]), loss_of([1.0, 3.0]));
    let (of_first, of_second) = (first - equal, (second - equal) / 2.0);
    assert!(of_first > 1e-3 && of_second > 1e-3, "{of_first} {of_second}");
    assert!((of_first + of_second - equal).abs() < 1e-5 * equal, "{of_first} + {of_second} is not {equal}");

    let mut check = Check::new("lenet", "[26, 30]", &[], Loss::MeanSquaredError {}, backend);
    let parameters = check.network.initialize(5);
    let plain = (check.loss(&parameters), check.plan.gradient().to_vec());
    check.plan = TrainingPlan::new(&check.network, IMAGES).with_output_weights(&[1.0]);
    assert_eq!((check.loss(&parameters).to_bits(), check.plan.gradient()), (plain.0.to_bits(), &plain.1[..]));
}

/// The maps of the convolution are the same everywhere, so every window ties; the images are not, so the gradient of its weights
/// tells which element of a window was chosen.
#[test]
fn of_equals_in_a_pooling_window_the_first_takes_the_gradient() {
    #[derive(serde::Deserialize)]
    struct Layers {
        layers: Vec<LayerSpec>,
    }
    const SUM: f32 = 8.0;
    let (shape, images) = (Shape::new(2, 12, 12), 2);
    let mut random = rng(12, Purpose::Test, 0, 0);
    // Two channels that add up to SUM in every position.
    let first: Vec<f32> = (0..images * 144).map(|_| uniform(&mut random, 0.0, 9.0).floor() as f32).collect();
    let x = Array4::from_shape_fn(shape.batch(images), |(n, c, h, w)| {
        let value = first[n * 144 + h * 12 + w];
        if c == 0 { value } else { SUM - value }
    });
    let conv = "{ kind = 'conv2d', filters = 1, kernel = [1, 1], init = { constant = 1.0 } }";
    let dense = "{ kind = 'dense', units = 1, init = { constant = 1.0 } }";
    for (between, norm) in
        [("", false), ("{ kind = 'relu' },", false), ("{ kind = 'batch_norm' }, { kind = 'relu' },", true)]
    {
        for window in [2, 3, 4, 6] {
            let pool = format!("{{ kind = 'max_pool', window = [{window}, {window}] }}");
            let text = format!("layers = [{conv}, {between} {pool}, {dense}]");
            let layers = toml::from_str::<Layers>(&text).unwrap().layers;
            for isa in Isa::available() {
                let network = Network::new(shape, &layers, isa).unwrap();
                let mut parameters = network.initialize(1);
                let windows = (12 / window) * (12 / window);
                let mut predicted = SUM * windows as f32;
                if norm {
                    // The normalised map is 0; beta lifts it over the kink.
                    parameters.array_mut(network.tensor("bn1.beta").unwrap()).fill(1.0);
                    predicted = windows as f32;
                }
                // The gradient of the loss with respect to each pooled value is 2 / images = 1.
                let labels = Array1::from_elem(images, predicted - 1.0);
                let mut plan = TrainingPlan::new(&network, images);
                let input = StepInput { x: x.view(), labels: labels.view(), seed: 1, step: 0 };
                plan.step(&network, &mut parameters, &Loss::default(), input);

                let positions = |n: usize| (0..144).map(move |at| (n, at / 12, at % 12));
                let chosen =
                    |(_, h, w): (usize, usize, usize)| if h % window == 0 && w % window == 0 { 1.0 } else { 0.0 };
                // Batch normalisation takes the mean of the gradient off and divides by the root of its epsilon.
                let (mean, gain) = if norm { (windows as f64 / 144.0, 1e-3f64.sqrt().recip()) } else { (0.0, 1.0) };
                let weights = &plan.gradient()[network.tensor("conv1.weight").unwrap().range.clone()];
                for (channel, found) in weights.iter().enumerate() {
                    let gradient = |(n, h, w)| gain * (chosen((n, h, w)) - mean) * f64::from(x[[n, channel, h, w]]);
                    let expected: f64 = (0..images).flat_map(positions).map(gradient).sum();
                    let tolerance = 1e-4 * expected.abs().max(gain);
                    let difference = (f64::from(*found) - expected).abs();
                    assert!(difference <= tolerance, "{found} for {expected}: {text} on {}", isa.name());
                }
            }
        }
    }
}
