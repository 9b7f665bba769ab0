//! A person drives with the page, and the program records the drive in the format of Udacity's simulator.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Instant;

use serde::Serialize;

use super::controls::{Action, Cockpit};
use super::coverage::{Coverage, Row, Shares};
use super::messages::{Hello, Manual, State};
use super::real_time::RealTime;
use super::server::Live;
use crate::error::{Error, Result};
use crate::files::new_folder::NewFolder;
use crate::observer::StopSignal;
use crate::simulator::camera::front_camera::FrontCamera;
use crate::simulator::car::dynamics::{Controls, MPS_PER_MPH, STEP_S, STEPS_PER_S};
use crate::simulator::recorder::options::RecordingInfo;
use crate::simulator::recorder::sample::Sample;
use crate::simulator::recorder::writer::RowWriter;
use crate::simulator::{RecordOptions, Simulation, Start, Track};

/// The message for a fault of this program.
const FAULT: &str = "the recording ended early";

/// Steps between two frames: 25 frames per second.
const STEPS_PER_FRAME: u64 = 2;
/// What the driver can take out of the recording at once, seconds of it.
const ERASED_S: u64 = 5;
/// Largest distance from the edge of the road, m. Beyond it the car is put back.
const MAX_OFF_ROAD_M: f64 = 12.0;

/// A drive by hand that is ready to begin: it has its folder and its port.
pub struct ManualDrive<'a> {
    track: &'a Track,
    options: &'a RecordOptions,
    out: &'a Path,
    folder: NewFolder,
    writer: RowWriter<'a>,
    live: Live,
}

/// The result of a drive by hand.
#[derive(Clone, Debug, Serialize)]
pub struct ManualSummary {
    /// The content of `recording.toml`.
    #[serde(flatten)]
    pub info: RecordingInfo,
    /// The folder of the recording, if a row was recorded.
    pub folder: Option<PathBuf>,
    /// What the recording covers.
    pub coverage: Shares,
    /// What the recording lacks.
    pub advice: Vec<String>,
}

