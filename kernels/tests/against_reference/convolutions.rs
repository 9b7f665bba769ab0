//! Convolution and its gradients.

use super::{Failures, isas, nans, numbers};
use steersman_kernels::conv::{Conv, ConvAlgorithm, ConvShape};
use steersman_kernels::im2col::{col2im, im2col};
use steersman_kernels::{Backend, Isa, reference};

/// Sizes c, h, w, oc; kernel; stride; padding top, bottom, left, right.
type Case = ([usize; 4], [usize; 2], [usize; 2], [usize; 4]);

const CASES: &[Case] = &[
    // The layers of the networks, cut down in height or channels where that changes nothing.
    ([3, 6, 160, 8], [3, 3], [1, 1], [0; 4]),
    ([8, 5, 158, 16], [3, 3], [1, 1], [0; 4]),
    ([16, 5, 78, 24], [3, 3], [1, 1], [0; 4]),
    ([24, 8, 38, 32], [3, 3], [1, 1], [0; 4]),
    ([32, 3, 18, 64], [3, 3], [1, 1], [0; 4]),
    ([1, 64, 64, 6], [3, 3], [1, 1], [0; 4]),
    ([6, 15, 15, 16], [3, 3], [1, 1], [0; 4]),
    ([3, 13, 200, 24], [5, 5], [2, 2], [0; 4]),
    ([24, 9, 98, 36], [5, 5], [2, 2], [0; 4]),
    ([36, 14, 47, 48], [5, 5], [2, 2], [0; 4]),
    ([48, 5, 22, 64], [3, 3], [1, 1], [0; 4]),
    ([64, 3, 20, 64], [3, 3], [1, 1], [0; 4]),
    // Tile borders: output widths 1, 15, 16, 17, 47, 48, 49 and channels 1, 3, 7, 9.
    ([1, 1, 1, 1], [1, 1], [1, 1], [0; 4]),
    ([2, 3, 17, 7], [3, 3], [1, 1], [0; 4]),
    ([2, 3, 18, 9], [3, 3], [1, 1], [0; 4]),
    ([2, 4, 19, 3], [3, 3], [1, 1], [0; 4]),
    ([1, 2, 48, 5], [2, 2], [1, 1], [0; 4]),
    ([1, 2, 49, 4], [2, 2], [1, 1], [0; 4]),
    ([1, 2, 50, 8], [2, 2], [1, 1], [0; 4]),
    // Padding, uneven padding, strides that differ, kernels smaller than the stride, input that no window touches.
    ([3, 7, 9, 5], [3, 3], [1, 1], [1; 4]),
    ([3, 7, 9, 5], [3, 3], [2, 2], [0, 1, 0, 1]),
    ([2, 6, 11, 4], [5, 2], [2, 3], [2, 1, 0, 3]),
    ([2, 9, 10, 3], [1, 1], [2, 2], [0; 4]),
    ([2, 8, 10, 3], [2, 1], [3, 4], [1, 0, 2, 0]),
    ([1, 4, 4, 2], [3, 3], [1, 1], [4, 4, 5, 3]),
    ([1, 2, 2, 2], [1, 1], [2, 2], [3, 3, 3, 3]),
    ([4, 5, 6, 6], [5, 6], [1, 1], [0; 4]),
    // Minimal filtering: several strips of a map, tiles of 2 rows, a last tile that stands over, images side by side in a strip,
    // strides and padding.
    ([8, 38, 158, 16], [3, 3], [1, 1], [0; 4]),
    ([12, 16, 98, 12], [5, 5], [2, 2], [0; 4]),
    ([6, 4, 100, 8], [3, 3], [1, 1], [0; 4]),
    ([5, 12, 75, 7], [3, 4], [1, 1], [1, 1, 2, 1]),
    ([4, 21, 60, 9], [5, 5], [2, 2], [1, 2, 1, 2]),
    ([3, 23, 47, 6], [6, 5], [2, 3], [2, 1, 0, 1]),
    ([4, 40, 14, 5], [7, 3], [3, 1], [0, 0, 4, 4]),
    ([64, 62, 70, 8], [3, 3], [1, 1], [0; 4]),
    ([3, 37, 60, 8], [5, 5], [2, 2], [0; 4]),
    ([6, 2, 100, 8], [3, 3], [1, 1], [0, 2, 0, 0]),
    // One output and many channels: the weight gradient as a matrix product.
    ([5, 3, 3, 40], [3, 3], [1, 1], [0; 4]),
    // A 1x1 kernel, whose columns are the image itself.
    ([6, 5, 7, 9], [1, 1], [1, 1], [0; 4]),
    // A kernel that does not fit: no output.
    ([2, 2, 2, 3], [3, 3], [1, 1], [0; 4]),
];

fn shape(&([c, h, w, oc], [kh, kw], [stride_h, stride_w], pad): &Case) -> ConvShape {
    let [pad_top, pad_bottom, pad_left, pad_right] = pad;
    ConvShape { c, h, w, oc, kh, kw, stride_h, stride_w, pad_top, pad_bottom, pad_left, pad_right }
}

/// Every instruction set with the algorithm of its choice, and the textbook algorithm, which has but one.
fn backends() -> Vec<Backend> {
    let auto = isas().into_iter().map(|isa| Backend { isa, conv: ConvAlgorithm::Auto });
    auto.chain([Backend { isa: Isa::PORTABLE, conv: ConvAlgorithm::Im2col }]).collect()
}

