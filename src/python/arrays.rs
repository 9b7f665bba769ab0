//! Images on the way in, results on the way out.

use numpy::{
    PyArray, PyArrayDescrMethods, PyArrayMethods, PyReadonlyArray, PyUntypedArray, PyUntypedArrayMethods, dtype,
};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use serde::Serialize;

use crate::dataset::Description;
use crate::error::Error;

/// `value` as an array of bytes with the dimensions of `D`, which is borrowed if it is one. What is no array is asked for one first,
/// as a picture of Pillow can be.
///
/// # Errors
///
/// `TypeError` for other numbers than bytes, `ValueError` for other dimensions; both say what `shape` is meant.
pub(super) fn bytes<'py, D: numpy::ndarray::Dimension>(
    value: &Bound<'py, PyAny>,
    shape: &str,
) -> PyResult<PyReadonlyArray<'py, u8, D>> {
    let py = value.py();
    let array = match value.cast::<PyUntypedArray>() {
        Ok(array) => array.clone(),
        Err(_) => py.import("numpy")?.call_method1("asarray", (value,))?.cast_into::<PyUntypedArray>()?,
    };
    if !array.dtype().is_equiv_to(&dtype::<u8>(py)) {
        let found = array.dtype().to_string();
        return Err(PyTypeError::new_err(format!(
            "an array of uint8 is meant, {shape} with values 0 to 255, not {found}"
        )));
    }
    if array.ndim() != D::NDIM.unwrap_or(array.ndim()) {
        return Err(PyValueError::new_err(format!("an array {shape} is meant, not one of shape {:?}", array.shape())));
    }
    let array = array.cast_into::<PyArray<u8, D>>()?;
    array.try_readonly().map_err(|error| PyValueError::new_err(error.to_string()))
}

/// `value` as Python has what its JSON says: dictionaries, lists, numbers, strings and None.
pub(super) fn plain<'py>(py: Python<'py>, value: &impl Serialize) -> PyResult<Bound<'py, PyAny>> {
    let text = serde_json::to_string(value).map_err(|e| Error::Fault(format!("cannot be written as JSON: {e}")))?;
    py.import("json")?.call_method1("loads", (text,))
}

/// What a dictionary says about recordings: the entries of `steersman.toml`.
///
/// # Errors
///
/// `UsageError` that names an unknown entry or a wrong value.
pub(super) fn said(description: Option<&Bound<PyAny>>) -> PyResult<Description> {
    let Some(description) = description else { return Ok(Description::default()) };
    let text: String = description.py().import("json")?.call_method1("dumps", (description,))?.extract()?;
    let said: Description =
        serde_json::from_str(&text).map_err(|e| Error::Usage(format!("description: {}", plain_words(&e))))?;
    said.validate().map_err(|message| Error::Usage(format!("description: {message}")))?;
    Ok(said)
}

/// What is wrong, without the place in a text that nobody has seen.
fn plain_words(error: &serde_json::Error) -> String {
    let text = error.to_string();
    text.rsplit_once(" at line ").map_or(text.as_str(), |(words, _)| words).to_string()
}
