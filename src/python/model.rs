//! The class `Model`.

use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};

use clap::ValueEnum;
use numpy::{IntoPyArray, PyArray1, PyArray2, PyArray3, PyArrayDyn, PyReadonlyArray3};
use pyo3::exceptions::PyKeyError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use steersman_kernels::Isa;

use super::arrays::{bytes, plain};
use super::exceptions::warn;
use super::work;
use crate::cli::arguments::model_file;
use crate::cli::export::{ExportRequest, Format};
use crate::cli::summary;
use crate::error::Error;
use crate::model_file::{Model as ModelFile, notice_without_digest, weights_hash};
use crate::picture::RgbImage;
use crate::pilot::Pilot;
use crate::report::explain::saliency::Saliency;

/// Shape of an image, for messages.
const IMAGE: &str = "(height, width, 3)";
/// Shape of a batch of images, for messages.
const BATCH: &str = "(n, height, width, 3)";

/// A trained model; see the stubs for what its methods take and give.
#[pyclass(module = "steersman", frozen)]
pub(super) struct Model {
    pub(super) file: ModelFile,
    path: PathBuf,
    pilot: Mutex<Pilot>,
}

impl Model {
    fn lock(&self) -> MutexGuard<'_, Pilot> {
        self.pilot.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A pilot of its own for whoever works in parallel.
    pub(super) fn pilot(&self) -> Pilot {
        self.lock().clone()
    }
}

#[pymethods]
impl Model {
    /// Reads a model file, or the model of a run.
    #[staticmethod]
    pub(super) fn load(py: Python, path: PathBuf) -> PyResult<Model> {
        let (model, notice) = py.detach(|| {
            let path = model_file(&path)?;
            let file = ModelFile::load(&path)?;
            let notice = notice_without_digest(&path)?;
            let pilot = Mutex::new(Pilot::new(file.clone(), Isa::best())?);
            Ok::<_, crate::Error>((Model { file, path, pilot }, notice))
        })?;
        if let Some(notice) = notice {
            warn(py, &notice, 1)?;
        }
        Ok(model)
    }

    fn steer(&self, py: Python, image: &Bound<PyAny>) -> PyResult<f32> {
        let image = bytes(image, IMAGE)?;
        let image: &PyReadonlyArray3<u8> = &image;
        let view = image.as_array();
        Ok(py.detach(|| self.lock().steer(view))?)
    }

    fn answer<'py>(&self, py: Python<'py>, image: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyDict>> {
        let image: PyReadonlyArray3<u8> = bytes(image, IMAGE)?;
        let view = image.as_array();
        let answer = py.detach(|| self.lock().answer(view))?;
        let dict = PyDict::new(py);
        dict.set_item("steering", answer.steering)?;
        let beside = [("throttle", answer.throttle), ("speed", answer.speed)];
        beside
            .iter()
            .filter_map(|(name, value)| value.map(|value| (name, value)))
            .try_for_each(|(name, value)| dict.set_item(name, value))?;
        Ok(dict)
    }

    fn steer_file(&self, py: Python, path: PathBuf) -> PyResult<f32> {
        Ok(py.detach(|| self.lock().steer_file(&path))?)
    }

