//! How the simulator's C# code reads a message of the server: its packet decoder, event parser and number parser, with their
//! faults.

use serde_json::Value;

use crate::udacity::{DecimalMark, NumberStyle};

/// The simulators of the second term add this to each steering command: one degree in radians.
const TERM_2_BIAS: f32 = std::f32::consts::PI / 180.0;

/// The effect of a message.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Reaction {
    /// Nothing.
    Ignored,
    /// `2`: the client sends a pong.
    Ping,
    /// `3`: the answer to a ping.
    Pong,
    /// `0{…}`: one more telemetry.
    Open,
    /// `42["steer",…]`.
    Steer(Steer),
    /// `42["manual",…]`: one more telemetry.
    Manual,
}

/// What the handler reads of a command before it ends or throws.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Steer {
    /// Steering, [-1, 1], if it could be read.
    pub steering: Option<f32>,
    /// Throttle, [-1, 1], if it and the steering could be read. Only then does telemetry follow; otherwise the handler throws
    /// and the token is lost.
    pub throttle: Option<f32>,
}

/// The effect of the message `text` on the client.
///
/// # Errors
///
/// The reason for which its decoder or parser throws. The socket then closes with code 1006: without a close frame.
pub fn react(text: &str, numbers: NumberStyle) -> Result<Reaction, &'static str> {
    let mut chars = text.chars();
    let Some(engine) = chars.next().and_then(|c| c.to_digit(10)) else {
        return Err("a message that does not begin with a digit");
    };
    match engine {
        0 => match serde_json::from_str::<Value>(chars.as_str()) {
            Ok(Value::Object(fields)) if fields.contains_key("sid") => Ok(Reaction::Open),
            _ => Err("an open packet without sid"),
        },
        2 => Ok(Reaction::Ping),
        3 => Ok(Reaction::Pong),
        4 => {
            let Some(socket) = chars.next().and_then(|c| c.to_digit(10)) else {
                return Err("a message packet without a second digit");
            };
            if socket == 2 { event(chars.as_str(), numbers) } else { Ok(Reaction::Ignored) }
        }
        _ => Ok(Reaction::Ignored),
    }
}

/// `[name, data]` behind an optional namespace and number.
fn event(rest: &str, numbers: NumberStyle) -> Result<Reaction, &'static str> {
    let rest = match rest.strip_prefix('/') {
        Some(named) => named.split_once(',').map_or("", |(_, rest)| rest),
        None => rest,
    };
    let json = rest.trim_start_matches(|c: char| c.is_ascii_digit());
    // One character is too little for the decoder to look at.
    if json.len() < 2 {
        return Ok(Reaction::Ignored);
    }
    let Ok(Value::Array(elements)) = serde_json::from_str::<Value>(json) else {
        return Err("an event that is no array");
    };
    let (name, data) = match &elements[..] {
        [Value::String(name)] => (name, None),
        [Value::String(name), data @ Value::Object(_)] => (name, Some(data)),
        [Value::String(_), _] => return Err("an event whose second element is no object"),
        [_] | [_, _] => return Err("an event without a name"),
        _ => return Err("an event that has not one or two elements"),
    };
    Ok(match name.as_str() {
        "steer" => Reaction::Steer(steer(data, numbers)),
        "manual" => Reaction::Manual,
        _ => Reaction::Ignored,
    })
}

fn steer(data: Option<&Value>, numbers: NumberStyle) -> Steer {
    let read = |name: &str| {
        let value = data?.get(name)?;
        match (numbers, value) {
            (NumberStyle::Strings(mark), Value::String(text)) => float_parse(text, mark),
            (NumberStyle::Json, Value::Number(number)) => number.as_f64().map(|number| number as f32),
            _ => None,
        }
    };
    let bias = if numbers == NumberStyle::Json { TERM_2_BIAS } else { 0.0 };
    let steering = read("steering_angle").map(|steering| steering + bias);
    Steer { steering, throttle: steering.and_then(|_| read("throttle")) }
}

/// .NET's `float.Parse` in a culture with this decimal mark: white space around, a sign, digits with group separators
/// wherever they stand, decimals, an exponent. In cultures with a comma the dot separates groups, and is skipped.
fn float_parse(text: &str, mark: DecimalMark) -> Option<f32> {
    let text = text.trim_matches(|c: char| c == ' ' || ('\t'..='\r').contains(&c));
    match text {
        "NaN" => return Some(f32::NAN),
        "Infinity" => return Some(f32::INFINITY),
        "-Infinity" => return Some(f32::NEG_INFINITY),
        _ => {}
    }
    let group = if mark == DecimalMark::DOT { ',' } else { '.' };
    let mut plain = String::with_capacity(text.len());
    let mut whole = true;
    for c in text.chars() {
        match c {
            c if c == mark.char() && whole => {
                plain.push('.');
                whole = false;
            }
            c if c == group && whole && plain.ends_with(|c: char| c.is_ascii_digit()) => {}
            '0'..='9' | '+' | '-' => plain.push(c),
            'e' | 'E' => {
                plain.push('e');
                whole = false;
            }
            _ => return None,
        }
    }
    // The original also throws for a number beyond the range of a float.
    plain.parse().ok().filter(|value: &f32| value.is_finite())
}

