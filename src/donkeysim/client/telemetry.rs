//! What DonkeySim sends: one JSON object a line, text in, messages out, no sockets.

use std::borrow::Cow;
use std::fmt;

use serde::Deserialize;
use serde::de::{Deserializer, IgnoredAny, MapAccess, SeqAccess, Visitor};

use crate::donkeysim::messages::shown;

/// A message of the simulator.
#[derive(Clone, Debug, PartialEq)]
pub enum ServerMessage {
    /// It is in its menu and waits for a scene.
    Menu,
    /// The names of its scenes.
    SceneNames(Vec<String>),
    /// The car stands in a scene.
    CarLoaded,
    /// A picture, and how the car moves.
    Telemetry(Box<Telemetry>),
    /// The car crosses the starting line of this index.
    StartingLine(i64),
    /// A lap took this time, s.
    LapTime(f64),
    /// The race does not count any more, for this reason.
    Disqualified(&'static str),
    /// Something that a driver need not know.
    Other,
}

/// How the car moves. Everything but the picture may be missing.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Telemetry {
    /// The picture in Base64; empty if there is none.
    pub image: String,
    /// Speed, in units of the telemetry.
    pub speed: Option<f64>,
    /// Time since the scene was loaded, s.
    pub time_s: Option<f64>,
    /// Distance from the line, in units of the scene.
    pub cte: Option<f64>,
    /// Place to the right and ahead (Unity's x and z), in units of the telemetry.
    pub place: Option<[f64; 2]>,
    /// Direction, deg, clockwise from ahead.
    pub yaw_deg: Option<f64>,
    /// Node of the line that is nearest, and their number.
    pub node: Option<[u64; 2]>,
    /// Whether the car hit something since the telemetry before.
    pub hit: bool,
}

/// A value that may be of any kind: the simulator writes what is no number as a string, as `"NaN"`.
#[derive(Clone, Debug, Default)]
enum Loose<'a> {
    Number(f64),
    Text(Cow<'a, str>),
    #[default]
    Nothing,
}

impl Loose<'_> {
    /// The finite number, if it is one.
    fn number(&self) -> Option<f64> {
        match self {
            Loose::Number(number) => Some(*number),
            Loose::Text(text) => text.trim().parse().ok(),
            Loose::Nothing => None,
        }
        .filter(|number: &f64| number.is_finite())
    }

    fn text(&self) -> &str {
        if let Loose::Text(text) = self { text } else { "" }
    }
}

impl<'de: 'a, 'a> Deserialize<'de> for Loose<'a> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Any;
        impl<'de> Visitor<'de> for Any {
            type Value = Loose<'de>;

            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                f.write_str("a value")
            }
            fn visit_f64<E>(self, number: f64) -> Result<Loose<'de>, E> {
                Ok(Loose::Number(number))
            }
            fn visit_i64<E>(self, number: i64) -> Result<Loose<'de>, E> {
                Ok(Loose::Number(number as f64))
            }
            fn visit_u64<E>(self, number: u64) -> Result<Loose<'de>, E> {
                Ok(Loose::Number(number as f64))
            }
            fn visit_bool<E>(self, _: bool) -> Result<Loose<'de>, E> {
                Ok(Loose::Nothing)
            }
            fn visit_unit<E>(self) -> Result<Loose<'de>, E> {
                Ok(Loose::Nothing)
            }
            fn visit_borrowed_str<E>(self, text: &'de str) -> Result<Loose<'de>, E> {
                Ok(Loose::Text(Cow::Borrowed(text)))
            }
            fn visit_str<E>(self, text: &str) -> Result<Loose<'de>, E> {
                Ok(Loose::Text(Cow::Owned(text.into())))
            }
            fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Loose<'de>, A::Error> {
                while items.next_element::<IgnoredAny>()?.is_some() {}
                Ok(Loose::Nothing)
            }
            fn visit_map<A: MapAccess<'de>>(self, mut items: A) -> Result<Loose<'de>, A::Error> {
                while items.next_entry::<IgnoredAny, IgnoredAny>()?.is_some() {}
                Ok(Loose::Nothing)
            }
        }
        deserializer.deserialize_any(Any)
    }
}

