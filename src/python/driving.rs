//! `drive`, `record`, `evaluate`: what is measured and made with a model or the expert at the wheel.

use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use ndarray::Array2;
use numpy::{IntoPyArray, PyArray2, ToPyArray};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};

use super::arrays::{plain, said};
use super::model::Model;
use super::work;
use crate::cli::arguments::Throttle;
use crate::error::{Error, Result};
use crate::evaluation::{self, EvaluateRequest, EvaluationEvent};
use crate::files::new_folder::NewFolder;
use crate::observer::{Observer, StopSignal};
use crate::pilot::Pilot;
use crate::report::charts::map;
use crate::simulator::car::expert::Style;
use crate::simulator::trial::drive::drive as drive_trials;
use crate::simulator::trial::trajectory::write_trajectories;
use crate::simulator::{
    self, DriveOptions, DriveState, Driver, DriverAnswer, Expert, LogFormat, Pace, RecordOptions, RgbFrame, Speed,
    Track, Trial, Zero,
};

/// Columns of a trajectory.
#[pyfunction]
pub(super) fn trajectory_columns() -> [&'static str; 10] {
    ["time_s", "x_m", "y_m", "heading_deg", "s_m", "cte_m", "steering", "throttle", "speed_mph", "intervention"]
}

/// A trial as `(moments, columns)`.
fn trajectory(trial: &Trial) -> Array2<f64> {
    let rows: Vec<[f64; 10]> = (trial.moments.iter())
        .map(|m| {
            let put_back = f64::from(u8::from(m.intervention));
            [m.time_s, m.x, m.y, m.heading_deg, m.s_m, m.cte_m, m.steering, m.throttle, m.speed_mph, put_back]
        })
        .collect();
    Array2::from(rows)
}

/// The speed that `speed_mph`, a number, `"auto"` or None, and `throttle`, `"hold"` or `"model"`, ask for.
fn speed(speed_mph: Option<&Bound<PyAny>>, throttle: Throttle) -> PyResult<Speed> {
    let speed = match speed_mph {
        None => None,
        Some(speed) => match (speed.extract::<f64>(), speed.extract::<String>().as_deref()) {
            (Ok(mph), _) => Some(Speed::Fixed(mph)),
            (_, Ok("auto")) => Some(Speed::Auto),
            _ => return Err(PyValueError::new_err("speed_mph: a number of mph or \"auto\" is meant")),
        },
    };
    Ok(throttle.aimed_at(speed)?)
}

/// The throttle called `name`.
fn throttle(name: &str) -> PyResult<Throttle> {
    match name {
        "hold" => Ok(Throttle::Hold),
        "model" => Ok(Throttle::Model),
        _ => Err(PyValueError::new_err(format!("throttle {name:?}: \"hold\" or \"model\" is meant"))),
    }
}

/// Who steers.
enum Wheel {
    Expert,
    Zero,
    Model(Box<Pilot>),
    Function(Function),
}

impl Wheel {
    fn of(driver: &Bound<PyAny>, throttle: Throttle) -> PyResult<Wheel> {
        if let Ok(model) = driver.cast::<Model>() {
            let pilot = model.get().pilot();
            throttle.check(&pilot, &model.get().path().display().to_string())?;
            return Ok(Wheel::Model(Box::new(pilot)));
        }
        if driver.is_callable() {
            let function = Arc::new(driver.clone().unbind());
            return Ok(Wheel::Function(Function { function, trouble: Arc::default() }));
        }
        match driver.extract::<String>().as_deref() {
            Ok("expert") => Ok(Wheel::Expert),
            Ok("zero") => Ok(Wheel::Zero),
            _ => Err(PyValueError::new_err("a driver is a Model, \"expert\", \"zero\" or a function")),
        }
    }

    /// A driver that gives up when `stop` is requested.
    fn driver(&self, stop: &StopSignal) -> Box<dyn Driver> {
        let driver: Box<dyn Driver> = match self {
            Wheel::Expert => Box::new(Expert),
            Wheel::Zero => Box::new(Zero),
            Wheel::Model(pilot) => pilot.clone(),
            Wheel::Function(function) => Box::new(function.clone()),
        };
        Box::new(Stoppable { driver, stop: stop.clone() })
    }
}

