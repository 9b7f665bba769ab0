//! Experiments, closed-loop: the two of the write-ups (what a number promises beside what the road delivers), and what makes the wheel
//! calm.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde_json::Value;

use super::job::{JobEvent, observed, test_on_tracks};
use super::{TrackResult, training_set};
use crate::dataset::augment::Augmentation;
use crate::dataset::colour::Colour;
use crate::dataset::split::SplitMode;
use crate::dataset::{Description, LabelKind, LabelSpec};
use crate::engine::layers::{BlurSpec, EluSpec, ReluSpec};
use crate::engine::loss::Smoothness;
use crate::engine::network::LayerSpec;
use crate::engine::optimizer::AveragingSpec;
use crate::error::{Error, Result};
use crate::files::atomic_file;
use crate::observer::{Observer, StopSignal};
use crate::pilot::Pilot;
use crate::recipe::Recipe;
use crate::simulator::car::expert::Style;
use crate::simulator::{DriveOptions, RecordOptions, RecordRequest, Track, record_all};
use crate::training::{self, TrainRequest};

/// The setting that an experiment varies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Subject {
    /// How validation rows are chosen: by blocks of time, single rows, single images.
    Split,
    /// The colours that the network sees: RGB, YUV, HSV, the saturation alone, grey.
    Colour,
    /// What labels are: the recorded wheel, or the steering that follows the driven path, with look-aheads of 0.7, 1.0 and 1.3 s.
    Labels,
    /// What makes the wheel calm: the recipe with none of them, larger batches, averaged weights, noise in the pictures, each term of
    /// smoothness, blur before each stride, ELU in place of ReLU, the last two and noise, all of them but the larger batches.
    Smooth,
}

/// Factor of the larger batches, decay of the averaged weights, amplitudes of the noise of pixels and blocks in grey levels, and weights
/// of the smoothness terms, of [`Subject::Smooth`].
const LARGER: usize = 4;
const DECAY: f64 = 0.998;
const NOISE: [f64; 2] = [48.0, 16.0];
const TERM: f64 = 2.0;

/// Seed of the first drive of [`keyboard_drives`]; far from those of the training set and of drives.
const KEYBOARD_SEED: u64 = 701;

impl Subject {
    /// The recipes to compare, each with its name, made from `base`.
    fn variants(self, base: &Recipe) -> Vec<(&'static str, Recipe)> {
        match self {
            Subject::Split => [SplitMode::Blocks, SplitMode::Random, SplitMode::RandomImages]
                .map(|mode| {
                    let mut recipe = base.clone();
                    recipe.split.mode = mode;
                    (mode.name(), recipe)
                })
                .to_vec(),
            Subject::Colour => [
                ("rgb", Colour::Rgb),
                ("yuv", Colour::Yuv),
                ("hsv", Colour::Hsv),
                ("saturation", Colour::Saturation),
                ("gray", Colour::Gray),
            ]
            .map(|(name, colour)| {
                let mut recipe = base.clone();
                recipe.preprocessing.colour = colour;
                (name, recipe)
            })
            .to_vec(),
            Subject::Labels => {
                let labels = |kind, look_ahead_s| LabelSpec { kind, look_ahead_s, ..base.labels };
                [
                    ("wheel", labels(LabelKind::Wheel, base.labels.look_ahead_s)),
                    ("path 0.7 s", labels(LabelKind::Path, 0.7)),
                    ("path 1.0 s", labels(LabelKind::Path, 1.0)),
                    ("path 1.3 s", labels(LabelKind::Path, 1.3)),
                ]
                .map(|(name, labels)| (name, Recipe { labels, ..base.clone() }))
                .to_vec()
            }
            Subject::Smooth => {
                let with_noise = |[pixel_noise, block_noise]: [f64; 2]| Augmentation {
                    pixel_noise,
                    block_noise,
                    ..base.augmentation.clone()
                };
                let none = with_relu(&unblurred(&base.layers));
                let plain = || Recipe {
                    averaging: None,
                    smoothness: None,
                    augmentation: with_noise([0.0; 2]),
                    layers: none.clone(),
                    ..base.clone()
                };
                let augmentation = with_noise(NOISE);
                let averaging = Some(AveragingSpec::Ema { decay: DECAY, from_share: 0.0, refit_batches: 0 });
                let terms = |spatial, temporal| Some(Smoothness { spatial, temporal, ..Smoothness::default() });
                let layers = blurred(&with_elu(&none));
                vec![
                    ("plain", plain()),
                    ("larger batches", Recipe { batch: LARGER * base.batch, ..plain() }),
                    ("averaged", Recipe { averaging, ..plain() }),
                    ("noise", Recipe { augmentation: augmentation.clone(), ..plain() }),
                    ("spatial", Recipe { smoothness: terms(TERM, 0.0), ..plain() }),
                    ("temporal", Recipe { smoothness: terms(0.0, TERM), ..plain() }),
                    ("blur", Recipe { layers: blurred(&none), ..plain() }),
                    ("elu", Recipe { layers: with_elu(&none), ..plain() }),
                    (
                        "blur+noise+elu",
                        Recipe { layers: layers.clone(), augmentation: augmentation.clone(), ..plain() },
                    ),
                    ("together", Recipe { averaging, augmentation, smoothness: terms(TERM, TERM), layers, ..plain() }),
                ]
            }
        }
    }
}

