//! A person drives with the page, and what they do is recorded in the format of Udacity's simulator.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Instant;

use serde::Serialize;

use super::clock::Clock;
use super::controls::{Cockpit, Event};
use super::coverage::{Coverage, Row, Shares};
use super::messages::{Hello, Manual, State};
use super::server::Live;
use crate::error::{Error, Result};
use crate::files::new_folder::NewFolder;
use crate::observer::StopSignal;
use crate::simulator::camera::eye::Eye;
use crate::simulator::car::dynamics::{Controls, MPS_PER_MPH, STEP_S, STEPS_PER_S};
use crate::simulator::recorder::record::{RecordingInfo, Sample};
use crate::simulator::recorder::writer::RowWriter;
use crate::simulator::{RecordOptions, Simulation, Start, Track};

/// What is said where the program itself is at fault.
const FAULT: &str = "the recording ended early";

/// Steps between frames: 25 frames a second.
const STEPS_PER_FRAME: u64 = 2;
/// Beyond this distance from the edge of the road the car is put back, m.
const LOST_M: f64 = 12.0;

/// A drive by hand, about to begin: its folder and its port are there.
pub struct ManualDrive<'a> {
    track: &'a Track,
    options: &'a RecordOptions,
    out: &'a Path,
    folder: NewFolder,
    writer: RowWriter<'a>,
    live: Live,
}

/// What a drive by hand came to.
#[derive(Clone, Debug, Serialize)]
pub struct ManualSummary {
    /// What stands in `recording.toml`.
    #[serde(flatten)]
    pub info: RecordingInfo,
    /// The recording, if anything was recorded.
    pub folder: Option<PathBuf>,
    /// What it covers.
    pub coverage: Shares,
    /// What it lacks.
    pub advice: Vec<String>,
}

