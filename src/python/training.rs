//! `train`, `resume`, and what is in the folder of a run.

use std::path::{Path, PathBuf};

use pyo3::exceptions::PyKeyboardInterrupt;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::arrays::{plain, said};
use super::work::{self, Reporter};
use crate::cli::arguments::model_file;
use crate::error::{Error, Result};
use crate::main_job::on_recording::judge_run;
use crate::main_job::with_simulator::{Allowed, beside_recordings};
use crate::model_file::Model;
use crate::recipe::Recipe;
use crate::report;
use crate::training::{self, NewRun, RunFolder, TrainRequest, TransferRequest};

/// Trains on recordings; returns the folder of the run. `settings` is what the function of the package takes.
#[pyfunction]
#[pyo3(signature = (recordings, settings, progress = None))]
pub(super) fn train(
    py: Python,
    recordings: Vec<PathBuf>,
    settings: Settings,
    progress: Option<&Bound<PyAny>>,
) -> PyResult<PathBuf> {
    let said = said(settings.description.as_ref().map(|description| description.bind(py)))?;
    let Settings { recipe, overrides, out, validate, with_simulator, begin_with, freeze, .. } = settings;
    let Settings { seed, threads, cache_mib, force_held_out, .. } = settings;
    let mut begun = None;
    let result = work::run(py, threads, progress, |reporter| {
        let from = begin_with.map(|model| model_file(&model)).transpose()?;
        let mut recipe = match (&recipe, &from) {
            (None, Some(from)) => {
                Recipe::parse(&from.display().to_string(), &Model::load(from)?.recipe.to_toml()?, &overrides)?
            }
            (recipe, _) => Recipe::find(recipe.as_deref().unwrap_or("recording"), &overrides)?,
        };
        let from = from.map(|model| TransferRequest { model, freeze });
        let allowed = Allowed { with_simulator, held_out: force_held_out };
        let (told, stop) = (reporter.clone(), reporter.stop.clone());
        let mut notice = |text: &str| told.notice(text);
        let sides = [&recordings[..], &validate];
        let simulator = beside_recordings(&mut recipe, sides, &said, allowed, &mut notice, reporter, &stop)?;
        let run = NewRun::at(out, &recipe.name)?;
        let out = run.path().to_path_buf();
        begun = Some(out.clone());
        let request = TrainRequest::new(recordings, recipe, out);
        let request = TrainRequest { validate, simulator, said, seed, cache_mib, from, ..request };
        run.settle(training::train(request, reporter, &stop))?;
        finish(begun.as_deref().unwrap_or(Path::new("")), reporter)
    });
    told_how_to_go_on(py, result, begun.as_deref())?;
    Ok(begun.unwrap_or_default())
}

/// What [`train`] takes beside the recordings.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub(super) struct Settings {
    recipe: Option<String>,
    overrides: Vec<String>,
    out: Option<PathBuf>,
    validate: Vec<PathBuf>,
    description: Option<Py<PyAny>>,
    /// Whether the simulator's set is trained on, too, and its share if that is not the recipe's.
    with_simulator: Option<Option<f64>>,
    begin_with: Option<PathBuf>,
    freeze: Vec<String>,
    seed: u64,
    threads: usize,
    cache_mib: usize,
    force_held_out: bool,
}

/// Goes on with the run in `folder`.
#[pyfunction]
#[pyo3(signature = (folder, threads = 0, progress = None))]
pub(super) fn resume(py: Python, folder: PathBuf, threads: usize, progress: Option<&Bound<PyAny>>) -> PyResult<()> {
    let result = work::run(py, threads, progress, |reporter| {
        let stop = reporter.stop.clone();
        training::resume(&folder, false, reporter, &stop)?;
        finish(&folder, reporter)
    });
    told_how_to_go_on(py, result, Some(&folder))
}

/// Judges the finished run in `folder` on its recordings and writes its page. The run is saved; what cannot be done now takes nothing
/// from it, and is told.
fn finish(folder: &Path, reporter: &Reporter) -> Result<()> {
    match judge_run(folder, &reporter.stop) {
        Err(Error::Interrupted) => return Err(Error::Interrupted),
        Err(error) => reporter.notice(format!("the model was not judged on the recording: {error}")),
        Ok(_) => {}
    }
    if let Err(error) = report::pages::run::write(folder) {
        reporter.notice(format!("no report.html: {error}"));
    }
    Ok(())
}

/// `result`, where a `KeyboardInterrupt` says what is saved and how to go on with it.
fn told_how_to_go_on(py: Python, result: PyResult<()>, folder: Option<&Path>) -> PyResult<()> {
    let Err(exception) = result else { return Ok(()) };
    let saved = folder.filter(|folder| folder.join("run.json").is_file());
    match saved {
        Some(folder) if exception.is_instance_of::<PyKeyboardInterrupt>(py) => {
            let folder = crate::text::escaped(&folder.display().to_string()).into_owned();
            Err(PyKeyboardInterrupt::new_err(format!("stopped and saved; go on with: steersman.resume({folder:?})")))
        }
        _ => Err(exception),
    }
}

/// The content of the run in `folder`: `history`, a list of epochs, `result`, `replay`, `recipe` and `info`.
#[pyfunction]
pub(super) fn read_run(py: Python, folder: PathBuf) -> PyResult<Bound<PyDict>> {
    let run = RunFolder::open(&folder)?;
    let dict = PyDict::new(py);
    // Before the first epoch has ended there is none.
    let history = if run.file("history.csv").is_file() { run.history()? } else { Vec::new() };
    dict.set_item("history", plain(py, &history)?)?;
    dict.set_item("result", plain(py, &run.result()?)?)?;
    dict.set_item("replay", plain(py, &run.replay()?)?)?;
    dict.set_item("recipe", plain(py, &run.recipe()?)?)?;
    dict.set_item("info", plain(py, &run.info()?)?)?;
    Ok(dict)
}
