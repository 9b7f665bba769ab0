//! Recipes: a whole experiment as one TOML file.
//!
//! A recipe holds preprocessing, network, samples, balancing, augmentation, split, optimizer and epochs. The shipped ones lie
//! in `data/recipes/` and are built into the binary. Unknown keys are errors that name the nearest known one.
//!
//! # To add a recipe
//!
//! Put a TOML file into `data/recipes/`: [`SHIPPED`] lists what lies there, and a test builds every recipe of it.

use std::path::Path;

use serde::{Deserialize, Serialize};
use steersman_kernels::{Backend, Isa};

use crate::dataset::augment::Augmentation;
use crate::dataset::preprocess::Preprocessing;
use crate::dataset::split::SplitSpec;
use crate::dataset::{Balance, Group, LabelSpec, Outputs, Recording, SampleSpec, Targets};
use crate::engine::loss::{Loss, Smoothness};
use crate::engine::network::{LayerSpec, Network};
use crate::engine::optimizer::{AveragingSpec, OptimizerSpec, Schedule, ScheduleSpec};
use crate::engine::tensor::Shape;
use crate::error::{Error, Result};
use crate::suggestion::{did_you_mean, meant, named_elsewhere};

/// Name and text of each recipe that is built in, by name.
pub const SHIPPED: &[(&str, &str)] = include!(concat!(env!("OUT_DIR"), "/recipes.rs"));

/// Maximum of layers of a network.
const MAX_LAYERS: usize = 1000;

/// A whole experiment.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// Name; run folders are called after it.
    pub name: String,
    /// One line for people.
    #[serde(default)]
    pub about: String,
    /// Passes over the training side.
    pub epochs: u32,
    /// Images in a training step; the last one of an epoch may be smaller.
    pub batch: usize,
    /// Angle of the front wheels at steering 1, in degrees; turns errors into degrees.
    #[serde(default = "default_full_lock_deg")]
    pub full_lock_deg: f64,
    /// The outputs of the network, and how much the loss of each counts; the steering alone when absent.
    #[serde(default, skip_serializing_if = "Outputs::is_default")]
    pub outputs: Outputs,
    /// The function that training minimizes.
    #[serde(default)]
    pub loss: Loss,
    /// Terms added to the loss that make the wheel calm; none when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub smoothness: Option<Smoothness>,
    /// Gradients with a larger L2 norm are scaled down to this one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clip_gradient_norm: Option<f64>,
    /// When to stop before the last epoch; never when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub early_stopping: Option<EarlyStopping>,
    /// Which epoch's weights become the model.
    #[serde(default)]
    pub keep: Keep,
    /// The error on the validation side that says which epoch is best, and when to stop early.
    #[serde(default, skip_serializing_if = "KeepBy::is_loss")]
    pub keep_by: KeepBy,
    /// The average of the weights over updates that is evaluated and becomes the model; the weights themselves when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub averaging: Option<AveragingSpec>,
    /// The network, from input to output.
    pub layers: Vec<LayerSpec>,
    /// From camera image to network input.
    pub preprocessing: Preprocessing,
    /// Where labels come from.
    #[serde(default, skip_serializing_if = "LabelSpec::is_default")]
    pub labels: LabelSpec,
    /// Which images of a row are used, and what that adds to the label.
    #[serde(default)]
    pub samples: SampleSpec,
    /// Thinning out of over-frequent labels.
    #[serde(default)]
    pub balance: Balance,
    /// Random changes of training images.
    #[serde(default)]
    pub augmentation: Augmentation,
    /// Training side and validation side.
    #[serde(default)]
    pub split: SplitSpec,
    /// The algorithm that updates the parameters.
    pub optimizer: OptimizerSpec,
    /// The learning-rate schedule.
    #[serde(default)]
    pub schedule: ScheduleSpec,
}

/// Ends a run when the validation loss stops falling; the best weights become the model.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EarlyStopping {
    /// Epochs without improvement before the end.
    pub patience_epochs: u32,
    /// A smaller fall of the validation loss is no improvement.
    #[serde(default)]
    pub min_delta: f64,
}

/// Which epoch's weights become the model of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Keep {
    /// The epoch with the lowest validation loss.
    #[default]
    Best,
    /// The last one. Where the learning rate falls to nothing the last epoch is the end of the descent, and differences
    /// between the validation losses of the last few are chance.
    Last,
}

