//! The sockets: a thread for each client.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use super::car::{DonkeyCar, FRAMES_PER_S};
use super::messages::{Command, Reading, Splitter};
use crate::geometry::CarGeometry;
use crate::net::http;
use crate::observer::{Observer, StopSignal};
use crate::simulator::Track;
use crate::{Error, Result};

/// Most clients at a time.
const MAX_CLIENTS: usize = 8;
/// Pause between two checks of the listener.
const LISTEN_PAUSE: Duration = Duration::from_millis(10);
/// Longest time that a client may take to accept what is sent.
const SEND_PATIENCE: Duration = Duration::from_secs(3);
/// Time between two pictures.
const FRAME_INTERVAL: Duration = Duration::from_millis(1000 / FRAMES_PER_S);
/// Shortest time between two pictures in which messages are read.
const MIN_LISTENING: Duration = Duration::from_millis(2);
/// Most notices about one client: a hostile one must not fill the screen.
const MAX_NOTICES: usize = 10;
/// Names of the levels that `gym_donkeycar` may ask for; each is our track.
const SCENES: [&str; 12] = [
    "generated_road",
    "warehouse",
    "sparkfun_avc",
    "generated_track",
    "mountain_track",
    "roboracingleague_1",
    "waveshare",
    "mini_monaco",
    "warren",
    "circuit_launch",
    "thunderhill",
    "steersman",
];

/// Where a connection begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scene {
    /// In the menu, where the client chooses a scene.
    Menu,
    /// On the track.
    Race,
}

/// How to be DonkeySim.
#[derive(Clone, Debug)]
pub struct DonkeySimOptions {
    /// Address to listen at; with port 0 the system chooses one.
    pub address: SocketAddr,
    /// Where a connection begins.
    pub scene: Scene,
    /// How strictly messages are read.
    pub reading: Reading,
    /// Draws light and textures.
    pub seed: u64,
    /// The car whose camera the pictures are from; the simulator's own if there is none. There must be no
    /// [`trouble`](crate::simulator::camera_trouble) with it.
    pub car: Option<CarGeometry>,
}

/// A server that already listens.
#[derive(Debug)]
pub struct DonkeySimServer {
    listener: TcpListener,
    options: DonkeySimOptions,
}

/// Notices from the threads of the clients.
type Notices<'a> = Mutex<&'a mut (dyn Observer<String> + Send)>;

impl DonkeySimServer {
    /// Begins to listen.
    ///
    /// # Errors
    ///
    /// [`Error::System`] with the remedy if the address cannot be had.
    pub fn bind(options: DonkeySimOptions) -> Result<DonkeySimServer> {
        let listener = http::listen(options.address, "end it (is the real simulator running?) or give --port")?;
        Ok(DonkeySimServer { listener, options })
    }

    /// The address at which it listens.
    ///
    /// # Errors
    ///
    /// [`Error::System`] if the system does not know it.
    pub fn address(&self) -> Result<SocketAddr> {
        self.listener.local_addr().map_err(|e| Error::System(format!("cannot tell the address: {e}")))
    }

    /// Lets clients drive on `track` until `stop` is requested. `observer` is told what a user should know. The result is the
    /// number of clients.
    ///
    /// # Errors
    ///
    /// The observer's own.
    pub fn run(self, track: &Track, observer: &mut (dyn Observer<String> + Send), stop: &StopSignal) -> Result<usize> {
        let (mut count, clients, options) = (0, AtomicUsize::new(0), &self.options);
        let notices: Notices = Mutex::new(observer);
        let failure = Mutex::new(None);
        std::thread::scope(|scope| {
            while !stop.requested() {
                let Ok((stream, address)) = self.listener.accept() else {
                    std::thread::sleep(LISTEN_PAUSE);
                    continue;
                };
                if clients.load(Ordering::Relaxed) >= MAX_CLIENTS {
                    drop(stream);
                    continue;
                }
                clients.fetch_add(1, Ordering::Relaxed);
                count += 1;
                let (notices, clients, failure) = (&notices, &clients, &failure);
                scope.spawn(move || {
                    let mut client = Client { options, notices, address, said: 0 };
                    if let Err(error) = client.serve(stream, track, stop) {
                        stop.request();
                        *failure.lock().unwrap_or_else(std::sync::PoisonError::into_inner) = Some(error);
                    }
                    clients.fetch_sub(1, Ordering::Relaxed);
                });
            }
        });
        let failure = failure.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
        failure.map_or(Ok(count), Err)
    }
}

struct Client<'a> {
    options: &'a DonkeySimOptions,
    notices: &'a Notices<'a>,
    address: SocketAddr,
    said: usize,
}