#[test]
fn convolutions_agree_with_the_loops() {
    let mut failures = Failures::default();
    for case in CASES {
        let shape = shape(case);
        let x_len = shape.c * shape.h * shape.w;
        let y_len = shape.oc * shape.out_h() * shape.out_w();
        let weight = numbers(1, shape.oc * shape.c * shape.kh * shape.kw);
        let bias = numbers(2, shape.oc);
        for n in [0, 1, 2, 5, 9] {
            let (x, dy) = (numbers(3, n * x_len), numbers(4, n * y_len));
            let (mut y, mut dx) = (nans(n * y_len), nans(n * x_len));
            let (mut dweight, mut dbias) = (weight.clone(), bias.clone());
            reference::conv_forward(&shape, n, &x, &weight, &bias, &mut y);
            reference::conv_backward_input(&shape, n, &dy, &weight, &mut dx);
            reference::conv_backward_weight(&shape, n, &x, &dy, &mut dweight, &mut dbias);
            for backend in backends() {
                let conv = Conv::new(shape, backend);
                let what = format!("{} {} n={n} {shape:?}", backend.isa.name(), backend.conv);
                let mut actual = nans(n * y_len);
                conv.forward(n, &x, &weight, &bias, &mut actual, &mut nans(conv.scratch_len()));
                failures.compare(&format!("forward {what}"), &actual, &y, 1e-5);
                let (mut packed, plain) = (nans(conv.packed_len()), actual.clone());
                conv.pack(&weight, &bias, &mut packed);
                conv.forward_packed(n, &x, &packed, &mut actual, &mut nans(conv.scratch_len()));
                assert_eq!(actual, plain, "forward_packed {what}");
                let mut actual = nans(n * x_len);
                conv.backward_input(n, &dy, &weight, &mut actual, &mut nans(conv.scratch_len()));
                failures.compare(&format!("backward_input {what}"), &actual, &dx, 1e-5);
                let (mut packed, plain) = (nans(conv.packed_gradient_len()), actual.clone());
                conv.pack_gradient(&weight, &mut packed);
                conv.backward_input_packed(n, &dy, &packed, &mut actual, &mut nans(conv.scratch_len()));
                assert_eq!(actual, plain, "backward_input_packed {what}");
                let (mut actual, mut actual_bias) = (weight.clone(), bias.clone());
                let scratch = &mut nans(conv.scratch_len());
                conv.backward_weight(n, &x, &dy, &mut actual, &mut actual_bias, scratch);
                failures.compare(&format!("backward_weight {what}"), &actual, &dweight, 1e-5);
                failures.compare(&format!("bias gradient {what}"), &actual_bias, &dbias, 1e-5);
            }
        }
    }
    failures.report();
}

#[test]
fn the_result_of_an_image_does_not_depend_on_the_batch() {
    for case in CASES {
        let shape = shape(case);
        let (x_len, y_len) = (shape.c * shape.h * shape.w, shape.oc * shape.out_h() * shape.out_w());
        let weight = numbers(1, shape.oc * shape.c * shape.kh * shape.kw);
        let bias = numbers(2, shape.oc);
        for backend in backends() {
            let conv = Conv::new(shape, backend);
            let mut scratch = nans(conv.scratch_len());
            let (n, x, dy) = (11, numbers(3, 11 * x_len), numbers(4, 11 * y_len));
            let (mut y, mut dx) = (nans(n * y_len), nans(n * x_len));
            conv.forward(n, &x, &weight, &bias, &mut y, &mut scratch);
            conv.backward_input(n, &dy, &weight, &mut dx, &mut scratch);
            for image in [0, 4, 10] {
                let (mut y_alone, mut dx_alone) = (nans(y_len), nans(x_len));
                conv.forward(1, &x[image * x_len..][..x_len], &weight, &bias, &mut y_alone, &mut scratch);
                conv.backward_input(1, &dy[image * y_len..][..y_len], &weight, &mut dx_alone, &mut scratch);
                assert!(y_alone == y[image * y_len..][..y_len], "{backend:?} forward {image} {shape:?}");
                assert!(dx_alone == dx[image * x_len..][..x_len], "{backend:?} gradient {image} {shape:?}");
            }
        }
    }
}

#[test]
fn columns_are_what_each_tap_sees_and_go_back_to_where_they_came_from() {
    for case in CASES {
        let s = shape(case);
        let (taps, pixels) = (s.c * s.kh * s.kw, s.out_h() * s.out_w());
        let x = numbers(3, s.c * s.h * s.w);
        let mut columns = nans(taps * pixels);
        im2col(&s, &x, &mut columns);
        let (values, mut back) = (numbers(4, columns.len()), vec![0.0; x.len()]);
        col2im(&s, &values, &mut back);
        let mut expected = vec![0.0; x.len()];
        for (at, (&actual, &value)) in columns.iter().zip(&values).enumerate() {
            let (tap, pixel) = (at / pixels, at % pixels);
            let (c, ky, kx) = (tap / s.kw / s.kh, tap / s.kw % s.kh, tap % s.kw);
            let (iy, ix) = (pixel / s.out_w() * s.stride_h + ky, pixel % s.out_w() * s.stride_w + kx);
            let inside = (s.pad_top..s.pad_top + s.h).contains(&iy) && (s.pad_left..s.pad_left + s.w).contains(&ix);
            let index = inside.then(|| (c * s.h + iy - s.pad_top) * s.w + ix - s.pad_left);
            assert_eq!(actual, index.map_or(0.0, |index| x[index]), "tap {tap}, output {pixel} of {s:?}");
            index.into_iter().for_each(|index| expected[index] += value);
        }
        let mut failures = Failures::default();
        failures.compare(&format!("col2im {s:?}"), &back, &expected, 1e-6);
        failures.report();
    }
}
