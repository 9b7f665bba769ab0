//! Everything that is not a product: activations, pooling, normalisation, updates, pixels.

use super::{Failures, isas, nans, numbers};
use steersman_kernels::update::AdamStep;
use steersman_kernels::{activation, blur, norm, pixels, pool, reference, update};

/// Lengths around the vector widths.
const LENGTHS: &[usize] = &[0, 1, 3, 4, 5, 15, 16, 17, 31, 100, 1027];

#[test]
fn activations_agree_with_the_loops() {
    let mut failures = Failures::default();
    for isa in isas() {
        for &len in LENGTHS {
            let (x, dy): (Vec<f32>, _) = (numbers(1, len).iter().map(|x| x * 4.0).collect(), numbers(2, len));
            let (mut expected, mut actual) = (nans(len), nans(len));
            reference::relu_forward(&x, &mut expected);
            activation::relu_forward(isa, &x, &mut actual);
            failures.compare(&format!("relu_forward {} {len}", isa.name()), &actual, &expected, 0.0);
            let y = expected.clone();
            let (mut expected, mut actual) = (nans(len), nans(len));
            reference::relu_backward(&y, &dy, &mut expected);
            activation::relu_backward(isa, &y, &dy, &mut actual);
            failures.compare(&format!("relu_backward {} {len}", isa.name()), &actual, &expected, 0.0);

            let (mut expected, mut actual) = (nans(len), nans(len));
            reference::elu_forward(0.7, &x, &mut expected);
            activation::elu_forward(isa, 0.7, &x, &mut actual);
            failures.compare(&format!("elu_forward {} {len}", isa.name()), &actual, &expected, 1e-6);
            let y = expected.clone();
            let (mut expected, mut actual) = (nans(len), nans(len));
            reference::elu_backward(0.7, &y, &dy, &mut expected);
            activation::elu_backward(isa, 0.7, &y, &dy, &mut actual);
            failures.compare(&format!("elu_backward {} {len}", isa.name()), &actual, &expected, 1e-6);

            let (mut expected, mut actual) = (nans(len), nans(len));
            reference::leaky_relu_forward(-0.3, &x, &mut expected);
            activation::leaky_relu_forward(isa, -0.3, &x, &mut actual);
            failures.compare(&format!("leaky_relu_forward {} {len}", isa.name()), &actual, &expected, 0.0);
            let (mut expected, mut actual) = (nans(len), nans(len));
            reference::leaky_relu_backward(-0.3, &x, &dy, &mut expected);
            activation::leaky_relu_backward(isa, -0.3, &x, &dy, &mut actual);
            failures.compare(&format!("leaky_relu_backward {} {len}", isa.name()), &actual, &expected, 0.0);

            let (mut expected, mut actual) = (nans(len), nans(len));
            reference::tanh_forward(&x, &mut expected);
            activation::tanh_forward(isa, &x, &mut actual);
            failures.compare(&format!("tanh_forward {} {len}", isa.name()), &actual, &expected, 2e-6);
            let y = expected.clone();
            let (mut expected, mut actual) = (nans(len), nans(len));
            reference::tanh_backward(&y, &dy, &mut expected);
            activation::tanh_backward(isa, &y, &dy, &mut actual);
            failures.compare(&format!("tanh_backward {} {len}", isa.name()), &actual, &expected, 1e-6);

            let (mut expected, mut actual) = (nans(len), nans(len));
            reference::softsign_forward(&x, &mut expected);
            activation::softsign_forward(isa, &x, &mut actual);
            failures.compare(&format!("softsign_forward {} {len}", isa.name()), &actual, &expected, 1e-6);
            let y = expected.clone();
            let (mut expected, mut actual) = (nans(len), nans(len));
            reference::softsign_backward(&y, &dy, &mut expected);
            activation::softsign_backward(isa, &y, &dy, &mut actual);
            failures.compare(&format!("softsign_backward {} {len}", isa.name()), &actual, &expected, 1e-6);

            let (mut expected, mut actual) = (nans(len), nans(len));
            reference::swish_forward(&x, &mut expected);
            activation::swish_forward(isa, &x, &mut actual);
            failures.compare(&format!("swish_forward {} {len}", isa.name()), &actual, &expected, 1e-6);
            let (mut expected, mut actual) = (nans(len), nans(len));
            reference::swish_backward(&x, &dy, &mut expected);
            activation::swish_backward(isa, &x, &dy, &mut actual);
            failures.compare(&format!("swish_backward {} {len}", isa.name()), &actual, &expected, 1e-6);
        }
    }
    failures.report();
}