/// `layers` with a blur of 3x3 before each convolution with a stride. Zeros around it keep the shapes.
fn blurred(layers: &[LayerSpec]) -> Vec<LayerSpec> {
    let mut blurred = Vec::new();
    for layer in layers {
        if matches!(layer, LayerSpec::Conv2d(conv) if conv.stride != [1, 1]) {
            blurred.push(LayerSpec::Blur(BlurSpec { window: [3, 3], stride: [1, 1], padding: [1, 1] }));
        }
        blurred.push(layer.clone());
    }
    blurred
}

/// `layers` without their blurs, those of a recipe of one's own included.
fn unblurred(layers: &[LayerSpec]) -> Vec<LayerSpec> {
    layers.iter().filter(|layer| !matches!(layer, LayerSpec::Blur(_))).cloned().collect()
}

/// `layers` with ELU in place of ReLU, but for those behind a batch normalisation, with which ReLU is computed in one pass.
fn with_elu(layers: &[LayerSpec]) -> Vec<LayerSpec> {
    let mut changed = layers.to_vec();
    for (layer, before) in changed.iter_mut().skip(1).zip(layers) {
        if matches!((&*layer, before), (LayerSpec::Relu(_), before) if !matches!(before, LayerSpec::BatchNorm(_))) {
            *layer = LayerSpec::Elu(EluSpec { alpha: 1.0 });
        }
    }
    changed
}

/// `layers` with ReLU in place of ELU.
fn with_relu(layers: &[LayerSpec]) -> Vec<LayerSpec> {
    let relu = |layer: &LayerSpec| match layer {
        LayerSpec::Elu(_) => LayerSpec::Relu(ReluSpec {}),
        other => other.clone(),
    };
    layers.iter().map(relu).collect()
}

/// An experiment.
#[derive(Clone, Debug)]
pub struct ExperimentPlan {
    /// The setting that is varied.
    pub subject: Subject,
    /// What stays the same.
    pub recipe: Recipe,
    /// Each variant is trained with the seeds 1, 2, … up to this one.
    pub seeds: u64,
    /// Recordings that are trained on.
    pub recordings: Vec<PathBuf>,
    /// What the user says about them.
    pub said: Description,
    /// Tracks that are driven.
    pub tracks: Vec<String>,
    /// Runs on each track, of one lap.
    pub runs: usize,
    /// Memory for decoded images in MiB.
    pub cache_mib: usize,
}

/// One training and its drives; a line of the CSV.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ExperimentRow {
    /// What was varied: a split mode or a colour space.
    pub variant: String,
    /// Seed of split, weights and order.
    pub seed: u64,
    /// Share of the validation frames with a training frame of the same session within a second, %.
    pub leak_percent: f64,
    /// Promised: mean squared error of the centre camera on the validation side.
    pub val_center_mse: Option<f64>,
    /// Promised: mean absolute error there, in degrees of the front wheels.
    pub val_mae_deg: Option<f64>,
    /// Delivered: mean absolute error on fresh frames of the tracks that are driven, in degrees of the front wheels.
    pub fresh_mae_deg: f64,
    /// Laps completed without help, over all tracks.
    pub laps_completed: usize,
    /// Laps asked for.
    pub laps_total: usize,
    /// Mean over the tracks of the share of the time in which nobody had to help, %.
    pub autonomy_percent: f64,
    /// Mean over the tracks of the distance from the line, m.
    pub cte_mean_m: f64,
    /// Mean over the tracks of the whiteness, deg/s.
    pub whiteness_deg_s: f64,
    /// The same for the expert.
    pub expert_whiteness_deg_s: f64,
    /// The largest whiteness on a track, deg/s.
    pub worst_whiteness_deg_s: f64,
    /// Mean over the tracks of the wheel reversals a minute.
    pub reversals_per_min: f64,
    /// Mean over the tracks of the 95th percentile of the angle's change a frame, deg.
    pub angle_change_p95_deg: f64,
    /// Mean over the tracks of the lateral jerk, m/s³.
    pub lateral_jerk_rms_mps3: f64,
    /// Held-out tracks that were trained on all the same.
    pub trained_on_held_out: Vec<String>,
}

