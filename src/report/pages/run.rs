//! The page of a training run, `report.html`: made from the run folder and the recordings, once the run is finished.

use std::path::{Path, PathBuf};

use rayon::prelude::*;

use super::drives;
use super::html::{Figure, Page};
use super::split_view::SplitView;
use crate::dataset::held_out::trained_on_held_out;
use crate::dataset::{Item, View};
use crate::engine::network::{Network, group_digits};
use crate::error::Result;
use crate::files::atomic_file;
use crate::metrics::{Metrics, Prediction};
use crate::pilot::Pilot;
use crate::replay::{RecordingVerdict, SideVerdict};
use crate::report::charts::chart::{Axis, Chart, Mark};
use crate::report::charts::palette::{MODEL_RGB, REFERENCE_RGB};
use crate::report::charts::steering::histogram;
use crate::report::charts::steering_line::{STEERING_SCALE, draw_steering};
use crate::report::charts::{network_diagram, palette};
use crate::report::tone::Tone;
use crate::training::{Data, EpochRecord, RunFolder, RunInfo, TrainResult};

/// Worst frames shown.
const WORST: usize = 24;
/// Of frames nearer than this to a worse one, in rows, one is enough.
const APART: usize = 5;
/// Width of a bin of the error by angle, degrees.
const BIN_DEG: f64 = 2.5;
/// A wide chart.
const WIDE: [f64; 2] = [1120.0, 280.0];
/// Two charts side by side.
const HALF: [f64; 2] = [552.0, 340.0];

/// What the model says of a validation row.
struct Answer {
    item: Item,
    prediction: Prediction,
}

/// Writes `report.html` into the run folder `path`; returns its path. Call it inside a rayon pool.
///
/// # Errors
///
/// [`Error::Io`](crate::Error::Io) and [`Error::Data`](crate::Error::Data) if the folder or the recordings cannot be read.
pub fn write(path: &Path) -> Result<PathBuf> {
    let folder = RunFolder::open(path)?;
    let page = page(&folder, path, false)?;
    let path = folder.file("report.html");
    atomic_file::write(&path, page.as_bytes())?;
    Ok(path)
}

/// The page of a run that is under way, after one of its epochs. Call it inside a rayon pool.
///
/// # Errors
///
/// As [`write`](fn@write).
pub fn render_so_far(path: &Path) -> Result<String> {
    page(&RunFolder::open(path)?, path, true)
}

fn page(folder: &RunFolder, path: &Path, under_way: bool) -> Result<String> {
    let (info, recipe, history) = (folder.info()?, folder.recipe()?, folder.history()?);
    let pilot = Pilot::load(&folder.model())?;
    let data = Data::of_run(&info, &recipe, 0)?;
    let lead = format!("Recipe {}: {}", recipe.name, recipe.about);
    let mut page = Page::new(&path.display().to_string(), &lead);
    let drives = drives::read(path)?;
    if !drives.is_empty() {
        drives::describe(&mut page, &drives);
        page.section("Training");
    }
    match folder.result()? {
        Some(result) => headline(&mut page, &result, drives.is_empty()),
        None if under_way => page.advice(&so_far(history.len(), recipe.epochs), Tone::Neutral),
        None => page.advice(&unfinished(history.len(), recipe.epochs, path), Tone::Warning),
    }
    if let Some(verdict) = folder.replay()? {
        on_recording(&mut page, &verdict);
    }
    curves(&mut page, &history);
    let answers = answers(&pilot, &data);
    let predictions: Vec<Prediction> = answers.iter().map(|answer| answer.prediction).collect();
    if let Some(metrics) = Metrics::of(&predictions, recipe.full_lock_deg) {
        judgement(&mut page, &metrics, &predictions, recipe.full_lock_deg);
        worst(&mut page, &answers, &data, recipe.full_lock_deg);
    }
    page.section("Data");
    let view = SplitView::of(data.without_simulator(), data.targets(), data.split(), &recipe);
    view.describe(&mut page);
    let title = "Labels of an epoch's training images";
    page.drawings(&[histogram(title, HALF, "images", &view.training_labels)]);
    page.section("Network");
    page.drawings(&[network_diagram::figure(pilot.network(), &recipe.name)]);
    layer_table(&mut page, pilot.network());
    page.section("How to repeat it");
    environment(&mut page, &info, &history);
    page.folded("The recipe with every entry resolved", &recipe.to_toml()?);
    Ok(page.finish())
}

fn so_far(epochs: usize, of: u32) -> String {
    format!("{epochs} of {of} epochs are done; this is the best model so far.")
}

