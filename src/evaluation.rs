//! A model against recordings: what it answers for the centre picture of every usable row, beside what was recorded.

mod answers;

use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};

#[cfg(feature = "mpi")]
pub(crate) use answers::Answers;
#[cfg(not(feature = "mpi"))]
use answers::Answers;
use answers::{Answered, Pictures, TASK_PICTURES};
use serde::Serialize;

use crate::cluster::tasks::run;
use crate::dataset::{self, Description, DrivenSessions, ImageCheck, OutputKind, OutputSpec, Outputs, Recording, View};
use crate::error::{Error, Result};
use crate::geometry::LookAhead;
use crate::metrics::{Metrics, OutputMetrics, Prediction};
use crate::observer::{Observer, Progress};
use crate::pilot::{Answer, Pilot};

/// How far ahead the driven path is aimed at, s, unless told otherwise.
pub const LOOK_AHEAD_S: f64 = 0.7;

/// What a model is compared with.
#[derive(Clone, Copy, Debug)]
pub struct EvaluateRequest<'a> {
    /// Recordings.
    pub recordings: &'a [PathBuf],
    /// What the user says about them.
    pub said: &'a Description,
    /// How far ahead the driven path is aimed at, s: 0 to 10.
    pub look_ahead_s: f64,
    /// [`row_id`](Recording::row_id)s of the rows that the model was trained on, sorted.
    pub training_rows: &'a [u64],
}

/// What happens in a comparison.
#[derive(Clone, Debug, PartialEq)]
pub enum EvaluationEvent {
    /// Something the user should know of a recording or a picture.
    Notice(String),
    /// This share of the rows is done.
    Progress(Progress),
}

/// What came out; `evaluate --json` prints it.
#[derive(Clone, Debug, Serialize)]
pub struct Evaluation {
    /// Against the recorded steering.
    #[serde(flatten)]
    pub metrics: Metrics,
    /// Against the driven path, where rows have such a label.
    #[serde(flatten)]
    pub path: Option<PathMetrics>,
    /// Of models that give a throttle.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub throttle: Option<OutputMetrics>,
    /// Of models that give a speed, mph.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub speed_mph: Option<OutputMetrics>,
    /// Held-out tracks that the model was trained on.
    #[serde(skip_serializing_if = "<[String]>::is_empty")]
    pub trained_on_held_out: Vec<String>,
    /// The rows themselves, in the order of the recordings.
    #[serde(skip)]
    pub rows: Vec<EvaluatedRow>,
    /// What the user should know about the figures.
    #[serde(skip)]
    pub notes: Vec<String>,
}

/// The answer for a row.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EvaluatedRow {
    /// Index of the recording.
    pub recording: usize,
    /// Index of the row in it.
    pub row: usize,
    /// Recorded steering.
    pub label: f32,
    /// What the model gave.
    pub answer: Answer,
}

/// Measures against the steering that follows the driven path; see [`crate::geometry::driven_path`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PathMetrics {
    /// How far ahead the path is aimed at, s; never nearer than two wheelbases.
    pub path_look_ahead_s: f64,
    /// Rows with a path label.
    pub path_rows: usize,
    /// Mean absolute error, in degrees of the front wheels.
    pub path_mae_deg: f64,
    /// Pearson's correlation of predictions and path labels.
    pub path_correlation: Option<f64>,
    /// Mean squared error ÷ mean squared path label.
    pub path_relative_to_zero: Option<f64>,
    /// Speed that was assumed where a recording says none, m/s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub path_assumed_speed_mps: Option<f64>,
}