/// What happens in an experiment.
#[derive(Clone, Debug, PartialEq)]
pub enum ExperimentEvent {
    /// Something happens in the training or the drives of a trial.
    Job(JobEvent),
    /// A trial is done.
    Row(ExperimentRow),
}

/// Recordings of the main job's set that an experiment trains on: both training tracks, and of the random tracks as many
/// as `random_tracks`.
pub fn takes(random_tracks: usize) -> Vec<training_set::Take> {
    let mut numbers = BTreeMap::new();
    let mut takes = training_set::takes();
    takes.retain(|take| {
        let known = numbers.len();
        !take.track.starts_with("random:") || *numbers.entry(take.track.clone()).or_insert(known) < random_tracks
    });
    takes
}

/// Records what [`Subject::Labels`] trains on under `folder`: a lap of `lake` in each direction, driven with keys as people do.
///
/// # Errors
///
/// As [`record_all`]; [`Error::Interrupted`] if `stop` is requested.
pub fn keyboard_drives(
    folder: &Path,
    observer: &mut (dyn Observer<JobEvent> + Send),
    stop: &StopSignal,
) -> Result<Vec<PathBuf>> {
    let track = Track::load("lake")?;
    observed("recording drives with keys".into(), observer, stop, |observer| {
        let drive = |(number, reverse): (usize, bool)| RecordRequest {
            track: &track,
            options: RecordOptions {
                reverse,
                style: Style::Keyboard,
                seed: KEYBOARD_SEED + number as u64,
                ..Default::default()
            },
            out: folder.join(if reverse { "lake-reverse" } else { "lake" }),
        };
        let requests = [(0, false), (1, true)].map(drive);
        record_all(&requests, observer)?;
        Ok(requests.map(|request| request.out).to_vec())
    })
}

/// Trains and drives every variant of `plan` with every seed. Call it inside a rayon pool; runs are kept in a temporary folder only.
///
/// # Errors
///
/// As [`training::train`] and [`test_on_tracks`]; [`Error::Interrupted`] if `stop` is requested.
pub fn run(
    plan: &ExperimentPlan,
    observer: &mut (dyn Observer<ExperimentEvent> + Send),
    stop: &StopSignal,
) -> Result<Vec<ExperimentRow>> {
    let folder = tempfile::tempdir().map_err(Error::io(std::env::temp_dir()))?;
    let mut trials = Vec::new();
    let variants = plan.subject.variants(&plan.recipe);
    // Not every colour space fits every network, nor every term every grouping; say so before minutes are spent.
    for (variant, recipe) in &variants {
        Recipe::parse(variant, &recipe.to_toml()?, &[])?;
    }
    for (variant, recipe) in variants {
        for seed in 1..=plan.seeds {
            observer.observe(ExperimentEvent::Job(JobEvent::Notice(format!("{variant}, seed {seed}"))))?;
            let out = folder.path().join(format!("{variant}-{seed}"));
            let request = TrainRequest {
                said: plan.said.clone(),
                seed,
                cache_mib: plan.cache_mib,
                ..TrainRequest::new(plan.recordings.clone(), recipe.clone(), out)
            };
            let mut of_job = |event| observer.observe(ExperimentEvent::Job(event));
            let training = training::train(request, &mut |event| of_job(JobEvent::Training(event)), stop)?;
            let options = DriveOptions { runs: plan.runs, ..Default::default() };
            let pilot = Pilot::load(&training.model)?;
            let drives = test_on_tracks(&pilot, &plan.tracks, &options, None, &mut of_job, stop)?;
            let mean = |of: &dyn Fn(&TrackResult) -> f64| drives.iter().map(of).sum::<f64>() / drives.len() as f64;
            let trial = ExperimentRow {
                variant: variant.into(),
                seed,
                leak_percent: training.leak_percent,
                val_center_mse: training.val_center_mse,
                val_mae_deg: training.val_mae_deg,
                fresh_mae_deg: mean(&|d| d.offline_mae_deg),
                laps_completed: drives.iter().map(|d| d.drive.laps_completed).sum(),
                laps_total: drives.iter().map(|d| d.drive.laps_total).sum(),
                autonomy_percent: mean(&|d| d.drive.autonomy_percent),
                cte_mean_m: mean(&|d| d.drive.cte_mean_m),
                whiteness_deg_s: mean(&|d| d.drive.whiteness_deg_s),
                expert_whiteness_deg_s: mean(&|d| d.drive.expert_whiteness_deg_s),
                worst_whiteness_deg_s: drives.iter().map(|d| d.drive.whiteness_deg_s).fold(0.0, f64::max),
                reversals_per_min: mean(&|d| d.drive.calm.unwrap_or_default().reversals_per_min),
                angle_change_p95_deg: mean(&|d| d.drive.calm.unwrap_or_default().angle_change_p95_deg),
                lateral_jerk_rms_mps3: mean(&|d| d.drive.calm.unwrap_or_default().lateral_jerk_rms_mps3),
                trained_on_held_out: training.trained_on_held_out,
            };
            observer.observe(ExperimentEvent::Row(trial.clone()))?;
            trials.push(trial);
        }
    }
    Ok(trials)
}

