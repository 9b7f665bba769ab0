//! Numbers in the messages: how each side writes and reads them.

use std::fmt::Write as _;

use serde::Deserialize;
use serde::de::{Deserializer, Visitor};

/// The characters that cultures of .NET put before the decimals.
const DECIMAL_MARKS: [char; 4] = ['.', ',', '/', '\u{66b}'];

/// The character before the decimals of a number on the client's machine, in telemetry and in commands.
///
/// Numbers in telemetry have exactly four decimals and stay below 1000, so each of them shows the mark without doubt.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DecimalMark(char);

impl DecimalMark {
    /// As in `12.5`.
    pub const DOT: DecimalMark = DecimalMark('.');
    /// As in `12,5`.
    pub const COMMA: DecimalMark = DecimalMark(',');

    /// The character.
    pub fn char(self) -> char {
        self.0
    }
}

/// The form of the numbers in a command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NumberStyle {
    /// JSON strings with this decimal mark: the behavioural-cloning simulator.
    Strings(DecimalMark),
    /// JSON numbers: the simulators of the second term, whose telemetry has the field `cte`.
    Json,
}

impl Default for NumberStyle {
    fn default() -> Self {
        NumberStyle::Strings(DecimalMark::DOT)
    }
}

/// A JSON number, or a string that holds one. `None` if it is no number in any language, or not finite.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Number {
    pub value: Option<f64>,
    pub mark: Option<DecimalMark>,
}

impl Number {
    pub(super) fn read(text: &str) -> Number {
        // Longer than any number with four decimals or in its shortest decimal form.
        const MAX_LEN: usize = 400;
        let mut plain = [0; MAX_LEN];
        let (mut len, mut mark) = (0, None);
        for c in text.trim().chars() {
            let c = match c {
                '0'..='9' | '+' | '-' | 'e' | 'E' => c,
                '\u{2212}' => '-',
                c if DECIMAL_MARKS.contains(&c) && mark.is_none() => {
                    mark = Some(DecimalMark(c));
                    '.'
                }
                _ => return Number::default(),
            };
            if len == MAX_LEN {
                return Number::default();
            }
            plain[len] = c as u8;
            len += 1;
        }
        let value = std::str::from_utf8(&plain[..len]).ok().and_then(|plain| plain.parse::<f64>().ok());
        match value.filter(|value| value.is_finite()) {
            Some(value) => Number { value: Some(value), mark },
            None => Number::default(),
        }
    }
}

impl<'de> Deserialize<'de> for Number {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct NumberOrText;
        impl<'de> Visitor<'de> for NumberOrText {
            type Value = Number;

            fn expecting(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
                f.write_str("a number or a string that holds one")
            }

            fn visit_str<E>(self, text: &str) -> Result<Number, E> {
                Ok(Number::read(text))
            }

            fn visit_f64<E>(self, value: f64) -> Result<Number, E> {
                Ok(Number { value: Some(value), mark: None })
            }

            fn visit_i64<E: serde::de::Error>(self, value: i64) -> Result<Number, E> {
                self.visit_f64(value as f64)
            }

            fn visit_u64<E: serde::de::Error>(self, value: u64) -> Result<Number, E> {
                self.visit_f64(value as f64)
            }

            fn visit_unit<E>(self) -> Result<Number, E> {
                Ok(Number::default())
            }
        }
        deserializer.deserialize_any(NumberOrText)
    }
}

pub(super) fn print_number(out: &mut String, value: f32, style: NumberStyle) {
    let value = if value.is_finite() { value } else { 0.0 };
    match style {
        NumberStyle::Json => push(out, format_args!("{value}")),
        NumberStyle::Strings(mark) => {
            out.push('"');
            print_decimal(out, format_args!("{value}"), mark);
            out.push('"');
        }
    }
}

/// Appends a number with its point replaced.
pub(super) fn print_decimal(out: &mut String, number: std::fmt::Arguments, mark: DecimalMark) {
    let from = out.len();
    push(out, number);
    if mark != DecimalMark::DOT
        && let Some(point) = out[from..].find('.')
    {
        let mut buffer = [0; 4];
        out.replace_range(from + point..from + point + 1, mark.char().encode_utf8(&mut buffer));
    }
}

/// Appends formatted text; writing to a string cannot fail.
pub(super) fn push(out: &mut String, text: std::fmt::Arguments) {
    let _ = out.write_fmt(text);
}
