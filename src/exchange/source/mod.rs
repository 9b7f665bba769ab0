//! Source code with the weights in it, in C99 or Rust: one file that needs nothing else.
//!
//! The file holds the preprocessing, the network and the buffers, so that memory is bounded and nothing is allocated. A model
//! becomes a program, the same for both languages: arrays and calls of the functions in `library.c` or
//! `library.rs`, of which the file gets those that it calls. Batch normalisation is folded into the layer before it.

mod c;
mod program;
mod rust;

use steersman_kernels::Isa;

use super::chain::{chain, check_finite, fold_batch_norm};
use crate::error::{Error, Result};
use crate::model_file::Model;

/// A language that models are written in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Language {
    /// C99 without warnings under `-Wall -Wextra -pedantic`.
    C,
    /// Rust of edition 2021 or later, without `std` and without `unsafe`.
    Rust,
}

/// Most numbers of a layer; a source file has about 12 characters for each, and compilers take long over larger ones.
const MAX_NUMBERS: usize = 1 << 22;

/// `model` as one source file.
///
/// # Errors
///
/// [`Error::Network`] names a layer with more weights than a source file can sensibly hold, or with numbers that are not finite
/// once batch normalisation is folded in.
pub fn source(model: &Model, language: Language) -> Result<String> {
    let steps = fold_batch_norm(chain(&model.recipe.network(Isa::PORTABLE)?, &model.parameters));
    check_finite(&steps)?;
    for step in &steps {
        let numbers = step.weight_len();
        if numbers > MAX_NUMBERS {
            let message =
                format!("{numbers} weights are too many for a source file (at most {MAX_NUMBERS}); export to onnx");
            return Err(Error::Network { layer: step.name.clone(), message });
        }
    }
    let program = program::Program::new(&model.recipe, &steps);
    Ok(match language {
        Language::C => c::write(&program),
        Language::Rust => rust::write(&program),
    })
}
