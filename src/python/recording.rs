//! The class `Recording`.

use std::path::PathBuf;

use ndarray::Array3;
use numpy::{IntoPyArray, PyArray1, PyArray3, PyArray4};
use pyo3::exceptions::{PyIndexError, PyValueError};
use pyo3::prelude::*;
use rayon::prelude::*;

use super::arrays::{plain, said};
use super::exceptions::warn;
use super::work;
use crate::dataset::{self, DrivenSessions, ImageCheck, Recording as Recorded, Row, View};
use crate::error::{Error, Result};
use crate::evaluation::LOOK_AHEAD_S;
use crate::geometry::LookAhead;
use crate::picture::RgbImage;
use crate::picture::decode::decode_rgb;

/// A recording; see the stubs for what its methods take and give.
#[pyclass(module = "steersman", frozen)]
pub(super) struct Recording {
    recorded: Recorded,
}

impl Recording {
    fn column<'py, T: numpy::Element>(&self, py: Python<'py>, of: impl Fn(&Row) -> T) -> Bound<'py, PyArray1<T>> {
        self.recorded.rows.iter().map(of).collect::<Vec<T>>().into_pyarray(py)
    }

    /// The row that Python calls `row`: negative ones count from the end.
    fn row(&self, row: isize) -> PyResult<usize> {
        let rows = self.recorded.rows.len();
        let at = if row < 0 { row + rows as isize } else { row };
        let known = usize::try_from(at).ok().filter(|at| *at < rows);
        known.ok_or_else(|| PyIndexError::new_err(format!("row {row} of a recording of {rows} rows")))
    }

    fn decode(&self, row: usize, view: View) -> Result<RgbImage> {
        let mut bytes = Vec::new();
        self.recorded.read_picture(row, view, &mut bytes)?;
        let mut image = RgbImage::default();
        let place = || self.recorded.image_path(row, view).unwrap_or_default();
        decode_rgb(&bytes, &mut image).map_err(|message| Error::data(place(), message))?;
        Ok(image)
    }
}

/// The camera called `name`.
fn view(name: &str) -> PyResult<View> {
    let known = View::ALL.into_iter().find(|view| view.name() == name);
    known.ok_or_else(|| PyValueError::new_err(format!("camera {name:?}: there are centre, left and right")))
}

#[pymethods]
impl Recording {
    #[new]
    #[pyo3(signature = (path, *, description = None))]
    fn new(py: Python, path: PathBuf, description: Option<&Bound<PyAny>>) -> PyResult<Recording> {
        let said = said(description)?;
        let recorded = work::run(py, 0, None, |_| {
            let recorded = dataset::load_with(&path, &said, ImageCheck::Verify)?;
            recorded.require_unit()?;
            Ok(recorded)
        })?;
        recorded.notices.iter().try_for_each(|text| warn(py, &format!("{}: {text}", path.display()), 1))?;
        Ok(Recording { recorded })
    }

    fn __len__(&self) -> usize {
        self.recorded.rows.len()
    }

    fn __repr__(&self) -> String {
        let Recorded { path, rows, .. } = &self.recorded;
        let about = format!("<steersman.Recording {}, {} rows>", path.display(), rows.len());
        crate::text::escaped(&about).into_owned()
    }

