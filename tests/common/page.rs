//! The live page's side of its WebSocket, without a browser.

use std::net::TcpStream;
use std::path::Path;
use std::time::Instant;

use serde_json::{Value, json};
use tungstenite::client::ClientRequestBuilder;
use tungstenite::{Message, WebSocket};

use super::command::steersman;
use super::double::SILENCE;
use super::served::Served;

/// Starts `steersman ARGS… --port 0` in `folder`, which serves a live page.
pub fn serve(folder: &Path, args: &[&str]) -> Served {
    let mut command = steersman(folder);
    command.args(args).args(["--port", "0"]);
    Served::spawn(command, "http://")
}

/// A frame as the page gets it.
pub struct Frame {
    /// Where the car is.
    pub state: Value,
    /// JPEG of the camera.
    pub camera: Vec<u8>,
    /// JPEG of the saliency, or empty.
    pub saliency: Vec<u8>,
}

impl Frame {
    /// A number of the state.
    pub fn number(&self, key: &str) -> f64 {
        self.state[key].as_f64().unwrap_or_else(|| panic!("{key} in {}", self.state))
    }
}

/// A page.
pub struct Page {
    socket: WebSocket<TcpStream>,
    /// What it was told first.
    pub hello: Value,
}

impl Page {
    /// Opens the WebSocket of the page at `port`.
    pub fn open(port: u16) -> Page {
        let request = ClientRequestBuilder::new(format!("ws://127.0.0.1:{port}/live").parse().unwrap())
            .with_header("Origin", format!("http://127.0.0.1:{port}"));
        let stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
        stream.set_read_timeout(Some(SILENCE)).unwrap();
        let mut socket = tungstenite::client(request, stream).unwrap().0;
        let Message::Text(hello) = socket.read().unwrap() else { panic!("no text first") };
        Page { socket, hello: serde_json::from_str(&hello).unwrap() }
    }

    /// Asks for something.
    pub fn ask(&mut self, request: &Value) {
        self.socket.send(Message::text(request.to_string())).unwrap();
    }

    /// Presses keys: -1, 0 or 1 for wheel and pedals.
    pub fn press(&mut self, steer: i32, pedal: i32) {
        self.ask(&json!({ "type": "controls", "steer": steer, "pedal": pedal }));
    }

    /// The next frame, or the last words.
    pub fn next(&mut self) -> Result<Frame, String> {
        self.ask(&json!({ "type": "next" }));
        loop {
            match self.socket.read().unwrap() {
                Message::Binary(bytes) => {
                    let part = |at: usize| {
                        let len = u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
                        (bytes[at + 4..at + 4 + len].to_vec(), at + 4 + len)
                    };
                    let (state, at) = part(0);
                    let (camera, at) = part(at);
                    let state = serde_json::from_slice(&state).unwrap();
                    return Ok(Frame { state, camera, saliency: bytes[at..].to_vec() });
                }
                Message::Text(text) => {
                    let farewell: Value = serde_json::from_str(&text).unwrap();
                    return Err(farewell["over"].as_str().unwrap().into());
                }
                _ => {}
            }
        }
    }

    /// Looks on until the car stands.
    pub fn until_it_stands(&mut self) -> Frame {
        let began = Instant::now();
        loop {
            let frame = self.next().unwrap();
            if frame.number("speed_mph") == 0.0 {
                return frame;
            }
            assert!(began.elapsed() < SILENCE, "it does not stop: {}", frame.state);
        }
    }

    /// Holds keys until a frame is as wanted.
    pub fn hold_until(&mut self, steer: i32, pedal: i32, wanted: impl Fn(&Frame) -> bool) -> Frame {
        let began = Instant::now();
        loop {
            self.press(steer, pedal);
            let frame = self.next().unwrap();
            if wanted(&frame) {
                return frame;
            }
            assert!(began.elapsed() < SILENCE, "never as wanted: {}", frame.state);
        }
    }
}
