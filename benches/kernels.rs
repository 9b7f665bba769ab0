//! The kernels at the sizes of the networks, on one core: `cargo bench --bench kernels`.
//!
//! Products are reported in elements a second where an element is a floating-point operation, so `Gelem/s` reads as
//! GFLOP/s, and in percent of the peak that is measured at the start. Passes over memory are reported in bytes read and
//! written.

use criterion::measurement::WallTime;
use criterion::{BenchmarkGroup, Criterion, Throughput, criterion_group, criterion_main};
use std::hint::black_box;
use std::time::{Duration, Instant};
use steersman_kernels::conv::{Conv, ConvAlgorithm, ConvShape, PooledConv};
use steersman_kernels::gemm::{gemm, gemm_scratch_len};
use steersman_kernels::matrix::{Matrix, MatrixMut};
use steersman_kernels::norm_rectify::{self, ChannelMeans, ChannelStatistics, RectifyShape, Slopes};
use steersman_kernels::pool::{self, PoolShape};
use steersman_kernels::sgemm::sgemm;
use steersman_kernels::{Backend, Isa, activation, norm, peak, update};

/// Images in a call: one shard of a training batch.
const IMAGES: usize = 8;

/// Name, c, h, w, oc, kernel and stride of each convolution of the four networks.
const LAYERS: &[(&str, [usize; 6])] = &[
    ("hyper1 3x40x160-8", [3, 40, 160, 8, 3, 1]),
    ("hyper2 8x38x158-16", [8, 38, 158, 16, 3, 1]),
    ("hyper3 16x18x78-24", [16, 18, 78, 24, 3, 1]),
    ("hyper4 24x8x38-32", [24, 8, 38, 32, 3, 1]),
    ("hyper5 32x3x18-64", [32, 3, 18, 64, 3, 1]),
    ("lenet1 1x64x64-6", [1, 64, 64, 6, 3, 1]),
    ("lenet2 6x15x15-16", [6, 15, 15, 16, 3, 1]),
    ("pilotnet1 3x66x200-24", [3, 66, 200, 24, 5, 2]),
    ("pilotnet2 24x31x98-36", [24, 31, 98, 36, 5, 2]),
    ("pilotnet3 36x14x47-48", [36, 14, 47, 48, 5, 2]),
    ("pilotnet4 48x5x22-64", [48, 5, 22, 64, 3, 1]),
    ("pilotnet5 64x3x20-64", [64, 3, 20, 64, 3, 1]),
    ("default1 3x40x160-16", [3, 40, 160, 16, 5, 2]),
    ("default2 16x18x78-24", [16, 18, 78, 24, 3, 2]),
    ("default3 24x8x38-32", [24, 8, 38, 32, 3, 2]),
    ("default4 32x3x18-48", [32, 3, 18, 48, 3, 1]),
];

/// Inputs and outputs of the dense layers; those with fewer than 50 inputs or outputs cost nothing.
const DENSE: &[(&str, usize, usize)] = &[
    ("hyper dense1", 1024, 100),
    ("hyper dense2", 100, 50),
    ("lenet dense1", 144, 120),
    ("lenet dense2", 120, 84),
    ("pilotnet dense1", 1152, 100),
    ("pilotnet dense2", 100, 50),
    ("default dense1", 768, 64),
];

/// Batch norm with what follows it: name, map, pooled, a slope for each position.
const RECTIFIED: &[(&str, RectifyShape, bool)] = &[
    ("hyper1", RectifyShape { c: 8, h: 38, w: 158, pooled: false }, false),
    ("hyper2", RectifyShape { c: 16, h: 36, w: 156, pooled: true }, false),
    ("hyper3", RectifyShape { c: 24, h: 16, w: 76, pooled: true }, true),
    ("hyper4", RectifyShape { c: 32, h: 6, w: 36, pooled: true }, true),
    ("hyper5", RectifyShape { c: 64, h: 1, w: 16, pooled: false }, true),
    ("default1", RectifyShape { c: 16, h: 18, w: 78, pooled: false }, false),
    ("default2", RectifyShape { c: 24, h: 8, w: 38, pooled: false }, false),
    ("default3", RectifyShape { c: 32, h: 3, w: 18, pooled: false }, false),
];

