//! What a client sends: one packet of Engine.IO, and in it one of Socket.IO.

use std::borrow::Cow;

use serde::Deserialize;
use serde::de::{Deserializer, IgnoredAny, SeqAccess, Visitor};

use crate::text::excerpt;

use super::telemetry::{Fields, Telemetry, Text};

/// A message that could not be understood.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum ProtocolError {
    /// The first character is no Engine.IO packet.
    #[error("a message that is no Engine.IO packet: {0:?}")]
    NotEngineIo(String),
    /// A message in the plain-JSON protocol of the browser version.
    #[error("plain JSON instead of Socket.IO: {0:?}")]
    PlainJson(String),
    /// An event whose JSON is broken.
    #[error("an event that cannot be read: {0}")]
    Event(String),
}

/// What a client sends.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum ClientPacket<'a> {
    /// `1`: the client leaves.
    Close,
    /// `2`, and the text that the pong sends back behind its `3`.
    Ping(&'a str),
    /// `3`: answer to a ping of ours.
    Pong,
    /// `40`: the client asks to connect to a namespace; `/` is the usual one.
    Connect {
        /// The namespace, with its slash.
        namespace: &'a str,
    },
    /// `41`: the client leaves a namespace.
    Disconnect,
    /// `42["telemetry",{…}]`, and the number of the acknowledgement if the client asks for one.
    Telemetry(Telemetry<'a>, Option<u64>),
    /// `42["telemetry",null]`: a person drives.
    Manual(Option<u64>),
    /// Another event.
    OtherEvent {
        /// Its name.
        name: Cow<'a, str>,
        /// The number of the acknowledgement, if the client asks for one.
        ack: Option<u64>,
    },
    /// A valid packet that needs no answer: an acknowledgement, an upgrade, an empty packet.
    Ignored,
}

/// Reads a message of a client.
///
/// # Errors
///
/// [`ProtocolError`]. The connection can go on.
pub(crate) fn parse(text: &str) -> Result<ClientPacket<'_>, ProtocolError> {
    let Some(digit) = text.bytes().next() else { return Err(ProtocolError::NotEngineIo(String::new())) };
    match digit {
        b'1' => Ok(ClientPacket::Close),
        b'2' => Ok(ClientPacket::Ping(&text[1..])),
        b'3' => Ok(ClientPacket::Pong),
        b'4' => parse_message(&text[1..]),
        b'0' | b'5' | b'6' => Ok(ClientPacket::Ignored),
        b'{' | b'[' => Err(ProtocolError::PlainJson(excerpt(text, SHOWN))),
        _ => Err(ProtocolError::NotEngineIo(excerpt(text, SHOWN))),
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
        _ => Err(ProtocolError::Event(excerpt(text, SHOWN))),
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
    let event: EventJson =
        serde_json::from_str(json).map_err(|e| ProtocolError::Event(excerpt(&e.to_string(), SHOWN_OF_ERROR)))?;
    Ok(match event {
        EventJson::Telemetry(Some(telemetry)) => ClientPacket::Telemetry(telemetry, ack),
        EventJson::Telemetry(None) => ClientPacket::Manual(ack),
        EventJson::Other(name) => ClientPacket::OtherEvent { name, ack },
    })
}

/// Characters of a message that are shown to a person.
const SHOWN: usize = 40;
/// Characters of an error about JSON that are shown: it can quote all of a long string.
const SHOWN_OF_ERROR: usize = 160;

enum EventJson<'a> {
    Telemetry(Option<Telemetry<'a>>),
    Other(Cow<'a, str>),
}

impl<'de> Deserialize<'de> for EventJson<'de> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Elements;
        impl<'de> Visitor<'de> for Elements {
            type Value = EventJson<'de>;

            fn expecting(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
                f.write_str("an array of an event's name and its data")
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut sequence: A) -> Result<EventJson<'de>, A::Error> {
                let Some(Text(name)) = sequence.next_element()? else {
                    return Err(serde::de::Error::custom("an event without a name"));
                };
                let event = if name == "telemetry" {
                    let fields: Option<Option<Fields>> = sequence.next_element()?;
                    EventJson::Telemetry(fields.flatten().map(Telemetry::from))
                } else {
                    EventJson::Other(name)
                };
                while sequence.next_element::<IgnoredAny>()?.is_some() {}
                Ok(event)
            }
        }
        deserializer.deserialize_seq(Elements)
    }
}