fn unfinished(epochs: usize, of: u32, path: &Path) -> String {
    let go_on = format!("steersman train --resume {}", path.display());
    format!("This run was stopped after {epochs} of {of} epochs; `{go_on}` goes on with it.")
}

/// What the training came to; `alone` if nothing was driven yet.
fn headline(page: &mut Page, result: &TrainResult, alone: bool) {
    let number = |value: Option<f64>, decimals: usize| value.map_or("-".into(), |v| format!("{v:.decimals$}"));
    if let (Some(mae_deg), Some(relative)) = (result.val_mae_deg, result.relative_to_zero) {
        let verdict = if relative < 1.0 { "better than" } else { "no better than" };
        page.advice(
            &format!(
                "On stretches it has not seen, the model of epoch {} is off by {mae_deg:.2}° of the front wheels on average: \
                 {relative:.2} of the squared error of a wheel held straight, {verdict} that.{}",
                result.best_epoch,
                if alone { " Whether it drives, only driving shows." } else { "" }
            ),
            if relative < 1.0 { Tone::Good } else { Tone::Warning },
        );
    }
    if !result.trained_on_held_out.is_empty() {
        page.advice(&format!("The model was {}.", trained_on_held_out(&result.trained_on_held_out)), Tone::Warning);
    }
    let rows = [
        ["best epoch".to_string(), format!("{} of {}", result.best_epoch, result.epochs)],
        ["validation MSE".into(), number(result.val_mse, 5)],
        ["centre camera: MSE".into(), number(result.val_center_mse, 5)],
        ["centre camera: MAE".into(), format!("{}°", number(result.val_mae_deg, 2))],
        ["training loss, last epoch".into(), format!("{:.5}", result.train_mse)],
        ["training images an epoch".into(), group_digits(result.train_images as u64)],
        ["validation images".into(), group_digits(result.val_images as u64)],
        ["time".into(), format!("{:.1} s", result.seconds)],
        ["speed".into(), format!("{:.0} images/s", result.images_per_second)],
        ["leak".into(), format!("{:.1} %", result.leak_percent)],
    ];
    let mut rows = rows.map(Vec::from).to_vec();
    if let Some(mae) = result.val_throttle_mae {
        rows.insert(4, vec!["centre camera: MAE of the throttle".into(), format!("{mae:.3}")]);
    }
    if let Some(mae) = result.val_speed_mae_mph {
        rows.insert(4, vec!["centre camera: MAE of the speed".into(), format!("{mae:.2} mph")]);
    }
    page.table(&["", ""], &rows);
}

/// What the model is worth on the recordings it was trained on.
fn on_recording(page: &mut Page, verdict: &RecordingVerdict) {
    page.subsection("On the recording");
    page.paragraph(
        "Errors of single pictures against the recorded wheel and against the steering that follows the driven path; then drives \
         on the recorded pictures, warped to where the car is, which is put back when it is more than a metre or 15 degrees from \
         the path.",
    );
    let deg = |value: Option<f64>| value.map_or("-".into(), |v| format!("{v:.2}°"));
    let ratio = |value: Option<f64>| value.map_or("-".into(), |v| format!("{v:.2}"));
    let row = |side: &SideVerdict| {
        let mut cells = vec![
            side.side.clone(),
            deg(side.wheel_mae_deg),
            ratio(side.wheel_relative_to_zero),
            deg(side.path_mae_deg),
            ratio(side.path_relative_to_zero),
        ];
        cells.extend(side.drive.as_ref().map_or([(); 4].map(|()| "-".into()), |drive| {
            [
                format!("{:.1} %", drive.autonomy_percent),
                format!("{:.1}", drive.interventions_per_km),
                format!("{:.2} m", drive.offset_mean_m),
                format!("{:.2} m", drive.offset_p95_m),
            ]
        }));
        cells
    };
    let headers = [
        "side",
        "error of the wheel",
        "squared ÷ straight wheel's",
        "error of the path's wheel",
        "squared ÷ straight wheel's",
        "autonomy",
        "put back, a km",
        "mean distance from path",
        "95 % below",
    ];
    page.table(&headers, &verdict.sides.iter().map(row).collect::<Vec<_>>());
    for note in &verdict.notes {
        page.paragraph(note);
    }
}

/// The curves over the epochs.
fn curves(page: &mut Page, history: &[EpochRecord]) {
    page.section("Learning curves");
    page.drawings(&learning_curves(history));
}