impl<'a> ManualDrive<'a> {
    /// Prepares the folder `out` and serves the page at `port`. Uses these `options`: the light (`seed`), the direction, the
    /// highest speed, the rows per second and the format of the log.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] for impossible options or a folder that exists, [`Error::System`] if the port is taken.
    pub fn prepare(track: &'a Track, options: &'a RecordOptions, out: &'a Path, port: u16) -> Result<ManualDrive<'a>> {
        options.check()?;
        let folder = NewFolder::create(out)?;
        let writer = RowWriter::new(track, options.seed, options.format, folder.unfinished(), out)
            .map_err(|error| folder.explain(error))?;
        let live = Live::start(port, Hello::new("manual", format!("recording into {}", out.display()), track), true)?;
        Ok(ManualDrive { track, options, out, folder, writer, live })
    }

    /// The address to open in a browser.
    pub fn url(&self) -> String {
        self.live.url()
    }

    /// Lets pages drive until one of them finishes or `stop` is requested, and gives the recording its name.
    ///
    /// # Errors
    ///
    /// [`Error::EndedEarly`] if something cannot be written. It keeps what was recorded and names the folder.
    pub fn run(self, stop: &StopSignal) -> Result<ManualSummary> {
        let ManualDrive { track, options, out, folder, writer, live } = self;
        let (sender, orders) = channel();
        let mut manual = ManualLoop::new(track, options, &live, sender);
        let (drive, written) = std::thread::scope(|scope| {
            let writing = scope.spawn(move || write(writer, &orders));
            let mut real_time = RealTime::start(Instant::now());
            let (mut steps, mut drive) = (0u64, Ok(true));
            while matches!(drive, Ok(true)) && !stop.requested() && !writing.is_finished() {
                std::thread::sleep(real_time.until(steps as f64 * STEP_S, Instant::now()));
                // A fault here must not lose the recording, nor leave the writer waiting.
                let step = catch_unwind(AssertUnwindSafe(|| manual.step()));
                drive = step.unwrap_or_else(|_| Err(Error::Fault(FAULT.into())));
                steps += 1;
            }
            manual.orders = None;
            if !writing.is_finished() {
                eprintln!("writing the last rows");
            }
            (drive, writing.join())
        });
        let (rows, trouble) = written.unwrap_or_else(|_| {
            (manual.coverage.shares(options.hz, track.length_m).rows, Some(Error::Fault(FAULT.into())))
        });
        let trouble = drive.err().or(trouble);
        let advice = manual.coverage.advice(track.length_m);
        let coverage = manual.coverage.shares(options.hz, track.length_m);
        drop(manual);
        let info = RecordingInfo {
            laps: (coverage.laps * 1000.0).round() / 1000.0,
            style: "manual".into(),
            ..RecordingInfo::new(track, options, rows)
        };
        let trouble = match info.write(folder.unfinished()) {
            Err(error) if rows > 0 => trouble.or(Some(error)),
            _ => trouble,
        };
        // The message names the intended place: the hidden one is gone when the user reads it.
        let hidden = folder.unfinished().to_path_buf();
        let place = |path: PathBuf| path.strip_prefix(&hidden).map_or(path.clone(), |inside| out.join(inside));
        let trouble = trouble.map(|error| match error {
            Error::Io { path, source } => Error::Io { path: place(path), source },
            Error::CannotWrite { path, source, remedy } => Error::CannotWrite { path: place(path), source, remedy },
            other => other,
        });
        let folder = (rows > 0).then(|| folder.finish_anyhow());
        let words = match &folder {
            Some(folder) => {
                let folder = folder.display();
                format!(
                    "{rows} rows are in {folder}; look at them with steersman inspect {folder}, train with steersman train {folder}"
                )
            }
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

/// What the writer is to do.
enum Order {
    /// Add a row.
    Add(Sample),
    /// Take out all rows but the first so many.
    Keep(usize),
}

/// Writes rows until the sender is dropped or a row cannot be written. Returns their number and the error.
fn write(mut writer: RowWriter, orders: &Receiver<Order>) -> (usize, Option<Error>) {
    for order in orders {
        let done = match order {
            Order::Add(sample) => writer.write(&sample),
            Order::Keep(rows) => writer.keep(rows),
        };
        if let Err(error) = done {
            return (writer.rows(), Some(error));
        }
    }
    (writer.rows(), None)
}

/// A way off the road.
#[derive(Clone, Copy)]
struct Excursion {
    /// Rows there were when the wheels of one side left the road.
    rows_before: usize,
    /// Whether all wheels were off it.
    whole_car: bool,
}

/// The car, its driver and the recording, one step after another.
struct ManualLoop<'a> {
    options: &'a RecordOptions,
    live: &'a Live,
    simulation: Simulation<'a>,
    eye: FrontCamera<'a>,
    cockpit: Cockpit,
    recording: bool,
    notice: String,
    put_back: usize,
    coverage: Coverage,
    /// Distance driven until the last row, m.
    row_way_m: f64,
    /// The rows so far.
    rows: Vec<Row>,
    /// While the wheels of one side are off the road.
    excursion: Option<Excursion>,
    /// The queue of the writer; `None` at the end.
    orders: Option<Sender<Order>>,
}

impl<'a> ManualLoop<'a> {
    fn new(track: &'a Track, options: &'a RecordOptions, live: &'a Live, orders: Sender<Order>) -> ManualLoop<'a> {
        let start =
            Start { reverse: options.reverse, offset_m: 0.0, heading_deg: 0.0, ..Start::draw(track, options.seed) };
        ManualLoop {
            options,
            live,
            simulation: Simulation::new(track, start, 0.0),
            eye: FrontCamera::new(track, options.seed),
            cockpit: Cockpit::default(),
            recording: false,
            notice: "Hold W or the up arrow to drive, R to record.".into(),
            put_back: 0,
            coverage: Coverage::default(),
            row_way_m: 0.0,
            rows: Vec::new(),
            excursion: None,
            orders: Some(orders),
        }
    }

    /// Simulates a step of 20 ms. Returns `false` if the driver has finished.
    fn step(&mut self) -> Result<bool> {
        let now = Instant::now();
        let look = |wheel: &mut super::controls::Wheel| (wheel.holder(now), wheel.input(now), wheel.take_actions());
        let (driver, input, actions) = self.live.with_wheel(look).unwrap_or_default();
        for action in actions {
            match action {
                Action::Record => self.record(!self.recording),
                Action::Cruise => self.cockpit.cruise = !self.cockpit.cruise,
                Action::Erase => self.erase(),
                Action::PutBack => {
                    let cut = left_out(self.cut_off_road());
                    self.put(false, &format!("The car was put back{cut}."));
                }
                Action::TurnRound => {
                    let cut = left_out(self.cut_off_road());
                    self.put(true, &format!("The car was turned round{cut}."));
                }
                Action::Finish => return Ok(false),
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
        self.watch_wheels();
        let edge_m = self.simulation.track.at(self.simulation.location.s_m).width_m / 2.0;
        if self.simulation.at_wall {
            self.rescue("The car hit a wall and was put back");
        } else if self.simulation.cte_m().abs() > edge_m + MAX_OFF_ROAD_M {
            self.rescue("The car was far off the road and was put back");
        }
        if self.simulation.steps.is_multiple_of(STEPS_PER_FRAME) {
            self.show(driver, controls)?;
        }
        Ok(true)
    }

    /// Puts the car back after an accident and pauses the recording.
    fn rescue(&mut self, what: &str) {
        let cut = left_out(self.cut_off_road());
        let then = if self.recording { "; recording is paused" } else { "" };
        self.record(false);
        self.put(false, &format!("{what}{cut}{then}."));
    }

    /// Notices when wheels leave the road, and when they are back on it. Rows of a car that was off it as a whole are left out; one
    /// that only crossed the edge shows the way back.
    fn watch_wheels(&mut self) {
        let wheels_off = self.simulation.wheels_off;
        if wheels_off >= 2 {
            let excursion = self.excursion.get_or_insert(Excursion { rows_before: self.rows.len(), whole_car: false });
            excursion.whole_car |= wheels_off == 4;
        } else if self.excursion.is_some_and(|excursion| excursion.whole_car) {
            let cut = self.cut_off_road();
            self.notice = cut.map_or(String::new(), |rows| format!("{rows} off the road: left out."));
        } else {
            self.excursion = None;
        }
    }

    /// Takes what was recorded since wheels left the road out of the recording. Says how many rows these were, if any.
    fn cut_off_road(&mut self) -> Option<String> {
        let rows = self.excursion.take()?.rows_before;
        (rows < self.rows.len()).then(|| self.keep(rows))
    }

    fn erase(&mut self) {
        let rows = (ERASED_S * self.options.hz) as usize;
        self.notice = if self.rows.is_empty() {
            "There is nothing to erase.".into()
        } else {
            let erased = self.keep(self.rows.len().saturating_sub(rows));
            format!("The last {erased} {} erased.", if erased == "1 row" { "is" } else { "are" })
        };
    }

    /// Takes all rows but the first `rows` out of the recording. Says how many these were.
    fn keep(&mut self, rows: usize) -> String {
        let count = self.rows.len() - rows;
        self.rows.truncate(rows);
        if let Some(excursion) = &mut self.excursion {
            excursion.rows_before = excursion.rows_before.min(rows);
        }
        self.coverage = Coverage::default();
        self.rows.iter().for_each(|row| self.coverage.add(row));
        self.order(Order::Keep(rows));
        if count == 1 { "1 row".into() } else { format!("{count} rows") }
    }

    fn order(&self, order: Order) {
        if let Some(orders) = &self.orders {
            // `run` notices before the next step that the writer has ended.
            let _ = orders.send(order);
        }
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
        // A gap in the times of the pictures tells readers that the drive is not continuous here.
        simulation.steps += 2 * STEPS_PER_S;
        self.cockpit = Cockpit::default();
        self.put_back += 1;
        self.notice = notice.into();
    }

    /// Records a row: the pose of the car and its controls.
    fn row(&mut self, controls: Controls, speed_mph: f64) {
        let simulation = &self.simulation;
        let row = Row {
            steering: controls.steering,
            cte_m: simulation.cte_m(),
            heading_error: simulation.heading_error(),
            reverse: simulation.reverse,
            way_m: simulation.progress_m - self.row_way_m,
        };
        self.coverage.add(&row);
        self.row_way_m = simulation.progress_m;
        let sample = Sample {
            time_s: simulation.time_s(),
            body: simulation.body_pose(),
            steering: controls.steering,
            throttle: controls.throttle.max(0.0),
            brake: (-controls.throttle).max(0.0),
            speed_mph,
        };
        self.rows.push(row);
        self.order(Order::Add(sample));
    }

    fn show(&mut self, driver: Option<u64>, controls: Controls) -> Result<()> {
        let mut state = State::of(&self.simulation);
        self.live.extend_trail(&state);
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

/// The part of a sentence that says what was cut.
fn left_out(rows: Option<String>) -> String {
    rows.map_or(String::new(), |rows| format!("; {rows} off the road: left out"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::live::messages::{Input, Request};

    /// A drive on `lake` without a writer, and the rows that a writer would have.
    struct Drive<'a> {
        manual: ManualLoop<'a>,
        live: &'a Live,
        orders: Receiver<Order>,
        written: Vec<f64>,
    }

    impl Drive<'_> {
        fn ask(&self, request: Request) {
            self.live.with_wheel(|wheel| wheel.take(1, request, Instant::now())).unwrap();
        }

        fn step(&mut self, wheel: f64, pedals: f64) {
            self.ask(Request::Controls(Input { wheel: Some(wheel), pedals: Some(pedals), ..Input::default() }));
            assert!(self.manual.step().unwrap());
            for order in self.orders.try_iter() {
                match order {
                    Order::Add(sample) => self.written.push(sample.time_s),
                    Order::Keep(rows) => self.written.truncate(rows),
                }
            }
            assert_eq!(self.written.len(), self.manual.rows.len());
            assert_eq!(self.written.len(), self.manual.coverage.shares(10, 1000.0).rows);
        }
    }

    #[test]
    fn what_was_driven_off_the_road_and_the_last_five_seconds_can_be_taken_out() {
        let track = Track::load("lake").unwrap();
        let options = RecordOptions::default();
        let live = Live::start(0, Hello::new("manual", String::new(), &track), true).unwrap();
        let (sender, orders) = channel();
        let manual = ManualLoop::new(&track, &options, &live, sender);
        let mut drive = Drive { manual, live: &live, orders, written: Vec::new() };
        drive.ask(Request::Take);
        drive.ask(Request::Record);
        for _ in 0..8 * STEPS_PER_S {
            drive.step(0.0, 0.02);
        }
        let rows = (8 * options.hz) as usize;
        assert_eq!(drive.written.len(), rows);
        let last_s = drive.written[rows - 1];
        drive.ask(Request::Erase);
        drive.step(0.0, 0.2);
        let left = drive.written.len();
        assert!(left <= rows + 1 - (5 * options.hz) as usize, "{left}");
        assert!(drive.written.iter().all(|&time_s| time_s <= last_s - 4.9 || time_s > last_s));
        assert!(drive.manual.notice.starts_with("The last 50 rows"), "{}", drive.manual.notice);
        let edge_m = track.at(drive.manual.simulation.location.s_m).width_m / 2.0;
        // A car that crosses the edge shows the way back; one that was off the road as a whole does not.
        for (offset_m, stays) in [(edge_m - 0.5, true), (edge_m + 1.5, false)] {
            for (offset_m, steps) in [(offset_m, 50), (0.0, 1)] {
                let s_m = drive.manual.simulation.location.s_m;
                drive.manual.simulation.put(Start { s_m, reverse: false, offset_m, heading_deg: 0.0 }, 0.0);
                let before = drive.written.len();
                (0..steps).for_each(|_| drive.step(0.0, 0.0));
                assert!(steps == 1 || drive.written.len() == before + 10);
                assert!(steps > 1 || stays == (drive.written.len() >= before), "{offset_m}");
            }
        }
        while drive.manual.put_back == 0 {
            drive.step(0.1, 0.5);
            assert!(drive.manual.simulation.steps < 200 * STEPS_PER_S, "it is never put back");
        }
        assert!(drive.manual.notice.contains("off the road: left out; recording is paused"), "{}", drive.manual.notice);
        let last_m = drive.manual.rows.last().unwrap().cte_m.abs();
        assert!((0.5..edge_m).contains(&last_m), "{last_m} of {edge_m}");
        // The button does the same.
        drive.ask(Request::Record);
        while drive.manual.simulation.wheels_off < 2 {
            drive.step(0.1, 0.3);
        }
        let before = drive.manual.rows.len();
        (0..20).for_each(|_| drive.step(0.0, 0.3));
        assert!(drive.manual.rows.len() > before);
        drive.ask(Request::PutBack);
        drive.step(0.0, 0.2);
        assert!(drive.manual.rows.len() <= before + 1, "{}", drive.manual.notice);
        assert!(drive.manual.notice.contains("off the road: left out"), "{}", drive.manual.notice);
    }
}
