//! Dropout.

use rand::Rng;
use serde::{Deserialize, Serialize};
use steersman_kernels::{Backend, Isa, dropout};

use super::{ExportForm, Family, Grads, Layer, LayerKind, Pair, Pass, ReceptiveField};
use crate::engine::random::{Purpose, rng};
use crate::engine::tensor::Shape;

/// Inverted dropout (Srivastava et al. 2014), with p = `drop_probability`.
///
/// - **Forward** `y = x · mask / (1 − p)`; each value of `mask` is 0 with probability p, else 1. So y has the mean of x.
/// - **Backward** of `y = x · mask / (1 − p)`: `dx = dy · mask / (1 − p)`. Needs the mask, and draws it again: it follows from
///   (seed, step, layer, image) alone, so nothing is kept, and the way a batch is cut into shards changes nothing.
/// - **Training** draws a new mask for each step; **evaluation** is `y = x`.
/// - **Limits** p lies in [0, 1).
///
/// # Shapes
///
/// x, y, dx, dy: `[n][c][h][w]`.
#[derive(Debug)]
pub struct Dropout {
    shape: Shape,
    drop_probability: f32,
    isa: Isa,
}

impl Dropout {
    /// Drops elements of maps of `shape` with `drop_probability` in [0, 1).
    pub fn new(shape: Shape, drop_probability: f32, isa: Isa) -> Result<Dropout, String> {
        if !(0.0..1.0).contains(&drop_probability) {
            return Err(format!("drop_probability must lie in [0, 1), not be {drop_probability}"));
        }
        Ok(Dropout { shape, drop_probability, isa })
    }

    fn apply(&self, pass: &Pass, from: &[f32], to: &mut [f32]) {
        if self.drop_probability == 0.0 {
            return to.copy_from_slice(from);
        }
        let keep_scale = 1.0 / (1.0 - self.drop_probability);
        // An element is dropped when its 32 random bits, as a fraction of 2³², are below the probability.
        let threshold = (f64::from(self.drop_probability) * 4_294_967_296.0) as u32;
        let images = from.chunks_exact(self.shape.len()).zip(to.chunks_exact_mut(self.shape.len()));
        for (image, (from, to)) in images.enumerate() {
            let stream = ((pass.layer as u64) << 32) | (pass.first_image + image) as u64;
            let mut bits = rng(pass.seed, Purpose::Dropout, pass.step, stream);
            let key = [bits.next_u32(), bits.next_u32()];
            dropout::dropout(self.isa, key, threshold, keep_scale, from, to);
        }
    }
}

impl Layer for Dropout {
    fn input(&self) -> Shape {
        self.shape
    }

    fn output(&self) -> Shape {
        self.shape
    }

    fn infer(&self, _params: &[f32], _statistics: &[f32], _n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        y.copy_from_slice(x);
    }

    fn forward(&self, _params: &[f32], pass: &Pass, _n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        self.apply(pass, x, y);
    }

    fn backward(&self, _params: &[f32], pass: &Pass, _n: usize, pair: Pair, dx: Option<&mut [f32]>, _grads: Grads) {
        if let Some(dx) = dx {
            self.apply(pass, pair.dy, dx);
        }
    }
}

/// Options of [`Dropout`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DropoutSpec {
    /// Fraction that is dropped, in [0, 1).
    pub drop_probability: f32,
}

impl LayerKind for DropoutSpec {
    fn base_name(&self) -> &'static str {
        "dropout"
    }

    fn describe(&self) -> String {
        format!("dropout {}", self.drop_probability)
    }

    fn family(&self) -> Family {
        Family::Regularization
    }

    fn receptive_field(&self, _input: Shape) -> ReceptiveField {
        ReceptiveField::Element
    }

    fn check(&self, _input: Shape) -> Result<(), String> {
        Ok(())
    }

    fn layer(&self, input: Shape, backend: Backend) -> Result<Box<dyn Layer>, String> {
        Ok(Box::new(Dropout::new(input, self.drop_probability, backend.isa)?))
    }

    fn export_form(&self, _input: Shape, _params: &[f32], _statistics: &[f32]) -> ExportForm {
        ExportForm::Identity
    }
}

#[cfg(test)]
mod tests {
    use super::super::gradcheck::check_layer;
    use super::*;

    fn pass(step: u64, layer: usize, first_image: usize) -> Pass<'static> {
        Pass { seed: 1, step, layer, first_image, moments: &[], packed: &[] }
    }

    fn drop(layer: &Dropout, pass: &Pass, x: &[f32]) -> Vec<f32> {
        let mut y = vec![f32::NAN; x.len()];
        layer.forward(&[], pass, x.len() / layer.shape.len(), x, &mut y, &mut []);
        y
    }

    #[test]
    fn gradients_hold() {
        check_layer(&Dropout::new(Shape::new(2, 3, 5), 0.3, Isa::best()).unwrap(), 3);
        check_layer(&Dropout::new(Shape::vector(7), 0.0, Isa::best()).unwrap(), 1);
    }

    #[test]
    fn the_named_fraction_is_dropped_and_the_mean_kept() {
        let layer = Dropout::new(Shape::vector(1000), 0.2, Isa::best()).unwrap();
        let y = drop(&layer, &pass(0, 0, 0), &[1.0; 100_000]);
        let dropped = y.iter().filter(|y| **y == 0.0).count() as f64 / 100_000.0;
        let mean = y.iter().map(|y| f64::from(*y)).sum::<f64>() / 100_000.0;
        assert!((dropped - 0.2).abs() < 0.01, "{dropped}");
        assert!((mean - 1.0).abs() < 0.01, "{mean}");
    }

    #[test]
    fn step_layer_and_image_each_change_what_is_dropped() {
        let layer = Dropout::new(Shape::vector(100), 0.5, Isa::best()).unwrap();
        let x = [1.0; 100];
        let first = drop(&layer, &pass(0, 0, 0), &x);
        assert_eq!(first, drop(&layer, &pass(0, 0, 0), &x));
        for other in [pass(1, 0, 0), pass(0, 1, 0), pass(0, 0, 1)] {
            assert_ne!(first, drop(&layer, &other, &x));
        }
    }

    #[test]
    fn an_image_loses_the_same_elements_wherever_the_batch_is_cut() {
        let layer = Dropout::new(Shape::vector(100), 0.5, Isa::best()).unwrap();
        let together = drop(&layer, &pass(3, 2, 0), &[1.0; 300]);
        assert_eq!(together[200..], drop(&layer, &pass(3, 2, 2), &[1.0; 100]));
    }

    #[test]
    fn evaluation_is_the_identity() {
        let layer = Dropout::new(Shape::vector(3), 0.9, Isa::best()).unwrap();
        let mut y = [f32::NAN; 3];
        layer.infer(&[], &[], 1, &[1., 2., 3.], &mut y, &mut []);
        assert_eq!(y, [1., 2., 3.]);
    }
}