/// Compares `pilot` with recordings. Call it inside a rayon pool.
///
/// # Errors
///
/// [`Error::Usage`] for a look-ahead that cannot be; as [`dataset::load_with`]; [`Error::Data`] if no row can be used; the observer's
/// own. Pictures that cannot be decoded are left out with a notice.
pub fn evaluate(
    pilot: &Pilot,
    request: &EvaluateRequest,
    observer: &mut (dyn Observer<EvaluationEvent> + Send),
) -> Result<Evaluation> {
    let EvaluateRequest { recordings, said, look_ahead_s, training_rows } = *request;
    if !(0.0..=10.0).contains(&look_ahead_s) {
        return Err(Error::Usage(format!("--look-ahead-s {look_ahead_s}: 0 to 10 s can be looked ahead")));
    }
    let (mut rows, mut predictions, mut path_predictions) = (Vec::new(), Vec::new(), Vec::new());
    let beside = Beside::of(&pilot.recipe().outputs);
    let (mut pairs_beside, mut assumed_mps) = (Vec::new(), None);
    let (mut known, mut sessions_before) = (0, 0);
    for (number, path) in recordings.iter().enumerate() {
        let recording = dataset::load_with(path, said, ImageCheck::Verify)?;
        recording.require_unit()?;
        for notice in recording.notices_for(&pilot.recipe().preprocessing).into_iter().chain(recording.camera_notice())
        {
            observer.observe(EvaluationEvent::Notice(notice))?;
        }
        let is_known = |row: &usize| training_rows.binary_search(&recording.row_id(*row)).is_ok();
        known += (0..recording.rows.len()).filter(is_known).count();
        let look_ahead = LookAhead { seconds: look_ahead_s, ..LookAhead::usual(&recording.geometry) };
        let driven = DrivenSessions::of(&recording, recording.geometry.clone());
        assumed_mps = assumed_mps.or(driven.assumed_speed_mps);
        let path_labels = driven.path_labels(look_ahead);
        let labels_beside = beside.as_ref().map(|beside| beside.output.recorded(&recording));
        let before = number as f64 / recordings.len() as f64;
        let tell =
            Teller { observer: Mutex::new((0, &mut *observer)), recording: &recording, before, of: recordings.len() };
        for (row, answer) in answers(pilot, &recording, &tell)? {
            if let (Some(beside), Some(labels)) = (&beside, &labels_beside) {
                pairs_beside.extend(beside.pair(&answer, labels[row]));
            }
            let (steering, label) = (answer.steering, recording.rows[row].steering);
            let (session, time_s) =
                (sessions_before + recording.session_of(row), recording.rows[row].time_ms as f64 / 1000.0);
            let prediction = Prediction { steering, label, session, time_s };
            predictions.push(prediction);
            path_predictions.extend(path_labels[row].map(|label| Prediction { label, ..prediction }));
            rows.push(EvaluatedRow { recording: number, row, label, answer });
        }
        sessions_before += recording.sessions.len();
    }
    if let Some(notice) = far_steering_notice(predictions.iter().map(|prediction| prediction.steering)) {
        observer.observe(EvaluationEvent::Notice(notice))?;
    }
    let full_lock_deg = pilot.recipe().full_lock_deg;
    let metrics = Metrics::of(&predictions, full_lock_deg).ok_or_else(|| Error::Data {
        place: "the recordings".into(),
        message: "no row can be used; `steersman inspect` says why".into(),
    })?;
    let path = Metrics::of(&path_predictions, full_lock_deg).map(|metrics| PathMetrics {
        path_look_ahead_s: look_ahead_s,
        path_rows: metrics.rows,
        path_mae_deg: metrics.mae_deg,
        path_correlation: metrics.correlation,
        path_relative_to_zero: metrics.relative_to_zero,
        path_assumed_speed_mps: assumed_mps,
    });
    let of_beside = OutputMetrics::of(&pairs_beside);
    let mut notes = Vec::new();
    if let (Some(beside), None) = (&beside, &of_beside) {
        let name = beside.output.name.name();
        notes.push(format!("no row has a {name}, so that of the model cannot be judged"));
    }
    if known > 0 {
        notes.push(format!(
            "{known} of {} rows belong to the model's training split: this is no test of how well it generalises",
            metrics.rows
        ));
    }
    let of = |kind| of_beside.filter(|_| beside.as_ref().is_some_and(|beside| beside.output.name == kind));
    let (throttle, speed_mph) = (of(OutputKind::Throttle), of(OutputKind::Speed));
    let trained_on_held_out = pilot.trained_on_held_out().to_vec();
    Ok(Evaluation { metrics, path, throttle, speed_mph, trained_on_held_out, rows, notes })
}

