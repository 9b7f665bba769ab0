//! Does driving on a recording tell how well a model drives? Models of all qualities drive in the simulator and on recordings of
//! the same tracks, and the orders that come of it are compared.

use std::ops::Range;
use std::path::Path;

use rand::Rng;
use serde::Serialize;
use steersman_kernels::Isa;

use super::job::{JobEvent, test_on_tracks};
use crate::dataset::{self, Correction, Recording};
use crate::engine::random::{Purpose, rng, unit};
use crate::error::{Error, Result};
use crate::files::atomic_file;
use crate::model_file::Model;
use crate::observer::{Observer, StopSignal};
use crate::picture::RgbImage;
use crate::pilot::Pilot;
use crate::recipe::Recipe;
use crate::replay::{Side, judge};
use crate::report::charts::chart::{Axis, Chart, Mark};
use crate::report::charts::palette;
use crate::report::pages::html::Page;
use crate::simulator::{DriveOptions, RecordOptions, RecordRequest, Track, record_all};
use crate::statistics::rank_correlation;
use crate::training::{self, TrainRequest};

/// Seed of the first recording to train on, and of the first to test on.
const SEEDS: [u64; 2] = [501, 601];

/// From one time to the next of the whole list, all seeds grow by this.
const SEED_STEP: u64 = 10;
/// Models of one time.
const MODELS: usize = 23;

/// How a model of the experiment is made.
#[derive(Clone, Debug, PartialEq)]
pub enum Origin {
    /// By training.
    Trained {
        /// Name of a shipped recipe.
        recipe: &'static str,
        /// Epochs.
        epochs: u32,
        /// Seed.
        seed: u64,
        /// Share of the training recordings' laps that it sees.
        share: Share,
    },
    /// By noise on the weights of one of the models before it.
    Spoilt {
        /// Number of that model.
        of: usize,
        /// Standard deviation of the noise ÷ root mean square of the tensor's weights.
        noise: f64,
    },
}

/// How much a model is trained on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Share {
    /// A lap of each track.
    Lap,
    /// A tenth of a lap.
    Tenth,
}

/// What is compared.
#[derive(Clone, Debug)]
pub struct ReplayPlan {
    /// The models.
    pub models: Vec<Origin>,
    /// Tracks that are recorded, trained on and driven.
    pub tracks: Vec<String>,
    /// Laps of the recordings that are trained on, and of those that are driven on; one in each direction.
    pub laps: [f64; 2],
    /// Runs in the simulator on each track, of one lap.
    pub runs: usize,
    /// Memory for decoded images in MiB.
    pub cache_mib: usize,
}

/// The models of the whole experiment: trained ones of four recipes, long and short, on much and on little, and two good ones
/// that are spoilt more and more. All of it `seeds` times, each time with other seeds.
pub fn models(seeds: u64) -> Vec<Origin> {
    (0..seeds).flat_map(|number| models_of(SEED_STEP * number, MODELS * number as usize)).collect()
}

/// The models of one time: with `seed` more than the first time, spoilt ones of those that stand from number `first` on.
fn models_of(seed: u64, first: usize) -> Vec<Origin> {
    let trained = |recipe, epochs, of_model, share| Origin::Trained { recipe, epochs, seed: seed + of_model, share };
    let mut models = vec![
        trained("default", 4, 1, Share::Lap),
        trained("lenet", 6, 1, Share::Lap),
        trained("lenet", 1, 1, Share::Lap),
        trained("lenet", 2, 1, Share::Lap),
        trained("lenet", 3, 2, Share::Lap),
        trained("lenet", 8, 3, Share::Tenth),
        trained("pilotnet", 1, 1, Share::Lap),
        trained("pilotnet", 2, 1, Share::Lap),
        trained("hyper", 1, 1, Share::Lap),
        trained("hyper", 2, 2, Share::Lap),
        trained("default", 1, 1, Share::Lap),
        trained("default", 2, 2, Share::Lap),
        trained("default", 6, 1, Share::Tenth),
    ];
    models.extend([0.1, 0.2, 0.3, 0.45, 0.6].map(|noise| Origin::Spoilt { of: first, noise }));
    models.extend([0.02, 0.04, 0.06, 0.08, 0.12].map(|noise| Origin::Spoilt { of: first + 1, noise }));
    models
}

