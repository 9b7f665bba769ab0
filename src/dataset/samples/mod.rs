//! From rows to batches: which rows stand on which side of the split, how often, and how their pictures are changed.

pub mod augment;
mod balance;
mod label_spec;
mod labels;
pub mod leak;
pub mod loader;
mod outputs;
mod pairs;
mod spec;
pub mod split;
pub mod takeover;
pub mod whole;

pub use balance::Balance;
pub use label_spec::{EXPERT_AHEAD_M, LabelKind, LabelSpec};
pub use labels::Targets;
pub use outputs::{OutputKind, OutputSpec, Outputs};
pub use spec::{Correction, Flip, Group, Item, Mirror, SampleSpec};