#[test]
fn prelu_agrees_with_the_loops() {
    let mut failures = Failures::default();
    for isa in isas() {
        for (slopes, repeat) in [(1, 1), (17, 1), (1, 33), (3, 16), (4, 45), (2, 0), (0, 3)] {
            for n in [0, 1, 3] {
                let len = n * slopes * repeat;
                let what = format!("{} {slopes} slopes for {repeat}, n={n}", isa.name());
                let (x, dy, slope) = (numbers(1, len), numbers(2, len), numbers(3, slopes));
                let (mut expected, mut actual) = (nans(len), nans(len));
                reference::prelu_forward(&slope, repeat, &x, &mut expected);
                activation::prelu_forward(isa, n, &slope, repeat, &x, &mut actual);
                failures.compare(&format!("prelu_forward {what}"), &actual, &expected, 0.0);
                let (mut expected, mut actual) = (nans(len), nans(len));
                let (mut dslope_expected, mut dslope) = (numbers(4, slopes), numbers(4, slopes));
                reference::prelu_backward(&slope, repeat, &x, &dy, &mut expected, &mut dslope_expected);
                activation::prelu_backward(isa, n, &slope, repeat, &x, &dy, &mut actual, &mut dslope);
                failures.compare(&format!("prelu_backward {what}"), &actual, &expected, 0.0);
                failures.compare(&format!("prelu slopes {what}"), &dslope, &dslope_expected, 1e-5);
            }
        }
    }
    failures.report();
}

#[test]
fn pooling_agrees_with_the_loops() {
    let mut failures = Failures::default();
    let sizes = [
        ([2, 6, 7], [2, 2], [2, 2]),
        ([1, 61, 61], [4, 4], [4, 4]),
        ([3, 38, 158], [2, 2], [2, 2]),
        ([2, 5, 37], [3, 3], [1, 2]),
        ([2, 9, 35], [3, 2], [2, 1]),
        ([1, 8, 8], [2, 2], [3, 5]),
        ([1, 1, 1], [1, 1], [1, 1]),
        ([2, 3, 3], [4, 2], [1, 1]),
    ];
    for ([c, h, w], [kh, kw], [stride_h, stride_w]) in sizes {
        let shape = pool::PoolShape { c, h, w, kh, kw, stride_h, stride_w };
        let (x_len, y_len) = (c * h * w, c * shape.out_h() * shape.out_w());
        for n in [0, 1, 3] {
            // Few distinct values, so that windows hold their maximum more than once.
            let x: Vec<f32> = numbers(1, n * x_len).iter().map(|x| (x * 4.0).round()).collect();
            let dy = numbers(2, n * y_len);
            for isa in isas() {
                let what = format!("{} n={n} {shape:?}", isa.name());
                let (mut expected, mut actual) = (nans(n * y_len), nans(n * y_len));
                reference::max_forward(&shape, n, &x, &mut expected);
                pool::max_forward(isa, &shape, n, &x, &mut actual);
                failures.compare(&format!("max_forward {what}"), &actual, &expected, 0.0);
                let y = expected.clone();
                let (mut expected, mut actual) = (nans(n * x_len), nans(n * x_len));
                reference::max_backward(&shape, n, &x, &y, &dy, &mut expected);
                pool::max_backward(isa, &shape, n, &x, &y, &dy, &mut actual);
                failures.compare(&format!("max_backward {what}"), &actual, &expected, 1e-6);
                let (mut expected, mut actual) = (nans(n * y_len), nans(n * y_len));
                reference::average_forward(&shape, n, &x, &mut expected);
                pool::average_forward(isa, &shape, n, &x, &mut actual);
                failures.compare(&format!("average_forward {what}"), &actual, &expected, 1e-6);
                let (mut expected, mut actual) = (nans(n * x_len), nans(n * x_len));
                reference::average_backward(&shape, n, &dy, &mut expected);
                pool::average_backward(isa, &shape, n, &dy, &mut actual);
                failures.compare(&format!("average_backward {what}"), &actual, &expected, 1e-6);
            }
        }
    }
    failures.report();
}

