//! The messages between Udacity's simulator and its driver: text in, text out, no sockets.
//!
//! Each message is one WebSocket text: an Engine.IO digit (`0` open, `1` close, `2` ping, `3` pong, `4` message), and in a
//! message a Socket.IO digit (`0` connect, `1` disconnect, `2` event) with JSON behind it. The simulator sends
//!
//! ```text
//! 42["telemetry",{"steering_angle":"0.0000","throttle":"0.0000","speed":"0.4380","image":"/9j/4AAQ…"}]
//! 42["telemetry",null]          while somebody holds W or S
//! 2                             ping
//! ```
//!
//! and understands
//!
//! ```text
//! 42["steer",{"steering_angle":"-0.0312","throttle":"0.25"}]
//! 42["manual",{}]               asks for telemetry, changes nothing
//! 3                             pong
//! ```
//!
//! Two traps of its parser decide how replies look. It reads the numbers of a command from JSON *strings* (the simulators of
//! the second term from JSON *numbers*), and it reads and writes them in the language of the machine, where `0.25` may mean
//! 25: see [`DecimalMark`]. Ordinary Socket.IO clients, which wait for a handshake that the simulator does without, are
//! served too: see [`EngineVersion`].

use std::borrow::Cow;
use std::fmt::Write as _;

use serde::Deserialize;
use serde::de::{Deserializer, IgnoredAny, SeqAccess, Visitor};

/// Port that the simulator connects to.
pub const DEFAULT_PORT: u16 = 4567;

/// Characters that some culture of .NET puts before the decimals.
const DECIMAL_MARKS: [char; 4] = ['.', ',', '/', '\u{66b}'];

/// What stands before the decimals of a number on the client's machine. It writes its telemetry and reads commands with it.
///
/// Telemetry has exactly four decimals and stays below 1000, so one number in it shows the mark without doubt.
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

/// How a client wants the numbers of a command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NumberStyle {
    /// JSON strings with this decimal mark: the behavioural-cloning simulator.
    Strings(DecimalMark),
    /// JSON numbers: the simulators of the second term, known by the field `cte` in their telemetry.
    Numbers,
}

impl Default for NumberStyle {
    fn default() -> Self {
        NumberStyle::Strings(DecimalMark::DOT)
    }
}

/// A message that could not be understood.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ProtocolError {
    /// The first character is no Engine.IO packet.
    #[error("a message that is no Engine.IO packet: {0:?}")]
    NotEngineIo(String),
    /// A message that begins like the plain-JSON protocol of the browser version.
    #[error("plain JSON instead of Socket.IO: {0:?}")]
    PlainJson(String),
    /// An event whose JSON is broken.
    #[error("an event that cannot be read: {0}")]
    Event(String),
}

/// What a client sends.
#[derive(Clone, Debug, PartialEq)]
pub enum ClientPacket<'a> {
    /// `1`: the client leaves.
    Close,
    /// `2` and what is to come back behind the `3`.
    Ping(&'a str),
    /// `3`: answer to a ping of ours.
    Pong,
    /// `40`: wants to connect to a namespace; `/` is the usual one.
    Connect {
        /// The namespace, with its slash.
        namespace: &'a str,
    },
    /// `41`: leaves a namespace.
    Disconnect,
    /// `42["telemetry",{…}]`, with the number to be acknowledged if the client asks for that.
    Telemetry(Telemetry<'a>, Option<u64>),
    /// `42["telemetry",null]`: a person drives.
    Manual(Option<u64>),
    /// Another event.
    OtherEvent {
        /// Its name.
        name: Cow<'a, str>,
        /// The number to be acknowledged.
        ack: Option<u64>,
    },
    /// Something valid that needs no answer: acknowledgements, upgrades, empty packets.
    Ignored,
}

/// One state of the client's car. Fields that it did not send are `None`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Telemetry<'a> {
    /// Angle of the wheels, degrees, + = right. Commands are in [-1, 1] instead.
    pub steering_deg: Option<f64>,
    /// Accelerator, 0 to 1.
    pub throttle: Option<f64>,
    /// Speed, mph.
    pub speed_mph: Option<f64>,
    /// Distance from the line, m; only the simulators of the second term send it.
    pub cte_m: Option<f64>,
    /// Simulated time, s; only a client that waits for each reply sends it.
    pub time_s: Option<f64>,
    /// A JPEG image in base64.
    pub image: Option<Cow<'a, str>>,
    /// The decimal mark, if a number showed it.
    pub mark: Option<DecimalMark>,
}