/// Shares of full lock by which a side camera and a pixel of shift change the expert's own labels, which lead to the point 6.13 m ahead of
/// the rear axle: `atan(2.87 m * 2 * x / (6.13 m)^2)` of 25 deg, where `x` is 0.81 m for a camera and 3.5 m / 138.6 for a pixel.
const SIDE_CAMERAS: f64 = 0.28;
const SHIFT_STEERING_PER_PX: f64 = 0.009;

/// The shipped recipe `name` for labels that are what the expert drives, as the path of these recordings is judged.
fn for_driven_labels(name: &str, epochs: u32) -> Result<Recipe> {
    let mut recipe = Recipe::find(name, &[format!("epochs={epochs}")])?;
    if recipe.labels.expert_ahead_m.take().is_some() {
        recipe.samples.side_cameras = Some(Correction::Fixed(SIDE_CAMERAS));
        recipe.augmentation.shift_steering_per_px = Some(Correction::Fixed(SHIFT_STEERING_PER_PX));
    }
    Ok(recipe)
}

impl Origin {
    /// In words.
    fn name(&self, all: &[Origin]) -> String {
        match self {
            Origin::Trained { recipe, epochs, seed, share } => {
                let share = if *share == Share::Lap { "" } else { ", a tenth of a lap" };
                format!("{recipe}, epochs {epochs}, seed {seed}{share}")
            }
            Origin::Spoilt { of, noise } => format!("{}, noise {noise}", all[*of].name(all)),
        }
    }
}

/// A model on a track; a line of the CSV.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ReplayRow {
    /// The model.
    pub model: String,
    /// The track.
    pub track: String,
    /// In the simulator: share of the time in which nobody had to help, %.
    pub autonomy_percent: f64,
    /// Times the car was put back, a km.
    pub interventions_per_km: f64,
    /// The same on recordings of the track.
    pub replay_autonomy_percent: f64,
    /// Times the car was put back there, a km.
    pub replay_interventions_per_km: f64,
    /// Mean distance from the driven path there, m.
    pub replay_offset_mean_m: f64,
    /// Squared error on the rows of these recordings ÷ that of a wheel held straight: the validation error.
    pub wheel_relative_to_zero: f64,
    /// The same against the steering that follows the driven path.
    pub path_relative_to_zero: f64,
}

/// What happens in the experiment.
#[derive(Clone, Debug, PartialEq)]
pub enum ReplayExperimentEvent {
    /// Something happens in the training or the drives of a model.
    Job(JobEvent),
    /// A model has driven on a track.
    Row(ReplayRow),
}

/// Spearman's rank correlations with the autonomy in the simulator.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct RankCorrelations {
    /// Models times tracks.
    pub rows: usize,
    /// Of the autonomy on recordings.
    pub replay_autonomy: f64,
    /// Of the interventions a km there, with the sign changed.
    pub replay_interventions: f64,
    /// Of the validation error, with the sign changed.
    pub validation_error: f64,
    /// Of the error against the path, with the sign changed.
    pub path_error: f64,
}

impl RankCorrelations {
    /// Those of `rows`; `None` if fewer than three, or all equal.
    pub fn of(rows: &[ReplayRow]) -> Option<RankCorrelations> {
        let column = |of: fn(&ReplayRow) -> f64| -> Vec<f64> { rows.iter().map(of).collect() };
        let driven = column(|row| row.autonomy_percent);
        let with = |of: fn(&ReplayRow) -> f64| rank_correlation(&column(of), &driven);
        (rows.len() >= 3).then_some(())?;
        Some(RankCorrelations {
            rows: rows.len(),
            replay_autonomy: with(|row| row.replay_autonomy_percent)?,
            replay_interventions: with(|row| -row.replay_interventions_per_km)?,
            validation_error: with(|row| -row.wheel_relative_to_zero)?,
            path_error: with(|row| -row.path_relative_to_zero)?,
        })
    }
}

