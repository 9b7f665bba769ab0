//! From rows to batches: which rows stand on which side of the split, how often, and how their pictures are changed.

pub mod augment;
mod balance;
pub mod leak;
pub mod loader;
mod pairs;
mod spec;
pub mod split;

pub use balance::Balance;
pub use spec::{Flip, Group, Item, SampleSpec};