/// Loss, error in degrees, learning rate.
fn learning_curves(history: &[EpochRecord]) -> Vec<String> {
    let of = |value: fn(&EpochRecord) -> Option<f64>| -> Vec<[f64; 2]> {
        history.iter().filter_map(|record| Some([f64::from(record.epoch), value(record)?])).collect()
    };
    let epochs = || Axis::new("epoch");
    let validation = of(|record| record.val_mse);
    let mut loss = Chart::new("Loss", HALF, epochs(), Axis::new("squared error of steering").log())
        .add("training", palette::BLUE, Mark::Line(2.0), of(|record| Some(record.train_loss)))
        .add("validation", palette::VERMILION, Mark::Line(2.0), validation.clone())
        .add("centre camera", palette::ORANGE, Mark::Dashed, of(|record| record.val_center_mse));
    if let Some(best) = validation.iter().min_by(|a, b| a[1].total_cmp(&b[1])) {
        loss = loss.add("best", palette::INK, Mark::Dots(10.0), vec![*best]);
    }
    let mae = Chart::new("Mean absolute error, centre camera", HALF, epochs(), Axis::new("degrees of the wheels")).add(
        "",
        palette::VERMILION,
        Mark::Line(2.0),
        of(|record| record.val_mae_deg),
    );
    let rate = Chart::new("Learning rate at the end of the epoch", HALF, epochs(), Axis::new("learning rate")).add(
        "",
        palette::GREEN,
        Mark::Line(2.0),
        of(|record| Some(record.learning_rate)),
    );
    let relative = Chart::new("Squared error ÷ that of a wheel held straight", HALF, epochs(), Axis::new("ratio"))
        .add("", palette::BLUE, Mark::Line(2.0), of(|record| record.relative_to_zero))
        .add(
            "as bad as never steering",
            palette::INK,
            Mark::Dashed,
            history.iter().map(|r| [f64::from(r.epoch), 1.0]).collect(),
        );
    [loss, mae, relative, rate].iter().map(Chart::draw).collect()
}

/// What the model says of the centre images of the validation side, in their order; those that cannot be decoded left out.
fn answers(pilot: &Pilot, data: &Data) -> Vec<Answer> {
    let centre: Vec<Item> =
        data.split().validation.iter().copied().filter(|item| item.cameras().any(|c| c == View::Centre)).collect();
    // Sessions are counted through all recordings.
    let mut sessions_before = vec![0];
    for recording in data.recordings() {
        sessions_before.push(sessions_before[sessions_before.len() - 1] + recording.sessions.len());
    }
    let answer = |pilot: &mut Pilot, item: Item| {
        let (index, row) = (usize::from(item.recording), item.row as usize);
        let recording = &data.recordings()[index];
        let mut bytes = Vec::new();
        recording.read_picture(row, View::Centre, &mut bytes).ok()?;
        let steering = pilot.steer_encoded(&bytes).ok()?;
        let prediction = Prediction {
            steering,
            label: recording.rows[row].steering,
            session: sessions_before[index] + recording.session_of(row),
            time_s: recording.rows[row].time_ms as f64 / 1000.0,
        };
        Some(Answer { item, prediction })
    };
    centre.into_par_iter().map_init(|| pilot.clone(), answer).flatten().collect()
}