/// A driver, and the signal at which it gives up.
struct Stoppable {
    driver: Box<dyn Driver>,
    stop: StopSignal,
}

impl Driver for Stoppable {
    fn steer(&mut self, frame: &RgbFrame, state: &DriveState) -> f32 {
        self.driver.steer(frame, state)
    }

    fn drive(&mut self, frame: &RgbFrame, state: &DriveState) -> DriverAnswer {
        self.driver.drive(frame, state)
    }

    fn needs_frame(&self) -> bool {
        self.driver.needs_frame()
    }

    fn gives_up(&self) -> bool {
        self.stop.requested() || self.driver.gives_up()
    }
}

/// A Python function that steers: image and speed in, steering or steering and throttle out.
#[derive(Clone)]
struct Function {
    function: Arc<Py<PyAny>>,
    /// The first exception that it raised.
    trouble: Arc<Mutex<Option<PyErr>>>,
}

impl Function {
    fn lock(&self) -> MutexGuard<'_, Option<PyErr>> {
        self.trouble.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn call(&self, frame: &RgbFrame, speed_mph: f64) -> PyResult<DriverAnswer> {
        Python::attach(|py| {
            let answer = self.function.bind(py).call1((frame.view().to_pyarray(py), speed_mph))?;
            if let Ok((steering, throttle)) = answer.extract::<(f32, f32)>() {
                return Ok(DriverAnswer { steering, pace: Some(Pace::Throttle(throttle)) });
            }
            Ok(DriverAnswer { steering: answer.extract()?, pace: None })
        })
    }
}

impl Driver for Function {
    fn steer(&mut self, frame: &RgbFrame, state: &DriveState) -> f32 {
        self.drive(frame, state).steering
    }

    fn drive(&mut self, frame: &RgbFrame, state: &DriveState) -> DriverAnswer {
        self.call(frame, state.speed_mph).unwrap_or_else(|exception| {
            self.lock().get_or_insert(exception);
            DriverAnswer { steering: 0.0, pace: None }
        })
    }

    fn gives_up(&self) -> bool {
        self.lock().is_some()
    }
}

/// How `drive` drives; its entries are those of the function of the package.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub(super) struct DriveSettings {
    laps: usize,
    runs: usize,
    seed: u64,
    speed_mph: Option<Py<PyAny>>,
    throttle: String,
    latency_ms: f64,
    noise: f64,
    out: Option<PathBuf>,
    threads: usize,
}

/// Lets `driver` drive on `track`: the summary, and a list of trials as dictionaries.
#[pyfunction]
#[pyo3(signature = (driver, track, settings, progress = None))]
pub(super) fn drive<'py>(
    py: Python<'py>,
    driver: &Bound<'py, PyAny>,
    track: String,
    settings: DriveSettings,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyList>)> {
    let throttle = throttle(&settings.throttle)?;
    let speed = speed(settings.speed_mph.as_ref().map(|speed| speed.bind(py)), throttle)?;
    let DriveSettings { laps, runs, seed, latency_ms, noise, out, threads, .. } = settings;
    let options = DriveOptions { laps, runs, seed, speed, latency_ms, noise };
    let wheel = Wheel::of(driver, throttle)?;
    let result = work::run(py, threads, progress, |reporter| {
        options.check()?;
        let track = Track::load(&track)?;
        let folder = out.as_deref().map(NewFolder::create).transpose()?;
        let stop = reporter.stop.clone();
        let mut result = drive_trials(&track, || Ok(wheel.driver(&stop)), &options, reporter)?;
        if let Wheel::Model(pilot) = &wheel {
            result.summary.trained_on_held_out = pilot.trained_on_held_out().to_vec();
        }
        if let Some(folder) = folder {
            map::write(&track, &result, &folder)?;
            write_trajectories(&result, folder)?;
        }
        Ok(result)
    });
    if let Wheel::Function(function) = &wheel
        && let Some(exception) = function.lock().take()
    {
        return Err(exception);
    }
    let result = result?;
    let trials = PyList::empty(py);
    for pair in &result.trials {
        for (assisted, trial) in [(false, &pair.free), (true, &pair.assisted)] {
            let dict = PyDict::new(py);
            dict.set_item("seed", pair.seed)?;
            dict.set_item("assisted", assisted)?;
            dict.set_item("laps_completed", trial.laps_completed)?;
            dict.set_item("distance_m", trial.distance_m)?;
            dict.set_item("time_s", trial.time_s)?;
            dict.set_item("failure", plain(py, &trial.failure)?)?;
            dict.set_item("interventions", trial.interventions)?;
            dict.set_item("autonomy_percent", trial.autonomy_percent())?;
            dict.set_item("trajectory", trajectory(trial).into_pyarray(py))?;
            trials.append(dict)?;
        }
    }
    Ok((plain(py, &result.summary)?, trials))
}

