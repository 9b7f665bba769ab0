//! Holds what a kind of layer says of itself against what its layer computes.

use steersman_kernels::Isa;

use super::{ExportForm, Family, LayerKind, ReceptiveField};
use crate::engine::layers::Taps;
use crate::engine::layers::gradcheck::Harness;
use crate::engine::tensor::Shape;

/// Asks `kind` all questions of [`LayerKind`] and checks the answers on inputs of shape `input`.
///
/// - The receptive field is measured: each input value is moved, and the outputs that change must be those that see it.
/// - An elementwise formula and a convolution give what the layer computes; a layer left out of exports computes nothing.
/// - Name, family and receptive field go together.
///
/// Small inputs will do: the layer runs twice for each input value.
///
/// # Panics
///
/// If the layer cannot be built for `input`, or an answer is wrong, naming it.
pub fn check_kind(kind: &dyn LayerKind, input: Shape) {
    let name = kind.base_name();
    let is_name = !name.is_empty() && name.chars().all(|c| c.is_ascii_lowercase() || c == '_');
    assert!(is_name, "base name `{name}` of {kind:?} is not made of lower-case letters and _");
    assert!(!kind.describe().trim().is_empty(), "{kind:?} has no description");
    let fits = match kind.family() {
        Family::Activation | Family::Normalization | Family::Regularization => {
            kind.receptive_field(input) == ReceptiveField::Element
        }
        Family::Convolution => matches!(kind.receptive_field(input), ReceptiveField::Window { .. }),
        Family::Pooling => {
            matches!(kind.receptive_field(input), ReceptiveField::Window { .. } | ReceptiveField::Resized { .. })
        }
        Family::Dense => kind.receptive_field(input) == ReceptiveField::All,
        Family::Rearrangement => kind.receptive_field(input) != ReceptiveField::Element,
    };
    assert!(fits, "{:?} does not go with {:?} in {kind:?}", kind.family(), kind.receptive_field(input));

    let layer = kind.build(input, Isa::PORTABLE).unwrap_or_else(|e| panic!("{kind:?} does not take {input}: {e}"));
    assert_eq!(layer.input(), input, "{kind:?}");
    let harness = Harness::new(&*layer, 1);
    let mut scratch = vec![f32::NAN; layer.scratch_len(1)];
    let mut infer = |x: &[f32]| {
        let mut y = vec![f32::NAN; layer.output().len()];
        layer.infer(&harness.params, &harness.statistics, 1, x, &mut y, &mut scratch);
        y
    };
    let y = infer(&harness.x);

    let field = kind.receptive_field(input);
    let mut seen = vec![false; input.positions() * layer.output().positions()];
    for i in 0..input.len() {
        for moved in [-10.0, 10.0] {
            let mut x = harness.x.clone();
            x[i] = moved;
            for (o, (before, after)) in y.iter().zip(infer(&x)).enumerate() {
                if after.to_bits() != before.to_bits() {
                    assert!(
                        sees(field, input, layer.output(), i, o),
                        "output {o} depends on input {i}, outside {field:?} of {kind:?}"
                    );
                    seen[i % input.positions() * layer.output().positions() + o % layer.output().positions()] = true;
                }
            }
        }
    }
    for i in 0..input.positions() {
        for o in 0..layer.output().positions() {
            let expected = sees(field, input, layer.output(), i, o);
            let seen = seen[i * layer.output().positions() + o];
            assert!(seen || !expected, "output position {o} does not depend on input position {i} in {kind:?}");
        }
    }

    match kind.export_form(input, &harness.params, &harness.statistics) {
        ExportForm::Elementwise(formula) => {
            for (x, y) in harness.x.iter().zip(&y) {
                let expected = formula.evaluate(f64::from(*x));
                let error = (f64::from(*y) - expected).abs();
                assert!(error <= 1e-5 * expected.abs().max(1.0), "{kind:?} gives {y} for {x}, its formula {expected}");
            }
        }
        ExportForm::Identity => assert_eq!(y, harness.x, "{kind:?} is left out of exports, but computes something"),
        ExportForm::Conv { depthwise, kernel, stride, pads, weight, bias } => {
            let padded = [input.h + pads.top + pads.bottom, input.w + pads.left + pads.right];
            let [h, w] = [0, 1].map(|axis| (padded[axis] - kernel[axis]) / stride[axis] + 1);
            assert_eq!(layer.output(), Shape::new(bias.len(), h, w), "{kind:?}");
            // Channels that a filter sees.
            let depth = if depthwise { 1 } else { input.c };
            let taps = depth * kernel[0] * kernel[1];
            for (o, y) in y.iter().enumerate() {
                let (filter, i, j) = (o / (h * w), o / w % h, o % w);
                let term = |tap: usize| {
                    let (channel, k) = (tap / (kernel[0] * kernel[1]), tap % (kernel[0] * kernel[1]));
                    let c = if depthwise { filter } else { channel };
                    let row = (i * stride[0] + k / kernel[1]).checked_sub(pads.top).filter(|row| *row < input.h)?;
                    let column = (j * stride[1] + k % kernel[1]).checked_sub(pads.left).filter(|at| *at < input.w)?;
                    let x = harness.x[(c * input.h + row) * input.w + column];
                    Some(f64::from(weight[filter * taps + tap]) * f64::from(x))
                };
                let expected = f64::from(bias[filter]) + (0..taps).filter_map(term).sum::<f64>();
                let error = (f64::from(*y) - expected).abs();
                assert!(error <= 1e-5 * expected.abs().max(1.0), "{kind:?} gives {y} at {o}, its export {expected}");
            }
        }
        ExportForm::Dense { .. }
        | ExportForm::BatchNorm { .. }
        | ExportForm::PRelu { .. }
        | ExportForm::MaxPool { .. }
        | ExportForm::AveragePool { .. }
        | ExportForm::Crop { .. }
        | ExportForm::ZeroPad { .. }
        | ExportForm::Resize { .. }
        | ExportForm::Flatten => {}
    }
}

/// Whether `field` lets output value `o` see input value `i`. With a window any channel may be seen.
fn sees(field: ReceptiveField, input: Shape, output: Shape, i: usize, o: usize) -> bool {
    match field {
        ReceptiveField::Element => i == o,
        ReceptiveField::All => true,
        ReceptiveField::Resized { to, method } => {
            let (i, o) = (i % input.positions(), o % output.positions());
            Taps::new(input.h, to[0], method).seen(o / output.w).contains(&(i / input.w))
                && Taps::new(input.w, to[1], method).seen(o % output.w).contains(&(i % input.w))
        }
        ReceptiveField::Window { size, stride, before } => {
            let (i, o) = (i % input.positions(), o % output.positions());
            let (from, to) = ([i / input.w, i % input.w], [o / output.w, o % output.w]);
            (0..2).all(|axis| {
                let first = (to[axis] * stride[axis]) as isize - before[axis];
                (first..first + size[axis] as isize).contains(&(from[axis] as isize))
            })
        }
    }
}
