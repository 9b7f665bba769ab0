//! The model that a command is given: a model file, the folder of a run, or something else that is answered.

use std::ffi::OsString;
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};

use crate::dataset::recordings_below;
use crate::error::{Error, Result};
use crate::model_file::{Model, notice_without_digest};
use crate::pilot::Pilot;
use crate::recipe::SHIPPED;
use crate::simulator::road::builtin;
use crate::text::escaped;

/// Name of the model in the folder of a run.
const MODEL: &str = "model.safetensors";
/// First bytes of an HDF5 file.
const HDF5: &[u8] = b"\x89HDF\r\n\x1a\n";

/// The model file that `given` means: itself, or that of the run whose folder it is.
///
/// # Errors
///
/// [`Error::Usage`] that says what to do, for a recording, a recipe, a Keras model and other things that are no model.
pub(crate) fn model_file(given: &Path) -> Result<PathBuf> {
    let wrong = |what: String| Err(Error::Usage(format!("{}: {what}", given.display())));
    let metadata = match std::fs::metadata(given) {
        Ok(metadata) => metadata,
        Err(error) => return missing(given, Error::io(given)(error)),
    };
    if metadata.is_dir() {
        let model = given.join(MODEL);
        if model.is_file() {
            return Ok(model);
        }
        if given.join("run.json").is_file() {
            let run = given.display();
            return wrong(format!("this run has no model yet; go on with: steersman train --resume {run}"));
        }
        if let Some(run) = newest_run(given) {
            let path = run.join(MODEL);
            return wrong(format!("is a folder of runs; name a model, such as {}", path.display()));
        }
    } else if !metadata.is_file() {
        return wrong("is a FIFO, a device or a socket, no model".into());
    } else {
        let mut head = Vec::new();
        File::open(given).and_then(|file| file.take(9).read_to_end(&mut head)).map_err(Error::io(given))?;
        let extension = given.extension().unwrap_or_default().to_ascii_lowercase();
        if head.starts_with(HDF5) || extension == "keras" {
            let import = "steersman import FILE --out model.safetensors";
            return wrong(format!("is a model of Keras; {import} makes a model file of it"));
        }
        if extension == "onnx" || extension == "c" || extension == "rs" {
            return wrong("was exported for other programs; name the model file that it was made from".into());
        }
        // Eight bytes say how long the header is, which is JSON.
        if head.get(8) == Some(&b'{') || extension == "safetensors" {
            return Ok(given.to_path_buf());
        }
    }
    if recordings_below(given).is_ok_and(|found| !found.is_empty()) {
        let command = match command_with_the_model_first(given, std::env::args_os().collect()) {
            Some(command) => format!("this is the other way round: {command}"),
            None => format!("name a model there, {MODEL} of a run"),
        };
        return wrong(format!("is a recording, no model; {command}"));
    }
    // Whatever else a file is, reading it says what is wrong.
    if metadata.is_file() { Ok(given.to_path_buf()) } else { wrong(format!("no {MODEL} in this folder")) }
}

/// Reads the model that `given` means, and says so if it has no digest.
pub(crate) fn load_model(given: &Path) -> Result<Model> {
    let path = &model_file(given)?;
    let model = Model::load(path)?;
    say_if_without_digest(path)?;
    Ok(model)
}

/// Reads the model that `given` means to drive with it, and says so if it has no digest.
pub(crate) fn load_pilot(given: &Path) -> Result<Pilot> {
    let path = &model_file(given)?;
    let pilot = Pilot::load(path)?;
    say_if_without_digest(path)?;
    Ok(pilot)
}

fn say_if_without_digest(path: &Path) -> Result<()> {
    if let Some(notice) = notice_without_digest(path)?.filter(|_| !crate::cluster::follows()) {
        eprintln!("note: {}", escaped(&notice));
    }
    Ok(())
}

/// What to do about a model that is not there, as `not_there` says.
fn missing(given: &Path, not_there: Error) -> Result<PathBuf> {
    let name = given.display().to_string();
    let newest = |of: &str| newest_run_of(Path::new("runs"), of);
    if SHIPPED.iter().any(|(recipe, _)| *recipe == name) {
        let trained = match newest(&name) {
            Some(run) => format!("its newest model is {}", run.join(MODEL).display()),
            None => format!("train a model with: steersman train --recipe {name}"),
        };
        return Err(Error::Usage(format!("{name} is a recipe, no model; {trained}")));
    }
    if builtin::names().any(|track| track == name) {
        let message =
            format!("{name} is a track, no model: the model comes first, the track is named with --track {name}");
        return Err(Error::Usage(message));
    }
    match newest_run(Path::new("runs")) {
        Some(run) => Err(Error::Usage(format!("{not_there}; the newest model is {}", run.join(MODEL).display()))),
        None => Err(not_there),
    }
}

/// The newest run with a model in `folder`.
fn newest_run(folder: &Path) -> Option<PathBuf> {
    newest_run_of(folder, "")
}

/// The same among the runs that are called after a recipe `name`.
fn newest_run_of(folder: &Path, name: &str) -> Option<PathBuf> {
    let runs = std::fs::read_dir(folder).ok()?.flatten().map(|entry| entry.path());
    let called = |run: &PathBuf| run.file_name().is_some_and(|file| file.to_string_lossy().starts_with(name));
    let with_time = |run: PathBuf| Some((std::fs::metadata(run.join(MODEL)).ok()?.modified().ok()?, run));
    runs.filter(called).filter_map(with_time).max().map(|(_, run)| run)
}

/// The command line `args` with the recording in the place of the model, and the model in its place, if a model is among them.
fn command_with_the_model_first(recording: &Path, args: Vec<OsString>) -> Option<String> {
    let place = args.iter().position(|arg| arg == recording.as_os_str())?;
    let is_model = |arg: &OsString| {
        let path = Path::new(arg);
        path.join(MODEL).is_file() || path.is_file() && path.extension().is_some_and(|e| e == "safetensors")
    };
    let model = (1..args.len()).find(|i| is_model(&args[*i]))?;
    let mut words: Vec<String> = args.iter().map(|arg| quoted(&arg.to_string_lossy())).collect();
    words.swap(place, model);
    words[0] = "steersman".into();
    Some(words.join(" "))
}

/// A word for a shell.
fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_alphanumeric() || "-_./=:,+@%~".contains(c);
    if !word.is_empty() && word.chars().all(plain) { word.into() } else { format!("'{}'", word.replace('\'', "'\\''")) }
}