/// How `record` records; its entries are those of the function of the package.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub(super) struct RecordSettings {
    laps: f64,
    reverse: bool,
    recovery: bool,
    style: String,
    seed: u64,
    speed_mph: f64,
    slower_in_bends_mps2: Option<f64>,
    label_ahead_m: Option<f64>,
    noise: f64,
    hz: u64,
    format: String,
    threads: usize,
}

/// The expert drives on `track` and is recorded in the new folder `out`.
#[pyfunction]
#[pyo3(signature = (track, out, settings, progress = None))]
pub(super) fn record(
    py: Python,
    track: String,
    out: PathBuf,
    settings: RecordSettings,
    progress: Option<&Bound<PyAny>>,
) -> PyResult<()> {
    let RecordSettings { laps, reverse, recovery, seed, speed_mph, noise, hz, threads, .. } = settings;
    let options = RecordOptions {
        laps,
        reverse,
        recovery,
        style: match settings.style.as_str() {
            "smooth" => Style::Smooth,
            "keyboard" => Style::Keyboard,
            other => {
                return Err(PyValueError::new_err(format!("style {other:?}: \"smooth\" or \"keyboard\" is meant")));
            }
        },
        seed,
        speed_mph,
        bends_mps2: settings.slower_in_bends_mps2,
        label_ahead_m: settings.label_ahead_m,
        noise,
        hz,
        format: match settings.format.as_str() {
            "sample" => LogFormat::Sample,
            "v2" => LogFormat::V2,
            other => return Err(PyValueError::new_err(format!("format {other:?}: \"sample\" or \"v2\" is meant"))),
        },
        car: None,
    };
    work::run(py, threads, progress, |reporter| simulator::record(&Track::load(&track)?, &options, &out, reporter))?;
    Ok(())
}

/// Compares a model with recordings: the measures, and a row of `(recording, row, label, steering, throttle or speed)` for each image.
#[pyfunction]
#[pyo3(signature = (model, recordings, look_ahead_s, description, threads, progress = None))]
pub(super) fn evaluate<'py>(
    py: Python<'py>,
    model: &Model,
    recordings: Vec<PathBuf>,
    look_ahead_s: f64,
    description: Option<&Bound<'py, PyAny>>,
    threads: usize,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyArray2<f64>>)> {
    let (said, pilot) = (said(description)?, model.pilot());
    let (recordings, said, training_rows) = (&recordings[..], &said, &model.file.training_rows[..]);
    let request = EvaluateRequest { recordings, said, look_ahead_s, training_rows };
    let evaluation = work::run(py, threads, progress, |reporter| {
        let mut of_rows = reporter.clone();
        let mut observer = |event| -> Result<(), Error> {
            match event {
                EvaluationEvent::Notice(text) => of_rows.notice(text),
                EvaluationEvent::Progress(progress) => return of_rows.observe(progress),
            }
            Ok(())
        };
        let evaluation = evaluation::evaluate(&pilot, &request, &mut observer)?;
        evaluation.notes.iter().for_each(|note| reporter.notice(note.clone()));
        Ok(evaluation)
    })?;
    let rows: Vec<[f64; 5]> = (evaluation.rows.iter())
        .map(|row| {
            let beside = row.answer.throttle.or(row.answer.speed).map_or(f64::NAN, f64::from);
            [row.recording as f64, row.row as f64, f64::from(row.label), f64::from(row.answer.steering), beside]
        })
        .collect();
    Ok((plain(py, &evaluation)?, Array2::from(rows).into_pyarray(py)))
}