/// Makes and drives every model of `plan`. Call it inside a rayon pool; recordings and models are kept in a temporary folder only.
///
/// # Errors
///
/// As [`training::train`], [`judge`] and [`test_on_tracks`]; [`Error::Interrupted`] if `stop` is requested.
pub fn run(
    plan: &ReplayPlan,
    observer: &mut (dyn Observer<ReplayExperimentEvent> + Send),
    stop: &StopSignal,
) -> Result<Vec<ReplayRow>> {
    let scratch = tempfile::tempdir().map_err(Error::io(std::env::temp_dir()))?;
    let folder = scratch.path();
    let tracks: Vec<Track> = plan.tracks.iter().map(|name| Track::load(name)).collect::<Result<_>>()?;
    let mut requests = Vec::new();
    for (number, track) in tracks.iter().enumerate() {
        for (what, first_seed, laps) in
            [("lap", SEEDS[0], plan.laps[0]), ("tenth", SEEDS[0], 0.1 * plan.laps[0]), ("test", SEEDS[1], plan.laps[1])]
        {
            for reverse in [false, true] {
                let seed = first_seed + 2 * number as u64 + u64::from(reverse);
                let options = RecordOptions { laps, reverse, seed, ..RecordOptions::default() };
                requests.push(RecordRequest { track, options, out: folder.join(format!("{what}-{number}-{reverse}")) });
            }
        }
    }
    record_all(&requests, &mut |_| stop.check())?;
    let mut tested = Vec::new();
    let mut trained = [Vec::new(), Vec::new()];
    for of_track in requests.chunks_exact(6) {
        let outs = |part: Range<usize>| of_track[part].iter().map(|request| request.out.clone());
        trained[0].extend(outs(0..2));
        trained[1].extend(outs(2..4));
        tested.push(outs(4..6).map(|path| dataset::load(&path)).collect::<Result<Vec<Recording>>>()?);
    }
    let mut made: Vec<Model> = Vec::new();
    let mut rows = Vec::new();
    for (number, origin) in plan.models.iter().enumerate() {
        let name = origin.name(&plan.models);
        observer.observe(ReplayExperimentEvent::Job(JobEvent::Notice(name.clone())))?;
        let mut of_job = |event| observer.observe(ReplayExperimentEvent::Job(event));
        let model = match origin {
            Origin::Trained { recipe, epochs, seed, share } => {
                let recordings = trained[usize::from(*share == Share::Tenth)].clone();
                let recipe = for_driven_labels(recipe, *epochs)?;
                let request = TrainRequest::new(recordings, recipe, folder.join(format!("run-{number}")));
                let request = TrainRequest { seed: *seed, cache_mib: plan.cache_mib, ..request };
                let result = training::train(request, &mut |event| of_job(JobEvent::Training(event)), stop)?;
                Model::load(&result.model)?
            }
            Origin::Spoilt { of, noise } => spoilt(&made[*of], *noise, number as u64)?,
        };
        let pilot = Pilot::new(model.clone(), Isa::best())?;
        made.push(model);
        let options = DriveOptions { runs: plan.runs, ..Default::default() };
        let drives = test_on_tracks(&pilot, &plan.tracks, &options, None, &mut of_job, stop)?;
        for (drive, recordings) in drives.iter().zip(&tested) {
            stop.check()?;
            let all_rows = recordings.iter().enumerate().flat_map(|(i, r)| (0..r.rows.len()).map(move |row| (i, row)));
            let side = Side { name: "validation", rows: all_rows.collect() };
            let new_driver = || {
                let mut pilot = pilot.clone();
                Ok(move |picture: &RgbImage| pilot.steer(picture.view()))
            };
            let mut verdict = judge(recordings, &[side], pilot.recipe().full_lock_deg, new_driver, stop)?;
            let side = verdict.sides.remove(0);
            let (Some(replay), Some(wheel), Some(path)) =
                (side.drive, side.wheel_relative_to_zero, side.path_relative_to_zero)
            else {
                return Err(Error::Data { place: drive.drive.track.clone(), message: verdict.notes.join("; ") });
            };
            let row = ReplayRow {
                model: name.clone(),
                track: drive.drive.track.clone(),
                autonomy_percent: drive.drive.autonomy_percent,
                interventions_per_km: drive.drive.interventions_per_km,
                replay_autonomy_percent: replay.autonomy_percent,
                replay_interventions_per_km: replay.interventions_per_km,
                replay_offset_mean_m: replay.offset_mean_m,
                wheel_relative_to_zero: wheel,
                path_relative_to_zero: path,
            };
            observer.observe(ReplayExperimentEvent::Row(row.clone()))?;
            rows.push(row);
        }
    }
    Ok(rows)
}