/// The error on the validation side by which epochs are compared.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum KeepBy {
    /// The squared error against the labels, over all images.
    #[default]
    Loss,
    /// The squared error of the centre camera's images against the steering that follows the driven path: it does not depend on
    /// how the driver moved the wheel.
    Path,
}

impl KeepBy {
    fn is_loss(&self) -> bool {
        *self == KeepBy::Loss
    }
}

fn default_full_lock_deg() -> f64 {
    25.0
}

impl Recipe {
    /// The built-in recipe `name`, or the one in the file `name` if it ends in `.toml` or is a path; then each `key=value`
    /// of `overrides` set (`epochs=3`, `optimizer.learning_rate=1e-4`).
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] for an unknown name, naming the nearest; [`Error::Io`] for an unreadable file; [`Error::Recipe`] and
    /// [`Error::Network`] for what is wrong inside.
    pub fn find(name: &str, overrides: &[String]) -> Result<Recipe> {
        let text = match SHIPPED.iter().find(|(shipped, _)| *shipped == name) {
            Some((_, text)) => text.to_string(),
            None if name.ends_with(".toml") || Path::new(name).components().count() > 1 => {
                std::fs::read_to_string(name).map_err(Error::io(name))?
            }
            None => {
                let names: Vec<&str> = SHIPPED.iter().map(|(name, _)| *name).collect();
                return Err(Error::Usage(format!(
                    "there is no recipe `{name}`{}; built in are {}; a recipe of your own is given as FILE.toml",
                    did_you_mean(name, &names),
                    names.join(", ")
                )));
            }
        };
        Recipe::parse(name, &text, overrides)
    }

    /// The recipe in `text`, called `source` in error messages.
    ///
    /// # Errors
    ///
    /// [`Error::Recipe`] for wrong or unknown entries, [`Error::Network`] for layers that do not fit.
    pub fn parse(source: &str, text: &str, overrides: &[String]) -> Result<Recipe> {
        let wrong = |message: String| Error::Recipe { recipe: source.into(), message };
        let mut table: toml::Table = text.parse().map_err(|e: toml::de::Error| wrong(e.to_string()))?;
        for entry in overrides {
            set(&mut table, entry).map_err(Error::Usage)?;
        }
        // Layers one by one, so that an error can say which one it means.
        if let Some(toml::Value::Array(layers)) = table.get("layers") {
            for (index, layer) in layers.iter().enumerate() {
                LayerSpec::deserialize(layer.clone())
                    .map_err(|e| wrong(format!("layers, entry {}: {}", index + 1, with_nearest(e.message()))))?;
            }
        }
        let recipe = Recipe::deserialize(table).map_err(|e| wrong(with_nearest(e.message())))?;
        recipe.check().map_err(wrong)?;
        recipe.network(Isa::PORTABLE)?;
        Ok(recipe)
    }

    /// The entry of recipes that is called `name`, or that other libraries call so: `lr` is `optimizer.learning_rate`.
    pub(crate) fn key_like(name: &str) -> Option<String> {
        let table: toml::Table = Recipe::find("default", &[]).ok()?.to_toml().ok()?.parse().ok()?;
        let mut keys = Vec::new();
        for (key, value) in &table {
            match value {
                toml::Value::Table(inner) => keys.extend(inner.keys().map(|inner| format!("{key}.{inner}"))),
                _ => keys.push(key.clone()),
            }
        }
        let name = name.replace('-', "_");
        let names: Vec<&str> = keys.iter().map(|key| key.rsplit('.').next().unwrap_or(key)).collect();
        let meant = meant(&name, &names).filter(|meant| {
            let near = strsim::damerau_levenshtein(&name, meant) <= 1;
            near || named_elsewhere(&name) == Some(meant)
        })?;
        keys.iter().zip(&names).find(|(_, name)| **name == meant).map(|(key, _)| key.clone())
    }

    /// The text of a recipe file with every entry resolved.
    ///
    /// # Errors
    ///
    /// [`Error::Recipe`] if a number is larger than TOML can hold.
    pub fn to_toml(&self) -> Result<String> {
        toml::to_string(self).map_err(|e| Error::Recipe { recipe: self.name.clone(), message: e.to_string() })
    }

    /// The network of the recipe, computed with `backend`: an [`Isa`], or one with a convolution algorithm.
    ///
    /// # Errors
    ///
    /// [`Error::Network`] if a layer does not fit.
    pub fn network(&self, backend: impl Into<Backend>) -> Result<Network> {
        let [c, h, w] = self.preprocessing.output();
        let network = Network::new(Shape::new(c, h, w), &self.layers, backend)?;
        if network.layers().iter().all(|l| l.layer.is_view()) {
            let message = "a network needs a layer that computes something".into();
            return Err(Error::Network { layer: "(all)".into(), message });
        }
        let outputs = self.outputs.count();
        if network.output() != Shape::vector(outputs) {
            let layer = network.layers().last().map_or(String::new(), |l| l.name.clone());
            let gives = network.output();
            let message = match outputs {
                1 => format!(
                    "the last layer must give one number, the steering; this one gives {gives}. `outputs` names more than that"
                ),
                _ => format!(
                    "the last layer must give {outputs} numbers, one for each of the outputs {}; this one gives {gives}: set its \
                     units to {outputs}, as with --set layers.last.units={outputs}",
                    self.outputs.names()
                ),
            };
            return Err(Error::Network { layer, message });
        }
        Ok(network)
    }

    /// The labels of `recordings`, with `views` behind them, single pictures that a model met, and then `drives` of the simulator.
    ///
    /// # Errors
    ///
    /// [`Error::Data`] for recordings without what an output learns from.
    pub fn targets(&self, recordings: &[Recording], views: &[Recording], drives: &[Recording]) -> Result<Targets> {
        let targets =
            self.steering_targets(recordings).with_views(views, &self.labels).with_drives(drives, &self.labels);
        targets.with_outputs(recordings.iter().chain(views).chain(drives), &self.outputs, &self.labels)
    }

    /// The labels of the steering of `recordings`, whatever else the network gives.
    pub fn steering_targets(&self, recordings: &[Recording]) -> Targets {
        Targets::of(recordings, &self.labels, &self.samples, &self.augmentation)
    }

    fn check(&self) -> Result<(), String> {
        let allowed = |c: char| c.is_alphanumeric() || "-_.".contains(c);
        if self.name.is_empty() || self.name.starts_with('.') || !self.name.chars().all(allowed) {
            return Err(format!("name must consist of letters, digits, - and _, not be `{}`", self.name));
        }
        if self.layers.len() > MAX_LAYERS {
            return Err(format!("layers: {} are more than {MAX_LAYERS}", self.layers.len()));
        }
        if self.epochs == 0 || self.batch == 0 {
            return Err("epochs and batch must be at least 1".into());
        }
        if let Some(EarlyStopping { min_delta, .. }) = self.early_stopping
            && !(min_delta.is_finite() && min_delta >= 0.0)
        {
            return Err(format!("early_stopping.min_delta must not be negative or infinite, but is {min_delta}"));
        }
        if self.keep == Keep::Last && self.early_stopping.is_some() {
            return Err("early_stopping keeps the best epoch, so it does not go with keep = \"last\"".into());
        }
        let plateau = matches!(self.schedule.shape, Schedule::ReduceOnPlateau { .. });
        if self.split.validation_share == 0.0 && (plateau || self.early_stopping.is_some()) {
            return Err(
                "early_stopping and reduce_on_plateau need a validation side: split.validation_share is 0".into()
            );
        }
        if !(self.full_lock_deg.is_finite() && self.full_lock_deg > 0.0) {
            return Err(format!("full_lock_deg must be a positive number, not {}", self.full_lock_deg));
        }
        if self.clip_gradient_norm.is_some_and(|norm| !(norm.is_finite() && norm > 0.0)) {
            return Err("clip_gradient_norm must be a positive number".into());
        }
        if let Loss::Huber { delta } = self.loss
            && !(delta.is_finite() && delta > 0.0)
        {
            return Err(format!("loss.delta must be a positive number, not {delta}"));
        }
        if let Some(smoothness) = &self.smoothness {
            smoothness.check(self.batch).map_err(|message| format!("[smoothness] {message}"))?;
            if !smoothness.is_off() && self.samples.group == Group::Rows {
                return Err(
                    "[smoothness] pairs are made of single images, not of rows: samples.group must be \"images\""
                        .into(),
                );
            }
        }
        self.optimizer.check().map_err(|message| format!("[optimizer] {message}"))?;
        if let Some(averaging) = &self.averaging {
            averaging.check().map_err(|message| format!("averaging: {message}"))?;
        }
        self.schedule.check().map_err(|message| format!("[schedule] {message}"))?;
        self.preprocessing.validate().map_err(|e| e.to_string())?;
        self.outputs.validate().map_err(|e| e.to_string())?;
        self.labels.validate().map_err(|e| e.to_string())?;
        self.samples.validate().map_err(|e| e.to_string())?;
        self.balance.validate().map_err(|e| e.to_string())?;
        self.augmentation.validate().map_err(|e| e.to_string())?;
        self.split.validate().map_err(|e| e.to_string())
    }
}

