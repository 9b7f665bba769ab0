//! `steersman evaluate`: a model against recordings.

use std::path::PathBuf;

use clap::Args;
use steersman_kernels::Isa;

use super::arguments::{RecordingArgs, load_model};
use super::process::pool;
use super::terminal::{or_dash, print_json};
use crate::dataset::held_out::trained_on_held_out;
use crate::error::Result;
use crate::evaluation::{EvaluateRequest, EvaluationEvent, LOOK_AHEAD_S, evaluate};
use crate::pilot::Pilot;

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
    #[arg(long, default_value_t = LOOK_AHEAD_S, value_name = "S")]
    look_ahead_s: f64,
    /// Threads; 0 is one for each core
    #[arg(long, default_value_t = 0)]
    threads: usize,
    /// Print one JSON object as the last line
    #[arg(long)]
    json: bool,
}

pub fn run(args: EvaluateArgs) -> Result<()> {
    let model = load_model(&args.model)?;
    let training_rows = model.training_rows.clone();
    let pilot = Pilot::new(model, Isa::best())?;
    let pool = pool(args.threads)?;
    let recordings = args.reading.expand(args.recordings)?;
    let request = EvaluateRequest {
        recordings: &recordings,
        said: &args.reading.said(),
        look_ahead_s: args.look_ahead_s,
        training_rows: &training_rows,
    };
    let mut observer = |event| {
        if let EvaluationEvent::Notice(notice) = event {
            eprintln!("{notice}");
        }
        Ok(())
    };
    let evaluation = pool.install(|| evaluate(&pilot, &request, &mut observer))?;
    evaluation.notes.iter().for_each(|note| eprintln!("note: {note}"));
    if args.json {
        return print_json(&evaluation);
    }
    if !evaluation.trained_on_held_out.is_empty() {
        println!("note: the model was {}", trained_on_held_out(&evaluation.trained_on_held_out));
    }
    let metrics = &evaluation.metrics;
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
    if let Some(path) = &evaluation.path {
        println!("against the driven path    {} rows, {} s ahead", path.path_rows, path.path_look_ahead_s);
        println!("  correlation              {}", or_dash(path.path_correlation, 3));
        println!("  MSE / predicting zero    {}", or_dash(path.path_relative_to_zero, 3));
        println!("  MAE                      {:.2} deg", path.path_mae_deg);
        if let Some(mps) = path.path_assumed_speed_mps {
            println!("  no speed was recorded; {mps:.1} m/s was assumed");
        }
    }
    let beside = [("throttle", "", evaluation.throttle), ("speed", " mph", evaluation.speed_mph)];
    for (name, unit, m) in beside.into_iter().filter_map(|(name, unit, metrics)| Some((name, unit, metrics?))) {
        println!("{:<27}{} rows, mean {:.3}{unit}", format!("{name} as recorded"), m.rows, m.label_mean);
        println!("  MAE                      {:.3}{unit}", m.mae);
        println!("  RMSE                     {:.3}{unit}", m.rmse);
        println!("  bias                     {:+.3}{unit}", m.bias);
        println!("  R2                       {}", or_dash(m.r2, 3));
        println!("  correlation              {}", or_dash(m.correlation, 3));
    }
    Ok(())
}