/// The fields of all messages that are read; others are passed over without being kept.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Fields<'a> {
    #[serde(borrow)]
    msg_type: Loose<'a>,
    #[serde(borrow)]
    image: Loose<'a>,
    #[serde(borrow)]
    hit: Loose<'a>,
    #[serde(borrow)]
    speed: Loose<'a>,
    #[serde(borrow)]
    time: Loose<'a>,
    #[serde(borrow)]
    cte: Loose<'a>,
    #[serde(borrow)]
    pos_x: Loose<'a>,
    #[serde(borrow)]
    pos_z: Loose<'a>,
    #[serde(borrow)]
    yaw: Loose<'a>,
    #[serde(borrow, rename = "activeNode")]
    active_node: Loose<'a>,
    #[serde(borrow, rename = "totalNodes")]
    total_nodes: Loose<'a>,
    #[serde(borrow)]
    starting_line_index: Loose<'a>,
    #[serde(borrow)]
    lap_time: Loose<'a>,
    scene_names: Vec<String>,
}

/// Reads one line.
///
/// # Errors
///
/// What the line is instead of a message.
pub fn parse(line: &[u8]) -> Result<ServerMessage, String> {
    let fields: Fields = match serde_json::from_slice(line) {
        Ok(fields) => fields,
        // A simulator under a language with decimal commas writes them into its numbers.
        Err(_) => return parse_repaired(line),
    };
    message(&fields).ok_or_else(|| format!("a message without `msg_type`: {}", shown(line)))
}

fn parse_repaired(line: &[u8]) -> Result<ServerMessage, String> {
    let repaired = with_decimal_points(line);
    let fields = serde_json::from_slice(&repaired).ok();
    fields.as_ref().and_then(message).ok_or_else(|| format!("text that is no message: {}", shown(line)))
}

fn message(fields: &Fields) -> Option<ServerMessage> {
    let Loose::Text(kind) = &fields.msg_type else { return None };
    Some(match kind.as_ref() {
        "scene_selection_ready" => ServerMessage::Menu,
        "scene_names" => ServerMessage::SceneNames(fields.scene_names.clone()),
        "car_loaded" | "need_car_config" => ServerMessage::CarLoaded,
        "telemetry" => ServerMessage::Telemetry(Box::new(telemetry(fields))),
        "collision_with_starting_line" => {
            ServerMessage::StartingLine(fields.starting_line_index.number().unwrap_or(0.0) as i64)
        }
        "cross_start" => ServerMessage::LapTime(fields.lap_time.number().unwrap_or(0.0)),
        "DQ" => ServerMessage::Disqualified("the simulator has disqualified the car"),
        "missed_checkpoint" => ServerMessage::Disqualified("the car has missed a checkpoint"),
        _ => ServerMessage::Other,
    })
}

fn telemetry(fields: &Fields) -> Telemetry {
    let node = |value: &Loose| value.number().filter(|n| (0.0..1e9).contains(n)).map(|n| n as u64);
    let hit = fields.hit.text();
    Telemetry {
        image: fields.image.text().into(),
        speed: fields.speed.number(),
        time_s: fields.time.number(),
        cte: fields.cte.number(),
        place: fields.pos_x.number().zip(fields.pos_z.number()).map(|(x, z)| [x, z]),
        yaw_deg: fields.yaw.number(),
        node: node(&fields.active_node)
            .zip(node(&fields.total_nodes))
            .filter(|(active, total)| active < total && *total > 2)
            .map(|(active, total)| [active, total]),
        hit: !hit.is_empty() && hit != "none",
    }
}

/// The line with a point for each comma that stands within a number behind a colon: between two fields a comma is followed by a quote.
fn with_decimal_points(line: &[u8]) -> Vec<u8> {
    let mut repaired = line.to_vec();
    let (mut in_string, mut escaped, mut in_number) = (false, false, false);
    for at in 0..line.len() {
        match line[at] {
            _ if escaped => escaped = false,
            b'\\' if in_string => escaped = true,
            b'"' => (in_string, in_number) = (!in_string, false),
            _ if in_string => {}
            b':' => in_number = true,
            b',' if in_number && at > 0 && line[at - 1].is_ascii_digit() => {
                if line.get(at + 1).is_some_and(u8::is_ascii_digit) {
                    repaired[at] = b'.';
                }
                in_number = false;
            }
            b'0'..=b'9' | b'-' | b'+' | b'e' | b'E' | b' ' => {}
            _ => in_number = false,
        }
    }
    repaired
}