fn judgement(page: &mut Page, metrics: &Metrics, predictions: &[Prediction], full_lock_deg: f64) {
    page.section("Predicted against recorded steering");
    page.paragraph(
        "Validation side, centre camera, the model with the lowest validation error. Angles of the front wheels.",
    );
    let deg = |steering: f32| f64::from(steering) * full_lock_deg;
    let optional = |value: Option<f64>, unit: &str| value.map_or("-".into(), |v| format!("{v:.2}{unit}"));
    let rows = [
        ["frames".to_string(), metrics.rows.to_string()],
        ["mean absolute error".into(), format!("{:.2}°", metrics.mae_deg)],
        ["where the driver steers left".into(), optional(metrics.mae_left_deg, "°")],
        ["straight (within 1°)".into(), optional(metrics.mae_straight_deg, "°")],
        ["right".into(), optional(metrics.mae_right_deg, "°")],
        ["bias (+ = too far right)".into(), format!("{:+.2}°", metrics.bias_deg)],
        ["R²".into(), optional(metrics.r2, "")],
        ["change of angle from frame to frame".into(), optional(metrics.whiteness_deg_s, "°/s")],
    ];
    page.table(&["", ""], &rows.map(Vec::from));

    let points: Vec<[f64; 2]> = predictions.iter().map(|p| [deg(p.label), deg(p.steering)]).collect();
    let reach = points.iter().flatten().fold(5.0f64, |most, v| most.max(v.abs())).ceil();
    let scatter = Chart::new(
        "Each frame",
        HALF,
        Axis::new("recorded, degrees (+ = right)").range(-reach, reach),
        Axis::new("predicted, degrees").range(-reach, reach),
    )
    .add("", palette::MODEL, Mark::Dots(4.0), points)
    .add("perfect", palette::REFERENCE, Mark::Dashed, vec![[-reach, -reach], [reach, reach]]);
    let bins = error_by_angle(predictions, full_lock_deg);
    let errors = bins.iter().map(|bin| [bin.centre_deg, bin.mae_deg]).collect();
    let by_angle = Chart::new(
        "Error by angle",
        HALF,
        Axis::new("recorded, degrees (+ = right)"),
        Axis::new("mean absolute error, degrees"),
    )
    .add("model", palette::MODEL, Mark::Bars { width: BIN_DEG }, errors)
    .add(
        "a wheel held straight",
        palette::INK,
        Mark::Line(1.5),
        bins.iter().map(|b| [b.centre_deg, b.zero_mae_deg]).collect(),
    );
    page.drawings(&[scatter.draw(), by_angle.draw()]);

    // Blocks stand one after the other, a second apart.
    let (mut recorded, mut model) = (Vec::new(), Vec::new());
    let mut at_s = 0.0;
    for (i, prediction) in predictions.iter().enumerate() {
        if let Some(before) = i.checked_sub(1).map(|i| &predictions[i]) {
            let step_s = prediction.time_s - before.time_s;
            let joined = before.session == prediction.session && (0.0..1.0).contains(&step_s);
            at_s += if joined { step_s } else { 1.0 };
            if !joined {
                recorded.push([at_s, f64::NAN]);
                model.push([at_s, f64::NAN]);
            }
        }
        recorded.push([at_s, deg(prediction.label)]);
        model.push([at_s, deg(prediction.steering)]);
    }
    let chart =
        Chart::new("Over time", WIDE, Axis::new("time in the validation blocks, s"), Axis::new("degrees (+ = right)"))
            .add("recorded", palette::REFERENCE, Mark::Line(1.3), recorded)
            .add("predicted", palette::MODEL, Mark::Line(1.3), model);
    page.drawings(&[chart.draw()]);
}

/// Errors of the frames whose recorded angle lies in one range.
#[derive(Debug, PartialEq)]
struct AngleBin {
    centre_deg: f64,
    mae_deg: f64,
    /// What predicting zero would give.
    zero_mae_deg: f64,
}

/// The bins that have frames, from left to right; one is centred at 0.
fn error_by_angle(predictions: &[Prediction], full_lock_deg: f64) -> Vec<AngleBin> {
    let mut bins = std::collections::BTreeMap::<i64, (f64, f64, f64)>::new();
    for prediction in predictions {
        let label_deg = f64::from(prediction.label) * full_lock_deg;
        let error_deg = (f64::from(prediction.steering) * full_lock_deg - label_deg).abs();
        let (count, errors, labels) = bins.entry((label_deg / BIN_DEG).round() as i64).or_default();
        (*count, *errors, *labels) = (*count + 1.0, *errors + error_deg, *labels + label_deg.abs());
    }
    let bin = |(bin, (count, errors, labels)): (i64, (f64, f64, f64))| AngleBin {
        centre_deg: bin as f64 * BIN_DEG,
        mae_deg: errors / count,
        zero_mae_deg: labels / count,
    };
    bins.into_iter().map(bin).collect()
}

