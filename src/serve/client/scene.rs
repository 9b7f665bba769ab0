//! The car behind the connection: physics at 50 Hz, frames, and what happens in a frame.

use std::time::{Duration, Instant};

use data_encoding::BASE64;

use super::connection::{Connection, Event};
use super::handshake::ServerUrl;
use super::reaction::{Numbers, Steer};
use crate::observer::{Observer, Progress};
use crate::serve::protocol::{DecimalMark, Readings, print_telemetry};
use crate::simulator::camera::eye::Eye;
use crate::simulator::car::dynamics::{MAX_STEER_DEG, STEP_S};
use crate::simulator::car::expert::pursuit;
use crate::simulator::car::speed::{Speed, telemetry_mph};
use crate::simulator::road::track::Track;
use crate::simulator::trial::closed_loop::ClosedLoop;
use crate::simulator::trial::run::{Run, RunOptions};
use crate::{Error, Result};

/// Most simulated time that one frame may make up for (Unity's maximum allowed timestep), s.
const MOST_PER_FRAME_S: f64 = 1.0 / 3.0;
/// How often a wait looks up, s. A wait counts no more than that for itself, so that a process that was stopped for a while
/// does not take its own absence for the server's.
const TICK_S: f64 = 0.1;
/// How long a notice is not repeated.
const SAME_NOTICE: Duration = Duration::from_secs(5);

/// When frames are taken.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Pace {
    /// As `drive` does: 20 frames for each simulated second, and time waits for the reply to each.
    Lockstep,
    /// By the clock, this many frames for each second; time waits for nobody.
    RealTime {
        /// Frames a second.
        fps: f64,
    },
}

/// How the client drives.
#[derive(Clone, Debug)]
pub struct ClientOptions {
    /// The server.
    pub url: ServerUrl,
    /// Laps to drive.
    pub laps: usize,
    /// Draws start and light, as in `drive`.
    pub seed: u64,
    /// Speed at the start, mph. (Unity's car stands at the start; `drive` begins at the speed to be held.)
    pub start_mph: f64,
    /// Lockstep or real time.
    pub pace: Pace,
    /// Which simulator, and in which language its machine writes numbers.
    pub numbers: Numbers,
    /// Simulated time from which and until which somebody holds W and steers by hand, s.
    pub manual_s: Option<(f64, f64)>,
    /// Simulated time at which the scene is left and entered again, s: the connection ends without a word, the car starts anew.
    pub scene_change_s: Option<f64>,
    /// Answered telemetries after which to stop.
    pub frames: Option<u64>,
    /// Longest time without a reply, s.
    pub patience_s: f64,
}

impl Default for ClientOptions {
    fn default() -> Self {
        ClientOptions {
            url: ServerUrl::default(),
            laps: 1,
            seed: 1,
            start_mph: 20.0,
            pace: Pace::RealTime { fps: 60.0 },
            numbers: Numbers::Strings(DecimalMark::DOT),
            manual_s: None,
            scene_change_s: None,
            frames: None,
            patience_s: 30.0,
        }
    }
}

/// What the client saw.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ClientReport {
    /// What the car did since the scene was entered last.
    pub run: Run,
    /// Frames: chances to send telemetry.
    pub frames: u64,
    /// Telemetries sent with a picture.
    pub telemetries: u64,
    /// Telemetries sent as `null`, while somebody drove by hand.
    pub manual_telemetries: u64,
    /// Commands that could be read.
    pub commands: u64,
    /// `manual` events in reply to `null`.
    pub manuals: u64,
    /// `manual` events out of turn: the server asked for telemetry.
    pub questions: u64,
    /// Commands that could not be read, so that their token was lost.
    pub tokens_lost: u64,
    /// WebSocket connections.
    pub connections: u64,
    /// Time by the clock from the first connection to the end, s.
    pub wall_s: f64,
    /// From telemetry sent to reply received, ms, in the order of their length.
    pub round_trips_ms: Vec<f64>,
}

/// What happens in a drive.
#[derive(Clone, Debug, PartialEq)]
pub enum ClientEvent {
    /// Something to know: connected, lost, a reply that could not be read.
    Notice(String),
    /// A share of the way is made.
    Progress(Progress),
}

/// Drives on `track` with the server of `options` at the wheel.
///
/// # Errors
/// Impossible options, a server that does not reply for longer than `patience_s`, and the observer's own.
pub fn drive(track: &Track, options: &ClientOptions, observer: &mut dyn Observer<ClientEvent>) -> Result<ClientReport> {
    check(options)?;
    let mut scene = Scene::new(track, options, observer);
    let driven = match options.scene_change_s {
        Some(_) => scene.play(options.scene_change_s).and_then(|_| {
            scene.change()?;
            scene.play(None)
        }),
        None => scene.play(None),
    };
    let Scene { connection, mut report, connections, since, .. } = scene;
    report.connections = connections + connection.count();
    report.wall_s = since.map_or(0.0, |since| since.elapsed().as_secs_f64());
    connection.quit();
    report.round_trips_ms.sort_by(f64::total_cmp);
    Ok(ClientReport { run: driven?, ..report })
}