#[cfg(test)]
mod tests {
    use super::*;

    fn telemetry_of(text: &str) -> Telemetry {
        match parse(text.as_bytes()) {
            Ok(ServerMessage::Telemetry(telemetry)) => *telemetry,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn messages_are_told_by_their_type_and_what_may_be_missing_may() {
        let read = |text: &str| parse(text.as_bytes()).unwrap();
        assert_eq!(read(r#"{"msg_type":"scene_selection_ready","loaded":"1"}"#), ServerMessage::Menu);
        assert_eq!(read(r#"{"msg_type":"need_car_config"}"#), ServerMessage::CarLoaded);
        let names = r#"{"msg_type":"scene_names","scene_names":["a","b"]}"#;
        assert_eq!(read(names), ServerMessage::SceneNames(vec!["a".into(), "b".into()]));
        let line = r#"{"msg_type":"collision_with_starting_line","starting_line_index":2,"timeStamp":3.5}"#;
        assert_eq!(read(line), ServerMessage::StartingLine(2));
        assert_eq!(read(r#"{"msg_type":"cross_start","lap_time":31.5}"#), ServerMessage::LapTime(31.5));
        assert!(matches!(read(r#"{"msg_type":"DQ"}"#), ServerMessage::Disqualified(_)));
        assert_eq!(read(r#"{"msg_type":"ping"}"#), ServerMessage::Other);
        let full = telemetry_of(
            r#"{"msg_type":"telemetry","image":"QUJD","speed":1.5,"time":2,"hit":"cone","cte":-0.25,"pos_x":1,"pos_y":9,
                "pos_z":-2,"yaw":90,"activeNode":3,"totalNodes":100,"lidar":[{"rx":1,"d":[[2]]}],"accel_x":"NaN"}"#,
        );
        let expected = Telemetry {
            image: "QUJD".into(),
            speed: Some(1.5),
            time_s: Some(2.0),
            cte: Some(-0.25),
            place: Some([1.0, -2.0]),
            yaw_deg: Some(90.0),
            node: Some([3, 100]),
            hit: true,
        };
        assert_eq!(full, expected);
        let odd = r#"{"msg_type":"telemetry","image":7,"speed":"NaN","hit":"none","cte":null,"activeNode":100,"totalNodes":100}"#;
        assert_eq!(telemetry_of(odd), Telemetry::default());
    }

    #[test]
    fn decimal_commas_are_read_and_valid_messages_are_left_alone() {
        let text = r#"{"msg_type":"telemetry","image":"a:1,2","speed":1,25,"cte":-0,5,"time":3,"yaw":1,5E-05}"#;
        let read = telemetry_of(text);
        assert_eq!((read.speed, read.cte, read.time_s), (Some(1.25), Some(-0.5), Some(3.0)));
        assert_eq!((read.yaw_deg, read.image.as_str()), (Some(1.5e-5), "a:1,2"));
    }

    #[test]
    fn rubbish_is_an_error_and_tame() {
        for text in [
            &b"HTTP/1.1 400 Bad Request\r"[..],
            b"{\"msg_type\":\"telemetry\",\"image\":\"QUJD\"",
            b"\x1b[2J\xff\xfe",
            b"{\"msg_type\":\"\xff\"}",
            b"[]",
            b"{}",
            b"{\"msg_type\":7}",
            b"{\"msg_type\":\"scene_names\",\"scene_names\":\"a\"}",
            b"{\"msg_type\":\"telemetry\",\"speed\":1e999}",
        ] {
            let error = parse(text).unwrap_err();
            assert!(error.chars().all(|c| !c.is_control()) && error.len() < 200, "{error}");
        }
        let deep = ["{\"msg_type\":\"a\",\"b\":", &"[".repeat(100_000)].concat();
        assert!(parse(deep.as_bytes()).is_err());
    }
}
