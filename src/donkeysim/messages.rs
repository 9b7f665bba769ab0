//! What a client of DonkeySim sends: JSON objects, one behind the other, text in, commands out, no sockets; and the other way round, for
//! our own client.
//!
//! The client writes bare objects without line ends, so the stream is split where an object ends. All values are strings, as in
//! `{"msg_type": "control", "steering": "0.25", "throttle": "0.1", "brake": "0.0"}`.

use serde_json::{Map, Value};

use crate::text::excerpt;

/// Longest message of a client, bytes. The longest that clients send have some hundred.
pub const MAX_MESSAGE_BYTES: usize = 1 << 16;

/// Smallest and largest height or width of a picture, pixels.
const SIDES: std::ops::RangeInclusive<f64> = 16.0..=1024.0;

/// How strictly messages are read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reading {
    /// Objects are split wherever they end; numbers may be numbers, too.
    Lenient,
    /// As the real simulator: what arrives at once must be one message, and numbers must be strings.
    Strict,
}

/// What a client asks for.
#[derive(Clone, Debug, PartialEq)]
pub enum Command {
    /// Steering and throttle in [-1, 1], + = right and forwards; brake in [0, 1].
    Control {
        /// Share of full lock.
        steering: f64,
        /// Share of full power; less than 0 brakes.
        throttle: f64,
        /// Share of full braking.
        brake: f64,
    },
    /// Put the car back to the start.
    Reset,
    /// Which scenes are there?
    SceneNames,
    /// Enter a scene.
    LoadScene(String),
    /// Leave the scene for the menu.
    ExitScene,
    /// End the connection.
    Quit,
    /// Which version of the protocol is it?
    ProtocolVersion,
    /// Where is a node of the line?
    NodePosition(usize),
    /// Height and width of the pictures; none keeps what is.
    Camera {
        /// Pixels.
        height: Option<usize>,
        /// Pixels.
        width: Option<usize>,
        /// Other settings than these were asked for.
        others: bool,
    },
    /// Settings without an effect here, by their name.
    Ignored(String),
}

/// A message of a client: a bare object whose values are all strings, as the real simulator wants them.
pub fn text(kind: &str, fields: &[(&str, String)]) -> String {
    let mut message = Map::from_iter([("msg_type".to_string(), kind.into())]);
    message.extend(fields.iter().map(|(name, value)| (name.to_string(), value.as_str().into())));
    Value::Object(message).to_string()
}

/// Splits what arrives into messages.
#[derive(Debug, Default)]
pub struct Splitter {
    bytes: Vec<u8>,
}

impl Splitter {
    /// Takes what arrived at once and gives the commands that are complete, or why something is none.
    ///
    /// # Errors
    ///
    /// A message without an end, after which nothing more can be told apart.
    pub fn push(&mut self, chunk: &[u8], reading: Reading) -> Result<Vec<Result<Command, String>>, String> {
        if reading == Reading::Strict {
            return Ok(vec![command(chunk, reading)]);
        }
        self.bytes.extend_from_slice(chunk);
        let (mut commands, mut start) = (Vec::new(), 0);
        while let Some(range) = object(&self.bytes[start..])? {
            let message = &self.bytes[start + range.start..start + range.end];
            commands.push(command(message, reading));
            start += range.end;
        }
        self.bytes.drain(..start);
        if self.bytes.len() > MAX_MESSAGE_BYTES {
            return Err(format!("a message of more than {MAX_MESSAGE_BYTES} bytes"));
        }
        Ok(commands)
    }
}

/// Where the first object of `bytes` lies, if it is complete.
fn object(bytes: &[u8]) -> Result<Option<std::ops::Range<usize>>, String> {
    let (mut start, mut depth, mut in_string, mut escaped) = (None, 0usize, false, false);
    for (at, &byte) in bytes.iter().enumerate() {
        match (start, byte) {
            (None, b'{') => (start, depth) = (Some(at), 1),
            (None, byte) if byte.is_ascii_whitespace() || byte == 0 => {}
            (None, _) => return Err(format!("text that is no message: {}", shown(&bytes[at..]))),
            _ if escaped => escaped = false,
            (_, b'\\') if in_string => escaped = true,
            (_, b'"') => in_string = !in_string,
            _ if in_string => {}
            (_, b'{') => depth += 1,
            (Some(start), b'}') => {
                depth -= 1;
                if depth == 0 {
                    return Ok(Some(start..at + 1));
                }
            }
            _ => {}
        }
    }
    Ok(None)
}

/// The beginning of a message, fit for a terminal.
pub(super) fn shown(bytes: &[u8]) -> String {
    excerpt(&String::from_utf8_lossy(&bytes[..bytes.len().min(200)]), 60)
}

