//! A layer added by the recipe at the top of `engine::layers`, from outside the crate: its loop, its layer with a gradient check, and
//! its answers. Whoever changes what a layer has to say changes this file first.

use serde::{Deserialize, Serialize};
use steersman::engine::layers::gradcheck::{Harness, check_layer};
use steersman::engine::layers::{
    ExportForm, Family, Formula, Function, Grads, Layer, LayerKind, Pair, Pass, ReceptiveField, check_kind,
};
use steersman::engine::tensor::Shape;
use steersman_kernels::{Backend, Isa};

/// Hard sigmoid.
///
/// - **Forward** `y = relu(slope · x + 1/2) − relu(slope · x − 1/2)`, which is `slope · x + 1/2` held between 0 and 1.
/// - **Backward** of `y = slope · x + 1/2`: `dx = dy · slope`; where y is held, `dx = 0`. Needs y.
/// - **Training and evaluation** are the same.
///
/// # Shapes
///
/// x, y, dx, dy: `[n][c][h][w]`.
#[derive(Debug)]
struct HardSigmoid {
    shape: Shape,
    slope: f32,
    /// Makes the gradient wrong, to see the check fail.
    spoilt: bool,
}

impl Layer for HardSigmoid {
    fn input(&self) -> Shape {
        self.shape
    }

    fn output(&self) -> Shape {
        self.shape
    }

    fn infer(&self, _params: &[f32], _statistics: &[f32], _n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        for (y, x) in y.iter_mut().zip(x) {
            *y = (self.slope * x + 0.5).clamp(0.0, 1.0);
        }
    }

    fn forward(&self, params: &[f32], _pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.infer(params, &[], n, x, y, scratch);
    }

    fn backward(&self, _params: &[f32], _pass: &Pass, _n: usize, pair: Pair, dx: Option<&mut [f32]>, _grads: Grads) {
        let Some(dx) = dx else { return };
        for ((dx, dy), y) in dx.iter_mut().zip(pair.dy).zip(pair.y) {
            let is_held = *y <= 0.0 || *y >= 1.0;
            *dx = if is_held && !self.spoilt { 0.0 } else { dy * self.slope };
        }
    }
}

/// Options of [`HardSigmoid`], and what the test lets it say of itself.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct HardSigmoidSpec {
    slope: f32,
    #[serde(skip, default = "element")]
    field: ReceptiveField,
    /// Slope of the exported formula.
    #[serde(skip, default = "fifth")]
    exported_slope: f32,
}

fn element() -> ReceptiveField {
    ReceptiveField::Element
}

fn fifth() -> f32 {
    0.2
}

impl LayerKind for HardSigmoidSpec {
    fn base_name(&self) -> &'static str {
        "hard_sigmoid"
    }

    fn describe(&self) -> String {
        "hard sigmoid".into()
    }

    fn family(&self) -> Family {
        match self.field {
            ReceptiveField::Window { .. } => Family::Pooling,
            _ => Family::Activation,
        }
    }

    fn receptive_field(&self, _input: Shape) -> ReceptiveField {
        self.field
    }

    fn check(&self, _input: Shape) -> Result<(), String> {
        if self.slope.is_finite() { Ok(()) } else { Err(format!("slope must be finite, not {}", self.slope)) }
    }

    fn layer(&self, input: Shape, _backend: Backend) -> Result<Box<dyn Layer>, String> {
        Ok(Box::new(HardSigmoid { shape: input, slope: self.slope, spoilt: false }))
    }

    fn export_form(&self, _input: Shape, _params: &[f32], _statistics: &[f32]) -> ExportForm {
        let shifted =
            |by: f32| Function::Relu.of(Formula::X * Formula::Number(self.exported_slope) + Formula::Number(by));
        ExportForm::Elementwise(shifted(0.5) + Formula::Number(-1.0) * shifted(-0.5))
    }
}

const INPUT: Shape = Shape::new(2, 3, 5);

fn spec() -> HardSigmoidSpec {
    toml::from_str("slope = 0.2").unwrap()
}

#[test]
fn the_recipe_makes_a_layer_that_is_whole() {
    check_kind(&spec(), INPUT);
    for (n, shape) in [(1, INPUT), (3, Shape::vector(7))] {
        check_layer(&*(&spec() as &dyn LayerKind).build(shape, Isa::best()).unwrap(), n);
    }
    // Steep enough that values are held.
    check_layer(&HardSigmoid { shape: INPUT, slope: 1.0, spoilt: false }, 2);
    let refused = HardSigmoidSpec { slope: f32::NAN, ..spec() };
    let error = (&refused as &dyn LayerKind).build(INPUT, Isa::best()).unwrap_err();
    assert_eq!(error, "slope must be finite, not NaN");
}

#[test]
#[should_panic(expected = "gradient of input is off")]
fn a_wrong_gradient_is_found() {
    check_layer(&HardSigmoid { shape: INPUT, slope: 1.0, spoilt: true }, 2);
}

#[test]
#[should_panic(expected = "its formula")]
fn an_exported_formula_that_differs_is_found() {
    check_kind(&HardSigmoidSpec { exported_slope: 0.25, ..spec() }, INPUT);
}

#[test]
#[should_panic(expected = "does not depend on input position")]
fn a_receptive_field_that_is_too_large_is_found() {
    let field = ReceptiveField::Window { size: [2, 1], stride: [1, 1], before: [0, 0] };
    check_kind(&HardSigmoidSpec { field, ..spec() }, INPUT);
}

#[test]
#[should_panic(expected = "outside Window")]
fn a_receptive_field_at_the_wrong_place_is_found() {
    let field = ReceptiveField::Window { size: [1, 1], stride: [1, 1], before: [0, 1] };
    check_kind(&HardSigmoidSpec { field, ..spec() }, INPUT);
}

#[test]
fn the_harness_runs_it_as_a_network_would() {
    let layer = HardSigmoid { shape: Shape::vector(3), slope: 0.2, spoilt: false };
    let mut harness = Harness::new(&layer, 1);
    harness.x.copy_from_slice(&[-9.0, 1.0, 9.0]);
    harness.dy.copy_from_slice(&[1.0; 3]);
    harness.forward();
    harness.backward();
    assert_eq!((&harness.y[..], &harness.dx[..]), (&[0.0, 0.7, 1.0][..], &[0.0, 0.2, 0.0][..]));
}