/// Measures a product of `operations`, and says what share of the `peak` (in GFLOP/s) its best call of 0.1 s reaches.
fn product(group: &mut BenchmarkGroup<WallTime>, name: &str, operations: u64, peak: f64, mut call: impl FnMut()) {
    group.throughput(Throughput::Elements(operations));
    group.bench_function(name, |b| b.iter(&mut call));
    let (end, mut best) = (Instant::now() + Duration::from_millis(100), f64::INFINITY);
    while Instant::now() < end {
        let start = Instant::now();
        call();
        best = best.min(start.elapsed().as_secs_f64());
    }
    println!("{name}: {:.0} % of the peak", operations as f64 / best / peak / 1e7);
}

fn convolutions(criterion: &mut Criterion) {
    let isa = Isa::best();
    let peak = peak::measure_peak_gflops(isa, 0.5);
    println!("{}: peak of one core {peak:.1} GFLOP/s", isa.name());
    for &(name, [c, h, w, oc, kernel, stride]) in LAYERS {
        let [pad_top, pad_bottom, pad_left, pad_right] = [0; 4];
        let (kh, kw, stride_h, stride_w) = (kernel, kernel, stride, stride);
        let shape = ConvShape { c, h, w, oc, kh, kw, stride_h, stride_w, pad_top, pad_bottom, pad_left, pad_right };
        let conv = Conv::new(shape, isa);
        let x = vec![0.5; IMAGES * c * h * w];
        let mut y = vec![0.5; IMAGES * oc * shape.out_h() * shape.out_w()];
        let weight = vec![0.1; oc * c * kh * kw];
        let (mut dx, dy, mut dweight, mut dbias) = (x.clone(), y.clone(), weight.clone(), vec![0.1; oc]);
        let bias = dbias.clone();
        let mut scratch = vec![0.0; conv.scratch_len()];
        let operations = 2 * IMAGES as u64 * shape.multiply_adds();
        let mut group = criterion.benchmark_group(format!("conv {name}"));
        product(&mut group, "forward", operations, peak, || {
            conv.forward(IMAGES, black_box(&x), &weight, &bias, &mut y, &mut scratch);
        });
        product(&mut group, "backward_input", operations, peak, || {
            conv.backward_input(IMAGES, black_box(&dy), &weight, &mut dx, &mut scratch);
        });
        // As in a training step, where weights are packed once for all shards.
        for conv in [Conv::new(shape, isa), Conv::new(shape, Backend { isa, conv: ConvAlgorithm::Im2col })] {
            let name = |pass: &str| {
                format!("{pass}{}", if conv.backend().conv == ConvAlgorithm::Auto { "" } else { ", im2col" })
            };
            let mut scratch = vec![0.0; conv.scratch_len()];
            let (mut packed, mut packed_gradient) =
                (vec![0.0; conv.packed_len()], vec![0.0; conv.packed_gradient_len()]);
            conv.pack(&weight, &bias, &mut packed);
            conv.pack_gradient(&weight, &mut packed_gradient);
            product(&mut group, &name("forward_packed"), operations, peak, || {
                conv.forward_packed(IMAGES, black_box(&x), &packed, &mut y, &mut scratch);
            });
            product(&mut group, &name("backward_input_packed"), operations, peak, || {
                conv.backward_input_packed(IMAGES, black_box(&dy), &packed_gradient, &mut dx, &mut scratch);
            });
            product(&mut group, &name("backward_weight"), operations, peak, || {
                conv.backward_weight(IMAGES, black_box(&x), &dy, &mut dweight, &mut dbias, &mut scratch);
            });
        }
        group.finish();
    }
}

fn products(criterion: &mut Criterion) {
    let isa = Isa::best();
    let peak = peak::measure_peak_gflops(isa, 0.5);
    // A dense layer has a weight of [outputs][inputs]: forward, input gradient, weight gradient.
    for &(layer, inputs, outputs) in DENSE {
        for images in [1, 8, 128] {
            let sizes = [
                ("forward", (images, inputs, outputs), (inputs, 1), (1, inputs)),
                ("backward_input", (images, outputs, inputs), (outputs, 1), (inputs, 1)),
                ("backward_weight", (outputs, images, inputs), (1, outputs), (inputs, 1)),
            ];
            for (name, (m, k, n), a_strides, b_strides) in sizes {
                let (a, b, mut c) = (vec![0.1; m * k], vec![0.1; k * n], vec![0.0; m * n]);
                let a = Matrix { values: &a, rows: m, columns: k, strides: a_strides };
                let b = Matrix { values: &b, rows: k, columns: n, strides: b_strides };
                let mut scratch = vec![0.0; gemm_scratch_len(m, k, n)];
                let mut group = criterion.benchmark_group(format!("{layer} {images}x{inputs}-{outputs} {name}"));
                let operations = 2 * (m * k * n) as u64;
                product(&mut group, "gemm", operations, peak, || {
                    gemm(isa, 1.0, black_box(a), b, 0.0, MatrixMut::new(&mut c, m, n), &mut scratch);
                });
                product(&mut group, "sgemm (matrixmultiply)", operations, peak, || {
                    sgemm(black_box(a), b, 0.0, MatrixMut::new(&mut c, m, n));
                });
                group.finish();
            }
        }
    }
}