impl Telemetry<'_> {
    /// How this client wants numbers.
    pub fn number_style(&self) -> NumberStyle {
        match self.cte_m {
            Some(_) => NumberStyle::Numbers,
            None => NumberStyle::Strings(self.mark.unwrap_or(DecimalMark::DOT)),
        }
    }
}

/// Reads a message of a client.
///
/// # Errors
///
/// [`ProtocolError`]; the connection can go on.
pub fn parse(text: &str) -> Result<ClientPacket<'_>, ProtocolError> {
    let Some(digit) = text.bytes().next() else { return Err(ProtocolError::NotEngineIo(String::new())) };
    match digit {
        b'1' => Ok(ClientPacket::Close),
        b'2' => Ok(ClientPacket::Ping(&text[1..])),
        b'3' => Ok(ClientPacket::Pong),
        b'4' => parse_message(&text[1..]),
        b'0' | b'5' | b'6' => Ok(ClientPacket::Ignored),
        b'{' | b'[' => Err(ProtocolError::PlainJson(shorten(text, SHOWN))),
        _ => Err(ProtocolError::NotEngineIo(shorten(text, SHOWN))),
    }
}

/// The Socket.IO packet in an Engine.IO message.
fn parse_message(text: &str) -> Result<ClientPacket<'_>, ProtocolError> {
    let Some(digit) = text.bytes().next() else { return Ok(ClientPacket::Ignored) };
    let rest = if digit.is_ascii() { &text[1..] } else { text };
    match digit {
        b'0' => Ok(ClientPacket::Connect { namespace: split_namespace(rest).0 }),
        b'1' => Ok(ClientPacket::Disconnect),
        b'2' => {
            let (_, rest) = split_namespace(rest);
            let digits = rest.bytes().take_while(u8::is_ascii_digit).count();
            parse_event(&rest[digits..], rest[..digits].parse().ok())
        }
        b'3'..=b'6' => Ok(ClientPacket::Ignored),
        _ => Err(ProtocolError::Event(shorten(text, SHOWN))),
    }
}

/// `/name,rest` or `rest`.
fn split_namespace(text: &str) -> (&str, &str) {
    match (text.starts_with('/'), text.find(',')) {
        (true, Some(comma)) => (text[..comma].split('?').next().unwrap_or("/"), &text[comma + 1..]),
        (true, None) => (text, ""),
        _ => ("/", text),
    }
}

fn parse_event(json: &str, ack: Option<u64>) -> Result<ClientPacket<'_>, ProtocolError> {
    let event: Event =
        serde_json::from_str(json).map_err(|e| ProtocolError::Event(shorten(&e.to_string(), SHOWN_OF_ERROR)))?;
    Ok(match event {
        Event::Telemetry(Some(telemetry)) => ClientPacket::Telemetry(telemetry, ack),
        Event::Telemetry(None) => ClientPacket::Manual(ack),
        Event::Other(name) => ClientPacket::OtherEvent { name, ack },
    })
}

/// Characters of a message that are shown to a person.
const SHOWN: usize = 40;
/// Characters of an error about JSON that are shown: it can quote all of a long string.
const SHOWN_OF_ERROR: usize = 160;

/// The first `shown` characters of a text.
fn shorten(text: &str, shown: usize) -> String {
    let mut short: String = text.chars().take(shown).collect();
    if text.chars().nth(shown).is_some() {
        short.push('…');
    }
    short
}

