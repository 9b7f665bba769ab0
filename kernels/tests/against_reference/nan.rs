//! A NaN in the input: what the docs of each kernel say.

use super::isas;
use steersman_kernels::conv::{ConvShape, PooledConv};
use steersman_kernels::norm_rectify::{self, ChannelMeans, ChannelStatistics, RectifyShape, Slopes};
use steersman_kernels::pool::{self, PoolShape};
use steersman_kernels::{Isa, activation};

/// Whether two slices are equal, with NaN equal to NaN.
fn same(a: &[f32], b: &[f32]) -> bool {
    a.len() == b.len() && a.iter().zip(b).all(|(a, b)| a == b || (a.is_nan() && b.is_nan()))
}

const NAN: f32 = f32::NAN;

#[test]
fn relu_makes_zero_of_nan_and_the_other_activations_pass_it_on() {
    for isa in isas() {
        let x = [[1.0, NAN, -1.0], [NAN, NAN, 2.0]].as_flattened().repeat(9);
        let apply = |f: &dyn Fn(&mut [f32])| {
            let mut y = vec![0.5; x.len()];
            f(&mut y);
            y
        };
        let relu = apply(&|y| activation::relu_forward(isa, &x, y));
        assert!(same(&relu[..6], &[1.0, 0.0, 0.0, 0.0, 0.0, 2.0]), "{}: {relu:?}", isa.name());
        let dx = apply(&|dx| activation::relu_backward(isa, &relu, &vec![3.0; x.len()], dx));
        assert!(same(&dx[..6], &[3.0, 0.0, 0.0, 0.0, 0.0, 3.0]), "{}: {dx:?}", isa.name());
        for (name, y) in [
            ("elu", apply(&|y| activation::elu_forward(isa, 1.0, &x, y))),
            ("leaky relu", apply(&|y| activation::leaky_relu_forward(isa, 0.1, &x, y))),
            ("tanh", apply(&|y| activation::tanh_forward(isa, &x, y))),
            ("softsign", apply(&|y| activation::softsign_forward(isa, &x, y))),
            ("swish", apply(&|y| activation::swish_forward(isa, &x, y))),
            ("prelu", apply(&|y| activation::prelu_forward(isa, 1, &[0.1, 0.2], x.len() / 2, &x, y))),
        ] {
            let agree = x.iter().zip(&y).all(|(x, y)| x.is_nan() == y.is_nan());
            assert!(agree, "{name} on {}: {y:?}", isa.name());
        }
    }
}

/// The window `values` of 2x2, forward and backward with `dy = 1`.
fn pooled(isa: Isa, values: [f32; 4]) -> (f32, [f32; 4]) {
    let shape = PoolShape { c: 1, h: 2, w: 2, kh: 2, kw: 2, stride_h: 2, stride_w: 2 };
    let (mut y, mut dx) = ([0.5], [0.5; 4]);
    pool::max_forward(isa, &shape, 1, &values, &mut y);
    pool::max_backward(isa, &shape, 1, &values, &y, &[1.0], &mut dx);
    (y[0], dx)
}

#[test]
fn max_pooling_skips_nan_and_average_pooling_passes_it_on() {
    for isa in isas() {
        assert_eq!(pooled(isa, [NAN, 1.0, 2.0, NAN]), (2.0, [0.0, 0.0, 1.0, 0.0]), "{}", isa.name());
        assert_eq!(pooled(isa, [NAN; 4]), (f32::NEG_INFINITY, [0.0; 4]), "{}", isa.name());
        let shape = PoolShape { c: 1, h: 2, w: 2, kh: 2, kw: 2, stride_h: 2, stride_w: 2 };
        let mut y = [0.5];
        pool::average_forward(isa, &shape, 1, &[1.0, NAN, 1.0, 1.0], &mut y);
        assert!(y[0].is_nan(), "{}: {y:?}", isa.name());
    }
}