impl<'a> ManualDrive<'a> {
    /// Prepares the folder `out` and serves the page at `port`. Of `options` count the light (`seed`), the direction, the
    /// highest speed, the rows a second and the log's format.
    ///
    /// # Errors
    ///
    /// Impossible options, a folder that exists, a port that cannot be had.
    pub fn prepare(track: &'a Track, options: &'a RecordOptions, out: &'a Path, port: u16) -> Result<ManualDrive<'a>> {
        options.check()?;
        let folder = NewFolder::create(out)?;
        let writer = RowWriter::new(track, options.seed, options.format, folder.unfinished(), out)
            .map_err(|error| folder.explain(error))?;
        let live = Live::start(port, Hello::new("manual", format!("recording into {}", out.display()), track), true)?;
        Ok(ManualDrive { track, options, out, folder, writer, live })
    }

    /// What to open in a browser.
    pub fn url(&self) -> String {
        self.live.url()
    }

    /// Lets pages drive until one finishes or `stop` is requested, and gives the recording its name.
    ///
    /// # Errors
    ///
    /// If something cannot be written. What was recorded until then is kept, and the message says where.
    pub fn run(self, stop: &StopSignal) -> Result<ManualSummary> {
        let ManualDrive { track, options, out, folder, writer, live } = self;
        let (sender, samples) = channel();
        let mut session = Session::new(track, options, &live, sender);
        let (drive, written) = std::thread::scope(|scope| {
            let writing = scope.spawn(move || write(writer, &samples));
            let mut clock = Clock::start(Instant::now());
            let (mut steps, mut drive) = (0u64, Ok(true));
            while matches!(drive, Ok(true)) && !stop.requested() && !writing.is_finished() {
                std::thread::sleep(clock.until(steps as f64 * STEP_S, Instant::now()));
                // A fault here must not take with it what was recorded, nor leave the writer waiting.
                let step = catch_unwind(AssertUnwindSafe(|| session.step()));
                drive = step.unwrap_or_else(|_| Err(Error::Fault(FAULT.into())));
                steps += 1;
            }
            session.samples = None;
            if !writing.is_finished() {
                eprintln!("writing the last rows");
            }
            (drive, writing.join())
        });
        let (rows, trouble) = written.unwrap_or_else(|_| {
            (session.coverage.shares(options.hz, track.length_m).rows, Some(Error::Fault(FAULT.into())))
        });
        let trouble = drive.err().or(trouble);
        let advice = session.coverage.advice(track.length_m);
        let coverage = session.coverage.shares(options.hz, track.length_m);
        drop(session);
        let info = RecordingInfo {
            laps: (coverage.laps * 1000.0).round() / 1000.0,
            style: "manual".into(),
            ..RecordingInfo::new(track, options, rows)
        };
        let trouble = match info.write(folder.unfinished()) {
            Err(error) if rows > 0 => trouble.or(Some(error)),
            _ => trouble,
        };
        // The place that was meant; the hidden one is no more when the message is read.
        let hidden = folder.unfinished().to_path_buf();
        let trouble = trouble.map(|error| match error {
            Error::Io { path, source } => {
                Error::Io { path: path.strip_prefix(&hidden).map_or(path.clone(), |inside| out.join(inside)), source }
            }
            other => other,
        });
        let folder = (rows > 0).then(|| folder.finish_anyhow());
        let words = match &folder {
            Some(folder) => format!("{rows} rows are in {}", folder.display()),
            None => format!("nothing was recorded, so there is no {}", out.display()),
        };
        if let Some(trouble) = trouble {
            let kept = format!("{words}; look after the disk before you go on with a new folder");
            let error = Error::EndedEarly { cause: Box::new(trouble), kept };
            live.finish(&format!("The drive ended early: {error}."));
            return Err(error);
        }
        live.finish(&format!("The drive is over: {words}."));
        Ok(ManualSummary { info, folder, coverage, advice })
    }
}

/// Writes rows until there are no more or one cannot be written; returns their number.
fn write(mut writer: RowWriter, samples: &Receiver<Sample>) -> (usize, Option<Error>) {
    let mut rows = 0;
    for sample in samples {
        match writer.write(&sample) {
            Ok(()) => rows += 1,
            Err(error) => return (rows, Some(error)),
        }
    }
    (rows, None)
}

/// The car, the person at the wheel, and what is recorded.
struct Session<'a> {
    options: &'a RecordOptions,
    live: &'a Live,
    simulation: Simulation<'a>,
    eye: Eye<'a>,
    cockpit: Cockpit,
    recording: bool,
    notice: String,
    put_back: usize,
    coverage: Coverage,
    /// Way made at the last row, m.
    row_way_m: f64,
    /// Where rows go; `None` at the end.
    samples: Option<Sender<Sample>>,
}

