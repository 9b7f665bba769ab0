//! Our networks against Keras, full size: forward passes, gradients, running statistics, five steps of Adam.
//! `tests/golden/README.md` says what the files hold and how to make them.

mod common;

use common::formula::{hash, unit};
use ndarray::{ArrayView1, ArrayView4, ArrayViewMut1};
use serde::Deserialize;
use steersman::engine::layers::gradcheck::relative_error;
use steersman::engine::layers::{Grads, Pair, Pass};
use steersman::engine::loss::Loss;
use steersman::engine::network::{LayerSpec, Network, Parameters, StepInput, TrainingPlan};
use steersman::engine::optimizer::{Optimizer, OptimizerSpec};
use steersman::recipe::Recipe;
use steersman_kernels::conv::ConvAlgorithm;
use steersman_kernels::{Backend, Isa};

const FORWARD: f64 = 1e-4;
const GRADIENT: f64 = 1e-3;
const CHANGE: f64 = 1e-2;
const RUNNING: f64 = 1e-4;

#[derive(Deserialize)]
struct Golden {
    batch: usize,
    steps: usize,
    loss: f64,
    loss_after_steps: Vec<f64>,
    tensors: Vec<GoldenTensor>,
}

#[derive(Deserialize)]
struct GoldenTensor {
    name: String,
    shape: Vec<usize>,
    norm: f64,
    dot: f64,
    samples: Vec<f64>,
}

impl Golden {
    fn read(network: &str) -> Golden {
        let path = format!("{}/tests/golden/{network}.json", env!("CARGO_MANIFEST_DIR"));
        serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
    }

    /// Compares norm, dot product and samples; what is off goes into `failures`.
    fn compare(&self, name: &str, values: &[f32], tolerance: f64, failures: &mut Vec<String>) {
        let Some(golden) = self.tensors.iter().find(|t| t.name == name) else {
            return failures.push(format!("{name}: not in the file"));
        };
        if golden.shape.iter().product::<usize>() != values.len() {
            return failures.push(format!("{name}: {} values, not {:?}", values.len(), golden.shape));
        }
        let norm = values.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
        let probe = hash(&format!("probe/{name}"));
        let dot: f64 = values.iter().enumerate().map(|(i, v)| f64::from(*v) * unit(probe(i))).sum();
        let count = golden.samples.len();
        let picked: Vec<f32> = (0..count).map(|k| values[k * values.len() / count]).collect();
        // A probe of random signs has the norm of the tensor times its own, about sqrt(len / 3), as its largest dot product,
        // and the norm of the tensor / sqrt(3) as its usual one: errors are measured against that.
        for (what, error) in [
            ("norm", (norm - golden.norm).abs() / golden.norm),
            ("dot product", (dot - golden.dot).abs() / (golden.norm / 3f64.sqrt())),
            ("samples", relative_error(&picked, &golden.samples)),
        ] {
            let ok = error <= tolerance;
            if !ok {
                failures.push(format!("{name}: {what} off by {error:.1e}, more than {tolerance:.0e}"));
            }
        }
    }
}

/// The layer names of the files: a kind of which there is one and that has no parameters carries no number.
fn golden_name(network: &str, layer: &str) -> String {
    match (network, layer) {
        (_, "flatten1" | "scale1") | ("pilotnet", "dropout1") => layer.trim_end_matches('1').into(),
        _ => layer.into(),
    }
}

fn network(name: &str, backend: Backend) -> Network {
    let mut recipe = Recipe::find(name, &[]).unwrap();
    for layer in &mut recipe.layers {
        if let LayerSpec::Dropout(dropout) = layer {
            dropout.drop_probability = 0.0;
        }
    }
    recipe.network(backend).unwrap()
}

fn parameters(network: &Network) -> Parameters {
    let mut parameters = network.initialize(0);
    for tensor in network.tensors() {
        let (h, fans) = (hash(&tensor.name), tensor.spec.fans);
        let limit = (6.0 / (fans.fan_in + fans.fan_out) as f64).sqrt();
        let value = |u: f64| match tensor.spec.name {
            "weight" => u * limit,
            "bias" | "beta" | "running_mean" => 0.1 * u,
            "gamma" => 1.0 + 0.1 * u,
            "running_variance" => 1.0 + 0.2 * u,
            "slope" => 0.25 * u,
            other => panic!("no formula for {other}"),
        };
        for (i, p) in parameters.tensor_mut(tensor).iter_mut().enumerate() {
            *p = value(unit(h(i))) as f32;
        }
    }
    parameters
}