    #[pyo3(signature = (images, *, threads = 0))]
    fn predict<'py>(
        &self,
        py: Python<'py>,
        images: &Bound<'py, PyAny>,
        threads: usize,
    ) -> PyResult<Bound<'py, PyArray1<f32>>> {
        let images = bytes(images, BATCH)?;
        let view = images.as_array();
        let pilot = self.pilot();
        Ok(work::run(py, threads, None, |_| pilot.predict(view))?.into_pyarray(py))
    }

    #[pyo3(signature = (images, *, threads = 0))]
    fn predict_outputs<'py>(
        &self,
        py: Python<'py>,
        images: &Bound<'py, PyAny>,
        threads: usize,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let images = bytes(images, BATCH)?;
        let view = images.as_array();
        let pilot = self.pilot();
        Ok(work::run(py, threads, None, |_| pilot.predict_outputs(view))?.into_pyarray(py))
    }

    /// Steering, the map of saliency, and the image with the map on it.
    #[allow(clippy::type_complexity, reason = "a tuple of arrays is what Python gets")]
    fn saliency<'py>(
        &self,
        py: Python<'py>,
        image: &Bound<'py, PyAny>,
    ) -> PyResult<(f32, Bound<'py, PyArray2<f32>>, Bound<'py, PyArray3<u8>>)> {
        let image: PyReadonlyArray3<u8> = bytes(image, IMAGE)?;
        let view = image.as_array();
        let (steering, map, overlay) = py.detach(|| {
            let mut pilot = self.pilot();
            let mut saliency = Saliency::new(pilot.network())?;
            let steering = saliency.steer(&mut pilot, view)?;
            let (height, width, _) = view.dim();
            let mut overlay = RgbImage { height, width, pixels: view.iter().copied().collect() };
            saliency.overlay(&pilot.recipe().preprocessing, &mut overlay);
            let [h, w] = saliency.size();
            let map = ndarray::Array2::from_shape_vec((h, w), saliency.map().to_vec()).expect("a map has its size");
            Ok::<_, crate::Error>((steering, map, overlay.view().to_owned()))
        })?;
        Ok((steering, map.into_pyarray(py), overlay.into_pyarray(py)))
    }

    #[pyo3(signature = (file, *, to = None, with_preprocessing = false, fold_batch_norm = false, throttle = None, force = false))]
    #[allow(clippy::too_many_arguments, reason = "they have names in Python")]
    fn export<'py>(
        &self,
        py: Python<'py>,
        file: PathBuf,
        to: Option<String>,
        with_preprocessing: bool,
        fold_batch_norm: bool,
        throttle: Option<f32>,
        force: bool,
    ) -> PyResult<Bound<'py, PyAny>> {
        let extension = file.extension().unwrap_or_default().to_string_lossy().into_owned();
        let name = to.unwrap_or(if extension == "rs" { "rust".into() } else { extension });
        let to = Format::from_str(&name, false).map_err(|_| {
            let known = Format::value_variants()
                .iter()
                .filter_map(|format| Some(format.to_possible_value()?.get_name().to_string()));
            Error::Usage(format!("to = {name:?}: formats are {}", known.collect::<Vec<_>>().join(", ")))
        })?;
        let request = ExportRequest { to, file, with_preprocessing, fold_batch_norm, throttle, force };
        let exported = py.detach(|| request.write(&self.path, &self.file))?;
        plain(py, &exported)
    }

    fn summary(&self) -> PyResult<String> {
        Ok(summary::of_model(&self.path, &self.file)?)
    }

    fn weights<'py>(&self, py: Python<'py>, name: &str) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
        let pilot = self.lock();
        let Some(weights) = pilot.weights(name) else {
            let names: Vec<&str> = pilot.network().tensors().iter().map(|tensor| tensor.name.as_str()).collect();
            return Err(PyKeyError::new_err(format!("there is no `{name}`; there are {}", names.join(", "))));
        };
        Ok(weights.to_owned().into_pyarray(py))
    }

    #[getter]
    fn tensors<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        PyTuple::new(py, self.lock().network().tensors().iter().map(|tensor| tensor.name.clone()))
    }

    #[getter]
    fn weights_hash(&self) -> String {
        weights_hash(self.lock().network(), &self.file.parameters)
    }

    #[getter]
    pub(super) fn path(&self) -> PathBuf {
        self.path.clone()
    }

    #[getter]
    fn outputs<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        PyTuple::new(py, self.file.recipe.outputs.specs().iter().map(|output| output.name.name()))
    }

    #[getter]
    fn top_speed_mph(&self) -> Option<f64> {
        self.file.recipe.outputs.top_speed_mph()
    }

    #[getter]
    fn image_size(&self) -> (usize, usize) {
        self.file.recipe.preprocessing.source.into()
    }

    #[getter]
    fn full_lock_deg(&self) -> f64 {
        self.file.recipe.full_lock_deg
    }

    #[getter]
    fn recipe<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        plain(py, &self.file.recipe)
    }

    #[getter]
    fn training<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        plain(py, &self.file.record)
    }

    fn __repr__(&self) -> String {
        let about = format!("<steersman.Model {}, recipe {}>", self.path.display(), self.file.recipe.name);
        crate::text::escaped(&about).into_owned()
    }
}
