//! Each kind of layer, forward and backward: those of the shipped networks at their sizes, all others at one size. Eight images
//! at a time, one thread, as in a training step.

use std::collections::HashMap;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use steersman::engine::layers::gradcheck::Harness;
use steersman::engine::network::LayerSpec;
use steersman::engine::tensor::Shape;
use steersman_kernels::Isa;

const IMAGES: usize = 8;

/// Name, input (channels, height, width), layer.
const LAYERS: [(&str, [usize; 3], &str); 10] = [
    ("hyper conv2", [8, 38, 158], "{ kind = 'conv2d', filters = 16, kernel = [3, 3] }"),
    ("pilotnet conv2", [24, 31, 98], "{ kind = 'conv2d', filters = 36, kernel = [5, 5], stride = [2, 2] }"),
    ("hyper bn2", [16, 36, 156], "{ kind = 'batch_norm' }"),
    ("hyper relu2", [16, 36, 156], "{ kind = 'relu' }"),
    ("hyper prelu1", [24, 16, 76], "{ kind = 'prelu' }"),
    ("pilotnet elu1", [24, 31, 98], "{ kind = 'elu' }"),
    ("hyper pool1", [16, 36, 156], "{ kind = 'max_pool', window = [2, 2] }"),
    ("lenet pool1", [6, 62, 62], "{ kind = 'max_pool', window = [4, 4] }"),
    ("pilotnet dropout", [64, 1, 18], "{ kind = 'dropout', drop_probability = 0.5 }"),
    ("hyper dense1", [1024, 1, 1], "{ kind = 'dense', units = 100 }"),
];

/// Input of the kinds that `LAYERS` does not have.
const INPUT: [usize; 3] = [24, 31, 98];

fn layers(c: &mut Criterion) {
    let has_row = |kind: &str| LAYERS.iter().any(|(_, _, spec)| spec.contains(&format!("kind = '{kind}'")));
    let others = LayerSpec::EXAMPLES.iter().filter(|(kind, _)| !has_row(kind));
    let others = others.map(|(kind, example)| (*kind, INPUT, *example));
    for (name, [channels, h, w], spec) in LAYERS.into_iter().chain(others) {
        let input = Shape::new(channels, h, w);
        let mut table: HashMap<String, LayerSpec> =
            toml::from_str(&format!("layer = {spec}")).expect("an entry of a recipe's layers");
        let spec = table.remove("layer").expect("the only key");
        let layer = spec.build(input, Isa::best()).expect("the layer fits its input");
        let mut harness = Harness::new(&*layer, IMAGES);
        let mut group = c.benchmark_group(name);
        // Multiply-adds where there are some, else elements read.
        let work = IMAGES as u64 * layer.multiply_adds().max(input.len() as u64);
        group.throughput(Throughput::Elements(work));
        group.bench_function("forward", |b| b.iter(|| harness.forward()));
        group.bench_function("backward", |b| b.iter(|| harness.backward()));
        group.finish();
    }
}

criterion_group!(benches, layers);
criterion_main!(benches);
