//! Rows that cannot be used, counted by reason.

use serde::Serialize;
use std::collections::BTreeMap;

/// Examples kept for each reason.
const EXAMPLES: usize = 3;

/// Why a row cannot be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Reason {
    /// Fewer fields than a row has.
    TooFewFields,
    /// More fields than a row has, and decimal commas do not explain them.
    TooManyFields,
    /// Decimal commas that can be read in more than one way.
    Ambiguous,
    /// A field that should be a number is none, or a record is not readable.
    NotANumber,
    /// The steering label is not in [-1, 1], or not finite.
    LabelOutOfRange,
    /// An image file is not there.
    ImageMissing,
    /// An image file is empty, ends too early or cannot be decoded.
    ImageTruncated,
    /// An image file is neither JPEG nor PNG, or cannot be read.
    NotAnImage,
    /// The path of an image is that of a FIFO, a device or a socket.
    NotAFile,
}

impl Reason {
    /// The reason in words.
    pub fn text(self) -> &'static str {
        match self {
            Reason::TooFewFields => "too few fields",
            Reason::TooManyFields => "too many fields",
            Reason::Ambiguous => "decimal commas that can be read in more than one way",
            Reason::NotANumber => "not a number",
            Reason::LabelOutOfRange => "label out of range or not finite",
            Reason::ImageMissing => "image missing",
            Reason::ImageTruncated => "image damaged or truncated",
            Reason::NotAnImage => "not a readable image",
            Reason::NotAFile => "no regular file",
        }
    }
}

/// Rows left out for one reason.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct Tally {
    /// Number of rows.
    pub rows: usize,
    /// The first few, each with its place.
    pub examples: Vec<String>,
}

/// The rows that had to be left out, by reason.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct Unusable(pub BTreeMap<Reason, Tally>);

impl Unusable {
    /// Number of rows left out.
    pub fn rows(&self) -> usize {
        self.0.values().map(|tally| tally.rows).sum()
    }

    /// Counts a row; the first few of each reason are kept as examples.
    pub(crate) fn add(&mut self, reason: Reason, example: impl FnOnce() -> String) {
        let tally = self.0.entry(reason).or_default();
        tally.rows += 1;
        if tally.examples.len() < EXAMPLES {
            tally.examples.push(example());
        }
    }
}
