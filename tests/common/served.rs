//! `steersman serve` as a process of its own, and clients that are not the built-in simulator.

use std::io::{BufRead, BufReader, ErrorKind, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Condvar, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use data_encoding::BASE64;
use serde_json::Value;
use steersman::model_file::{Model, TrainingRecord};
use steersman::recipe::Recipe;
use steersman_kernels::Isa;
use tungstenite::client::ClientRequestBuilder;
use tungstenite::{Message, WebSocket};

use super::command::steersman;
use super::double::SILENCE;

/// Writes a model of `recipe` with random weights.
pub fn random_model(path: &Path, recipe: &str) {
    let recipe = Recipe::find(recipe, &[]).unwrap();
    let parameters = recipe.network(Isa::best()).unwrap().initialize(1);
    let record = TrainingRecord::default();
    Model { recipe, parameters, record, training_rows: vec![] }.save(path).unwrap();
}

/// A folder with `model`, a small network with random weights.
pub fn folder_with_model() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    random_model(&folder.path().join("model"), "lenet");
    folder
}

/// A server at the speed of `drive`.
pub fn serve(folder: &tempfile::TempDir, args: &[&str]) -> Served {
    Served::start(folder.path(), "model", &[&["--speed", "20"], args].concat())
}

/// Drives `client` once: sends telemetry and wants a command.
pub fn turn(client: &mut Client, speed: f64, jpeg: &[u8]) -> (f64, f64) {
    client.send(&telemetry(speed, jpeg));
    command(&client.next())
}

/// The program that Udacity's simulator says it is.
pub const SIMULATOR: &str = "websocket-sharp/1.0";

/// A running server.
pub struct Served {
    child: Child,
    /// Its port.
    pub port: u16,
    said: Arc<(Mutex<String>, Condvar)>,
    listener: Option<JoinHandle<()>>,
}

impl Served {
    /// Starts `serve MODEL` in `folder` on a free port.
    pub fn start(folder: &Path, model: &str, args: &[&str]) -> Served {
        let mut command = steersman(folder);
        command.args(["serve", model, "--port", "0", "--json"]).args(args);
        Served::spawn(command, "ws://")
    }

    /// Runs `command`, and waits until it says at which port it serves, in an address that begins with `scheme`.
    pub fn spawn(mut command: Command, scheme: &str) -> Served {
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let stderr = BufReader::new(child.stderr.take().unwrap());
        let said = Arc::new((Mutex::new(String::new()), Condvar::new()));
        let listener = {
            let said = said.clone();
            std::thread::spawn(move || {
                for line in stderr.lines() {
                    let mut text = said.0.lock().unwrap();
                    text.push_str(&line.unwrap());
                    text.push('\n');
                    said.1.notify_all();
                }
            })
        };
        let mut served = Served { child, port: 0, said, listener: Some(listener) };
        let text = served.wait_until_it_says(scheme);
        let address = text.split(scheme).nth(1).unwrap().split('/').next().unwrap();
        served.port = address.rsplit(':').next().unwrap().parse().unwrap();
        served
    }

    /// What it said on standard error so far.
    pub fn said(&self) -> String {
        self.said.0.lock().unwrap().clone()
    }

    /// Waits until standard error contains `words`; all of it.
    pub fn wait_until_it_says(&self, words: &str) -> String {
        let text = self.said.0.lock().unwrap();
        let (text, timeout) = self.said.1.wait_timeout_while(text, SILENCE, |text| !text.contains(words)).unwrap();
        assert!(!timeout.timed_out(), "never said {words:?}, but: {text}");
        text.clone()
    }