/// `model` with normal noise on all weights that are trained, but for biases and what batch normalisation scales by.
fn spoilt(model: &Model, noise: f64, seed: u64) -> Result<Model> {
    let mut model = model.clone();
    let network = model.recipe.network(Isa::PORTABLE)?;
    for (number, tensor) in network.tensors().iter().enumerate().filter(|(_, tensor)| tensor.spec.shape.len() > 1) {
        let values = model.parameters.tensor_mut(tensor);
        let square: f64 = values.iter().map(|v| f64::from(*v).powi(2)).sum();
        let scale = noise * (square / values.len().max(1) as f64).sqrt();
        let mut rng = rng(seed, Purpose::Test, 0, number as u64);
        values.iter_mut().for_each(|value| *value += (scale * normal(&mut rng)) as f32);
    }
    Ok(model)
}

/// A standard normal number (Box and Muller).
fn normal(rng: &mut impl Rng) -> f64 {
    let (radius, angle) = (1.0 - unit(rng), std::f64::consts::TAU * unit(rng));
    (-2.0 * libm::log(radius)).sqrt() * libm::cos(angle)
}

/// Writes `rows` as CSV, in whole or not at all.
///
/// # Errors
///
/// [`Error::Io`].
pub fn write_csv(path: &Path, rows: &[ReplayRow]) -> Result<()> {
    let failed = |e: csv::Error| Error::data(path, e.to_string());
    let mut writer = csv::Writer::from_writer(Vec::new());
    rows.iter().try_for_each(|row| writer.serialize(row)).map_err(failed)?;
    let bytes = writer.into_inner().map_err(|e| Error::data(path, e.to_string()))?;
    atomic_file::write(path, &bytes)
}

