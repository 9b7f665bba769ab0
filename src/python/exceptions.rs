//! Errors as Python exceptions, and notices as Python warnings. Both are text for a person, so nothing foreign in them is raw.

use std::ffi::CString;

use pyo3::exceptions::{PyKeyboardInterrupt, PyRuntimeError, PyUserWarning};
use pyo3::prelude::*;
use pyo3::types::PyType;

use crate::error::Error;
use crate::text::escaped_lines;

/// The module that defines the classes.
const MODULE: &str = "steersman._errors";

impl From<Error> for PyErr {
    /// The exception with the text that the command line prints behind `error:`.
    fn from(error: Error) -> PyErr {
        if let Error::Interrupted = error {
            return PyKeyboardInterrupt::new_err(());
        }
        let text = escaped_lines(&error.to_string()).into_owned();
        Python::attach(|py| match class(py, class_of(&error)) {
            Ok(class) => PyErr::from_type(class, text),
            Err(_) => PyRuntimeError::new_err(text),
        })
    }
}

/// Name of the class that stands for `error`.
fn class_of(error: &Error) -> &'static str {
    match error {
        Error::Io { .. } | Error::CannotWrite { .. } => "FileError",
        Error::Data { .. } | Error::Codec(_) => "DataError",
        Error::Recipe { .. } | Error::Network { .. } | Error::Usage(_) | Error::Input(_) => "UsageError",
        Error::EndedEarly { cause, .. } => class_of(cause),
        _ => "Error",
    }
}

fn class<'py>(py: Python<'py>, name: &str) -> PyResult<Bound<'py, PyType>> {
    Ok(py.import(MODULE)?.getattr(name)?.cast_into()?)
}

/// Warns of `text`, which seems to come from the line that called the function `depth` Python functions above.
///
/// # Errors
///
/// The exception that the warning is turned into, if the user wants that.
pub(super) fn warn(py: Python, text: &str, depth: i32) -> PyResult<()> {
    let text = CString::new(escaped_lines(text).as_ref()).unwrap_or_default();
    match class(py, "Notice") {
        Ok(category) => PyErr::warn(py, &category, &text, depth),
        Err(_) => PyErr::warn(py, &py.get_type::<PyUserWarning>(), &text, depth),
    }
}
