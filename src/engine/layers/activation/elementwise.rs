//! What activations without trainable numbers have in common: the layer, and the answers of [`LayerKind`].

use std::fmt::Debug;

use steersman_kernels::{Backend, Isa};

use crate::engine::layers::{ExportForm, Family, Formula, Grads, Layer, LayerKind, Pair, Pass, ReceptiveField};
use crate::engine::tensor::Shape;

/// An activation without trainable numbers: what it computes of each value by itself. It is implemented by the options of the layer;
/// [`Elementwise`] is the layer, and the questions of [`LayerKind`] are answered for all of them here.
pub trait Curve: Clone + Debug + Send + Sync + 'static {
    /// The [base name](LayerKind::base_name).
    const BASE_NAME: &'static str;

    /// The [description](LayerKind::describe).
    fn title(&self) -> String;

    /// Checks the options, for an activation that has any.
    ///
    /// # Errors
    ///
    /// A sentence that says what is wrong.
    fn check_options(&self) -> Result<(), String> {
        Ok(())
    }

    /// Overwrites `y` with the activation of each value of `x`.
    fn activate(&self, isa: Isa, x: &[f32], y: &mut [f32]);

    /// Overwrites `dx` with the gradient of `x`.
    fn differentiate(&self, isa: Isa, pair: Pair, dx: &mut [f32]);

    /// What [`activate`](Curve::activate) computes, for exporters.
    fn formula(&self) -> Formula;
}

/// The layer of a [`Curve`].
#[derive(Debug)]
pub struct Elementwise<C> {
    pub(super) shape: Shape,
    pub(super) curve: C,
    pub(super) isa: Isa,
}

impl<C: Curve> Elementwise<C> {
    /// The activation `curve` of maps of `shape`.
    ///
    /// # Errors
    ///
    /// As [`Curve::check_options`].
    pub fn of(shape: Shape, curve: C, isa: Isa) -> Result<Elementwise<C>, String> {
        curve.check_options()?;
        Ok(Elementwise { shape, curve, isa })
    }
}

impl<C: Curve> Layer for Elementwise<C> {
    fn input(&self) -> Shape {
        self.shape
    }

    fn output(&self) -> Shape {
        self.shape
    }

    fn infer(&self, _params: &[f32], _statistics: &[f32], _n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        self.curve.activate(self.isa, x, y);
    }

    fn forward(&self, _params: &[f32], _pass: &Pass, _n: usize, x: &[f32], y: &mut [f32], _scratch: &mut [f32]) {
        self.curve.activate(self.isa, x, y);
    }

    fn backward(&self, _params: &[f32], _pass: &Pass, _n: usize, pair: Pair, dx: Option<&mut [f32]>, _grads: Grads) {
        if let Some(dx) = dx {
            self.curve.differentiate(self.isa, pair, dx);
        }
    }
}

impl<C: Curve> LayerKind for C {
    fn base_name(&self) -> &'static str {
        C::BASE_NAME
    }

    fn describe(&self) -> String {
        self.title()
    }

    fn family(&self) -> Family {
        Family::Activation
    }

    fn receptive_field(&self, _input: Shape) -> ReceptiveField {
        ReceptiveField::Element
    }

    fn check(&self, _input: Shape) -> Result<(), String> {
        Ok(())
    }

    fn layer(&self, input: Shape, backend: Backend) -> Result<Box<dyn Layer>, String> {
        Ok(Box::new(Elementwise::of(input, self.clone(), backend.isa)?))
    }

    fn export_form(&self, _input: Shape, _params: &[f32], _statistics: &[f32]) -> ExportForm {
        ExportForm::Elementwise(self.formula())
    }
}