/// Batch norm, rectifier and pooling in one pass.
fn rectified(criterion: &mut Criterion) {
    let isa = Isa::best();
    for &(name, shape, per_position) in RECTIFIED {
        let RectifyShape { c, h, w, pooled } = shape;
        let (image, pooled_image) = (c * h * w, if pooled { c * (h / 2) * (w / 2) } else { c * h * w });
        let numbers = |len: usize| (0..len).map(|i| (i * 7919 % 1000) as f32 / 500.0 - 1.0).collect::<Vec<f32>>();
        let (mut x, mut y, dy) =
            (numbers(IMAGES * image), vec![0.0; IMAGES * pooled_image], numbers(IMAGES * pooled_image));
        let (of_channel, list, mut sums) = (numbers(c), numbers(image), vec![0.0; 2 * c]);
        let slopes = if per_position { Slopes::PerPosition(&list) } else { Slopes::Zero };
        let mut dslopes = vec![0.0; if per_position { image } else { 0 }];
        let s = &of_channel;
        let statistics = ChannelStatistics { mean: s, inv_std: s, scale: s, shift: s };
        let mut group = criterion.benchmark_group(format!("norm_rectify {name} {c}x{h}x{w}"));
        group.throughput(Throughput::Bytes(4 * (IMAGES * (image + pooled_image)) as u64));
        group.bench_function("forward", |b| {
            b.iter(|| norm_rectify::forward(isa, &shape, IMAGES, black_box(&x), s, s, slopes, &mut y));
        });
        group.bench_function("backward_sums", |b| {
            b.iter(|| {
                let x = black_box(&x);
                norm_rectify::backward_sums(isa, &shape, IMAGES, x, &dy, statistics, slopes, &mut sums, &mut dslopes);
            });
        });
        group.throughput(Throughput::Bytes(4 * (IMAGES * (2 * image + pooled_image)) as u64));
        group.bench_function("backward", |b| {
            // In place: statistics of 0 but for the gain of 1 keep the values from growing.
            let (zero, one) = (vec![0.0; c], vec![1.0; c]);
            let means = ChannelMeans { dz: &zero, dz_xhat: &zero, gain: &one };
            b.iter(|| norm_rectify::backward(isa, &shape, IMAGES, black_box(&mut x), &dy, statistics, means, slopes));
        });
        group.finish();
    }
}

/// A convolution before a 4x4 pooling: forward with the pooling, and the gradients from the maxima alone.
fn pooled_convolutions(criterion: &mut Criterion) {
    let isa = Isa::best();
    let peak = peak::measure_peak_gflops(isa, 0.5);
    for &(name, [c, h, w, oc, kernel, _]) in LAYERS.iter().filter(|(name, _)| name.starts_with("lenet")) {
        let [pad_top, pad_bottom, pad_left, pad_right] = [0; 4];
        let (kh, kw, stride_h, stride_w) = (kernel, kernel, 1, 1);
        let shape = ConvShape { c, h, w, oc, kh, kw, stride_h, stride_w, pad_top, pad_bottom, pad_left, pad_right };
        let conv = PooledConv::new(shape, isa).expect("lenet's convolutions have the pass");
        let pooled = IMAGES * conv.y_len();
        let (mut y, mut argmax, dy) = (vec![0.0; pooled], vec![0; pooled], vec![0.5; pooled]);
        let (x, weight) = (vec![0.5; IMAGES * c * h * w], vec![0.1; oc * c * kh * kw]);
        let (mut dx, mut dweight, mut dbias) = (x.clone(), weight.clone(), vec![0.0; oc]);
        let (mut packed, mut scratch) = (vec![0.0; conv.packed_len()], vec![0.0; conv.scratch_len()]);
        conv.pack(&weight, &dbias, &mut packed);
        let mut group = criterion.benchmark_group(format!("pooled conv {name}"));
        product(&mut group, "forward", 2 * IMAGES as u64 * shape.multiply_adds(), peak, || {
            conv.forward(IMAGES, black_box(&x), &packed, &mut y, &mut argmax, &mut scratch);
        });
        // Of the positions that have a gradient: a 16th of all.
        let operations = 2 * (pooled * c * kh * kw) as u64;
        product(&mut group, "backward_weight", operations, peak, || {
            conv.backward_weight(IMAGES, black_box(&x), &argmax, &dy, &mut dweight, &mut dbias);
        });
        product(&mut group, "backward_input", operations, peak, || {
            conv.backward_input(IMAGES, &argmax, black_box(&dy), &weight, &mut dx);
        });
        group.finish();
    }
}

