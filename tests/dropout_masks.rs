//! Dropout in a training run: each step drops other values, and the same values whenever the same step is made again.
//!
//! One dense layer from zeros behind a dropout layer, trained by plain gradient descent: a weight moves in a step if and only if
//! its input is kept in at least one image of the batch. An epoch is one step here.

mod common;

use std::fs;
use std::path::Path;

use common::command::run;
use common::painted_log;
use steersman::model_file::Model;

const RECIPE: &str = r#"
name = "masked"
epochs = 1
batch = 1000
keep = "last"
layers = [
  { kind = "flatten" },
  { kind = "dropout", drop_probability = 0.9 },
  { kind = "dense", units = 1, init = { constant = 0.0 } },
]
[preprocessing]
resize = [10, 20]
colour = "gray"
scale = 0.01
offset = 1.0
[split]
validation_share = 0.0
[optimizer]
kind = "sgd"
learning_rate = 0.01
momentum = 0.0
"#;

/// The weights after `epochs` steps.
fn weights(folder: &Path, out: &str, epochs: &str, seed: &str) -> Vec<f32> {
    let epochs = format!("epochs={epochs}");
    run(folder, &["train", "log", "--recipe", "masked.toml", "--out", out, "--seed", seed, "--set", &epochs]);
    let mut weights = Model::load(&folder.join(out).join("last.safetensors")).unwrap().parameters.values;
    weights.pop(); // The bias always moves.
    weights
}

/// Which weights a step moves from `before`.
fn moved(before: &[f32], after: &[f32]) -> Vec<bool> {
    let moved: Vec<bool> = before.iter().zip(after).map(|(before, after)| before != after).collect();
    let count = moved.iter().filter(|moved| **moved).count();
    assert!(count > moved.len() / 10 && count < moved.len() * 9 / 10, "{count} of {} weights moved", moved.len());
    moved
}

#[test]
fn masks_differ_between_steps_and_seeds_and_are_the_same_for_the_same_step() {
    let folder = tempfile::tempdir().unwrap();
    painted_log::write(&folder.path().join("log"), 7, "");
    fs::write(folder.path().join("masked.toml"), RECIPE).unwrap();
    let [one, two, three] = ["1", "2", "3"].map(|epochs| weights(folder.path(), epochs, epochs, "5"));
    let zeros = vec![0.0; one.len()];
    let masks = [moved(&zeros, &one), moved(&one, &two), moved(&two, &three)];
    assert!(masks[0] != masks[1] && masks[1] != masks[2] && masks[0] != masks[2], "each step has a mask of its own");
    assert!(one == weights(folder.path(), "again", "1", "5"), "the same seed and step: the same mask");
    assert_ne!(masks[0], moved(&zeros, &weights(folder.path(), "other", "1", "6")), "another seed: another mask");
}