enum Event<'a> {
    Telemetry(Option<Telemetry<'a>>),
    Other(Cow<'a, str>),
}

impl<'de> Deserialize<'de> for Event<'de> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Elements;
        impl<'de> Visitor<'de> for Elements {
            type Value = Event<'de>;

            fn expecting(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
                f.write_str("an array of an event's name and its data")
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut sequence: A) -> Result<Event<'de>, A::Error> {
                let Some(Text(name)) = sequence.next_element()? else {
                    return Err(serde::de::Error::custom("an event without a name"));
                };
                let event = if name == "telemetry" {
                    let fields: Option<Option<Fields>> = sequence.next_element()?;
                    Event::Telemetry(fields.flatten().map(Telemetry::from))
                } else {
                    Event::Other(name)
                };
                while sequence.next_element::<IgnoredAny>()?.is_some() {}
                Ok(event)
            }
        }
        deserializer.deserialize_seq(Elements)
    }
}

/// A string, borrowed unless it has escapes.
#[derive(Deserialize)]
struct Text<'a>(#[serde(borrow)] Cow<'a, str>);

/// The fields of telemetry as they stand in the JSON, in any order, among others.
#[derive(Default, Deserialize)]
#[serde(expecting = "the fields of telemetry, or null", default)]
struct Fields<'a> {
    steering_angle: Number,
    throttle: Number,
    speed: Number,
    cte: Number,
    #[serde(rename = "steersman_lockstep_s", deserialize_with = "number_or_nothing")]
    lockstep_s: Number,
    #[serde(borrow)]
    image: Option<Text<'a>>,
}

impl<'a> From<Fields<'a>> for Telemetry<'a> {
    fn from(fields: Fields<'a>) -> Telemetry<'a> {
        let Fields { steering_angle, throttle, speed, cte, lockstep_s, image } = fields;
        Telemetry {
            steering_deg: steering_angle.value,
            throttle: throttle.value,
            speed_mph: speed.value,
            cte_m: cte.value,
            time_s: lockstep_s.value,
            image: image.map(|Text(image)| image),
            mark: speed.mark.or(steering_angle.mark).or(throttle.mark),
        }
    }
}

/// A number if it is one; anything else is no fault of a field that simulators do not have.
fn number_or_nothing<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Number, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged)]
    enum Anything {
        Number(Number),
        Other(IgnoredAny),
    }
    Ok(match Anything::deserialize(deserializer)? {
        Anything::Number(number) => number,
        Anything::Other(IgnoredAny) => Number::default(),
    })
}

/// A number, or a string that holds one. What is neither, not even in another language, or not finite, is `None`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Number {
    value: Option<f64>,
    mark: Option<DecimalMark>,
}

