//! `steersman evaluate`: a model against recordings.

use std::collections::BTreeSet;
use std::path::PathBuf;

use clap::Args;
use rayon::prelude::*;
use serde::Serialize;
use steersman_kernels::Isa;

use super::far_outputs::notice_far_outputs;
use super::recording_args::RecordingArgs;
use super::{load_model, or_dash, pool, print_json};
use crate::dataset::held_out::trained_on_held_out;
use crate::dataset::{DrivenSessions, OutputKind, OutputSpec, Outputs, Recording, View};
use crate::error::{Error, Result};
use crate::geometry::LookAhead;
use crate::metrics::{Metrics, OutputMetrics, Prediction};
use crate::picture::decode::MAX_SIDE;
use crate::pilot::{Answer, Pilot};

/// Compare a model's steering with what was recorded: centre camera, every usable row
#[derive(Debug, Args)]
pub struct EvaluateArgs {
    /// Model file
    model: PathBuf,
    /// Recordings: folders, logs, or .zip and .tar.gz archives of them
    #[arg(required = true, value_name = "RECORDING")]
    recordings: Vec<PathBuf>,
    #[command(flatten)]
    reading: RecordingArgs,
    /// How far ahead the driven path is aimed at for the path_* measures, s
    #[arg(long, default_value_t = 0.7, value_name = "S")]
    look_ahead_s: f64,
    /// Threads; 0 is one for each core
    #[arg(long, default_value_t = 0)]
    threads: usize,
    /// Print one JSON object as the last line
    #[arg(long)]
    json: bool,
}

/// What `evaluate --json` prints.
#[derive(Serialize)]
struct Report<'a> {
    #[serde(flatten)]
    metrics: &'a Metrics,
    #[serde(flatten)]
    path: Option<PathReport>,
    /// Of models that give a throttle.
    #[serde(skip_serializing_if = "Option::is_none")]
    throttle: Option<OutputMetrics>,
    /// Of models that give a speed, mph.
    #[serde(skip_serializing_if = "Option::is_none")]
    speed_mph: Option<OutputMetrics>,
    #[serde(skip_serializing_if = "<[String]>::is_empty")]
    trained_on_held_out: &'a [String],
}

/// The same against the steering that follows the driven path; see [`crate::geometry::driven_path`].
#[derive(Serialize)]
struct PathReport {
    /// How far ahead the path is aimed at, s; never nearer than two wheelbases.
    path_look_ahead_s: f64,
    /// Rows with a path label.
    path_rows: usize,
    /// Mean absolute error, in degrees of the front wheels.
    path_mae_deg: f64,
    /// Pearson's correlation of predictions and path labels.
    path_correlation: Option<f64>,
    /// Mean squared error ÷ mean squared path label.
    path_relative_to_zero: Option<f64>,
    /// Speed that was assumed where a recording says none, m/s.
    #[serde(skip_serializing_if = "Option::is_none")]
    path_assumed_speed_mps: Option<f64>,
}