/// The output beside the steering.
struct Beside {
    output: OutputSpec,
    /// Of its unit in one of the output.
    scale: f64,
}

impl Beside {
    fn of(outputs: &Outputs) -> Option<Beside> {
        let output = *outputs.specs().get(1)?;
        Some(Beside { output, scale: outputs.top_speed_mph().unwrap_or(1.0) })
    }

    /// Prediction and label, where there is one.
    fn pair(&self, answer: &Answer, label: f32) -> Option<(f64, f64)> {
        let predicted = answer.throttle.or(answer.speed).filter(|_| !label.is_nan())?;
        Some((self.scale * f64::from(predicted), self.scale * f64::from(label)))
    }
}

/// Tells the observer of a recording that several threads work on.
struct Teller<'a> {
    /// Rows done, and whom to tell.
    observer: Mutex<(usize, &'a mut (dyn Observer<EvaluationEvent> + Send))>,
    recording: &'a Recording,
    /// Share of the recordings before this one, and recordings in all.
    before: f64,
    of: usize,
}

impl Teller<'_> {
    /// Another row is done; `trouble` says why it is left out, if it is.
    fn row(&self, trouble: Option<String>) -> Result<()> {
        let mut state = self.observer.lock().unwrap_or_else(PoisonError::into_inner);
        let (done, observer) = &mut *state;
        *done += 1;
        if let Some(trouble) = trouble {
            observer.observe(EvaluationEvent::Notice(format!("left out: {trouble}")))?;
        }
        let share = *done as f64 / self.recording.rows.len() as f64;
        observer.observe(EvaluationEvent::Progress(Progress(self.before + share / self.of as f64)))
    }
}

/// The answers for the centre pictures of all rows, each with its row; rows whose picture cannot be decoded are left out.
fn answers(pilot: &Pilot, recording: &Recording, tell: &Teller) -> Result<Vec<(usize, Answer)>> {
    // A few tasks for each thread, so that all end together.
    let of_task = (recording.rows.len() / (4 * rayon::current_num_threads())).clamp(1, TASK_PICTURES);
    let rows = |number: usize| {
        let first = number * of_task;
        first..recording.rows.len().min(first + of_task)
    };
    let picture = |row: usize| {
        let mut bytes = Vec::new();
        let read = recording.read_picture(row, View::Centre, &mut bytes);
        let place = recording.image_path(row, View::Centre).unwrap_or_default().display().to_string();
        (place, read.map(|()| bytes).map_err(|error| error.to_string()))
    };
    let all = Mutex::new(Vec::with_capacity(recording.rows.len()));
    let keep = |number: usize, answered: Answered| {
        for (row, answer) in rows(number).zip(answered.0) {
            tell.row(answer.as_ref().err().cloned())?;
            all.lock().unwrap_or_else(PoisonError::into_inner).extend(answer.ok().map(|answer| (row, answer)));
        }
        Ok(())
    };
    let count = recording.rows.len().div_ceil(of_task);
    let task = |number: usize| Ok(Pictures(rows(number).map(picture).collect()));
    run(&Answers(pilot.clone()), count, task, keep).ended?;
    let mut all = all.into_inner().unwrap_or_else(PoisonError::into_inner);
    all.sort_unstable_by_key(|(row, _)| *row);
    Ok(all)
}

/// Full lock is 1. Models of a steering beyond 1 exist, as labels of cars do, but hardly one beyond this.
const FAR: f32 = 2.0;

/// A warning if more than a twentieth of `steering` lies beyond twice full lock or is no number.
pub fn far_steering_notice(steering: impl Iterator<Item = f32>) -> Option<String> {
    let (mut count, mut far, mut farthest) = (0usize, 0usize, 0.0f32);
    for value in steering {
        count += 1;
        far += usize::from(value.is_nan() || value.abs() > FAR);
        farthest = farthest.max(value.abs());
    }
    (far * 20 > count).then(|| {
        format!(
            "warning: {far} of {count} answers lie beyond {FAR}, up to {farthest:.1}, where 1 is full lock: an imported model may \
             see pictures as it was not trained to (import --preprocessing, --fit), or give another unit (import --output-scale)"
        )
    })
}