#[test]
fn blurring_agrees_with_the_loops() {
    let mut failures = Failures::default();
    let sizes = [
        ([2, 6, 7], [3, 3], [1, 1]),
        ([3, 40, 160], [3, 3], [1, 1]),
        ([2, 18, 78], [3, 3], [1, 1]),
        ([1, 8, 16], [3, 3], [1, 1]),
        ([1, 1, 1], [1, 1], [1, 1]),
        ([1, 1, 1], [3, 3], [1, 1]),
        ([2, 37, 33], [7, 5], [1, 1]),
        ([1, 3, 95], [2, 4], [1, 1]),
        ([2, 5, 37], [3, 3], [1, 2]),
        ([2, 9, 35], [3, 2], [2, 1]),
        ([1, 8, 8], [2, 2], [3, 5]),
        ([1, 34, 9], [6, 7], [2, 3]),
        ([2, 3, 3], [4, 2], [1, 1]),
    ];
    for ([c, h, w], [kh, kw], [stride_h, stride_w]) in sizes {
        let windows = pool::PoolShape { c, h, w, kh, kw, stride_h, stride_w };
        for pads in [[0, 0], [kh / 2, kw / 2], [kh - 1, 0], [0, kw - 1], [kh - 1, kw - 1]] {
            let shape = blur::BlurShape { windows, pad_h: pads[0], pad_w: pads[1] };
            let (x_len, y_len) = (c * h * w, c * shape.out_h() * shape.out_w());
            for n in [0, 1, 3] {
                let (x, dy) = (numbers(1, n * x_len), numbers(2, n * y_len));
                for isa in isas() {
                    let what = format!("{} n={n} {shape:?}", isa.name());
                    let mut scratch = nans(shape.scratch_len());
                    let (mut expected, mut actual) = (nans(n * y_len), nans(n * y_len));
                    reference::blur_forward(&shape, n, &x, &mut expected);
                    blur::blur_forward(isa, &shape, n, &x, &mut actual, &mut scratch);
                    failures.compare(&format!("blur_forward {what}"), &actual, &expected, 1e-6);
                    scratch.fill(f32::NAN);
                    let (mut expected, mut actual) = (nans(n * x_len), nans(n * x_len));
                    reference::blur_backward(&shape, n, &dy, &mut expected);
                    blur::blur_backward(isa, &shape, n, &dy, &mut actual, &mut scratch);
                    failures.compare(&format!("blur_backward {what}"), &actual, &expected, 1e-6);
                }
            }
        }
    }
    failures.report();
}

#[test]
fn the_variance_of_what_deviates_little_from_a_large_mean_is_kept() {
    for isa in isas() {
        for (c, hw) in [(2, 5616), (3, 6004), (2, 47)] {
            for deviation in [0.0, 0.25] {
                let n = 3;
                let x: Vec<f32> = numbers(1, n * c * hw).iter().map(|v| 300.1 + deviation * v).collect();
                let (mut expected, mut actual) = (vec![0.0; 2 * c], vec![0.0; 2 * c]);
                reference::channel_sums(c, hw, &x, &mut expected);
                norm::channel_sums(isa, n, c, hw, &x, &mut actual);
                let count = (n * hw) as f64;
                for channel in 0..c {
                    let [expected, actual] = [&expected, &actual].map(|sums| {
                        let mean = sums[channel] / count;
                        sums[c + channel] / count - mean * mean
                    });
                    // The sums of the loops in double precision have an error of their own.
                    let error = (actual - expected).abs();
                    let what = format!("{} c={c} hw={hw} deviation {deviation}", isa.name());
                    assert!(error <= 1e-6 * expected.abs() + 1e-7, "{what}: variance {actual}, not {expected}");
                }
            }
        }
    }
}

