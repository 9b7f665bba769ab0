//! Networks and the plans that run them.
//!
//! | | |
//! |---|---|
//! | [`Network`] | the description: named layers in order, and the layout of their tensors |
//! | [`Parameters`] | the numbers |
//! | [`TrainingPlan`] | the buffers of a training step: forward, loss, backward |
//! | [`InferencePlan`] | the buffers of evaluation, for parameters that change between calls |
//! | [`ObservationPlan`] | the buffers of evaluation layer by layer, to look at each output |
//! | [`Predictor`] | evaluation with parameters that stay: it owns them, and packs their weights once |
//!
//! A plan borrows the parameters for the length of a call: shared for evaluation, which therefore cannot change them.
//! A plan refuses another network than the one it was planned for.

mod fused;
mod inference;
mod observation;
mod predictor;
mod spec;
mod structure;
mod training;

pub use inference::InferencePlan;
pub use observation::ObservationPlan;
pub use predictor::Predictor;
pub use spec::LayerSpec;
pub use structure::{MAX_PARAMETERS, NamedLayer, Network, group_digits};
pub use training::{Ranks, StageTime, StepInput, TrainingPlan, share};

pub use crate::engine::parameters::{Parameters, Tensor};