/// A page with both scatter plots: what the recording and what the validation error promise, against the autonomy in the simulator.
///
/// # Errors
///
/// [`Error::Io`].
pub fn write_page(path: &Path, rows: &[ReplayRow]) -> Result<()> {
    let mut page = Page::new(
        "Does driving on a recording tell how well a model drives?",
        "Each dot is a model on a track: in the simulator (upwards) and on recordings of the same track (to the right).",
    );
    if let Some(all) = RankCorrelations::of(rows) {
        page.paragraph(&format!(
            "Rank correlation with the autonomy in the simulator over {} models: {:.2} of the autonomy on recordings, {:.2} of the \
             validation error, {:.2} of the error against the driven path.",
            all.rows, all.replay_autonomy, all.validation_error, all.path_error
        ));
    }
    let size = [552.0, 380.0];
    let driven = || Axis::new("autonomy in the simulator, %").range(0.0, 100.0);
    let points = |of: fn(&ReplayRow) -> f64| rows.iter().map(|row| [of(row), row.autonomy_percent]).collect();
    let replay = Chart::new("Autonomy", size, Axis::new("autonomy on recordings, %").range(0.0, 100.0), driven())
        .add("", palette::BLUE, Mark::Dots(8.0), points(|row| row.replay_autonomy_percent))
        .add("the same", palette::INK, Mark::Dashed, vec![[0.0, 0.0], [100.0, 100.0]]);
    let error = Chart::new("Validation error", size, Axis::new("squared error ÷ straight wheel's").log(), driven())
        .add("", palette::VERMILION, Mark::Dots(8.0), points(|row| row.wheel_relative_to_zero));
    page.drawings(&[replay.draw(), error.draw()]);
    let cells = |row: &ReplayRow| {
        vec![
            row.model.clone(),
            row.track.clone(),
            format!("{:.1} %", row.autonomy_percent),
            format!("{:.1} %", row.replay_autonomy_percent),
            format!("{:.2} m", row.replay_offset_mean_m),
            format!("{:.2}", row.wheel_relative_to_zero),
            format!("{:.2}", row.path_relative_to_zero),
        ]
    };
    let headers = [
        "model",
        "track",
        "autonomy, simulator",
        "autonomy, recordings",
        "mean distance from path",
        "error ÷ straight wheel's",
        "path error ÷ straight wheel's",
    ];
    page.table(&headers, &rows.iter().map(cells).collect::<Vec<_>>());
    atomic_file::write(path, page.finish().as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(autonomy_percent: f64, replay_autonomy_percent: f64, wheel_relative_to_zero: f64) -> ReplayRow {
        ReplayRow {
            model: "a, noise 0.1".into(),
            track: "lake".into(),
            autonomy_percent,
            interventions_per_km: 100.0 - autonomy_percent,
            replay_autonomy_percent,
            replay_interventions_per_km: 100.0 - replay_autonomy_percent,
            replay_offset_mean_m: 0.2,
            wheel_relative_to_zero,
            path_relative_to_zero: wheel_relative_to_zero,
        }
    }

    #[test]
    fn an_order_that_agrees_correlates_and_a_small_error_counts_as_good() {
        // The recording orders as the simulator does, the error puts the best model last.
        let rows = [row(0.0, 10.0, 2.0), row(50.0, 30.0, 1.0), row(90.0, 80.0, 0.9), row(100.0, 90.0, 3.0)];
        let found = RankCorrelations::of(&rows).unwrap();
        assert_eq!((found.rows, found.replay_autonomy, found.replay_interventions), (4, 1.0, 1.0));
        // Ranks of the negated errors: 2, 3, 4, 1 against 1, 2, 3, 4.
        assert!((found.validation_error + 0.2).abs() < 1e-12, "{found:?}");
        assert_eq!(RankCorrelations::of(&rows[..2]), None);
        assert_eq!(RankCorrelations::of(&[row(1.0, 5.0, 1.0), row(2.0, 5.0, 2.0), row(3.0, 5.0, 3.0)]), None);
    }

    #[test]
    fn recipes_with_labels_from_farther_ahead_take_those_that_were_driven() {
        let found = for_driven_labels("default", 3).unwrap();
        assert_eq!((found.epochs, found.labels.expert_ahead_m), (3, None));
        let corrections = [found.samples.side_cameras, found.augmentation.shift_steering_per_px];
        assert_eq!(corrections, [0.28, 0.009].map(|steering| Some(Correction::Fixed(steering))));
        assert_eq!(for_driven_labels("lenet", 2).unwrap(), Recipe::find("lenet", &["epochs=2".into()]).unwrap());
    }

    #[test]
    fn noise_has_the_size_that_was_asked_for_and_leaves_biases_alone() {
        let recipe = Recipe::find("lenet", &[]).unwrap();
        let network = recipe.network(Isa::PORTABLE).unwrap();
        let parameters = network.initialize(1);
        let model = Model { recipe, parameters, record: Default::default(), training_rows: Vec::new() };
        let noisy = spoilt(&model, 0.5, 3).unwrap();
        for tensor in network.tensors() {
            let (before, after) = (model.parameters.tensor(tensor), noisy.parameters.tensor(tensor));
            let square = |values: &mut dyn Iterator<Item = f32>| values.map(|v| f64::from(v).powi(2)).sum::<f64>();
            let noise = square(&mut before.iter().zip(after).map(|(a, b)| b - a));
            if tensor.spec.shape.len() == 1 {
                assert_eq!(noise, 0.0, "{}", tensor.name);
            } else {
                let relative = (noise / square(&mut before.iter().copied())).sqrt();
                assert!((relative - 0.5).abs() < 0.1, "{}: {relative}", tensor.name);
            }
        }
    }

    #[test]
    fn there_are_at_least_twenty_models_and_their_names_differ() {
        let models = models(3);
        let mut names: Vec<String> = models.iter().map(|origin| origin.name(&models)).collect();
        names.sort();
        names.dedup();
        assert!(models.len() == 3 * MODELS && names.len() == models.len());
        // A spoilt model is one of the same time.
        for (number, model) in models.iter().enumerate() {
            let Origin::Spoilt { of, .. } = model else { continue };
            assert!(*of < number && of / MODELS == number / MODELS, "{number}");
            assert!(matches!(models[*of], Origin::Trained { .. }));
        }
    }
}