    #[getter]
    fn steering<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        self.column(py, |row| row.steering)
    }

    #[getter]
    fn throttle<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        self.column(py, |row| row.throttle)
    }

    #[getter]
    fn brake<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        self.column(py, |row| row.brake)
    }

    #[getter]
    fn speed_mph<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        self.column(py, |row| row.speed_mph)
    }

    #[getter]
    fn time_s<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        let first_ms = self.recorded.rows.first().map_or(0, |row| row.time_ms);
        self.column(py, |row| (row.time_ms - first_ms) as f64 / 1000.0)
    }

    #[getter]
    fn line<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<u32>> {
        self.column(py, |row| row.line)
    }

    #[getter]
    fn session<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<u32>> {
        let sessions = self.recorded.sessions.iter().enumerate();
        let of_rows = sessions.flat_map(|(number, rows)| std::iter::repeat_n(number as u32, rows.len()));
        of_rows.collect::<Vec<u32>>().into_pyarray(py)
    }

    #[pyo3(signature = (look_ahead_s = LOOK_AHEAD_S))]
    fn path_labels<'py>(&self, py: Python<'py>, look_ahead_s: f64) -> PyResult<Bound<'py, PyArray1<f32>>> {
        if !(0.0..=10.0).contains(&look_ahead_s) {
            let message = format!("look_ahead_s {look_ahead_s}: 0 to 10 s can be looked ahead");
            return Err(Error::Usage(message).into());
        }
        let recorded = &self.recorded;
        let labels = py.detach(|| {
            let look_ahead = LookAhead { seconds: look_ahead_s, ..LookAhead::usual(&recorded.geometry) };
            let labels = DrivenSessions::of(recorded, recorded.geometry.clone()).path_labels(look_ahead);
            labels.into_iter().map(|label| label.unwrap_or(f32::NAN)).collect::<Vec<f32>>()
        });
        Ok(labels.into_pyarray(py))
    }

    #[pyo3(signature = (row, camera = "centre"))]
    fn image<'py>(&self, py: Python<'py>, row: isize, camera: &str) -> PyResult<Bound<'py, PyArray3<u8>>> {
        let (row, view) = (self.row(row)?, view(camera)?);
        let RgbImage { height, width, pixels } = py.detach(|| self.decode(row, view))?;
        let image = Array3::from_shape_vec((height, width, 3), pixels).expect("an image has its pixels");
        Ok(image.into_pyarray(py))
    }

    #[pyo3(signature = (rows = None, camera = "centre", *, threads = 0))]
    fn images<'py>(
        &self,
        py: Python<'py>,
        rows: Option<Vec<isize>>,
        camera: &str,
        threads: usize,
    ) -> PyResult<Bound<'py, PyArray4<u8>>> {
        let view = view(camera)?;
        let rows = match rows {
            Some(rows) => rows.into_iter().map(|row| self.row(row)).collect::<PyResult<Vec<usize>>>()?,
            None => (0..self.recorded.rows.len()).collect(),
        };
        let images = work::run(py, threads, None, |reporter| {
            let Some(first) = rows.first() else { return Ok(ndarray::Array4::zeros((0, 0, 0, 3))) };
            let RgbImage { height, width, .. } = self.decode(*first, view)?;
            let mut pixels = vec![0; rows.len() * height * width * 3];
            let each = pixels.par_chunks_exact_mut((height * width * 3).max(1)).zip(&rows);
            each.try_for_each(|(pixels, row)| {
                reporter.stop.check()?;
                let image = self.decode(*row, view)?;
                if (image.height, image.width) != (height, width) {
                    let found = format!("{}x{}", image.height, image.width);
                    let place = self.recorded.image_path(*row, view).unwrap_or_default();
                    let message =
                        format!("is {found} pixels, the first one is {height}x{width}: take it alone, with image()");
                    return Err(Error::data(place, message));
                }
                pixels.copy_from_slice(&image.pixels);
                Ok(())
            })?;
            Ok(ndarray::Array4::from_shape_vec((rows.len(), height, width, 3), pixels).expect("as many pixels"))
        })?;
        Ok(images.into_pyarray(py))
    }

    #[pyo3(signature = (row, camera = "centre"))]
    fn image_path(&self, row: isize, camera: &str) -> PyResult<Option<PathBuf>> {
        Ok(self.recorded.image_path(self.row(row)?, view(camera)?))
    }

    #[getter]
    fn cameras(&self) -> Vec<&'static str> {
        View::ALL.into_iter().filter(|view| self.recorded.has(*view)).map(View::name).collect()
    }

    #[getter]
    fn path(&self) -> PathBuf {
        self.recorded.path.clone()
    }

    #[getter]
    fn kind(&self) -> &'static str {
        self.recorded.kind()
    }

    #[getter]
    fn rate_hz(&self) -> Option<f64> {
        self.recorded.rate_hz()
    }

    #[getter]
    fn driven_s(&self) -> f64 {
        self.recorded.driven_s()
    }

    #[getter]
    fn unusable<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        plain(py, &self.recorded.unusable)
    }
}