impl Number {
    fn read(text: &str) -> Number {
        // Longer than any number that is printed with four decimals or as the shortest decimal.
        const LONGEST: usize = 400;
        let mut plain = [0; LONGEST];
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
            if len == LONGEST {
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

/// What the car is told.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Command {
    /// Steering, [-1, 1], + = right.
    pub steering: f32,
    /// Accelerator from 0 to 1, brake from 0 to -1.
    pub throttle: f32,
}

/// Appends a `steer` event. Numbers are the shortest decimals that read back as the same 32 bits, which is what the
/// simulator keeps, without exponents; what is not finite becomes 0, because the simulator would drop the message and wait for ever.
pub fn print_steer(out: &mut String, command: Command, style: NumberStyle) {
    out.push_str("42[\"steer\",{\"steering_angle\":");
    print_number(out, command.steering, style);
    out.push_str(",\"throttle\":");
    print_number(out, command.throttle, style);
    out.push_str("}]");
}

fn print_number(out: &mut String, value: f32, style: NumberStyle) {
    let value = if value.is_finite() { value } else { 0.0 };
    match style {
        NumberStyle::Numbers => push(out, format_args!("{value}")),
        NumberStyle::Strings(mark) => {
            out.push('"');
            print_decimal(out, format_args!("{value}"), mark);
            out.push('"');
        }
    }
}

/// Appends a number with its point replaced.
fn print_decimal(out: &mut String, number: std::fmt::Arguments, mark: DecimalMark) {
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
fn push(out: &mut String, text: std::fmt::Arguments) {
    let _ = out.write_fmt(text);
}

/// Appends the `manual` event: the client answers with telemetry, and its car goes on as before.
pub fn print_manual(out: &mut String) {
    out.push_str("42[\"manual\",{}]");
}

/// Appends the answer to an event that wants to be acknowledged.
pub fn print_ack(out: &mut String, ack: u64) {
    push(out, format_args!("43{ack}[]"));
}

/// The version of Engine.IO that an ordinary client speaks.
///
/// The simulator claims version 4, speaks version 3, and needs neither's handshake.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EngineVersion {
    /// Socket.IO 1 and 2: connected to `/` at once, the client pings.
    V3,
    /// Socket.IO 3 and later: connected when it asks, the server pings.
    V4,
}

/// Time between pings, ms.
pub const PING_INTERVAL_MS: u64 = 25_000;
/// Time after which a client of version 4 gives up when no ping comes, beyond the interval, ms.
pub const PING_TIMEOUT_MS: u64 = 20_000;

/// Appends the packet that opens a session.
pub fn print_open(out: &mut String, version: EngineVersion, sid: &str) {
    push(
        out,
        format_args!(
            "0{{\"sid\":\"{sid}\",\"upgrades\":[],\"pingInterval\":{PING_INTERVAL_MS},\"pingTimeout\":{PING_TIMEOUT_MS}"
        ),
    );
    if version == EngineVersion::V4 {
        out.push_str(",\"maxPayload\":1000000");
    }
    out.push('}');
}

/// Appends the packet that connects a client to `/`.
pub fn print_connected(out: &mut String, version: EngineVersion, sid: &str) {
    match version {
        EngineVersion::V3 => out.push_str("40"),
        EngineVersion::V4 => push(out, format_args!("40{{\"sid\":\"{sid}\"}}")),
    }
}

/// Appends the refusal of a namespace other than `/`.
pub fn print_namespace_refused(out: &mut String, version: EngineVersion, namespace: &str) {
    match version {
        EngineVersion::V3 => push(out, format_args!("44{namespace},\"Invalid namespace\"")),
        EngineVersion::V4 => push(out, format_args!("44{namespace},{{\"message\":\"Invalid namespace\"}}")),
    }
}

/// What a client's telemetry says: the other direction of [`Telemetry`], for a client.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Readings<'a> {
    /// Angle of the wheels, degrees, + = right.
    pub steering_deg: f64,
    /// Accelerator, 0 to 1.
    pub throttle: f64,
    /// Speed, mph.
    pub speed_mph: f64,
    /// Distance from the line, m, as the simulators of the second term send it.
    pub cte_m: Option<f64>,
    /// Simulated time, s, if the client waits for each reply.
    pub time_s: Option<f64>,
    /// A JPEG image in base64.
    pub image: &'a str,
}

/// Appends a `telemetry` event as the simulator writes it: all numbers as strings with four decimals, in the order and
/// language of the original. `steersman_lockstep_s`, the simulated time, is no field of the original and has a name that no
/// other simulator sends; it stands last, as the shortest decimal, with a point.
pub fn print_telemetry(out: &mut String, readings: &Readings, mark: DecimalMark) {
    out.push_str("42[\"telemetry\",{");
    let mut field = |name: &str, value: f64| {
        push(out, format_args!("\"{name}\":\""));
        // .NET's Framework and Mono print no minus before a number that is rounded to zero.
        let value = if value.abs() < 0.000_05 { 0.0 } else { value };
        print_decimal(out, format_args!("{value:.4}"), mark);
        out.push_str("\",");
    };
    field("steering_angle", readings.steering_deg);
    field("throttle", readings.throttle);
    field("speed", readings.speed_mph);
    if let Some(cte_m) = readings.cte_m {
        field("cte", cte_m);
    }
    push(out, format_args!("\"image\":\"{}\"", readings.image));
    if let Some(time_s) = readings.time_s {
        push(out, format_args!(",\"steersman_lockstep_s\":\"{time_s}\""));
    }
    out.push_str("}]");
}

#[cfg(test)]
mod tests;