    /// A value of `/proc/PID/status`, where there is one.
    pub fn status(&self, name: &str) -> Option<u64> {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).ok()?;
        let line = status.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(':'))?;
        line.split_whitespace().next()?.parse().ok()
    }

    /// Presses Ctrl-C.
    pub fn interrupt(&self) {
        let killed = Command::new("kill").args(["-INT", &self.child.id().to_string()]).status().unwrap();
        assert!(killed.success());
    }

    /// Waits for the end; the exit code.
    pub fn code(mut self) -> Option<i32> {
        self.child.wait().unwrap().code()
    }

    /// Presses Ctrl-C. What it printed as JSON, and all it said.
    pub fn stop(self) -> (Value, String) {
        self.interrupt();
        self.end()
    }

    /// Waits for the end. What it printed as JSON, and all it said.
    pub fn end(mut self) -> (Value, String) {
        let mut printed = String::new();
        self.child.stdout.take().unwrap().read_to_string(&mut printed).unwrap();
        let status = self.child.wait().unwrap();
        self.listener.take().unwrap().join().unwrap();
        let said = self.said();
        assert!(status.success(), "{status}: {said}");
        assert!(!said.contains("panicked"), "{said}");
        let last = printed.lines().last().unwrap_or_default();
        (serde_json::from_str(last).unwrap_or_else(|e| panic!("{e} in {printed}")), said)
    }

    /// Sends a request as it stands and reads the whole answer.
    pub fn ask(&self, request: &str) -> String {
        let mut stream = self.connect_tcp();
        stream.write_all(request.as_bytes()).unwrap();
        let mut answer = Vec::new();
        match stream.read_to_end(&mut answer) {
            Err(e) if e.kind() != ErrorKind::ConnectionReset => panic!("{e}"),
            _ => String::from_utf8(answer).unwrap(),
        }
    }

    /// A TCP connection.
    pub fn connect_tcp(&self) -> TcpStream {
        connect_tcp(self.port)
    }

    /// A WebSocket of the program `agent`.
    pub fn connect(&self, agent: &str, eio: u32) -> Client {
        Client::connect(self.port, agent, eio)
    }

    /// A WebSocket that the server takes for the simulator's.
    pub fn connect_simulator(&self) -> Client {
        self.connect(SIMULATOR, 4)
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        // After a test that failed; otherwise it has ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn connect_tcp(port: u16) -> TcpStream {
    let stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
    stream.set_read_timeout(Some(SILENCE)).unwrap();
    stream
}

/// A client of few words.
pub struct Client(pub WebSocket<TcpStream>);

impl Client {
    /// A WebSocket of the program `agent` to the server at `port`.
    pub fn connect(port: u16, agent: &str, eio: u32) -> Client {
        let uri = format!("ws://127.0.0.1:{port}/socket.io/?EIO={eio}&transport=websocket");
        let request = ClientRequestBuilder::new(uri.parse().unwrap()).with_header("User-Agent", agent);
        Client(tungstenite::client(request, connect_tcp(port)).unwrap().0)
    }

    /// Sends a text.
    pub fn send(&mut self, text: &str) {
        self.0.send(Message::text(text)).unwrap();
    }

    /// The next text; `None` at the end of the connection, or if none comes within `limit`.
    pub fn next_within(&mut self, limit: Duration) -> Option<String> {
        let began = Instant::now();
        loop {
            let left = limit.saturating_sub(began.elapsed()).max(Duration::from_millis(1));
            self.0.get_ref().set_read_timeout(Some(left)).unwrap();
            match self.0.read() {
                Ok(Message::Text(text)) => return Some(text.to_string()),
                Ok(Message::Close(_)) | Err(_) => return None,
                Ok(_) => {}
            }
        }
    }

    /// The next text, which must come.
    pub fn next(&mut self) -> String {
        self.next_within(SILENCE).expect("an answer")
    }
}

/// A JPEG of the sample log.
pub fn sample_jpeg() -> Vec<u8> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("data/sample/IMG");
    let mut names: Vec<_> = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    names.sort();
    std::fs::read(&names[0]).unwrap()
}

/// Telemetry of a car at `speed` mph with this JPEG, as the simulator writes it.
pub fn telemetry(speed: f64, jpeg: &[u8]) -> String {
    let image = BASE64.encode(jpeg);
    format!(
        r#"42["telemetry",{{"steering_angle":"0.0000","throttle":"0.0000","speed":"{speed:.4}","image":"{image}"}}]"#
    )
}

/// Steering and throttle of a command.
pub fn command(text: &str) -> (f64, f64) {
    let event: Value = serde_json::from_str(text.strip_prefix("42").unwrap_or_else(|| panic!("{text}"))).unwrap();
    assert_eq!(event[0], "steer", "{text}");
    let number = |name: &str| event[1][name].as_str().unwrap_or_else(|| panic!("{text}")).parse().unwrap();
    (number("steering_angle"), number("throttle"))
}
