//! What a network runs on.

use crate::Isa;
use crate::conv_algorithm::ConvAlgorithm;

/// What a network runs on: the instruction set of its kernels and the algorithm of its convolutions.
///
/// An [`Isa`] turns into a backend with the algorithm of [`ConvAlgorithm::of_environment`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Backend {
    /// The instruction set.
    pub isa: Isa,
    /// How convolutions are computed.
    pub conv: ConvAlgorithm,
}

impl From<Isa> for Backend {
    fn from(isa: Isa) -> Backend {
        Backend { isa, conv: ConvAlgorithm::of_environment() }
    }
}
