//! Kernels that do what several others do, against those loops one after the other.

use super::{Failures, isas, nans, numbers};
use steersman_kernels::conv::{ConvShape, PooledConv};
use steersman_kernels::norm_rectify::{self, ChannelMeans, ChannelStatistics, RectifyShape, Slopes};
use steersman_kernels::{pool, reference};

/// Maps around the vector widths, even and odd, down to those without a window.
const MAPS: &[[usize; 3]] = &[
    [1, 1, 1],
    [2, 2, 2],
    [3, 3, 5],
    [2, 4, 15],
    [1, 5, 16],
    [2, 2, 17],
    [1, 6, 31],
    [2, 4, 32],
    [1, 3, 33],
    [2, 5, 47],
    [1, 2, 66],
    [3, 1, 700],
    [2, 37, 157],
];

#[test]
fn norm_rectify_agrees_with_its_parts() {
    let mut failures = Failures::default();
    for isa in isas() {
        for &[c, h, w] in MAPS {
            for pooled in [false, true] {
                for kind in ["relu", "a slope a channel", "a slope an element"] {
                    let n = 3;
                    let (hw, image) = (h * w, c * h * w);
                    let what = format!("{} {c}x{h}x{w} pooled {pooled} {kind}", isa.name());
                    let shape = RectifyShape { c, h, w, pooled };
                    let pool_shape = pool::PoolShape { c, h, w, kh: 2, kw: 2, stride_h: 2, stride_w: 2 };
                    let y_len = if pooled { n * c * pool_shape.out_h() * pool_shape.out_w() } else { n * image };
                    let (x, dy) = (numbers(1, n * image), numbers(2, y_len));
                    let (scale, shift, mean) = (numbers(3, c), numbers(4, c), numbers(5, c));
                    let inv_std: Vec<f32> = numbers(6, c).iter().map(|v| v + 1.5).collect();
                    let (a, b, g) = (numbers(7, c), numbers(8, c), numbers(9, c));
                    let list = numbers(10, if kind == "a slope an element" { image } else { c });
                    let (slopes, repeat) = match kind {
                        "relu" => (Slopes::Zero, 0),
                        "a slope a channel" => (Slopes::PerChannel(&list), hw),
                        _ => (Slopes::PerPosition(&list), 1),
                    };

                    let (mut z, mut f, mut y) = (nans(n * image), nans(n * image), nans(y_len));
                    reference::normalize(c, hw, &x, &scale, &shift, &mut z);
                    match slopes {
                        Slopes::Zero => reference::relu_forward(&z, &mut f),
                        _ => reference::prelu_forward(&list, repeat, &z, &mut f),
                    }
                    match pooled {
                        true => reference::max_forward(&pool_shape, n, &f, &mut y),
                        false => y.copy_from_slice(&f),
                    }
                    let mut actual = nans(y_len);
                    norm_rectify::forward(isa, &shape, n, &x, &scale, &shift, slopes, &mut actual);
                    failures.compare(&format!("forward {what}"), &actual, &y, 1e-6);

                    let (mut df, mut dz, mut dx) = (nans(n * image), nans(n * image), nans(n * image));
                    match pooled {
                        true => reference::max_backward(&pool_shape, n, &f, &y, &dy, &mut df),
                        false => df.copy_from_slice(&dy),
                    }
                    let slope_count = if kind == "relu" { 0 } else { list.len() };
                    let (mut dslopes, mut actual_dslopes) = (numbers(11, slope_count), numbers(11, slope_count));
                    match slopes {
                        Slopes::Zero => reference::relu_backward(&f, &df, &mut dz),
                        _ => reference::prelu_backward(&list, repeat, &z, &df, &mut dz, &mut dslopes),
                    }
                    let (mut sums, mut actual_sums) = (vec![0.5; 2 * c], vec![0.5; 2 * c]);
                    reference::norm_backward_sums((c, hw), &x, &dz, &mean, &inv_std, &mut sums);
                    reference::norm_backward((c, hw), &x, &dz, [&mean, &inv_std, &a, &b, &g], &mut dx);

                    let statistics = ChannelStatistics { mean: &mean, inv_std: &inv_std, scale: &scale, shift: &shift };
                    let ds = &mut actual_dslopes;
                    norm_rectify::backward_sums(isa, &shape, n, &x, &dy, statistics, slopes, &mut actual_sums, ds);
                    let narrow = |sums: &[f64]| sums.iter().map(|&sum| sum as f32).collect::<Vec<f32>>();
                    failures.compare(&format!("sums {what}"), &narrow(&actual_sums), &narrow(&sums), 1e-5);
                    failures.compare(&format!("slopes {what}"), &actual_dslopes, &dslopes, 1e-5);
                    let mut actual = x.clone();
                    let means = ChannelMeans { dz: &a, dz_xhat: &b, gain: &g };
                    norm_rectify::backward(isa, &shape, n, &mut actual, &dy, statistics, means, slopes);
                    failures.compare(&format!("backward {what}"), &actual, &dx, 1e-5);
                }
            }
        }
    }
    failures.report();
}

