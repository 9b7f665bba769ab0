//! What a sentence that stands out means for the reader.

use serde::Serialize;

/// Good news, news, or a warning.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Tone {
    /// All is well.
    Good,
    /// Something to know, neither good nor bad.
    Neutral,
    /// Something is wrong or needs a decision.
    Warning,
}
