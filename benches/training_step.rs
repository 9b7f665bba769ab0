//! A whole training step of each shipped network on random images: forward, backward, update. All cores.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use ndarray::{ArrayView1, ArrayView4};
use steersman::engine::network::{StepInput, TrainingPlan};
use steersman::engine::optimizer::Optimizer;
use steersman::engine::random::{Purpose, rng, uniform};
use steersman::recipe::Recipe;
use steersman_kernels::Isa;

const BATCH: usize = 128;

fn training_step(c: &mut Criterion) {
    let mut group = c.benchmark_group("training step, batch 128");
    group.sample_size(10);
    group.throughput(Throughput::Elements(BATCH as u64));
    for name in ["hyper", "lenet", "pilotnet"] {
        let recipe = Recipe::find(name, &[]).expect("the recipe is built in");
        let network = recipe.network(Isa::best()).expect("the recipe is tested");
        let mut random = rng(1, Purpose::Test, 0, 0);
        let mut fill = |len: usize| (0..len).map(|_| uniform(&mut random, -0.5, 0.5) as f32).collect::<Vec<f32>>();
        let (x, labels) = (fill(BATCH * network.input().len()), fill(BATCH));
        let mut parameters = network.initialize(1);
        let mut plan = TrainingPlan::new(&network, BATCH);
        let mut optimizer = Optimizer::new(recipe.optimizer, None, network.tensors(), network.isa());
        group.bench_function(name, |b| {
            b.iter(|| {
                let x = ArrayView4::from_shape(network.input().batch(BATCH), &x).expect("a batch");
                let input = StepInput { x, labels: ArrayView1::from(&labels), seed: 1, step: optimizer.updates };
                let loss = plan.step(&network, &mut parameters, &recipe.loss, input);
                let norm = plan.gradient_norm();
                optimizer.step(1e-4, &mut parameters.values, plan.gradient_mut(), norm);
                loss
            });
        });
    }
    group.finish();
}

criterion_group!(benches, training_step);
criterion_main!(benches);