#[test]
fn of_equal_values_in_a_window_the_first_gets_the_gradient() {
    let mut failures = Failures::default();
    let [c, h, w, n] = [2, 6, 70, 2];
    let (hw, len) = (h * w, n * c * h * w);
    let shape = RectifyShape { c, h, w, pooled: true };
    let pool_shape = pool::PoolShape { c, h, w, kh: 2, kw: 2, stride_h: 2, stride_w: 2 };
    // So coarse that nothing is rounded and most windows have two largest values or more, on both sides of 0.
    let x: Vec<f32> = numbers(1, len).iter().map(|v| (2.0 * v).round() / 2.0).collect();
    let dy = numbers(2, len / 4);
    let (scale, shift, list) = ([2.0, -0.5], [-0.5, 0.25], [0.5, -1.0]);
    let (mean, inv_std, gain, none) = ([0.0; 2], [1.0; 2], [1.0; 2], [0.0; 2]);
    for isa in isas() {
        for slopes in [Slopes::Zero, Slopes::PerChannel(&list)] {
            let (mut z, mut f, mut y) = (nans(len), nans(len), nans(len / 4));
            let (mut df, mut dz) = (nans(len), nans(len));
            reference::normalize(c, hw, &x, &scale, &shift, &mut z);
            match slopes {
                Slopes::Zero => reference::relu_forward(&z, &mut f),
                _ => reference::prelu_forward(&list, hw, &z, &mut f),
            }
            reference::max_forward(&pool_shape, n, &f, &mut y);
            reference::max_backward(&pool_shape, n, &f, &y, &dy, &mut df);
            match slopes {
                Slopes::Zero => reference::relu_backward(&f, &df, &mut dz),
                _ => reference::prelu_backward(&list, hw, &z, &df, &mut dz, &mut [0.0; 2]),
            }
            let statistics = ChannelStatistics { mean: &mean, inv_std: &inv_std, scale: &scale, shift: &shift };
            let means = ChannelMeans { dz: &none, dz_xhat: &none, gain: &gain };
            let mut actual = x.clone();
            norm_rectify::backward(isa, &shape, n, &mut actual, &dy, statistics, means, slopes);
            failures.compare(&format!("{} {slopes:?}", isa.name()), &actual, &dz, 0.0);
            let (mut sums, mut actual_sums) = ([0.0; 4], [0.0; 4]);
            reference::norm_backward_sums((c, hw), &x, &dz, &mean, &inv_std, &mut sums);
            let mut dslopes = vec![0.0; if slopes == Slopes::Zero { 0 } else { c }];
            norm_rectify::backward_sums(isa, &shape, n, &x, &dy, statistics, slopes, &mut actual_sums, &mut dslopes);
            let [sums, actual_sums] = [sums, actual_sums].map(|sums| sums.map(|sum| sum as f32));
            failures.compare(&format!("sums {} {slopes:?}", isa.name()), &actual_sums, &sums, 1e-5);
        }
    }
    failures.report();
}