/// Writes `trials` as CSV, in whole or not at all; several tracks in one field are separated by spaces.
///
/// # Errors
///
/// [`Error::Io`].
pub fn write_csv(path: &Path, trials: &[ExperimentRow]) -> Result<()> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    for (at, trial) in trials.iter().enumerate() {
        // A record of CSV cannot hold a list, so it is made from the JSON.
        let Value::Object(fields) = serde_json::to_value(trial).map_err(|e| Error::data(path, e.to_string()))? else {
            unreachable!("a struct is an object")
        };
        if at == 0 {
            writer.write_record(fields.keys()).map_err(|e| Error::data(path, e.to_string()))?;
        }
        writer.write_record(fields.values().map(field)).map_err(|e| Error::data(path, e.to_string()))?;
    }
    let bytes = writer.into_inner().map_err(|e| Error::data(path, e.to_string()))?;
    atomic_file::write(path, &bytes)
}

/// A JSON value as a field of CSV.
fn field(value: &Value) -> String {
    match value {
        Value::Null => String::new(),
        Value::String(text) => text.clone(),
        Value::Array(items) => items.iter().map(field).collect::<Vec<_>>().join(" "),
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn variants_differ_in_the_subject_alone_and_fit_every_shipped_network() {
        for (name, _) in crate::recipe::SHIPPED {
            let base = Recipe::find(name, &[]).unwrap();
            for subject in [Subject::Split, Subject::Colour, Subject::Labels, Subject::Smooth] {
                for (variant, mut recipe) in subject.variants(&base) {
                    recipe
                        .network(steersman_kernels::Isa::PORTABLE)
                        .unwrap_or_else(|e| panic!("{name} {variant}: {e}"));
                    recipe.split.mode = base.split.mode;
                    recipe.preprocessing.colour = base.preprocessing.colour;
                    (recipe.averaging, recipe.smoothness) = (base.averaging, base.smoothness);
                    recipe.augmentation.clone_from(&base.augmentation);
                    recipe.batch = base.batch;
                    recipe.labels = base.labels;
                    recipe.layers.clone_from(&base.layers);
                    assert_eq!(recipe, base);
                }
            }
        }
    }

    #[test]
    fn labels_are_those_of_the_wheel_and_of_the_path_at_three_look_aheads() {
        let base = Recipe::find("recording", &[]).unwrap();
        let found: Vec<_> = (Subject::Labels.variants(&base).into_iter())
            .map(|(name, recipe)| (name, recipe.labels.kind, recipe.labels.look_ahead_s))
            .collect();
        let path = LabelKind::Path;
        let wheel = ("wheel", LabelKind::Wheel, 1.0);
        assert_eq!(found, [wheel, ("path 0.7 s", path, 0.7), ("path 1.0 s", path, 1.0), ("path 1.3 s", path, 1.3)]);
    }

    #[test]
    fn what_makes_the_wheel_calm_is_tried_alone_and_together() {
        let base = Recipe::find("default", &[]).unwrap();
        let variants = Subject::Smooth.variants(&base);
        let plain = &variants[0].1;
        assert_eq!((plain.averaging, plain.smoothness), (None, None));
        assert_eq!((plain.augmentation.pixel_noise, plain.augmentation.block_noise), (0.0, 0.0));
        for (name, recipe) in &variants {
            // Each is a recipe that could be written and read.
            let read = Recipe::parse(name, &recipe.to_toml().unwrap(), &[]).unwrap_or_else(|e| panic!("{name}: {e}"));
            assert_eq!(read, *recipe);
        }
        let count = |recipe: &Recipe, kind| recipe.layers.iter().filter(|layer| layer.base_name() == kind).count();
        let ingredients = |recipe: &Recipe| {
            let noise = recipe.augmentation != plain.augmentation;
            let switches = [recipe.averaging.is_some(), noise, recipe.smoothness.is_some()].map(usize::from);
            (switches, [count(recipe, "blur"), count(recipe, "elu"), count(recipe, "relu")])
        };
        let found: Vec<_> = variants.iter().map(|(name, recipe)| (*name, ingredients(recipe))).collect();
        let none = [0, 0, 5];
        let expected = [
            ("plain", ([0, 0, 0], none)),
            ("larger batches", ([0, 0, 0], none)),
            ("averaged", ([1, 0, 0], none)),
            ("noise", ([0, 1, 0], none)),
            ("spatial", ([0, 0, 1], none)),
            ("temporal", ([0, 0, 1], none)),
            ("blur", ([0, 0, 0], [3, 0, 5])),
            ("elu", ([0, 0, 0], [0, 2, 3])),
            ("blur+noise+elu", ([0, 1, 0], [3, 2, 3])),
            ("together", ([1, 1, 1], [3, 2, 3])),
        ];
        assert_eq!(found, expected);
        let batches: Vec<_> = variants.iter().map(|(_, recipe)| recipe.batch).collect();
        assert!(batches[1] == 4 * base.batch && [&batches[..1], &batches[2..]].concat() == [base.batch; 9]);
        // Blur, noise and ELU make `default`.
        assert_eq!(variants[8].1, base);
    }

    #[test]
    fn the_csv_has_every_field_and_tells_held_out_tracks() {
        let trial = ExperimentRow {
            variant: "blocks".into(),
            seed: 3,
            leak_percent: 12.5,
            val_center_mse: None,
            val_mae_deg: Some(0.25),
            fresh_mae_deg: 1.0,
            laps_completed: 2,
            laps_total: 4,
            autonomy_percent: 99.0,
            cte_mean_m: 0.1,
            whiteness_deg_s: 8.0,
            expert_whiteness_deg_s: 1.0,
            worst_whiteness_deg_s: 9.0,
            reversals_per_min: 30.0,
            angle_change_p95_deg: 1.5,
            lateral_jerk_rms_mps3: 5.0,
            trained_on_held_out: vec!["coast".into(), "random:1000001".into()],
        };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("trials.csv");
        write_csv(&path, &[trial.clone(), ExperimentRow { trained_on_held_out: Vec::new(), ..trial }]).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        let expected = "variant,seed,leak_percent,val_center_mse,val_mae_deg,fresh_mae_deg,laps_completed,laps_total,\
                        autonomy_percent,cte_mean_m,whiteness_deg_s,expert_whiteness_deg_s,worst_whiteness_deg_s,\
                        reversals_per_min,angle_change_p95_deg,lateral_jerk_rms_mps3,trained_on_held_out\n\
                        blocks,3,12.5,,0.25,1.0,2,4,99.0,0.1,8.0,1.0,9.0,30.0,1.5,5.0,coast random:1000001\n\
                        blocks,3,12.5,,0.25,1.0,2,4,99.0,0.1,8.0,1.0,9.0,30.0,1.5,5.0,\n";
        assert_eq!(text, expected);
    }

    #[test]
    fn takes_are_limited_to_some_random_tracks() {
        let few = takes(2);
        let random = few.iter().filter(|take| take.track.starts_with("random:")).count();
        assert_eq!((few.len() - random, random), (8, 4));
        assert_eq!(takes(1000), training_set::takes());
    }
}