fn batch(name: &str, network: &Network, n: usize) -> (Vec<f32>, Vec<f32>) {
    let (input, labels) = (hash("input"), hash("labels"));
    let pixel = |u: f64| if name == "hyper" { 0.5 * u } else { ((u + 1.0) * 127.5 + 0.5).floor() };
    (
        (0..n * network.input().len()).map(|i| pixel(unit(input(i))) as f32).collect(),
        (0..n).map(|i| (0.5 * unit(labels(i))) as f32).collect(),
    )
}

/// Forward and backward, one layer after the other, in the plainest way: what plans must agree with.
struct LayerByLayer {
    outputs: Vec<Vec<f32>>,
    d_input: Vec<f32>,
    gradient: Vec<f32>,
}

impl LayerByLayer {
    fn run(network: &Network, parameters: &mut Parameters, x: &[f32], labels: &[f32]) -> LayerByLayer {
        let n = labels.len();
        let mut outputs: Vec<Vec<f32>> = Vec::new();
        let mut all_moments = Vec::new();
        for (index, named) in network.layers().iter().enumerate() {
            let (layer, x) = (&named.layer, outputs.last().map_or(x, |y| y.as_slice()));
            let params = &parameters.values[named.params.clone()];
            let mut moments = Vec::new();
            if let Some(barrier) = layer.batch_statistics() {
                let mut sums = vec![f64::NAN; barrier.sums_len()];
                moments.resize(barrier.moments_len(), f32::NAN);
                barrier.forward_sums(n, x, &mut sums);
                let statistics = &mut parameters.statistics[named.statistics.clone()];
                barrier.finish_forward(params, n, &sums, &mut moments, statistics);
            }
            let mut y = vec![f32::NAN; n * layer.output().len()];
            let mut scratch = vec![f32::NAN; layer.scratch_len(n)];
            let pass = Pass { seed: 0, step: 0, layer: index, first_image: 0, moments: &moments, packed: &[] };
            layer.forward(params, &pass, n, x, &mut y, &mut scratch);
            outputs.push(y);
            all_moments.push(moments);
        }
        let mut gradient = vec![0.0; parameters.values.len()];
        let mut dy = vec![f32::NAN; n];
        Loss::MeanSquaredError {}.value_and_gradient(outputs.last().unwrap(), labels, 1.0 / n as f32, &mut dy);
        for (index, named) in network.layers().iter().enumerate().rev() {
            let layer = &named.layer;
            let x = if index > 0 { &outputs[index - 1] } else { x };
            let params = &parameters.values[named.params.clone()];
            let dparams = &mut gradient[named.params.clone()];
            let moments = &mut all_moments[index];
            if let Some(barrier) = layer.batch_statistics() {
                let mut sums = vec![f64::NAN; barrier.sums_len()];
                barrier.backward_sums(moments, n, x, &dy, &mut sums, dparams);
                barrier.finish_backward(params, n, &sums, moments);
            }
            let mut dx = vec![f32::NAN; x.len()];
            let mut scratch = vec![f32::NAN; layer.scratch_len(n)];
            let pass = Pass { seed: 0, step: 0, layer: index, first_image: 0, moments, packed: &[] };
            let pair = Pair { x, y: &outputs[index], dy: &dy };
            layer.backward(params, &pass, n, pair, Some(&mut dx), Grads { dparams, scratch: &mut scratch });
            dy = dx;
        }
        LayerByLayer { outputs, d_input: dy, gradient }
    }
}