/// Sets `a.b.c=value` in `table`. A value that is no TOML counts as a string.
fn set(table: &mut toml::Table, entry: &str) -> Result<(), String> {
    let (key, value) =
        entry.split_once('=').ok_or_else(|| format!("--set takes key=value, as in epochs=3; found `{entry}`"))?;
    let value = value.trim();
    let parsed = format!("value = {value}").parse::<toml::Table>().ok().and_then(|mut t| t.remove("value"));
    let parsed = parsed.unwrap_or_else(|| toml::Value::String(value.into()));
    let mut path: Vec<&str> = key.split('.').map(str::trim).collect();
    let last = path.pop().unwrap_or_default();
    let mut inner = table;
    if let ["layers", layer] = path[..] {
        let layers = inner.get_mut("layers").and_then(toml::Value::as_array_mut);
        let layers = layers.ok_or_else(|| format!("--set {key}: the recipe has no list of `layers`"))?;
        let count = layers.len();
        let index = if layer == "last" { Some(count) } else { layer.parse().ok() };
        let entry = index.and_then(|index: usize| layers.get_mut(index.wrapping_sub(1)));
        inner = entry.and_then(toml::Value::as_table_mut).ok_or_else(|| {
            format!("--set {key}: layers are counted from 1 to {count}, and `last` is the last one; found `{layer}`")
        })?;
        path.clear();
    }
    for part in path {
        inner = inner
            .entry(part)
            .or_insert_with(|| toml::Value::Table(toml::Table::new()))
            .as_table_mut()
            .ok_or_else(|| format!("--set {key}: `{part}` is a single value, it has no entries"))?;
    }
    inner.insert(last.into(), parsed);
    Ok(())
}