fn passes(criterion: &mut Criterion) {
    let isa = Isa::best();
    // The output of hyper's second convolution.
    let (c, h, w) = (16, 36, 156);
    let hw = h * w;
    let len = IMAGES * c * hw;
    let x: Vec<f32> = (0..len).map(|i| (i * 7919 % 1000) as f32 / 500.0 - 1.0).collect();
    let (mut y, dy, mut dx) = (x.clone(), x.clone(), x.clone());
    let (slopes, mut dslopes, mut sums) = (vec![0.1; c], vec![0.0; c], vec![0.0f64; 2 * c]);
    let pool_shape = PoolShape { c, h, w, kh: 2, kw: 2, stride_h: 2, stride_w: 2 };
    let mut pooled = vec![0.0; len / 4];
    let mut group = criterion.benchmark_group(format!("passes {IMAGES}x{c}x{h}x{w}"));
    let bytes = |floats: usize| Throughput::Bytes(4 * floats as u64);

    group.throughput(bytes(2 * len));
    group.bench_function("relu_forward", |b| b.iter(|| activation::relu_forward(isa, black_box(&x), &mut y)));
    group.bench_function("elu_forward", |b| b.iter(|| activation::elu_forward(isa, 1.0, black_box(&x), &mut y)));
    group.bench_function("prelu_forward", |b| {
        b.iter(|| activation::prelu_forward(isa, IMAGES, &slopes, hw, black_box(&x), &mut y));
    });
    group.bench_function("normalize", |b| {
        b.iter(|| norm::normalize(isa, IMAGES, c, hw, black_box(&x), &slopes, &slopes, &mut y));
    });
    group.throughput(bytes(len));
    group.bench_function("channel_sums", |b| {
        b.iter(|| norm::channel_sums(isa, IMAGES, c, hw, black_box(&x), &mut sums));
    });
    group.throughput(bytes(3 * len));
    group.bench_function("elu_backward", |b| {
        b.iter(|| activation::elu_backward(isa, 1.0, black_box(&x), &dy, &mut dx));
    });
    group.bench_function("prelu_backward", |b| {
        b.iter(|| activation::prelu_backward(isa, IMAGES, &slopes, hw, black_box(&x), &dy, &mut dx, &mut dslopes));
    });
    group.bench_function("norm_backward", |b| {
        let s = &slopes;
        b.iter(|| norm::norm_backward(isa, IMAGES, c, hw, black_box(&x), &dy, s, s, s, s, s, &mut dx));
    });
    group.throughput(bytes(2 * len));
    group.bench_function("norm_backward_sums", |b| {
        b.iter(|| norm::norm_backward_sums(isa, IMAGES, c, hw, black_box(&x), &dy, &slopes, &slopes, &mut sums));
    });
    group.throughput(bytes(len + len / 4));
    group.bench_function("max_forward 2x2", |b| {
        b.iter(|| pool::max_forward(isa, &pool_shape, IMAGES, black_box(&x), &mut pooled));
    });
    group.throughput(bytes(2 * len + len / 2));
    group.bench_function("max_backward 2x2", |b| {
        let dpooled = pooled.clone();
        b.iter(|| pool::max_backward(isa, &pool_shape, IMAGES, black_box(&x), &pooled, &dpooled, &mut dx));
    });
    group.throughput(bytes(7 * len));
    group.bench_function("adam", |b| {
        let (mut m, mut v) = (vec![0.0; len], vec![0.01; len]);
        let step = update::AdamStep {
            lr: 1e-3,
            beta1: 0.9,
            beta2: 0.999,
            epsilon: 1e-7,
            bias_correction1: 0.1,
            bias_correction2: 1e-3,
            l2: 0.0,
            decoupled_decay: 0.0,
        };
        b.iter(|| update::adam(isa, &step, &mut y, black_box(&dy), &mut m, &mut v));
    });
    group.finish();
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(20).measurement_time(std::time::Duration::from_secs(1));
    targets = convolutions, pooled_convolutions, products, rectified, passes
}
criterion_main!(benches);