#[cfg(test)]
mod tests {
    use super::*;

    const DOT: NumberStyle = NumberStyle::Strings(DecimalMark::DOT);
    const COMMA: NumberStyle = NumberStyle::Strings(DecimalMark::COMMA);

    fn steer(text: &str, numbers: NumberStyle) -> (Option<f32>, Option<f32>) {
        match react(text, numbers).unwrap() {
            Reaction::Steer(Steer { steering, throttle }) => (steering, throttle),
            other => panic!("{text}: {other:?}"),
        }
    }

    #[test]
    fn packets_of_every_kind() {
        for (text, reaction) in [
            (r#"0{"sid":"8f","upgrades":[],"pingTimeout":60000,"pingInterval":25000}"#, Reaction::Open),
            ("1", Reaction::Ignored),
            ("2", Reaction::Ping),
            ("2probe", Reaction::Ping),
            ("3", Reaction::Pong),
            ("40", Reaction::Ignored),
            (r#"40{"sid":"x"}"#, Reaction::Ignored),
            ("41", Reaction::Ignored),
            ("42", Reaction::Ignored),
            (r#"42["manual",{}]"#, Reaction::Manual),
            (r#"42["manual"]"#, Reaction::Manual),
            (r#"42/,17["manual",{}]"#, Reaction::Manual),
            (r#"42["reset",{}]"#, Reaction::Ignored),
            ("43[1]", Reaction::Ignored),
            ("44", Reaction::Ignored),
            ("5", Reaction::Ignored),
            ("6", Reaction::Ignored),
        ] {
            assert_eq!(react(text, DOT), Ok(reaction), "{text}");
        }
    }

    #[test]
    fn messages_that_close_the_socket() {
        for text in [
            "",
            "x",
            "{\"steer\":1}",
            "0",
            "0{}",
            "0{\"sid\"",
            "4",
            "4x",
            r#"42["steer",null]"#,
            r#"42["steer",1]"#,
            r#"42["steer",{},{}]"#,
            "42[]",
            "42[1,{}]",
            r#"42{"a":1}"#,
            r#"42["steer",{"steering_angle":"0.1""#,
        ] {
            assert!(react(text, DOT).is_err(), "{text}");
        }
    }

    #[test]
    fn a_command_needs_strings_and_numbers_of_the_second_term_need_numbers() {
        let strings = r#"42["steer",{"steering_angle":"-0.0312","throttle":"0.2500"}]"#;
        let plain = r#"42["steer",{"steering_angle":-0.0312,"throttle":0.25}]"#;
        assert_eq!(steer(strings, DOT), (Some(-0.0312), Some(0.25)));
        assert_eq!(steer(plain, DOT), (None, None));
        assert_eq!(steer(plain, NumberStyle::Json), (Some(-0.0312 + 0.017_453_292), Some(0.25)));
        assert_eq!(steer(strings, NumberStyle::Json), (None, None));
        assert_eq!(steer(r#"42["steer",{"steering_angle":"0.5"}]"#, DOT), (Some(0.5), None));
        assert_eq!(steer(r#"42["steer",{"throttle":"0.5"}]"#, DOT), (None, None));
        assert_eq!(steer(r#"42["steer",{"steering_angle":"0.5","throttle":"nan"}]"#, DOT), (Some(0.5), None));
        assert_eq!(steer(r#"42["steer"]"#, DOT), (None, None));
    }

    #[test]
    fn a_machine_with_decimal_comma_reads_a_dot_as_separator_of_thousands() {
        let command = |steering: &str| format!(r#"42["steer",{{"steering_angle":"{steering}","throttle":"0"}}]"#);
        for (text, dot, comma) in [
            ("0.123", Some(0.123), Some(123.0)),
            ("0,123", Some(123.0), Some(0.123)),
            ("-0,5", Some(-5.0), Some(-0.5)),
            ("1e-05", Some(1e-5), Some(1e-5)),
            (" 7 ", Some(7.0), Some(7.0)),
            ("+.5", Some(0.5), None),
            ("1,2.5", Some(12.5), None),
            ("1.2,5", None, Some(12.5)),
            ("1e99", None, None),
            ("", None, None),
            ("--1", None, None),
            ("nan", None, None),
            ("inf", None, None),
            ("0x1", None, None),
        ] {
            assert_eq!(steer(&command(text), DOT).0, dot, "{text}");
            assert_eq!(steer(&command(text), COMMA).0, comma, "{text}");
        }
        assert!(steer(&command("NaN"), DOT).0.unwrap().is_nan());
    }
}
