//! The Python package: the extension module `steersman._native`. What Python programmers see is in `src/python/steersman/`, whose
//! modules wrap this one.
//!
//! Every call that works for long goes through [`work::run`]: it lets go of Python's lock, tells progress, and stops on Ctrl-C.
//! Errors become exceptions with the same text ([`exceptions`]).

mod arrays;
mod driving;
mod exceptions;
mod model;
mod recording;
mod simulation;
mod training;
mod work;

use pyo3::prelude::*;

/// The extension module.
#[pymodule]
mod _native {
    #[pymodule_export]
    const VERSION: &str = env!("CARGO_PKG_VERSION");
    #[pymodule_export]
    use super::driving::{drive, evaluate, record, trajectory_columns};
    #[pymodule_export]
    use super::model::Model;
    #[pymodule_export]
    use super::recording::Recording;
    #[pymodule_export]
    use super::simulation::Simulation;
    #[pymodule_export]
    use super::training::{read_run, resume, train};
}