impl<'a> Session<'a> {
    fn new(track: &'a Track, options: &'a RecordOptions, live: &'a Live, samples: Sender<Sample>) -> Session<'a> {
        let start =
            Start { reverse: options.reverse, offset_m: 0.0, heading_deg: 0.0, ..Start::draw(track, options.seed) };
        Session {
            options,
            live,
            simulation: Simulation::new(track, start, 0.0),
            eye: Eye::new(track, options.seed),
            cockpit: Cockpit::default(),
            recording: false,
            notice: "Hold W or the up arrow to drive, R to record.".into(),
            put_back: 0,
            coverage: Coverage::default(),
            row_way_m: 0.0,
            samples: Some(samples),
        }
    }

    /// Drives a step of 20 ms. `false` if the person at the wheel has finished.
    fn step(&mut self) -> Result<bool> {
        let now = Instant::now();
        let look = |wheel: &mut super::controls::Wheel| (wheel.holder(now), wheel.input(now), wheel.take_events());
        let (driver, input, events) = self.live.with_wheel(look).unwrap_or_default();
        for event in events {
            match event {
                Event::Record => self.record(!self.recording),
                Event::Cruise => self.cockpit.cruise = !self.cockpit.cruise,
                Event::PutBack => self.put(false, "The car was put back."),
                Event::TurnRound => self.put(true, "The car was turned round."),
                Event::Finish => return Ok(false),
            }
        }
        if driver.is_none() && self.recording {
            self.record(false);
            self.notice = "Nobody was at the wheel: the car braked, and recording paused. R goes on.".into();
        }
        let speed_mph = self.simulation.car.speed_mps / MPS_PER_MPH;
        let controls = self.cockpit.step(input, speed_mph, self.options.speed_mph, STEP_S);
        if self.recording && self.simulation.steps.is_multiple_of(STEPS_PER_S / self.options.hz) {
            self.row(controls, speed_mph);
        }
        self.simulation.step(controls);
        let edge_m = self.simulation.track.at(self.simulation.location.s_m).width_m / 2.0;
        if self.simulation.at_wall {
            self.rescue("The car hit a wall and was put back");
        } else if self.simulation.cte_m().abs() > edge_m + LOST_M {
            self.rescue("The car was far off the road and was put back");
        }
        if self.simulation.steps.is_multiple_of(STEPS_PER_FRAME) {
            self.show(driver, controls)?;
        }
        Ok(true)
    }

    /// Puts the car back after an accident; what led there is not to be learned any further.
    fn rescue(&mut self, what: &str) {
        let then = if self.recording { "; recording is paused." } else { "." };
        self.record(false);
        self.put(false, &format!("{what}{then}"));
    }

    fn record(&mut self, recording: bool) {
        (self.recording, self.row_way_m) = (recording, self.simulation.progress_m);
        self.notice.clear();
    }

    /// Puts the car onto the middle of the road, standing.
    fn put(&mut self, turned: bool, notice: &str) {
        let simulation = &mut self.simulation;
        simulation.reverse ^= turned;
        let start =
            Start { s_m: simulation.location.s_m, reverse: simulation.reverse, offset_m: 0.0, heading_deg: 0.0 };
        simulation.put(start, 0.0);
        // A pause in the names of the pictures, so that a reader sees that the road does not go on.
        simulation.steps += 2 * STEPS_PER_S;
        self.cockpit = Cockpit::default();
        self.put_back += 1;
        self.notice = notice.into();
    }

    /// Records where the car is and what it is told.
    fn row(&mut self, controls: Controls, speed_mph: f64) {
        let simulation = &self.simulation;
        self.coverage.add(&Row {
            steering: controls.steering,
            cte_m: simulation.cte_m(),
            heading_error: simulation.heading_error(),
            reverse: simulation.reverse,
            way_m: simulation.progress_m - self.row_way_m,
        });
        self.row_way_m = simulation.progress_m;
        let sample = Sample {
            time_s: simulation.time_s(),
            body: simulation.body_pose(),
            steering: controls.steering,
            throttle: controls.throttle.max(0.0),
            brake: (-controls.throttle).max(0.0),
            speed_mph,
        };
        if let Some(samples) = &self.samples {
            // A writer that has ended is noticed, and its error told, before the next step.
            let _ = samples.send(sample);
        }
    }

    fn show(&mut self, driver: Option<u64>, controls: Controls) -> Result<()> {
        let mut state = State::of(&self.simulation);
        self.live.trace(&state);
        if self.live.viewers() == 0 {
            return Ok(());
        }
        state.title = if self.simulation.reverse { "by hand, the other way round" } else { "by hand" }.into();
        (state.steering, state.throttle, state.put_back) = (controls.steering, controls.throttle, self.put_back);
        let lap_m = self.simulation.track.length_m;
        state.manual = Some(Manual {
            driver,
            recording: self.recording,
            cruise: self.cockpit.cruise,
            notice: self.notice.clone(),
            coverage: self.coverage.shares(self.options.hz, lap_m),
            advice: self.coverage.advice(lap_m),
        });
        let jpeg = self.eye.jpeg(&self.simulation)?;
        self.live.publish(&state, jpeg, &[]);
        Ok(())
    }
}