fn check(name: &str, backend: Backend) {
    let golden = Golden::read(name);
    let network = network(name, backend);
    let (x, labels) = batch(name, &network, golden.batch);
    let mut failures = Vec::new();

    let start = parameters(&network);
    let mut inference = steersman::engine::network::InferencePlan::new(&network, golden.batch);
    let mut predictions = vec![f32::NAN; golden.batch];
    let images = ArrayView4::from_shape(network.input().batch(golden.batch), &x).unwrap();
    inference.run(&network, &start, images, ArrayViewMut1::from(&mut predictions));
    let last = &network.layers().last().unwrap().name;
    golden.compare(&format!("infer/{last}"), &predictions, FORWARD, &mut failures);

    let mut after_one_pass = start.clone();
    let plain = LayerByLayer::run(&network, &mut after_one_pass, &x, &labels);
    for (named, output) in network.layers().iter().zip(&plain.outputs) {
        golden.compare(&format!("forward/{}", golden_name(name, &named.name)), output, FORWARD, &mut failures);
    }
    golden.compare("grad/input", &plain.d_input, GRADIENT, &mut failures);

    let mut parameters = start.clone();
    let mut plan = TrainingPlan::new(&network, golden.batch);
    let spec = OptimizerSpec::Adam {
        learning_rate: 1e-3,
        beta1: 0.9,
        beta2: 0.999,
        epsilon: 1e-8,
        l2: 0.0,
        decoupled_weight_decay: 0.0,
    };
    let mut optimizer = Optimizer::new(spec, None, network.tensors(), network.isa());
    // Batch normalisation takes away what a bias right before it adds.
    let cancelled: Vec<String> = network
        .layers()
        .windows(2)
        .filter(|pair| pair[1].layer.batch_statistics().is_some())
        .map(|pair| format!("{}.bias", pair[0].name))
        .collect();
    let mut losses = Vec::new();
    for step in 0..=golden.steps {
        let input = StepInput { x: images, labels: ArrayView1::from(&labels), seed: 0, step: step as u64 };
        losses.push(plan.step(&network, &mut parameters, &Loss::MeanSquaredError {}, input));
        if step == 0 {
            for tensor in network.tensors().iter().filter(|t| t.trainable) {
                for gradient in [plan.gradient(), &plain.gradient] {
                    let values = &gradient[tensor.range.clone()];
                    if cancelled.contains(&tensor.name) {
                        let norm = values.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
                        assert!(norm <= 1e-4, "{}: gradient {norm:.1e} instead of 0", tensor.name);
                    } else {
                        golden.compare(&format!("grad/{}", tensor.name), values, GRADIENT, &mut failures);
                    }
                }
            }
            for tensor in network.tensors().iter().filter(|t| !t.trainable) {
                for parameters in [&parameters, &after_one_pass] {
                    let values = parameters.tensor(tensor);
                    golden.compare(&format!("running/{}", tensor.name), values, RUNNING, &mut failures);
                }
            }
        }
        if step < golden.steps {
            let norm = plan.gradient_norm();
            optimizer.step(1e-3, &mut parameters.values, plan.gradient_mut(), norm);
        }
    }
    for (step, (loss, expected)) in losses.iter().zip([golden.loss].iter().chain(&golden.loss_after_steps)).enumerate()
    {
        let error = (loss - expected).abs() / expected;
        if !matches!(error.partial_cmp(&CHANGE), Some(std::cmp::Ordering::Less)) {
            failures.push(format!("loss after {step} steps: {loss}, not {expected}"));
        }
    }
    for tensor in network.tensors().iter().filter(|t| t.trainable && !cancelled.contains(&t.name)) {
        let range = tensor.range.clone();
        let change: Vec<f32> = parameters.values[range.clone()]
            .iter()
            .zip(&start.values[range])
            .map(|(after, before)| after - before)
            .collect();
        golden.compare(&format!("change/{}", tensor.name), &change, CHANGE, &mut failures);
    }
    assert!(failures.is_empty(), "{name} on {}, {}:\n{}", backend.isa.name(), backend.conv, failures.join("\n"));
}

/// Every instruction set with the algorithms of its choice, and the textbook algorithm on the best.
fn backends() -> impl Iterator<Item = Backend> {
    let auto = Isa::available().into_iter().map(|isa| Backend { isa, conv: ConvAlgorithm::Auto });
    auto.chain([Backend { isa: Isa::best(), conv: ConvAlgorithm::Im2col }])
}

#[test]
fn hyper_agrees_with_keras() {
    backends().for_each(|backend| check("hyper", backend));
}

#[test]
fn lenet_agrees_with_keras() {
    backends().for_each(|backend| check("lenet", backend));
}

#[test]
fn pilotnet_agrees_with_keras() {
    backends().for_each(|backend| check("pilotnet", backend));
}
