//! Fully connected layer.

use serde::{Deserialize, Serialize};
use steersman_kernels::gemm::{gemm, gemm_scratch_len};
use steersman_kernels::matrix::{Matrix, MatrixMut};
use steersman_kernels::{Backend, Isa};

use super::kind::{MAX_NUMBERS, check_first_value, check_sizes, weight_and_bias};
use super::{ExportForm, Family, Grads, Layer, LayerKind, Linear, Pair, ParamSpec, Pass, ReceptiveField};
use crate::engine::tensor::{Fans, Initializer, Shape};

/// Fully connected layer with bias.
///
/// - **Forward** `y = W·x + b`.
/// - **Backward** of `y = W·x + b`: `dx = Wᵀ·dy`, `dW = Σ dy·xᵀ` and `db = Σ dy` over the images. Needs x.
/// - **Training and evaluation** are the same.
/// - **Limits** At most 2²⁶ weights. A map is taken as a vector in the order channel, row, column.
///
/// # Shapes
///
/// x, dx: `[n][inputs]`; y, dy: `[n][units]`. Parameters: `weight` (W) `[units][inputs]`, `bias` (b) `[units]`.
#[derive(Debug)]
pub struct Dense {
    inputs: usize,
    input: Shape,
    units: usize,
    init: Initializer,
    isa: Isa,
}

impl Dense {
    /// `units` outputs from all numbers of `input`.
    pub fn new(input: Shape, units: usize, init: Initializer, isa: Isa) -> Result<Dense, String> {
        if units == 0 {
            return Err("units must be at least 1".into());
        }
        Ok(Dense { inputs: input.len(), input, units, init, isa })
    }
}

impl Layer for Dense {
    fn input(&self) -> Shape {
        self.input
    }

    fn output(&self) -> Shape {
        Shape::vector(self.units)
    }

    fn params(&self) -> Vec<ParamSpec> {
        let fans = Fans { fan_in: self.inputs, fan_out: self.units };
        vec![
            ParamSpec::weight(vec![self.units, self.inputs], self.init, fans),
            ParamSpec::constant("bias", vec![self.units], 0.0),
        ]
    }

    fn multiply_adds(&self) -> u64 {
        (self.inputs * self.units) as u64
    }

    fn scratch_len(&self, n: usize) -> usize {
        let (i, u) = (self.inputs, self.units);
        gemm_scratch_len(n, i, u).max(gemm_scratch_len(u, n, i)).max(gemm_scratch_len(n, u, i))
    }

    fn infer(&self, params: &[f32], _statistics: &[f32], n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        let (inputs, units) = (self.inputs, self.units);
        let (weight, bias) = params.split_at(inputs * units);
        for row in y[..n * units].chunks_exact_mut(units) {
            row.copy_from_slice(bias);
        }
        let (x, weight) = (Matrix::new(x, n, inputs), Matrix::new(weight, units, inputs));
        gemm(self.isa, 1.0, x, weight.transposed(), 1.0, MatrixMut::new(y, n, units), scratch);
    }

    fn forward(&self, params: &[f32], _pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.infer(params, &[], n, x, y, scratch);
    }

    fn backward(&self, params: &[f32], pass: &Pass, n: usize, pair: Pair, dx: Option<&mut [f32]>, grads: Grads) {
        let Pair { x, dy, .. } = pair;
        let Grads { dparams, scratch } = grads;
        let (inputs, units) = (self.inputs, self.units);
        let (dweight, dbias) = dparams.split_at_mut(inputs * units);
        let (dy_matrix, x) = (Matrix::new(dy, n, units), Matrix::new(x, n, inputs));
        gemm(self.isa, 1.0, dy_matrix.transposed(), x, 1.0, MatrixMut::new(dweight, units, inputs), scratch);
        for row in dy[..n * units].chunks_exact(units) {
            for (sum, d) in dbias.iter_mut().zip(row) {
                *sum += d;
            }
        }
        if let Some(dx) = dx {
            self.backward_input(params, pass, n, dy, dx, scratch);
        }
    }

    fn linear(&self) -> Option<&dyn Linear> {
        Some(self)
    }
}

impl Linear for Dense {
    fn backward_input(&self, params: &[f32], _pass: &Pass, n: usize, dy: &[f32], dx: &mut [f32], scratch: &mut [f32]) {
        let (inputs, units) = (self.inputs, self.units);
        let weight = &params[..inputs * units];
        let (dy, weight) = (Matrix::new(dy, n, units), Matrix::new(weight, units, inputs));
        gemm(self.isa, 1.0, dy, weight, 0.0, MatrixMut::new(dx, n, inputs), scratch);
    }
}

/// Options of [`Dense`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DenseSpec {
    /// Outputs.
    pub units: usize,
    /// First weights: `glorot_uniform` (default), `he_normal` or `{ constant = … }`.
    #[serde(default)]
    pub init: Initializer,
}

impl LayerKind for DenseSpec {
    fn base_name(&self) -> &'static str {
        "dense"
    }

    fn describe(&self) -> String {
        "dense".into()
    }

    fn family(&self) -> Family {
        Family::Dense
    }

    fn receptive_field(&self, _input: Shape) -> ReceptiveField {
        ReceptiveField::All
    }

    fn check(&self, input: Shape) -> Result<(), String> {
        let units = self.units;
        if units.saturating_mul(input.len()) > MAX_NUMBERS {
            return Err(format!("{units} units would have more than {MAX_NUMBERS} weights"));
        }
        check_sizes(&[("units", units)])?;
        match self.init {
            Initializer::Constant(value) => check_first_value(value),
            Initializer::GlorotUniform | Initializer::HeNormal => Ok(()),
        }
    }

    fn layer(&self, input: Shape, backend: Backend) -> Result<Box<dyn Layer>, String> {
        Ok(Box::new(Dense::new(input, self.units, self.init, backend.isa)?))
    }

    fn export_form(&self, _input: Shape, params: &[f32], _statistics: &[f32]) -> ExportForm {
        let (weight, bias) = weight_and_bias(params, self.units);
        ExportForm::Dense { weight, bias }
    }
}

#[cfg(test)]
mod tests {
    use super::super::gradcheck::check_layer;
    use super::*;

    #[test]
    fn gradients_hold() {
        for isa in Isa::available() {
            for (n, inputs, units) in [(1, 1, 1), (1, 7, 3), (5, 3, 7), (4, 33, 17), (9, 2, 1)] {
                check_layer(&Dense::new(Shape::vector(inputs), units, Initializer::GlorotUniform, isa).unwrap(), n);
            }
        }
    }

    #[test]
    fn rows_of_the_weight_are_units() {
        let layer = Dense::new(Shape::vector(2), 3, Initializer::GlorotUniform, Isa::best()).unwrap();
        let (mut y, mut scratch) = ([f32::NAN; 3], vec![f32::NAN; layer.scratch_len(1)]);
        layer.infer(&[1., 2., 3., 4., 5., 6., 0.5, 0., -0.5], &[], 1, &[10., 1.], &mut y, &mut scratch);
        assert_eq!(y, [12.5, 34., 55.5]);
    }
}