fn command(message: &[u8], reading: Reading) -> Result<Command, String> {
    let fields: Map<String, Value> =
        serde_json::from_slice(message).map_err(|_| format!("text that is no message: {}", shown(message)))?;
    let text = |name: &str| fields.get(name).and_then(Value::as_str);
    let kind = text("msg_type").ok_or_else(|| format!("a message without `msg_type`: {}", shown(message)))?;
    let number = |name: &str, default: Option<f64>| {
        let found = match fields.get(name) {
            None => default,
            Some(Value::String(text)) => text.trim().parse().ok(),
            Some(Value::Number(number)) if reading == Reading::Lenient => number.as_f64(),
            Some(_) => None,
        };
        let found = found.filter(|number| number.is_finite());
        found.ok_or_else(|| format!("`{}`: `{name}` must be a number in a string", excerpt(kind, 40)))
    };
    Ok(match kind {
        "control" => Command::Control {
            steering: number("steering", None)?.clamp(-1.0, 1.0),
            throttle: number("throttle", None)?.clamp(-1.0, 1.0),
            brake: number("brake", Some(0.0))?.clamp(0.0, 1.0),
        },
        "reset_car" => Command::Reset,
        "get_scene_names" => Command::SceneNames,
        "load_scene" => Command::LoadScene(text("scene_name").ok_or("`load_scene` has no `scene_name`")?.into()),
        "exit_scene" => Command::ExitScene,
        "quit_app" => Command::Quit,
        "get_protocol_version" => Command::ProtocolVersion,
        "node_position" => Command::NodePosition(number("index", None)?.clamp(0.0, 1e9) as usize),
        "cam_config" => {
            let side = |name: &str| match number(name, Some(0.0))? {
                0.0 => Ok(None),
                size if SIDES.contains(&size) => Ok(Some(size as usize)),
                size => Err(format!("`cam_config`: `{name}` must be 16 to 1024, not {size}")),
            };
            let known = ["msg_type", "img_w", "img_h", "img_d", "img_enc"];
            let is_set = |value: &Value| !matches!(value.as_str().map(str::parse::<f64>), Some(Ok(0.0)));
            let others = fields.iter().any(|(name, value)| !known.contains(&name.as_str()) && is_set(value));
            Command::Camera { height: side("img_h")?, width: side("img_w")?, others }
        }
        other => Command::Ignored(excerpt(other, 40)),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const CONTROL: &str = r#"{"msg_type": "control", "steering": "0.25", "throttle": "-2", "brake": "0.5"}"#;

    #[test]
    fn objects_are_split_where_they_end_however_they_arrive() {
        let text = format!("{CONTROL}{{\"msg_type\":\"load_scene\",\"scene_name\":\"a}}\\\"{{b\"}}\n{CONTROL}");
        for size in [1, 7, text.len()] {
            let (mut splitter, mut found) = (Splitter::default(), Vec::new());
            for chunk in text.as_bytes().chunks(size) {
                found.extend(splitter.push(chunk, Reading::Lenient).unwrap());
            }
            let control = Command::Control { steering: 0.25, throttle: -1.0, brake: 0.5 };
            assert_eq!(found, [Ok(control.clone()), Ok(Command::LoadScene("a}\"{b".into())), Ok(control)]);
        }
    }

    #[test]
    fn strictly_read_two_messages_at_once_and_plain_numbers_fail() {
        let push = |text: &str, reading| Splitter::default().push(text.as_bytes(), reading).unwrap();
        let two = CONTROL.repeat(2);
        assert_eq!(push(&two, Reading::Lenient).len(), 2);
        assert!(push(&two, Reading::Strict)[0].is_err() && push(CONTROL, Reading::Strict)[0].is_ok());
        let plain = r#"{"msg_type":"control","steering":0.25,"throttle":"0"}"#;
        assert!(push(plain, Reading::Lenient)[0].is_ok());
        assert!(
            push(plain, Reading::Strict)[0].as_ref().unwrap_err().contains("`steering` must be a number in a string")
        );
    }

    #[test]
    fn what_our_client_writes_is_read_strictly_without_a_loss() {
        let read = |kind: &str, fields: &[(&str, String)]| {
            Splitter::default().push(text(kind, fields).as_bytes(), Reading::Strict).unwrap().remove(0)
        };
        let control = [("steering", "-0.25000"), ("throttle", "0.5"), ("brake", "0")].map(|(n, v)| (n, v.to_string()));
        assert_eq!(read("control", &control), Ok(Command::Control { steering: -0.25, throttle: 0.5, brake: 0.0 }));
        assert_eq!(read("reset_car", &[]), Ok(Command::Reset));
        let name = "a\"}{\\\n\u{1b}".to_string();
        assert_eq!(read("load_scene", &[("scene_name", name.clone())]), Ok(Command::LoadScene(name)));
    }

    #[test]
    fn hostile_text_is_an_error_and_tame() {
        let push = |bytes: &[u8]| Splitter::default().push(bytes, Reading::Lenient);
        assert!(push(b"GET / HTTP/1.1\r\n\r\n").unwrap_err().contains("no message"));
        assert!(push(&[b'{'; MAX_MESSAGE_BYTES + 1]).unwrap_err().contains("more than 65536"));
        let deep = ["{\"a\":".repeat(5000), "1".into(), "}".repeat(5000)].concat();
        assert!(push(deep.as_bytes()).unwrap()[0].is_err());
        for (text, named) in [
            ("{}", "without `msg_type`"),
            ("{\"msg_type\":7}", "without `msg_type`"),
            ("{\"msg_type\":\"control\",\"steering\":\"nan\",\"throttle\":\"0\"}", "`steering`"),
            ("{\"msg_type\":\"control\",\"steering\":\"0\"}", "`throttle`"),
            ("{\"msg_type\":\"cam_config\",\"img_w\":\"1e9\"}", "16 to 1024"),
            ("{\"msg_type\":\"load_scene\"}", "scene_name"),
        ] {
            let error = push(text.as_bytes()).unwrap().remove(0).unwrap_err();
            assert!(error.contains(named), "{text}: {error}");
        }
        let strange = push("{\"msg_type\":\"\\u001b[2J\"}".as_bytes()).unwrap().remove(0).unwrap();
        assert!(matches!(strange, Command::Ignored(name) if !name.contains('\u{1b}')));
    }
}