pub fn run(args: EvaluateArgs) -> Result<()> {
    let model = load_model(&args.model)?;
    let trained_on: BTreeSet<u64> = model.training_rows.iter().copied().collect();
    let held_out = model.record.trained_on_held_out.clone();
    let full_lock_deg = model.recipe.full_lock_deg;
    let pilot = Pilot::new(model, Isa::best())?;

    let pool = pool(args.threads)?;
    if !(0.0..=10.0).contains(&args.look_ahead_s) {
        return Err(Error::Usage(format!("--look-ahead-s {}: 0 to 10 s can be looked ahead", args.look_ahead_s)));
    }
    let (mut predictions, mut path_predictions, mut assumed_mps) = (Vec::new(), Vec::new(), None);
    let beside = Beside::of(&pilot.recipe().outputs);
    let mut pairs_beside = Vec::new();
    let (mut known, mut sessions_before) = (0, 0);
    for path in &args.reading.expand(args.recordings)? {
        let recording = pool.install(|| args.reading.load(path))?;
        for notice in recording.notices_for(&pilot.recipe().preprocessing) {
            eprintln!("{notice}");
        }
        known += (0..recording.rows.len()).filter(|row| trained_on.contains(&recording.row_id(*row))).count();
        recording.camera_notice().iter().for_each(|notice| eprintln!("{notice}"));
        let look_ahead = LookAhead { seconds: args.look_ahead_s, ..LookAhead::usual(&recording.geometry) };
        let driven = DrivenSessions::of(&recording, recording.geometry.clone());
        assumed_mps = assumed_mps.or(driven.assumed_speed_mps);
        let path_labels = driven.path_labels(look_ahead);
        let labels_beside = beside.as_ref().map(|beside| beside.output.recorded(&recording));
        for (row, prediction, answer) in pool.install(|| predict(&pilot, &recording, sessions_before)) {
            if let (Some(beside), Some(labels)) = (&beside, &labels_beside) {
                pairs_beside.extend(beside.pair(&answer, labels[row]));
            }
            predictions.push(prediction);
            path_predictions.extend(path_labels[row].map(|label| Prediction { label, ..prediction }));
        }
        sessions_before += recording.sessions.len();
    }
    notice_far_outputs(predictions.iter().map(|prediction| prediction.steering));
    let metrics = Metrics::of(&predictions, full_lock_deg).ok_or_else(|| Error::Data {
        place: "the recordings".into(),
        message: "no row can be used; `steersman inspect` says why".into(),
    })?;
    let path = Metrics::of(&path_predictions, full_lock_deg).map(|metrics| PathReport {
        path_look_ahead_s: args.look_ahead_s,
        path_rows: metrics.rows,
        path_mae_deg: metrics.mae_deg,
        path_correlation: metrics.correlation,
        path_relative_to_zero: metrics.relative_to_zero,
        path_assumed_speed_mps: assumed_mps,
    });
    let of_beside = OutputMetrics::of(&pairs_beside);
    if let (Some(beside), None) = (&beside, &of_beside) {
        let name = beside.output.name.name();
        eprintln!("note: no row has a {name}, so that of the model cannot be judged");
    }
    if known > 0 {
        eprintln!(
            "note: {known} of {} rows belong to the model's training split: this is no test of how well it generalises",
            metrics.rows
        );
    }
    if args.json {
        let of = |kind| of_beside.filter(|_| beside.as_ref().is_some_and(|beside| beside.output.name == kind));
        let (throttle, speed_mph) = (of(OutputKind::Throttle), of(OutputKind::Speed));
        return print_json(&Report { metrics: &metrics, path, throttle, speed_mph, trained_on_held_out: &held_out });
    }
    if !held_out.is_empty() {
        println!("note: the model was {}", trained_on_held_out(&held_out));
    }
    println!("rows                       {}", metrics.rows);
    println!("MSE                        {:.5}", metrics.mse);
    println!("MSE / predicting zero      {}", or_dash(metrics.relative_to_zero, 3));
    println!("R2                         {}", or_dash(metrics.r2, 3));
    println!("correlation                {}", or_dash(metrics.correlation, 3));
    println!("MAE                        {:.2} deg", metrics.mae_deg);
    println!("RMSE                       {:.2} deg", metrics.rmse_deg);
    println!(
        "MAE left/straight/right    {} / {} / {} deg",
        or_dash(metrics.mae_left_deg, 2),
        or_dash(metrics.mae_straight_deg, 2),
        or_dash(metrics.mae_right_deg, 2)
    );
    println!("bias                       {:+.2} deg", metrics.bias_deg);
    println!("whiteness                  {} deg/s", or_dash(metrics.whiteness_deg_s, 1));
    if let Some(path) = path {
        println!("against the driven path    {} rows, {} s ahead", path.path_rows, path.path_look_ahead_s);
        println!("  correlation              {}", or_dash(path.path_correlation, 3));
        println!("  MSE / predicting zero    {}", or_dash(path.path_relative_to_zero, 3));
        println!("  MAE                      {:.2} deg", path.path_mae_deg);
        if let Some(mps) = path.path_assumed_speed_mps {
            println!("  no speed was recorded; {mps:.1} m/s was assumed");
        }
    }
    if let (Some(beside), Some(m)) = (&beside, of_beside) {
        let (name, unit) = (beside.output.name.name(), beside.unit);
        println!("{:<27}{} rows, mean {:.3}{unit}", format!("{name} as recorded"), m.rows, m.label_mean);
        println!("  MAE                      {:.3}{unit}", m.mae);
        println!("  RMSE                     {:.3}{unit}", m.rmse);
        println!("  bias                     {:+.3}{unit}", m.bias);
        println!("  R2                       {}", or_dash(m.r2, 3));
        println!("  correlation              {}", or_dash(m.correlation, 3));
    }
    Ok(())
}

/// The output beside the steering.
struct Beside {
    output: OutputSpec,
    /// Of its unit in one of the output.
    scale: f64,
    unit: &'static str,
}

impl Beside {
    fn of(outputs: &Outputs) -> Option<Beside> {
        let output = *outputs.specs().get(1)?;
        let (scale, unit) = outputs.top_speed_mph().map_or((1.0, ""), |mph| (mph, " mph"));
        Some(Beside { output, scale, unit })
    }

    /// Prediction and label, where there is one.
    fn pair(&self, answer: &Answer, label: f32) -> Option<(f64, f64)> {
        let predicted = answer.throttle.or(answer.speed).filter(|_| !label.is_nan())?;
        Some((self.scale * f64::from(predicted), self.scale * f64::from(label)))
    }
}

/// Predictions for the centre images of all rows, each with its row and the whole answer; images that cannot be decoded are reported and left out.
fn predict(pilot: &Pilot, recording: &Recording, sessions_before: usize) -> Vec<(usize, Prediction, Answer)> {
    let session_of = |row: usize| recording.sessions.partition_point(|session| session.end <= row);
    let predict_row = |pilot: &mut Pilot, row: usize| {
        let mut bytes = Vec::new();
        let read = recording.read_picture(row, View::Centre, &mut bytes);
        let place = || recording.image_path(row, View::Centre).unwrap_or_default();
        let named = |error: Error| Error::data(place(), error.to_string());
        match read.and_then(|()| pilot.answer_encoded_within(&bytes, MAX_SIDE).map_err(named)) {
            Ok(answer) => {
                let (steering, label) = (answer.steering, recording.rows[row].steering);
                let session = sessions_before + session_of(row);
                let time_s = recording.rows[row].time_ms as f64 / 1000.0;
                Some((row, Prediction { steering, label, session, time_s }, answer))
            }
            Err(error) => {
                eprintln!("left out: {error}");
                None
            }
        }
    };
    let rows = (0..recording.rows.len()).into_par_iter();
    rows.map_init(|| pilot.clone(), predict_row).flatten().collect()
}