impl Client<'_> {
    fn say(&mut self, text: &str) -> Result<()> {
        self.said += 1;
        let text = match self.said {
            said if said < MAX_NOTICES => format!("{}: {text}", self.address),
            MAX_NOTICES => format!("{}: {text}; no more is said of this client", self.address),
            _ => return Ok(()),
        };
        self.notices.lock().unwrap_or_else(std::sync::PoisonError::into_inner).observe(text)
    }

    /// Serves until the client leaves. Errors are the observer's.
    fn serve(&mut self, stream: TcpStream, track: &Track, stop: &StopSignal) -> Result<()> {
        self.say("connected")?;
        let setting = stream
            .set_nonblocking(false)
            .and_then(|()| stream.set_nodelay(true))
            .and_then(|()| stream.set_write_timeout(Some(SEND_PATIENCE)));
        if setting.is_err() {
            return self.say("left at once");
        }
        let ended = self.converse(stream, track, stop)?;
        self.say(&ended)
    }

    /// Why the conversation ended.
    fn converse(&mut self, mut stream: TcpStream, track: &Track, stop: &StopSignal) -> Result<String> {
        let mut splitter = Splitter::default();
        let mut car = (self.options.scene == Scene::Race)
            .then(|| DonkeyCar::new(track, self.options.seed, self.options.car.as_ref()));
        let first = match self.options.scene {
            Scene::Menu => json!({"msg_type": "scene_selection_ready", "loaded": "1"}),
            Scene::Race => json!({"msg_type": "car_loaded"}),
        };
        if let Err(reason) = send(&mut stream, &[first]) {
            return Ok(reason);
        }
        let mut next_frame = Instant::now() + FRAME_INTERVAL;
        let (mut buffer, mut has_listened) = ([0; 4096], true);
        while !stop.requested() {
            let mut left = next_frame.saturating_duration_since(Instant::now());
            if !has_listened {
                // Between two pictures it listens, however long they take.
                left = left.max(MIN_LISTENING);
            }
            let mut answers = Vec::new();
            has_listened = !left.is_zero();
            if left.is_zero() {
                // A machine that is too slow drives slower; it does not catch up.
                next_frame = (next_frame + FRAME_INTERVAL).max(Instant::now());
                if let Some(car) = &mut car {
                    answers = car.frame()?;
                }
            } else {
                if stream.set_read_timeout(Some(left)).is_err() {
                    return Ok("left".into());
                }
                let chunk = match stream.read(&mut buffer) {
                    Ok(0) => return Ok("left".into()),
                    Ok(len) => &buffer[..len],
                    Err(error)
                        if matches!(
                            error.kind(),
                            ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted
                        ) =>
                    {
                        continue;
                    }
                    Err(_) => return Ok("left".into()),
                };
                let commands = match splitter.push(chunk, self.options.reading) {
                    Ok(commands) => commands,
                    Err(reason) => return Ok(format!("closed, as it sent {reason}")),
                };
                for command in commands {
                    match command {
                        Ok(Command::Quit) => return Ok("has quit".into()),
                        Ok(command) => answers.extend(self.obey(command, &mut car, track)?),
                        Err(reason) => self.say(&reason)?,
                    }
                }
            }
            if let Err(reason) = send(&mut stream, &answers) {
                return Ok(reason);
            }
        }
        Ok("the simulator ends".into())
    }

    /// Does what is asked, and gives the messages to answer.
    fn obey<'t>(&mut self, command: Command, car: &mut Option<DonkeyCar<'t>>, track: &'t Track) -> Result<Vec<Value>> {
        match (command, car.as_mut()) {
            (Command::SceneNames, _) => return Ok(vec![json!({"msg_type": "scene_names", "scene_names": SCENES})]),
            (Command::ProtocolVersion, _) => return Ok(vec![json!({"msg_type": "protocol_version", "version": "2"})]),
            (Command::LoadScene(name), _) if SCENES.contains(&name.as_str()) => {
                *car = Some(DonkeyCar::new(track, self.options.seed, self.options.car.as_ref()));
                return Ok(vec![json!({"msg_type": "car_loaded"})]);
            }
            (Command::LoadScene(name), _) => {
                let name = crate::text::excerpt(&name, 40);
                self.say(&format!("there is no scene `{name}`; `get_scene_names` lists them"))?;
            }
            (Command::ExitScene, _) => {
                *car = None;
                return Ok(vec![json!({"msg_type": "scene_selection_ready", "loaded": "1"})]);
            }
            (Command::NodePosition(index), Some(car)) => return Ok(vec![car.node(index)]),
            (Command::Control { steering, throttle, brake }, Some(car)) => car.control(steering, throttle, brake),
            (Command::Reset, Some(car)) => car.reset(),
            (Command::Camera { height, width, others }, Some(car)) => {
                car.set_size(height, width);
                if others {
                    self.say("asks for another camera; height and width of the picture are all that changes here")?;
                }
            }
            (Command::Ignored(name), _) => self.say(&format!("`{name}` has no effect here"))?,
            (Command::Quit, _) | (_, None) => {}
        }
        Ok(Vec::new())
    }
}

/// Sends messages, a line each; an error says why the client is gone.
fn send(stream: &mut TcpStream, messages: &[Value]) -> std::result::Result<(), String> {
    if messages.is_empty() {
        return Ok(());
    }
    let text: String = messages.iter().map(|message| format!("{message}\n")).collect();
    stream.write_all(text.as_bytes()).map_err(|_| "left, or takes nothing more".into())
}