fn check(options: &ClientOptions) -> Result<()> {
    let fail = |message: String| Err(Error::Usage(message));
    if options.laps == 0 {
        return fail("laps must be at least 1".into());
    }
    if !(0.0..=30.0).contains(&options.start_mph) {
        return fail(format!("a start at {} mph: the car drives 0 to 30 mph", options.start_mph));
    }
    if let Pace::RealTime { fps } = options.pace
        && !(1.0..=1000.0).contains(&fps)
    {
        return fail(format!("{fps} frames a second: 1 to 1000 can be taken"));
    }
    if let Some((from, until)) = options.manual_s
        && !(from >= 0.0 && until > from)
    {
        return fail(format!("driving by hand from {from} to {until} s: the end must come after the beginning"));
    }
    if options.scene_change_s.is_some_and(|at| !(at >= 0.0 && at.is_finite())) {
        return fail("the scene can change at a time in seconds, not below 0".into());
    }
    if !(options.patience_s > 0.0 && options.patience_s.is_finite()) {
        return fail(format!("a patience of {} s: more than 0 is meant", options.patience_s));
    }
    Ok(())
}

/// A telemetry on its way.
struct Sent {
    at: Instant,
    /// It was `null`: somebody drives by hand.
    by_hand: bool,
}

struct Scene<'a> {
    track: &'a Track,
    options: &'a ClientOptions,
    observer: &'a mut dyn Observer<ClientEvent>,
    connection: Connection,
    eye: Eye<'a>,
    /// The picture in base64, and the step at which it was taken.
    image: String,
    image_step: Option<u64>,
    message: String,
    /// Telemetries that are due.
    due: u64,
    /// The last command: steering and throttle.
    command: (f32, f32),
    /// The last telemetry that was sent, until its reply comes.
    sent: Option<Sent>,
    /// Time without a reply, s.
    silence_s: f64,
    /// When the first connection opened.
    since: Option<Instant>,
    /// Connections of scenes that were left.
    connections: u64,
    /// Share of the way that is made.
    share: f64,
    /// Why there is no connection.
    trouble: String,
    /// The last notice, and when it was given.
    noticed: Option<(String, Instant)>,
    report: ClientReport,
}

