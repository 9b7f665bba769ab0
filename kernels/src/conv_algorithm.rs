//! The choice between the textbook convolution and the fast ones.

use std::fmt;
use std::str::FromStr;
use std::sync::OnceLock;

/// How the three passes of a convolution are computed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ConvAlgorithm {
    /// For each pass the algorithm that measures fastest for its shape; see the table in [`conv`](crate::conv).
    #[default]
    Auto,
    /// The textbook algorithm for all passes: im2col and the `sgemm` of the crate `matrixmultiply`.
    Im2col,
}

impl ConvAlgorithm {
    /// The algorithm that the environment variable `STEERSMAN_CONV` names, else [`ConvAlgorithm::Auto`].
    ///
    /// The variable is there for tests. It is read once; an unknown name is ignored.
    pub fn of_environment() -> ConvAlgorithm {
        static NAMED: OnceLock<ConvAlgorithm> = OnceLock::new();
        *NAMED
            .get_or_init(|| std::env::var("STEERSMAN_CONV").ok().and_then(|name| name.parse().ok()).unwrap_or_default())
    }

    /// The name that [`FromStr`] reads.
    pub fn name(self) -> &'static str {
        match self {
            ConvAlgorithm::Auto => "auto",
            ConvAlgorithm::Im2col => "im2col",
        }
    }
}

impl fmt::Display for ConvAlgorithm {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for ConvAlgorithm {
    type Err = String;

    fn from_str(name: &str) -> Result<ConvAlgorithm, String> {
        [ConvAlgorithm::Auto, ConvAlgorithm::Im2col]
            .into_iter()
            .find(|algorithm| algorithm.name() == name)
            .ok_or_else(|| "the algorithms are auto and im2col".into())
    }
}