#[test]
fn normalisation_agrees_with_the_loops() {
    let mut failures = Failures::default();
    let narrow = |sums: Vec<f64>| sums.iter().map(|&sum| sum as f32).collect::<Vec<f32>>();
    for isa in isas() {
        for (n, c, hw) in [(0, 3, 5), (1, 1, 1), (2, 3, 15), (3, 2, 16), (2, 4, 129), (1, 2, 5000)] {
            let what = format!("{} n={n} c={c} hw={hw}", isa.name());
            let (x, dy) = (numbers(1, n * c * hw), numbers(2, n * c * hw));
            let stats: [Vec<f32>; 5] = [3, 4, 5, 6, 7].map(|seed| numbers(seed, c));
            let [mean, inv_std, a, b, g] = &stats;
            let (mut expected, mut actual) = (vec![0.25f64; 2 * c], vec![0.25f64; 2 * c]);
            reference::channel_sums(c, hw, &x, &mut expected);
            norm::channel_sums(isa, n, c, hw, &x, &mut actual);
            failures.compare(&format!("channel_sums {what}"), &narrow(actual), &narrow(expected), 1e-6);
            let (mut expected, mut actual) = (vec![0.25f64; 2 * c], vec![0.25f64; 2 * c]);
            reference::norm_backward_sums((c, hw), &x, &dy, mean, inv_std, &mut expected);
            norm::norm_backward_sums(isa, n, c, hw, &x, &dy, mean, inv_std, &mut actual);
            failures.compare(&format!("norm_backward_sums {what}"), &narrow(actual), &narrow(expected), 1e-6);
            let (mut expected, mut actual) = (nans(x.len()), nans(x.len()));
            reference::normalize(c, hw, &x, a, b, &mut expected);
            norm::normalize(isa, n, c, hw, &x, a, b, &mut actual);
            failures.compare(&format!("normalize {what}"), &actual, &expected, 1e-6);
            let (mut expected, mut actual) = (nans(x.len()), nans(x.len()));
            reference::norm_backward((c, hw), &x, &dy, [mean, inv_std, a, b, g], &mut expected);
            norm::norm_backward(isa, n, c, hw, &x, &dy, mean, inv_std, a, b, g, &mut actual);
            failures.compare(&format!("norm_backward {what}"), &actual, &expected, 1e-6);
        }
    }
    failures.report();
}

#[test]
fn updates_agree_with_the_loops() {
    let mut failures = Failures::default();
    let step = AdamStep {
        lr: 0.01,
        beta1: 0.9,
        beta2: 0.99,
        epsilon: 1e-7,
        bias_correction1: 0.19,
        bias_correction2: 0.0199,
        l2: 0.1,
        decoupled_decay: 0.2,
    };
    for isa in isas() {
        for &len in LENGTHS {
            let what = format!("{} {len}", isa.name());
            let (grads, v) = (numbers(2, len), numbers(4, len).iter().map(|v| v.abs()).collect::<Vec<_>>());
            let mut expected = [numbers(1, len), numbers(3, len), v];
            let mut actual = expected.clone();
            // A large epsilon tells whether it stands outside the root.
            for epsilon in [1e-7, 0.3] {
                let step = AdamStep { epsilon, ..step };
                let [p, m, v] = &mut expected;
                reference::adam(&step, p, &grads, m, v);
                let [p, m, v] = &mut actual;
                update::adam(isa, &step, p, &grads, m, v);
                failures.compare(&format!("adam {what}, {epsilon}"), &actual.concat(), &expected.concat(), 2e-6);
            }

            let mut expected = [numbers(1, len), numbers(3, len)];
            let mut actual = expected.clone();
            let [p, velocity] = &mut expected;
            reference::sgd_momentum(0.1, 0.9, 0.01, p, &grads, velocity);
            let [p, velocity] = &mut actual;
            update::sgd_momentum(isa, 0.1, 0.9, 0.01, p, &grads, velocity);
            failures.compare(&format!("sgd_momentum {what}"), &actual.concat(), &expected.concat(), 1e-6);

            let [mut sum, mut scaled] = [numbers(1, len), numbers(1, len)];
            update::sum_into(isa, &mut sum, &grads);
            update::scale(isa, &mut scaled, -3.0);
            let x = numbers(1, len);
            let expected: Vec<f32> = x.iter().zip(&grads).map(|(x, g)| x + g).collect();
            failures.compare(&format!("sum_into {what}"), &sum, &expected, 0.0);
            let mut moved = x.clone();
            update::move_towards(isa, 0.3, &mut moved, &grads);
            let expected: Vec<f32> =
                x.iter().zip(&grads).map(|(x, g)| (0.7 * f64::from(*x) + 0.3 * f64::from(*g)) as f32).collect();
            failures.compare(&format!("move_towards {what}"), &moved, &expected, 1e-6);
            let expected: Vec<f32> = x.iter().map(|x| x * -3.0).collect();
            failures.compare(&format!("scale {what}"), &scaled, &expected, 0.0);
            let expected: f64 = x.iter().map(|&x| f64::from(x).powi(2)).sum();
            let actual = update::sum_of_squares(isa, &x);
            failures.compare(&format!("sum_of_squares {what}"), &[actual as f32], &[expected as f32], 1e-6);
        }
    }
    failures.report();
}