impl<'a> Scene<'a> {
    fn new(track: &'a Track, options: &'a ClientOptions, observer: &'a mut dyn Observer<ClientEvent>) -> Scene<'a> {
        // The world takes a while to build, and a server does not like to wait for the first telemetry.
        let eye = Eye::new(track, options.seed);
        Scene {
            track,
            options,
            observer,
            connection: Connection::start(&options.url, options.numbers, options.seed),
            eye,
            image: String::new(),
            image_step: None,
            message: String::new(),
            due: 0,
            command: (0.0, 0.0),
            sent: None,
            silence_s: 0.0,
            since: None,
            connections: 0,
            share: 0.0,
            trouble: String::new(),
            noticed: None,
            report: ClientReport::default(),
        }
    }

    /// Leaves the scene and enters it again.
    fn change(&mut self) -> Result<()> {
        self.observer
            .observe(ClientEvent::Notice("the scene changes: the connection ends without a close frame".into()))?;
        let connection = Connection::start(&self.options.url, self.options.numbers, self.options.seed);
        let left = std::mem::replace(&mut self.connection, connection);
        self.connections += left.count();
        left.abort();
        (self.due, self.command, self.sent, self.image_step) = (0, (0.0, 0.0), None, None);
        Ok(())
    }

    /// Drives from the start to the end of the run, or until the scene is left.
    fn play(&mut self, leave_at_s: Option<f64>) -> Result<Run> {
        let run = RunOptions {
            laps: self.options.laps,
            speed: Speed::Fixed(self.options.start_mph),
            latency_ms: 0.0,
            noise: 0.0,
            assisted: false,
        };
        let mut closed_loop = ClosedLoop::new(self.track, &run, self.options.seed);
        let mut clock = match self.options.pace {
            Pace::Lockstep => None,
            Pace::RealTime { fps } => {
                self.wait_for_turn()?;
                Some(Clock::new(fps))
            }
        };
        while closed_loop.goes_on()
            && self.options.frames.is_none_or(|most| self.answers() < most)
            && leave_at_s.is_none_or(|at| closed_loop.simulation().time_s() < at)
        {
            match &mut clock {
                None => self.lockstep(&mut closed_loop)?,
                Some(clock) => self.frame(&mut closed_loop, clock)?,
            }
        }
        if closed_loop.is_too_slow() {
            let time_s = closed_loop.simulation().time_s();
            let notice = format!("the run ends after {time_s:.0} s: the car is far too slow for its laps");
            self.observer.observe(ClientEvent::Notice(notice))?;
        }
        Ok(closed_loop.finish())
    }

    /// One step, and before it, if a frame is due, one reply.
    fn lockstep(&mut self, closed_loop: &mut ClosedLoop) -> Result<()> {
        if closed_loop.frame_is_due() {
            self.progress(closed_loop)?;
            self.report.frames += 1;
            self.exchange(closed_loop)?;
            let (steering, throttle) = self.wheel(closed_loop);
            closed_loop.answer(steering, throttle);
        }
        closed_loop.step();
        Ok(())
    }

    /// Sends telemetry for every token and waits for a reply to it.
    fn exchange(&mut self, closed_loop: &ClosedLoop) -> Result<()> {
        while let Some(event) = self.connection.poll() {
            self.take(event)?;
        }
        loop {
            self.wait_for_turn()?;
            while self.due > 0 {
                self.send_telemetry(closed_loop)?;
            }
            // A question, an unreadable command or a new connection is one more turn for the same frame.
            let before = self.answers();
            while self.due == 0 {
                self.wait()?;
            }
            if self.answers() > before {
                return Ok(());
            }
        }
    }

    /// Waits until telemetry is due.
    fn wait_for_turn(&mut self) -> Result<()> {
        while self.due == 0 {
            self.wait()?;
        }
        Ok(())
    }

    /// Waits a little for something to happen.
    fn wait(&mut self) -> Result<()> {
        let began = Instant::now();
        let event = self.connection.wait(Duration::from_secs_f64(TICK_S));
        let waited_s = began.elapsed().as_secs_f64().min(TICK_S);
        if let Some(event) = event {
            self.take(event)?;
        }
        self.be_patient(waited_s)?;
        self.observer.observe(ClientEvent::Progress(Progress(self.share)))
    }

    /// One rendered frame of Unity: the physics that are due, then the events, then the telemetry.
    fn frame(&mut self, closed_loop: &mut ClosedLoop, clock: &mut Clock) -> Result<()> {
        self.progress(closed_loop)?;
        self.report.frames += 1;
        let passed_s = clock.frame();
        while clock.step_is_due() && closed_loop.goes_on() {
            let (steering, throttle) = self.wheel(closed_loop);
            closed_loop.take_up(steering, throttle);
            if closed_loop.frame_is_due() {
                closed_loop.answer(steering, throttle);
            }
            closed_loop.step();
        }
        self.be_patient(passed_s.min(TICK_S))?;
        while let Some(event) = self.connection.poll() {
            self.take(event)?;
        }
        while self.due > 0 {
            self.send_telemetry(closed_loop)?;
        }
        clock.sleep();
        Ok(())
    }

    fn progress(&mut self, closed_loop: &ClosedLoop) -> Result<()> {
        self.share = closed_loop.share();
        self.observer.observe(ClientEvent::Progress(Progress(self.share)))
    }

    /// Counts time without a reply.
    fn be_patient(&mut self, more_s: f64) -> Result<()> {
        self.silence_s += more_s;
        if self.silence_s <= self.options.patience_s {
            return Ok(());
        }
        let Scene { options: ClientOptions { url, patience_s, .. }, trouble, .. } = self;
        Err(Error::Connection(match (trouble.is_empty(), self.report.telemetries) {
            (false, _) => {
                format!("{url}: {trouble}, for {patience_s} s; start `steersman serve MODEL` and give its port")
            }
            (true, 0) => format!("{url}: nothing came for {patience_s} s after the connection opened"),
            (true, sent) => format!("{url}: no reply to telemetry for {patience_s} s, after {sent} telemetries"),
        }))
    }

    /// Telemetries that were answered.
    fn answers(&self) -> u64 {
        self.report.commands + self.report.manuals
    }

    /// Takes note of an event.
    fn take(&mut self, event: Event) -> Result<()> {
        match event {
            Event::Open => {
                if self.since.is_none() {
                    self.since = Some(Instant::now());
                }
                self.trouble.clear();
                self.due += 1;
            }
            Event::Steer(Steer { steering, throttle }, arrived) => {
                self.command.0 = steering.unwrap_or(self.command.0);
                match throttle {
                    Some(throttle) => {
                        self.command.1 = throttle;
                        self.report.commands += 1;
                        self.reply(arrived);
                    }
                    None => {
                        self.report.tokens_lost += 1;
                        self.notice("a command cannot be read: the simulator sends no telemetry for it".into())?;
                    }
                }
            }
            Event::Manual(arrived) => {
                match self.sent {
                    Some(Sent { by_hand: true, .. }) => self.report.manuals += 1,
                    _ => self.report.questions += 1,
                }
                self.reply(arrived);
            }
            Event::Closed(why) => {
                self.sent = None;
                self.notice(format!("{why}; connecting again"))?;
                self.trouble = why;
            }
            Event::Unreachable(why) => {
                self.notice(format!("{}: {why}; trying again", self.options.url))?;
                self.trouble = why;
            }
        }
        Ok(())
    }

    /// Passes a notice on, unless it is the same as just before.
    fn notice(&mut self, text: String) -> Result<()> {
        let again = |(last, at): &(String, Instant)| *last == text && at.elapsed() < SAME_NOTICE;
        if !self.noticed.as_ref().is_some_and(again) {
            self.observer.observe(ClientEvent::Notice(text.clone()))?;
            self.noticed = Some((text, Instant::now()));
        }
        Ok(())
    }

    fn reply(&mut self, arrived: Instant) {
        self.due += 1;
        self.silence_s = 0.0;
        if let Some(sent) = self.sent.take() {
            self.report.round_trips_ms.push(arrived.saturating_duration_since(sent.at).as_secs_f64() * 1000.0);
        }
    }

    /// Whether somebody holds W.
    fn by_hand(&self, closed_loop: &ClosedLoop) -> bool {
        let time_s = closed_loop.simulation().time_s();
        self.options.manual_s.is_some_and(|(from, until)| (from..until).contains(&time_s))
    }

    /// Steering and throttle of whoever drives: the server, or a hand that holds W and steers well.
    fn wheel(&self, closed_loop: &ClosedLoop) -> (f32, f32) {
        if self.by_hand(closed_loop) { (pursuit(closed_loop.simulation()) as f32, 1.0) } else { self.command }
    }

    fn send_telemetry(&mut self, closed_loop: &ClosedLoop) -> Result<()> {
        self.due -= 1;
        self.message.clear();
        let simulation = closed_loop.simulation();
        let by_hand = self.by_hand(closed_loop);
        if by_hand {
            self.message.push_str("42[\"telemetry\",null]");
            self.report.manual_telemetries += 1;
        } else {
            if self.image_step != Some(simulation.steps) {
                self.image_step = Some(simulation.steps);
                self.image.clear();
                BASE64.encode_append(self.eye.jpeg(simulation)?, &mut self.image);
            }
            let (mark, cte_m) = match self.options.numbers {
                Numbers::Strings(mark) => (mark, None),
                Numbers::Json => (DecimalMark::DOT, Some(simulation.cte_m())),
            };
            let readings = Readings {
                steering_deg: simulation.car.steering * MAX_STEER_DEG,
                throttle: closed_loop.controls().throttle.max(0.0),
                speed_mph: telemetry_mph(simulation.car.speed_mps),
                cte_m,
                time_s: (self.options.pace == Pace::Lockstep).then(|| simulation.time_s()),
                image: &self.image,
            };
            print_telemetry(&mut self.message, &readings, mark);
            self.report.telemetries += 1;
        }
        self.sent = Some(Sent { at: Instant::now(), by_hand });
        self.connection.send(&self.message);
        Ok(())
    }
}

/// Real time: how much simulated time is due, and when the next frame is.
struct Clock {
    frame_s: f64,
    last: Instant,
    next: Instant,
    owed_s: f64,
}

impl Clock {
    fn new(fps: f64) -> Clock {
        let now = Instant::now();
        Clock { frame_s: 1.0 / fps, last: now, next: now, owed_s: 0.0 }
    }

    /// Begins a frame. Time since the last one, s.
    fn frame(&mut self) -> f64 {
        let now = Instant::now();
        let passed_s = (now - self.last).as_secs_f64();
        self.owed_s += passed_s.min(MOST_PER_FRAME_S);
        self.last = now;
        passed_s
    }

    fn step_is_due(&mut self) -> bool {
        let due = self.owed_s >= STEP_S;
        self.owed_s -= if due { STEP_S } else { 0.0 };
        due
    }

    /// Sleeps until the next frame; frames that are late are not made up for.
    fn sleep(&mut self) {
        self.next += Duration::from_secs_f64(self.frame_s);
        let now = Instant::now();
        match self.next.checked_duration_since(now) {
            Some(left) => std::thread::sleep(left),
            None => self.next = now,
        }
    }
}