/// Adds the nearest known name to serde's «unknown field `x`, expected one of `a`, `b`».
fn with_nearest(message: &str) -> String {
    let message = message.trim_end();
    if !message.starts_with("unknown ") {
        return message.into();
    }
    let mut quoted = message.split('`').skip(1).step_by(2);
    let unknown = quoted.next().unwrap_or_default();
    let known: Vec<&str> = quoted.collect();
    match did_you_mean(unknown, &known) {
        hint if hint.is_empty() => message.into(),
        hint => format!("{}{hint}", message.split(',').next().unwrap_or(message)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn totals(name: &str) -> (usize, usize) {
        let network = Recipe::find(name, &[]).unwrap().network(Isa::PORTABLE).unwrap();
        (network.count(true) + network.count(false), network.count(true))
    }

    #[test]
    fn shipped_networks_have_the_published_numbers_of_parameters() {
        assert_eq!(totals("hyper"), (176_159, 175_671));
        assert_eq!(totals("hyper-prelu").0, 314_047);
        assert_eq!(totals("lenet").0, 28_589);
        assert_eq!(totals("pilotnet").0, 252_219);
    }

    #[test]
    fn shipped_networks_have_the_published_numbers_of_multiply_adds() {
        for (name, expected) in [("hyper", 13_864_346), ("lenet", 381_036), ("pilotnet", 26_876_342)] {
            let network = Recipe::find(name, &[]).unwrap().network(Isa::PORTABLE).unwrap();
            assert_eq!(network.multiply_adds(), expected, "{name}");
        }
    }

    #[test]
    fn corrections_of_side_cameras_and_shifts_are_those_of_the_labels_distance() {
        for name in ["default", "calm"] {
            let recipe = Recipe::find(name, &[]).unwrap();
            let ahead_m = recipe.labels.expert_ahead_m.unwrap();
            // Of a place `aside_m` beside the line: pure pursuit with a wheelbase of 2.87 m.
            let steering =
                |aside_m: f64| (2.0 * 2.87 * aside_m / ahead_m.powi(2)).atan().to_degrees() / recipe.full_lock_deg;
            let side_cameras = recipe.samples.side_cameras.unwrap().fixed();
            assert!((side_cameras - steering(0.81)).abs() < 5e-4, "{name}: {side_cameras}");
            // The camera stands 2.63 m before the rear axle, and has a focal length of 138.6 pixels.
            let per_px = recipe.augmentation.shift_steering_per_px.unwrap().fixed();
            assert!((per_px - steering((ahead_m - 2.63) / 138.6)).abs() < 1e-4, "{name}: {per_px}");
        }
    }

    #[test]
    fn shipped_recipes_are_called_like_their_files_and_survive_being_written() {
        for (name, _) in SHIPPED {
            let recipe = Recipe::find(name, &[]).unwrap();
            assert_eq!(recipe.name, *name);
            assert_eq!(Recipe::parse(name, &recipe.to_toml().unwrap(), &[]).unwrap(), recipe);
        }
    }

    #[test]
    fn overrides_reach_every_level() {
        let overrides = ["epochs=3", "optimizer.learning_rate = 0.5", "split.mode=random", "schedule.warmup_updates=9"];
        let recipe = Recipe::find("lenet", &overrides.map(String::from)).unwrap();
        assert_eq!((recipe.epochs, recipe.optimizer.learning_rate()), (3, 0.5));
        assert_eq!(recipe.schedule.warmup_updates, 9);
    }

    fn error(overrides: &[&str]) -> String {
        let overrides: Vec<String> = overrides.iter().map(|s| s.to_string()).collect();
        Recipe::find("lenet", &overrides).unwrap_err().to_string()
    }

    #[test]
    fn unknown_names_are_errors_that_name_the_nearest_known_one() {
        assert_eq!(error(&["epoch=3"]), "recipe lenet: unknown field `epoch` (did you mean `epochs`?)");
        assert!(error(&["optimizer.learningrate=1"]).ends_with("`learningrate` (did you mean `learning_rate`?)"));
        assert!(error(&["split.mod=1"]).contains("did you mean `mode`?"));
        assert!(error(&["loss={kind='mean_squared_error', delta=1}"]).contains("unknown field `delta`"));
        assert!(error(&["schedule.shape={kind='constant', factor=1}"]).contains("unknown field `factor`"));
        let recipe = Recipe::find("lente", &[]).unwrap_err().to_string();
        assert!(
            recipe.starts_with("there is no recipe `lente` (did you mean `lenet`?); built in are calm, default,"),
            "{recipe}"
        );
        let (_, lenet) = SHIPPED.iter().find(|(name, _)| *name == "lenet").unwrap();
        let layers = lenet.replacen("filters = 6", "filter = 6", 1);
        let layer = Recipe::parse("mine.toml", &layers, &[]).unwrap_err().to_string();
        assert_eq!(layer, "recipe mine.toml: layers, entry 2: unknown field `filter` (did you mean `filters`?)");
    }

    #[test]
    fn wrong_numbers_are_errors() {
        assert!(error(&["epochs=0"]).contains("at least 1"));
        assert!(error(&["epochs"]).contains("key=value"));
        assert!(error(&["epochs.x=1"]).contains("single value"));
        assert!(error(&["optimizer.learning_rate=-1"]).contains("learning_rate must be a positive number"));
        assert!(error(&["preprocessing.rows=[10, 200]"]).contains("rows"));
        assert!(error(&["preprocessing.resize=[4, 4]"]).contains("layer `pool1`"));
        assert!(error(&["keep=last", "early_stopping={patience_epochs=1}"]).contains("keeps the best epoch"));
        assert!(error(&["smoothness={spatial=-1}"]).contains("[smoothness] spatial must not be negative"));
        assert!(error(&["smoothness={spatial=1}", "batch=2"]).contains("leaves no pair"));
        assert!(error(&["smoothness={spacial=1}"]).contains("did you mean `spatial`?"));
        assert!(error(&["smoothness={temporal=1}", "samples.group=rows"]).contains("samples.group"));
        assert!(error(&["averaging={kind='ema', decay=1}"]).contains("averaging: decay must lie in [0, 1)"));
        assert!(error(&["averaging={kind='ema', decays=0.9}"]).contains("did you mean `decay`?"));
        assert!(error(&["name='../x'"]).contains("letters, digits"));
        assert!(error(&["early_stopping={patience_epochs=1}", "split.validation_share=0"]).contains("validation side"));
        assert!(error(&["layers=[{kind='dense', units=100000000000000}]"]).contains("units"));
        let many = format!("layers=[{}]", "{kind='relu'},".repeat(1001));
        assert!(error(&[&many]).contains("1001 are more than 1000"));
        assert!(error(&["layers=[{kind='conv2d', filters=60000, kernel=[3, 3]}]"]).contains("more than"));
    }
}