#[test]
fn noise_is_the_same_on_every_instruction_set_even_and_held_between_black_and_white() {
    let noise = |isa, key, step, grey, len| {
        let mut greys = vec![grey; len];
        pixels::add_noise(isa, key, step, &mut greys);
        greys
    };
    for isa in isas() {
        for len in [0, 1, 3, 4, 63, 64, 65, 130, 1000] {
            let expected = noise(steersman_kernels::Isa::PORTABLE, [3, 5], 129, 128, 1000);
            assert_eq!(noise(isa, [3, 5], 129, 128, len), expected[..len], "{} {len}", isa.name());
        }
        // With a step of 256 an error is a random number of [-127, 127]: -127 twice as often as each other.
        let mut counts = [0usize; 256];
        let greys = noise(isa, [1, 2], 256, 128, 256 * 400);
        greys.iter().for_each(|grey| counts[usize::from(*grey)] += 1);
        assert!(counts[0] == 0 && (700..900).contains(&counts[1]), "{:?}", &counts[..2]);
        assert!(counts[2..].iter().all(|count| (300..500).contains(count)), "{counts:?}");
        assert!(noise(isa, [1, 2], 128, 250, 5000).contains(&255));
        assert!(noise(isa, [1, 2], 128, 5, 5000).contains(&0));
        assert!(noise(isa, [1, 2], 0, 77, 500).iter().all(|grey| *grey == 77));
        assert_ne!(noise(isa, [1, 2], 128, 128, 64), noise(isa, [2, 2], 128, 128, 64));
    }
}

#[test]
#[should_panic(expected = "more than 256")]
fn noise_that_would_not_fit_16_bits_is_refused() {
    pixels::add_noise(steersman_kernels::Isa::PORTABLE, [1, 2], 257, &mut [0; 4]);
}

#[test]
fn pixels_agree_with_the_loops() {
    let mut failures = Failures::default();
    for isa in isas() {
        for len in [0, 1, 15, 16, 17, 256, 1027] {
            let src: Vec<u8> = (0..len).map(|i| (i * 7 % 256) as u8).collect();
            let (mut expected, mut actual) = (nans(len), nans(len));
            reference::u8_to_f32(&src, 1.0 / 127.5, -1.0, &mut expected);
            pixels::u8_to_f32(isa, &src, 1.0 / 127.5, -1.0, &mut actual);
            failures.compare(&format!("u8_to_f32 {} {len}", isa.name()), &actual, &expected, 1e-6);

            // Sums of quarters and halves are exact, so rounding is decided alike everywhere.
            let constant: Vec<f32> = (0..len).map(|i| (i * 37 % 800) as f32 * 0.25 - 100.0).collect();
            let slope: Vec<f32> = (0..len).map(|i| (i * 11 % 200) as f32 - 100.0).collect();
            let rgb = [src.as_slice(); 3].concat();
            let (mut expected, mut actual) = (rgb.clone(), rgb.clone());
            reference::add_grey(&constant, &slope, 0.5, &mut expected);
            pixels::add_grey(isa, &constant, &slope, 0.5, &mut actual);
            assert_eq!(actual, expected, "add_grey {} {len}", isa.name());

            let matrix = [[0.5, -0.25, 0.75], [1.5, 0.0, -1.0], [0.1, 0.2, 0.9]];
            let (mut expected, mut actual) = (rgb.clone(), rgb);
            reference::recolour(&matrix, 20.5, &mut expected);
            pixels::recolour(isa, &matrix, 20.5, &mut actual);
            assert_eq!(actual, expected, "recolour {} {len}", isa.name());
        }
    }
    failures.report();
}
