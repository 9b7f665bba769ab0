//! Foreign text on its way to a person.
//!
//! Cells of logs, names of files, texts of models, lines of peers: none of them may reach a terminal, a page or a log as it
//! is. A control character in it could clear the screen, move the cursor or turn what stands beside it around.
//! [`escaped`] shows such characters as `\u{1b}`. Commands print nothing that has not gone through this file.

use std::borrow::Cow;

/// Whether a terminal or a page would obey `c` instead of showing it: control characters, marks that change the direction
/// of text, and characters without width.
fn is_obeyed(c: char) -> bool {
    c.is_control()
        || matches!(c, '\u{61c}' | '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2060}'..='\u{206f}')
        || matches!(c, '\u{feff}' | '\u{fff9}'..='\u{fffb}' | '\u{fffe}' | '\u{ffff}' | '\u{e0000}'..='\u{e007f}')
}

/// `text` in one line, with every character that a terminal would obey written out: a line feed is `\n`, ESC is `\u{1b}`.
pub(crate) fn escaped(text: &str) -> Cow<'_, str> {
    escape_where(text, is_obeyed)
}

/// As [`escaped`], for text of several lines: line feeds and tabs stay.
pub(crate) fn escaped_lines(text: &str) -> Cow<'_, str> {
    escape_where(text, |c| is_obeyed(c) && !matches!(c, '\n' | '\t'))
}

/// The first `max_chars` characters of `text`, [`escaped`]; `…` stands for the rest.
pub(crate) fn excerpt(text: &str, max_chars: usize) -> String {
    match text.char_indices().nth(max_chars) {
        Some((end, _)) => escaped(&text[..end]).into_owned() + "…",
        None => escaped(text).into_owned(),
    }
}

/// A share in percent; one that is not 0 never reads as 0.
pub(crate) fn percent(value: f64) -> String {
    if value > 0.0 && value < 0.05 { "<0.1".into() } else { format!("{value:.1}") }
}

/// A JSON text with the characters that a terminal would obey written as `\u001b`. They can stand in strings alone, so the
/// value stays the same.
pub(crate) fn escaped_json(json: &str) -> Cow<'_, str> {
    if !json.contains(is_obeyed) {
        return Cow::Borrowed(json);
    }
    let mut text = String::with_capacity(json.len() + 16);
    for c in json.chars() {
        if is_obeyed(c) {
            let units = &mut [0; 2];
            c.encode_utf16(units).iter().for_each(|unit| text += &format!("\\u{unit:04x}"));
        } else {
            text.push(c);
        }
    }
    Cow::Owned(text)
}

fn escape_where(text: &str, is_escaped: impl Fn(char) -> bool) -> Cow<'_, str> {
    if !text.contains(&is_escaped) {
        return Cow::Borrowed(text);
    }
    let mut shown = String::with_capacity(text.len() + 16);
    for c in text.chars() {
        match c {
            '\n' | '\r' | '\t' if is_escaped(c) => shown.extend(c.escape_default()),
            c if is_escaped(c) => shown.extend(c.escape_unicode()),
            c => shown.push(c),
        }
    }
    Cow::Owned(shown)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_terminal_obeys_is_written_out() {
        assert_eq!(escaped("a\u{1b}[2Jb\r\n\u{9b}31m"), r"a\u{1b}[2Jb\r\n\u{9b}31m");
        assert_eq!(escaped("\u{202e}gpj.a \u{feff}\u{7f}"), r"\u{202e}gpj.a \u{feff}\u{7f}");
        assert_eq!(escaped_lines("a\n\tb\r\u{7}"), "a\n\tb\\r\\u{7}");
        for plain in ["", "straße 高速 🚗 C:\\IMG", "é\u{301}"] {
            assert!(matches!(escaped(plain), Cow::Borrowed(text) if text == plain));
        }
    }

    #[test]
    fn excerpts_are_cut_before_they_are_escaped() {
        assert_eq!(excerpt("a\u{1b}bc", 2), "a\\u{1b}…");
        assert_eq!(excerpt("äöü", 3), "äöü");
    }

    #[test]
    fn only_nothing_reads_as_zero_percent() {
        assert_eq!([0.0, 0.001, 0.049, 0.05, 68.84].map(percent), ["0.0", "<0.1", "<0.1", "0.1", "68.8"]);
    }

    #[test]
    fn json_keeps_its_value() {
        let value = serde_json::json!({"a\u{9b}": "\u{1b}[2J\u{7f}\u{e0041}\n\"ü"});
        let text = serde_json::to_string(&value).unwrap();
        let shown = escaped_json(&text);
        assert!(!shown.contains(is_obeyed));
        assert_eq!(serde_json::from_str::<serde_json::Value>(&shown).unwrap(), value);
    }
}
