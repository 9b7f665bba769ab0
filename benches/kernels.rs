//! The kernels at the sizes of the networks, on one core: `cargo bench --bench kernels`.
//!
//! Products are reported in elements a second where an element is a floating-point operation, so `Gelem/s` reads as
//! GFLOP/s; the measured peak is printed first. Passes over memory are reported in bytes read and written.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use std::hint::black_box;
use steersman_kernels::conv::{Conv, ConvShape};
use steersman_kernels::gemm::{gemm, gemm_scratch_len};
use steersman_kernels::pool::PoolShape;
use steersman_kernels::{Isa, activation, baseline, norm, peak, pool, update};

/// Images in a call: one shard of a training batch.
const IMAGES: usize = 8;

/// Name, c, h, w, oc, kernel and stride of each convolution of the three networks.
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
];

fn convolutions(criterion: &mut Criterion) {
    let isa = Isa::best();
    println!("{}: peak of one core {:.1} GFLOP/s", isa.name(), peak::measure_peak_gflops(isa, 0.5));
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
        let mut group = criterion.benchmark_group(format!("conv {name}"));
        group.throughput(Throughput::Elements(2 * IMAGES as u64 * shape.multiply_adds()));
        group.bench_function("forward", |b| {
            b.iter(|| conv.forward(IMAGES, black_box(&x), &weight, &bias, &mut y, &mut scratch));
        });
        group.bench_function("forward by im2col and matrixmultiply", |b| {
            b.iter(|| baseline::conv_forward(&shape, IMAGES, black_box(&x), &weight, &bias, &mut y));
        });
        group.bench_function("backward_input", |b| {
            b.iter(|| conv.backward_input(IMAGES, black_box(&dy), &weight, &mut dx, &mut scratch));
        });
        group.bench_function("backward_weight", |b| {
            b.iter(|| conv.backward_weight(IMAGES, black_box(&x), &dy, &mut dweight, &mut dbias, &mut scratch));
        });
        group.finish();
    }
}

fn products(criterion: &mut Criterion) {
    let isa = Isa::best();
    // A dense layer of 1024 inputs and 100 outputs, weight [100][1024]: forward, input gradient, weight gradient.
    let (inputs, outputs) = (1024, 100);
    for images in [1, 8, 128] {
        let sizes = [
            ("forward", (images, inputs, outputs), (inputs, 1), (1, inputs)),
            ("backward_input", (images, outputs, inputs), (outputs, 1), (inputs, 1)),
            ("backward_weight", (outputs, images, inputs), (1, outputs), (inputs, 1)),
        ];
        for (name, (m, k, n), a_strides, b_strides) in sizes {
            let (a, b, mut c) = (vec![0.1; m * k], vec![0.1; k * n], vec![0.0; m * n]);
            let mut scratch = vec![0.0; gemm_scratch_len(m, k, n)];
            let mut group = criterion.benchmark_group(format!("dense {images}x{inputs}-{outputs} {name}"));
            group.throughput(Throughput::Elements(2 * (m * k * n) as u64));
            group.bench_function("gemm", |bench| {
                bench.iter(|| {
                    let (a, c_strides) = (black_box(&a), (n, 1));
                    gemm(isa, m, k, n, 1.0, a, a_strides, &b, b_strides, 0.0, &mut c, c_strides, &mut scratch);
                });
            });
            // The rival: it allocates its packing buffers in every call.
            group.bench_function("ndarray (matrixmultiply)", |bench| {
                let view = |data: &[f32], rows, columns, strides: (usize, usize)| {
                    let shape = ndarray::ShapeBuilder::strides((rows, columns), strides);
                    ndarray::ArrayView2::from_shape(shape, data).map(|view| view.to_owned()).ok()
                };
                let (Some(a), Some(b)) = (view(&a, m, k, a_strides), view(&b, k, n, b_strides)) else { return };
                let mut c = ndarray::Array2::<f32>::zeros((m, n));
                bench.iter(|| ndarray::linalg::general_mat_mul(1.0, black_box(&a), &b, 0.0, &mut c));
            });
            group.finish();
        }
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
    targets = convolutions, products, passes
}
criterion_main!(benches);
