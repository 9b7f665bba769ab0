//! A model as source code in C99 or Rust: one file with the weights in it that needs no other file.
//!
//! The file holds preprocessing, network and buffers; it allocates nothing. A model first becomes a `program` of arrays and
//! calls, which is the same for both languages. The calls go to functions of `library.c` or `library.rs`; the file contains
//! those that it calls. Batch normalisation is folded into the layer before it.

mod c;
mod program;
mod rust;

use steersman_kernels::Isa;

use super::chain::{chain, check_finite, fold_batch_norm};
use crate::error::{Error, Result};
use crate::model_file::Model;

/// Language of the source file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Language {
    /// C99 without warnings under `-Wall -Wextra -pedantic`.
    C,
    /// Rust of edition 2021 or later, without `std` and without `unsafe`.
    Rust,
}

/// Most weights of a layer. A source file takes about 12 characters for each, and compilers take long over larger files.
const MAX_NUMBERS: usize = 1 << 22;

/// `model` as one source file.
///
/// # Errors
///
/// [`Error::Network`] names a layer with more than 2²² weights, or with weights that are not finite after folding.
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
