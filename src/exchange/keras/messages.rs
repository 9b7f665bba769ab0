//! What messages say of a file: problems of layers, and texts from the file that are safe to show.

use crate::text::excerpt;

/// Why a layer cannot be imported.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Problem {
    pub layer: String,
    pub class: String,
    pub reason: String,
}

/// The problems, one a line.
pub(super) fn listed(problems: &[Problem]) -> String {
    let mut text = match problems.len() {
        1 => "a layer cannot be imported:".to_string(),
        count => format!("{count} layers cannot be imported:"),
    };
    for Problem { layer, class, reason } in problems.iter().take(SHOWN_ENTRIES) {
        text += &format!("\n  {} ({}): {reason}", shown(layer), shown(class));
    }
    if let Some(more) = problems.len().checked_sub(SHOWN_ENTRIES).filter(|more| *more > 0) {
        text += &format!("\n  and {more} more");
    }
    text
}

/// Most characters of a text from the file that a message shows.
const SHOWN_CHARS: usize = 100;
const SHOWN_ENTRIES: usize = 20;

/// A text from the file, fit for a message: short, and without characters that a terminal obeys.
pub(super) fn shown(text: &str) -> String {
    excerpt(text, SHOWN_CHARS)
}

/// Names from the file in one line.
pub(super) fn shown_list<'a>(names: impl ExactSizeIterator<Item = &'a str>) -> String {
    let more = names.len().saturating_sub(SHOWN_ENTRIES);
    let mut text = names.take(SHOWN_ENTRIES).map(shown).collect::<Vec<_>>().join(", ");
    if more > 0 {
        text += &format!(" and {more} more");
    }
    text
}
