//! Pages that stand alone: of a training run, of a recording, of runs side by side, of all runs, of what a model looks at, of a sweep of latencies.

pub mod comparison;
mod driven_paths;
mod drives;
pub mod explanation;
pub mod html;
pub mod inspection;
mod layer_alignment;
pub mod run;
pub mod run_list;
mod split_view;
pub mod sweep;
