//! What a model looks at: [`saliency`] shows what excites its layers, [`counterfactual`] measures what its angle depends on.

pub mod change;
pub mod counterfactual;
pub mod exhibits;
pub mod findings;
pub mod footage;
pub mod saliency;