fn worst(page: &mut Page, answers: &[Answer], data: &Data, full_lock_deg: f64) {
    page.section("The worst frames");
    page.paragraph(&format!(
        "Validation frames with the largest errors, of frames within {APART} rows of each other only the worst. The lines show \
         recorded (blue) and predicted (orange) steering, at {STEERING_SCALE} times the angle of the wheels."
    ));
    let error = |answer: &Answer| (answer.prediction.steering - answer.prediction.label).abs();
    let mut sorted: Vec<&Answer> = answers.iter().collect();
    sorted.sort_by(|a, b| error(b).total_cmp(&error(a)).then(a.item.cmp(&b.item)));
    let mut chosen: Vec<&Answer> = Vec::new();
    for answer in sorted {
        let near = |other: &&Answer| {
            other.item.recording == answer.item.recording && other.item.row.abs_diff(answer.item.row) as usize <= APART
        };
        if chosen.len() < WORST && !chosen.iter().any(near) {
            chosen.push(answer);
        }
    }
    let figures: Vec<Figure> = chosen
        .into_iter()
        .filter_map(|Answer { item, prediction }| {
            let recording = &data.recordings()[usize::from(item.recording)];
            let row = item.row as usize;
            let mut image = recording.picture(row, View::Centre)?;
            let [recorded_deg, model_deg] =
                [prediction.label, prediction.steering].map(|s| f64::from(s) * full_lock_deg);
            draw_steering(&mut image, recorded_deg, REFERENCE_RGB);
            draw_steering(&mut image, model_deg, MODEL_RGB);
            let name = recording.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let caption = format!(
                "{name}, line {}\nrecorded {recorded_deg:+.1}°, model {model_deg:+.1}°: {:.1}° off",
                recording.rows[row].line,
                (model_deg - recorded_deg).abs()
            );
            Some(Figure { source: image.jpeg_address(), caption, pixelated: false })
        })
        .collect();
    page.figures(4, &figures);
}

fn layer_table(page: &mut Page, network: &Network) {
    let mut rows: Vec<Vec<String>> =
        vec![vec!["input".into(), String::new(), network.input().to_string(), String::new(), String::new()]];
    rows.extend(network.layers().iter().map(|layer| {
        let digits = |number: u64| if number == 0 { String::new() } else { group_digits(number) };
        vec![
            layer.name.clone(),
            layer.spec.describe(),
            layer.layer.output().to_string(),
            digits((layer.params.len() + layer.statistics.len()) as u64),
            digits(layer.layer.multiply_adds()),
        ]
    }));
    page.table(&["layer", "kind", "output", "parameters", "multiply-adds"], &rows);
    page.paragraph(&format!(
        "{} trainable parameters and {} running statistics; {} multiply-adds an image.",
        group_digits(network.count(true) as u64),
        group_digits(network.count(false) as u64),
        group_digits(network.multiply_adds())
    ));
}

fn environment(page: &mut Page, info: &RunInfo, history: &[EpochRecord]) {
    let cores = std::thread::available_parallelism().map_or("-".into(), |n| n.to_string());
    let rows = [
        ["version".to_string(), format!("steersman {}", info.version)],
        ["vector code".into(), info.isa.clone()],
        ["convolution algorithm".into(), info.algorithm.clone().unwrap_or_else(|| "auto".into())],
        ["seed".into(), info.seed.to_string()],
        ["recordings".into(), info.trained_on().join(", ")],
        ["hash of the rows".into(), info.rows_hash.clone()],
        [
            "this page was written on".into(),
            format!("{}, {}, {cores} cores", std::env::consts::OS, std::env::consts::ARCH),
        ],
    ];
    page.table(&["", ""], &rows.map(Vec::from));
    page.subsection("Times");
    let epoch = |record: &EpochRecord| {
        vec![
            record.epoch.to_string(),
            format!("{:.1} s", record.train_seconds),
            format!("{:.1} s", record.seconds),
            format!("{:.0}", record.images as f64 / record.train_seconds.max(1e-9)),
            format!("{:.5}", record.train_loss),
            record.val_mse.map_or("-".into(), |mse| format!("{mse:.5}")),
            record.val_mae_deg.map_or("-".into(), |mae| format!("{mae:.2}")),
        ]
    };
    let headers =
        ["epoch", "training", "with validation", "images/s", "training loss", "validation MSE", "MAE, degrees"];
    page.table(&headers, &history.iter().map(epoch).collect::<Vec<_>>());
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_are_averaged_by_the_recorded_angle() {
        let prediction = |label: f32, steering: f32| Prediction { steering, label, session: 0, time_s: 0.0 };
        // Labels of 0, 1, 10 and 11 degrees; errors of 2, 1, 5 and 1 degrees.
        let predictions = [prediction(0.0, 0.08), prediction(0.04, 0.0), prediction(0.4, 0.2), prediction(0.44, 0.48)];
        let bins = error_by_angle(&predictions, 25.0);
        let near = |a: f64, b: f64| (a - b).abs() < 1e-5;
        assert_eq!(bins.iter().map(|bin| bin.centre_deg).collect::<Vec<_>>(), [0.0, 10.0]);
        assert!(near(bins[0].mae_deg, 1.5) && near(bins[0].zero_mae_deg, 0.5), "{bins:?}");
        assert!(near(bins[1].mae_deg, 3.0) && near(bins[1].zero_mae_deg, 10.5), "{bins:?}");
    }
}
