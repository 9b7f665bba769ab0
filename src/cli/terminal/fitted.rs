//! Text for a terminal: prose wrapped at its width, and the first word of a warning in colour. Text that goes elsewhere, into a
//! file or another program, stays as it is.

use std::io::IsTerminal;

use terminal_size::{Width, terminal_size_of};

/// First words that have a colour, and its code: red, yellow, green, blue.
const COLOURS: [(&str, &str); 6] = [
    ("error:", "1;31"),
    ("warning:", "1;33"),
    ("advice", "1;33"),
    ("look at", "1;33"),
    ("good:", "1;32"),
    ("note:", "1;34"),
];
/// Wider terminals are filled to this width only: longer lines are hard to read.
const MAX_WIDTH: usize = 120;
/// Narrower terminals are not believed.
const MIN_WIDTH: usize = 40;
/// Continued lines of a warning stand this far in.
const INDENT: usize = 2;

/// `text`, several lines, as `stream` is to show it.
pub(super) fn fitted(text: &str, stream: &(impl IsTerminal + Columns)) -> String {
    if !stream.is_terminal() {
        return text.into();
    }
    let width = stream.columns().map(|width| width.clamp(MIN_WIDTH, MAX_WIDTH));
    let lines: Vec<String> = text
        .split('\n')
        .map(|line| {
            let wrapped = width.map_or_else(|| line.to_string(), |width| wrapped(line, width));
            if wants_colour() { coloured(&wrapped) } else { wrapped }
        })
        .collect();
    lines.join("\n")
}

/// A stream that may know the width of its terminal.
pub(crate) trait Columns {
    /// Characters in a line.
    fn columns(&self) -> Option<usize>;
}

impl Columns for std::io::Stdout {
    fn columns(&self) -> Option<usize> {
        terminal_size_of(self).map(|(Width(width), _)| usize::from(width))
    }
}

impl Columns for std::io::Stderr {
    fn columns(&self) -> Option<usize> {
        terminal_size_of(self).map(|(Width(width), _)| usize::from(width))
    }
}

/// As no-color.org asks: any `NO_COLOR` but an empty one means no; a dumb terminal has none.
fn wants_colour() -> bool {
    let set = |name: &str| std::env::var_os(name).is_some_and(|value| !value.is_empty());
    !set("NO_COLOR") && std::env::var_os("TERM").is_none_or(|term| term != "dumb")
}

/// The line with its first word in colour, if it is one of those that have one.
fn coloured(line: &str) -> String {
    match COLOURS.iter().find(|(word, _)| line.starts_with(word)) {
        Some((word, code)) => format!("\x1b[{code}m{word}\x1b[0m{}", &line[word.len()..]),
        None => line.into(),
    }
}

/// A line of prose, broken between words. What follows a label in a column of its own (`advice    drive slower`) stays in its
/// column; tables and lines that fit stay as they are.
fn wrapped(line: &str, width: usize) -> String {
    if line.chars().count() <= width {
        return line.into();
    }
    let begins = line.find("  ").map_or(0, |gap| gap + line[gap..].chars().take_while(|c| *c == ' ').count());
    let (label, prose) = line.split_at(begins);
    // More than one gap: the columns of a table.
    if prose.contains("  ") || label.chars().count() + 20 > width {
        return line.into();
    }
    let indent = if begins > 0 { label.chars().count() } else { INDENT };
    let mut text = label.to_string();
    let mut column = label.chars().count();
    for (k, word) in prose.split(' ').enumerate() {
        let length = word.chars().count();
        if k > 0 && column + 1 + length > width {
            text.push('\n');
            text.extend(std::iter::repeat_n(' ', indent));
            column = indent;
        } else if k > 0 {
            text.push(' ');
            column += 1;
        }
        text.push_str(word);
        column += length;
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn prose_is_broken_between_words_and_tables_are_not() {
        let line = "warning: a model that has learned nothing of use needs more epochs";
        let lines: Vec<String> = wrapped(line, 40).lines().map(String::from).collect();
        assert_eq!(lines, ["warning: a model that has learned", "  nothing of use needs more epochs"]);
        let labelled = wrapped("advice    3000 rows are few: record more laps and ways back", 40);
        assert_eq!(labelled, "advice    3000 rows are few: record more\n          laps and ways back");
        let table = "lake      12.5 %      3 times      0.25 m from the line";
        assert_eq!(wrapped(table, 40), table);
        let path = format!("wrote {}", "x".repeat(60));
        assert_eq!(wrapped(&path, 40).lines().last(), Some(&*format!("  {}", "x".repeat(60))), "no word is broken");
    }

    #[test]
    fn first_words_have_colours() {
        assert_eq!(coloured("error: no such file"), "\x1b[1;31merror:\x1b[0m no such file");
        assert_eq!(coloured("an error: no"), "an error: no");
    }
}