#[test]
fn a_pooled_convolution_agrees_with_its_parts() {
    let mut failures = Failures::default();
    let shapes = [
        ([1, 14, 18, 3], 3),
        ([3, 11, 7, 2], 3),
        ([2, 9, 13, 5], 5),
        ([1, 6, 6, 1], 3),
        ([1, 64, 64, 6], 3),
        ([6, 15, 15, 16], 3),
        ([2, 7, 141, 9], 3),
    ];
    for isa in isas() {
        for ([c, h, w, oc], k) in shapes {
            let n = 11;
            let [pad_top, pad_bottom, pad_left, pad_right] = [0; 4];
            let (stride_h, stride_w) = (1, 1);
            let shape =
                ConvShape { c, h, w, oc, kh: k, kw: k, stride_h, stride_w, pad_top, pad_bottom, pad_left, pad_right };
            let what = format!("{} {shape:?}", isa.name());
            let pool_shape =
                pool::PoolShape { c: oc, h: shape.out_h(), w: shape.out_w(), kh: 4, kw: 4, stride_h: 4, stride_w: 4 };
            let (out_h, out_w) = (pool_shape.out_h(), pool_shape.out_w());
            // Whole numbers: nothing is rounded, and many windows have two largest values or more.
            let whole = |seed, len| numbers(seed, len).iter().map(|v| v.round()).collect::<Vec<f32>>();
            let (x, weight, bias) = (whole(3, n * c * h * w), whole(4, oc * c * k * k), whole(5, oc));
            let mut map = nans(n * oc * shape.out_pixels());
            reference::conv_forward(&shape, n, &x, &weight, &bias, &mut map);
            let mut max = nans(n * oc * out_h * out_w);
            reference::max_forward(&pool_shape, n, &map, &mut max);
            let mut first = Vec::new();
            for (plane, max) in map.chunks_exact(shape.out_pixels()).zip(max.chunks_exact(out_h * out_w)) {
                for (at, max) in max.iter().enumerate() {
                    let (top, left) = (at / out_w * 4, at % out_w * 4);
                    let mut places = (0..16).map(|place| (top + place / 4, left + place % 4));
                    let (row, column) =
                        places.find(|(row, column)| plane[row * shape.out_w() + column] == *max).unwrap();
                    first.push((row * w + column) as u32);
                }
            }

            let conv = PooledConv::new(shape, isa).unwrap();
            let (mut packed, mut scratch) = (nans(conv.packed_len()), nans(conv.scratch_len()));
            conv.pack(&weight, &bias, &mut packed);
            let (mut y, mut argmax) = (nans(max.len()), vec![u32::MAX; max.len()]);
            conv.forward(n, &x, &packed, &mut y, &mut argmax, &mut scratch);
            failures.compare(&format!("maximum {what}"), &y, &max, 0.0);
            assert_eq!(argmax, first, "{what}");
            let mut y = nans(max.len());
            conv.forward(n, &x, &packed, &mut y, &mut [], &mut scratch);
            failures.compare(&format!("maximum alone {what}"), &y, &max, 0.0);

            let dpooled = numbers(2, max.len());
            let (mut dweight, mut dbias) = (numbers(5, weight.len()), numbers(6, oc));
            let (mut actual_dweight, mut actual_dbias) = (dweight.clone(), dbias.clone());
            let (mut dmap, mut dx, mut actual_dx) = (nans(map.len()), nans(x.len()), nans(x.len()));
            reference::max_backward(&pool_shape, n, &map, &max, &dpooled, &mut dmap);
            reference::conv_backward_weight(&shape, n, &x, &dmap, &mut dweight, &mut dbias);
            reference::conv_backward_input(&shape, n, &dmap, &weight, &mut dx);
            conv.backward_weight(n, &x, &argmax, &dpooled, &mut actual_dweight, &mut actual_dbias);
            conv.backward_input(n, &argmax, &dpooled, &weight, &mut actual_dx);
            failures.compare(&format!("weight {what}"), &actual_dweight, &dweight, 1e-5);
            failures.compare(&format!("bias {what}"), &actual_dbias, &dbias, 1e-5);
            failures.compare(&format!("input {what}"), &actual_dx, &dx, 1e-5);
        }
    }
    failures.report();
}
