//! The car that the server drives: physics at 50 Hz, frames, and what happens in each frame.

use std::time::{Duration, Instant};

use data_encoding::BASE64;

use super::frame_clock::FrameClock;
use super::link::{LinkEvent, ServerLink};
use super::options::{ClientOptions, ClientReport, TimeMode};
use super::reaction::Steer;
use crate::observer::{Observer, Progress};
use crate::simulator::camera::front_camera::FrontCamera;
use crate::simulator::car::dynamics::MAX_STEER_DEG;
use crate::simulator::car::expert::pursuit;
use crate::simulator::car::speed::{Speed, telemetry_mph};
use crate::simulator::track::Track;
use crate::simulator::trial::closed_loop::ClosedLoop;
use crate::simulator::trial::outcome::{Trial, TrialOptions};
use crate::udacity::{DecimalMark, NumberStyle, Readings, print_telemetry};
use crate::{Error, Result};

/// Longest single wait, s. Each wait counts at most this much silence of the server, so that a process that was suspended does
/// not blame the server for its own pause.
const TICK_S: f64 = 0.1;
/// Time for which the same notice is not repeated.
const SAME_NOTICE: Duration = Duration::from_secs(5);

/// What happens during a drive.
#[derive(Clone, Debug, PartialEq)]
pub enum ClientEvent {
    /// A notice for the user: connected, disconnected, a reply that cannot be read.
    Notice(String),
    /// The share of the distance that is driven.
    Progress(Progress),
}

/// Drives on `track` with the commands of the server in `options`.
///
/// # Errors
///
/// [`Error::Usage`] for impossible options, [`Error::Connection`] if the server does not reply for longer than `patience_s`,
/// and the error of `observer`.
pub fn drive(track: &Track, options: &ClientOptions, observer: &mut dyn Observer<ClientEvent>) -> Result<ClientReport> {
    options.check()?;
    let mut scene = Scene::new(track, options, observer);
    let driven = match options.scene_change_s {
        Some(_) => scene.play(options.scene_change_s).and_then(|_| {
            scene.change()?;
            scene.play(None)
        }),
        None => scene.play(None),
    };
    let Scene { link, mut report, connections, since, .. } = scene;
    report.connections = connections + link.count();
    report.wall_s = since.map_or(0.0, |since| since.elapsed().as_secs_f64());
    link.quit();
    report.round_trips_ms.sort_by(f64::total_cmp);
    Ok(ClientReport { run: driven?, ..report })
}

/// Distance from the line at which somebody takes the wheel, and at which the model has it again, m.
const CORRECT_M: f64 = 0.6;
const RELEASE_M: f64 = 0.2;

/// A telemetry that waits for its reply.
struct Sent {
    at: Instant,
    /// Whether a person drives by hand.
    by_hand: bool,
}

struct Scene<'a> {
    track: &'a Track,
    options: &'a ClientOptions,
    observer: &'a mut dyn Observer<ClientEvent>,
    link: ServerLink,
    eye: FrontCamera<'a>,
    /// The picture in base64.
    image: String,
    /// The simulation step of the picture.
    image_step: Option<u64>,
    message: String,
    /// Number of telemetries that are due.
    due: u64,
    /// The last command: steering and throttle.
    command: (f32, f32),
    /// Whether somebody corrects the car.
    correcting: bool,
    /// The last telemetry, until its reply arrives.
    sent: Option<Sent>,
    /// Time without a reply, s.
    silence_s: f64,
    /// When the first connection opened.
    since: Option<Instant>,
    /// Number of connections of earlier scenes.
    connections: u64,
    /// Share of the distance that is driven, 0 to 1.
    share: f64,
    /// Why there is no connection.
    trouble: String,
    /// The last notice and its time.
    noticed: Option<(String, Instant)>,
    report: ClientReport,
}