#[test]
fn a_pooled_convolution_skips_nan_but_in_the_upper_left_place() {
    let [pad_top, pad_bottom, pad_left, pad_right] = [0; 4];
    let (stride_h, stride_w) = (1, 1);
    let shape = ConvShape {
        c: 1,
        h: 6,
        w: 10,
        oc: 1,
        kh: 3,
        kw: 3,
        stride_h,
        stride_w,
        pad_top,
        pad_bottom,
        pad_left,
        pad_right,
    };
    // Only the first weight is not 0, but 0 times NaN is NaN too: a NaN spoils the places whose kernels lie over it.
    let weight: Vec<f32> = (0..9).map(|tap| if tap == 0 { 1.0 } else { 0.0 }).collect();
    for isa in isas() {
        let conv = PooledConv::new(shape, isa).unwrap();
        let (mut packed, mut scratch) = (vec![0.0; conv.packed_len()], vec![0.0; conv.scratch_len()]);
        conv.pack(&weight, &[0.0], &mut packed);
        let mut run = |nan: Option<usize>| {
            let mut x: Vec<f32> = (0..60).map(|i| (i * 7 % 32) as f32).collect();
            nan.into_iter().for_each(|at| x[at] = NAN);
            let (mut y, mut argmax) = ([0.5f32; 2], [99; 2]);
            conv.forward(1, &x, &packed, &mut y, &mut argmax, &mut scratch);
            (y, argmax)
        };
        // Place (row, column) of the map is `7 (10 row + column) mod 32`: 27 at (1, 3) and 29 at (2, 7) are the largest.
        assert_eq!(run(None), ([27.0, 29.0], [13, 27]), "{}", isa.name());
        // The kernels at (2, 7) and (3, 7) lie over the NaN. The next is 28, at (0, 4) and (3, 6).
        assert_eq!(run(Some(49)), ([27.0, 28.0], [13, 4]), "{}", isa.name());
        let (y, argmax) = run(Some(0));
        assert!(y[0].is_nan() && argmax[0] == 0 && !y[1].is_nan(), "{}: {y:?} {argmax:?}", isa.name());
    }
}

#[test]
fn norm_rectify_treats_nan_as_it_says() {
    let shape = RectifyShape { c: 1, h: 2, w: 6, pooled: true };
    // Three windows: NaN in the upper left, in the upper right, everywhere.
    let x = [[NAN, 1.0, 2.0, NAN, NAN, NAN], [2.0, 3.0, 5.0, 4.0, NAN, NAN]].concat();
    let (mean, inv_std, scale, shift, zero) = ([0.0], [1.0], [1.0], [0.0], [0.0]);
    let statistics = ChannelStatistics { mean: &mean, inv_std: &inv_std, scale: &scale, shift: &shift };
    let means = ChannelMeans { dz: &zero, dz_xhat: &zero, gain: &[1.0] };
    for isa in isas() {
        let mut y = [0.5; 3];
        norm_rectify::forward(isa, &shape, 1, &x, &scale, &shift, Slopes::Zero, &mut y);
        assert!(same(&y, &[3.0, 5.0, 0.0]), "{}: {y:?}", isa.name());
        norm_rectify::forward(isa, &shape, 1, &x, &scale, &shift, Slopes::PerChannel(&[0.1]), &mut y);
        assert!(same(&y, &[NAN, 5.0, NAN]), "{}: {y:?}", isa.name());
        let plain = RectifyShape { pooled: false, ..shape };
        let (mut relu, mut prelu) = ([0.5; 12], [0.5; 12]);
        norm_rectify::forward(isa, &plain, 1, &x, &scale, &shift, Slopes::Zero, &mut relu);
        norm_rectify::forward(isa, &plain, 1, &x, &scale, &shift, Slopes::PerChannel(&[0.1]), &mut prelu);
        for ((&x, relu), prelu) in x.iter().zip(relu).zip(prelu) {
            assert!(relu == if x.is_nan() { 0.0 } else { x }, "{}: ReLU of {x} is {relu}", isa.name());
            assert!(prelu.is_nan() == x.is_nan(), "{}: PReLU of {x} is {prelu}", isa.name());
        }
        // The gradient of a window of NaN alone reaches no element of ReLU: with a NaN in `x` itself the rest is NaN.
        let (mut sums, mut dslopes) = ([0.0; 2], []);
        let live = [[1.0, 2.0, 3.0, 0.5, NAN, NAN], [0.0, 1.0, 1.0, 1.0, NAN, NAN]].concat();
        norm_rectify::backward_sums(
            isa,
            &shape,
            1,
            &live,
            &[1.0, 2.0, 4.0],
            statistics,
            Slopes::Zero,
            &mut sums,
            &mut dslopes,
        );
        assert_eq!(sums[0], 3.0, "{}: the third window has no gradient", isa.name());
        let mut dx = live.clone();
        norm_rectify::backward(isa, &shape, 1, &mut dx, &[1.0, 2.0, 4.0], statistics, means, Slopes::Zero);
        assert!(same(&dx[..4], &[0.0, 1.0, 2.0, 0.0]), "{}: {dx:?}", isa.name());
    }
}