impl<'a> Scene<'a> {
    fn new(track: &'a Track, options: &'a ClientOptions, observer: &'a mut dyn Observer<ClientEvent>) -> Scene<'a> {
        // Building the world takes a while, and the server waits for the first telemetry.
        let eye = FrontCamera::new(track, options.seed);
        Scene {
            track,
            options,
            observer,
            link: ServerLink::start(&options.url, options.numbers, options.seed),
            eye,
            image: String::new(),
            image_step: None,
            message: String::new(),
            due: 0,
            command: (0.0, 0.0),
            correcting: false,
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
        let notice = "the scene changes: the connection ends without a close frame".into();
        self.observer.observe(ClientEvent::Notice(notice))?;
        let link = ServerLink::start(&self.options.url, self.options.numbers, self.options.seed);
        let left = std::mem::replace(&mut self.link, link);
        self.connections += left.count();
        left.abort();
        (self.due, self.command, self.sent, self.image_step) = (0, (0.0, 0.0), None, None);
        Ok(())
    }

    /// Drives from the start to the end of the run, or until the scene is left.
    fn play(&mut self, leave_at_s: Option<f64>) -> Result<Trial> {
        let run = TrialOptions {
            laps: self.options.laps,
            speed: Speed::Fixed(self.options.start_mph),
            latency_ms: 0.0,
            noise: 0.0,
            assisted: false,
        };
        let mut closed_loop = ClosedLoop::new(self.track, &run, self.options.seed);
        let mut clock = match self.options.time_mode {
            TimeMode::Lockstep => None,
            TimeMode::RealTime { fps } => {
                self.wait_for_turn()?;
                Some(FrameClock::new(fps))
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

    /// Simulates one step. If a frame is due, gets the reply to it first.
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
        self.watch_over(closed_loop);
        while let Some(event) = self.link.poll() {
            self.handle(event)?;
        }
        loop {
            self.wait_for_turn()?;
            while self.due > 0 {
                self.send_telemetry(closed_loop)?;
            }
            // After a question, an unreadable command or a new connection, the same frame gets another turn.
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

    /// Waits up to a tick for the connection.
    fn wait(&mut self) -> Result<()> {
        let began = Instant::now();
        let event = self.link.wait(Duration::from_secs_f64(TICK_S));
        let waited_s = began.elapsed().as_secs_f64().min(TICK_S);
        if let Some(event) = event {
            self.handle(event)?;
        }
        self.be_patient(waited_s)?;
        self.observer.observe(ClientEvent::Progress(Progress(self.share)))
    }

    /// One rendered frame of Unity: first the physics steps that are due, then the events, then the telemetry.
    fn frame(&mut self, closed_loop: &mut ClosedLoop, clock: &mut FrameClock) -> Result<()> {
        self.progress(closed_loop)?;
        self.report.frames += 1;
        self.watch_over(closed_loop);
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
        while let Some(event) = self.link.poll() {
            self.handle(event)?;
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

    /// Adds `more_s` to the time without a reply, and gives up after `patience_s`.
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

    /// Number of telemetries that were answered.
    fn answers(&self) -> u64 {
        self.report.commands + self.report.manuals
    }

    /// Handles an event of the connection.
    fn handle(&mut self, event: LinkEvent) -> Result<()> {
        match event {
            LinkEvent::Open => {
                if self.since.is_none() {
                    self.since = Some(Instant::now());
                }
                self.trouble.clear();
                self.due += 1;
            }
            LinkEvent::Steer(Steer { steering, throttle }, arrived) => {
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
            LinkEvent::Manual(arrived) => {
                match self.sent {
                    Some(Sent { by_hand: true, .. }) => self.report.manuals += 1,
                    _ => self.report.questions += 1,
                }
                self.reply(arrived);
            }
            LinkEvent::Closed(why) => {
                self.sent = None;
                self.notice(format!("{why}; connecting again"))?;
                self.trouble = why;
            }
            LinkEvent::Unreachable(why) => {
                self.notice(format!("{}: {why}; trying again", self.options.url))?;
                self.trouble = why;
            }
        }
        Ok(())
    }

    /// Tells the observer, unless the notice is the same as the last one.
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

    /// Whether a person holds W and drives by hand.
    fn by_hand(&self, closed_loop: &ClosedLoop) -> bool {
        let time_s = closed_loop.simulation().time_s();
        self.options.manual_s.is_some_and(|(from, until)| (from..until).contains(&time_s))
    }

    /// Takes the wheel if the car is far from the line, and gives it back near it.
    fn watch_over(&mut self, closed_loop: &ClosedLoop) {
        let beside_m = closed_loop.simulation().cte_m().abs();
        self.correcting = self.options.correct && beside_m > if self.correcting { RELEASE_M } else { CORRECT_M };
    }

    /// Steering and throttle: the command of the server or, by hand, the steering of the expert with W held.
    fn wheel(&self, closed_loop: &ClosedLoop) -> (f32, f32) {
        if self.correcting {
            return (pursuit(closed_loop.simulation()) as f32, self.command.1);
        }
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
                NumberStyle::Strings(mark) => (mark, None),
                NumberStyle::Json => (DecimalMark::DOT, Some(simulation.cte_m())),
            };
            let readings = Readings {
                steering_deg: simulation.car.steering * MAX_STEER_DEG,
                throttle: closed_loop.controls().throttle.max(0.0),
                speed_mph: telemetry_mph(simulation.car.speed_mps),
                cte_m,
                by_user: self.correcting,
                time_s: (self.options.time_mode == TimeMode::Lockstep).then(|| simulation.time_s()),
                image: &self.image,
            };
            print_telemetry(&mut self.message, &readings, mark);
            self.report.telemetries += 1;
            self.report.corrected_telemetries += u64::from(self.correcting);
        }
        self.sent = Some(Sent { at: Instant::now(), by_hand: by_hand || self.correcting });
        self.link.send(&self.message);
        Ok(())
    }
}
