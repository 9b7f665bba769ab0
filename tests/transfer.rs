//! `train --from`: weights of a model, frozen layers, and runs that go on.

mod common;

use std::fs;
use std::path::Path;

use common::command::{error, json, run, steersman};
use common::painted_log;
use steersman::model_file::Model;
use steersman_kernels::Isa;

/// Two convolutions with batch norm, two dense layers.
const RECIPE: &str = r#"
name = "small"
epochs = 2
batch = 16
clip_gradient_norm = 1.0
layers = [
  { kind = "conv2d", filters = 4, kernel = [5, 5], stride = [2, 2] },
  { kind = "batch_norm", running_old_weight = 0.9 },
  { kind = "relu" },
  { kind = "conv2d", filters = 6, kernel = [3, 3], stride = [2, 2] },
  { kind = "batch_norm", running_old_weight = 0.9 },
  { kind = "relu" },
  { kind = "dense", units = 8 },
  { kind = "prelu" },
  { kind = "dense", units = 1 },
]
[preprocessing]
rows = [60, 140]
resize = [20, 40]
colour = "gray"
scale = 0.0078125
offset = -1.0
[split]
validation_share = 0.2
[optimizer]
kind = "adam"
learning_rate = 3e-3
decoupled_weight_decay = 0.1
"#;

/// A log, the recipe, and a first model under `first/`.
fn folder_with_model() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    painted_log::write(&folder.path().join("log"), 150, "");
    painted_log::write(&folder.path().join("other"), 150, "_b");
    fs::write(folder.path().join("small.toml"), RECIPE).unwrap();
    run(folder.path(), &["train", "log", "--recipe", "small.toml", "--out", "first"]);
    folder
}

const FROM: &str = "first/last.safetensors";

fn load(folder: &Path, path: &str) -> Model {
    Model::load(&folder.join(path)).unwrap()
}

/// Names of the tensors that are the same in both models, which have the same recipe.
fn equal_tensors(a: &Model, b: &Model) -> Vec<String> {
    let network = a.recipe.network(Isa::PORTABLE).unwrap();
    let equal = network.tensors().iter().filter(|tensor| a.parameters.tensor(tensor) == b.parameters.tensor(tensor));
    equal.map(|tensor| tensor.name.clone()).collect()
}

#[test]
fn frozen_layers_and_their_statistics_stay_and_the_others_learn() {
    let folder = folder_with_model();
    let dir = folder.path();
    let output = run(
        dir,
        &[
            "train",
            "other",
            "--set",
            "split.validation_share=0",
            "--from",
            FROM,
            "--freeze",
            "conv1,bn1",
            "--freeze",
            "dense1",
            "--out",
            "second",
        ],
    );
    let notices = String::from_utf8(output.stderr).unwrap();
    assert!(
        notices.contains(
            "weights from first/last.safetensors: conv1, bn1, conv2, bn2, dense1, prelu1, dense2; fresh weights: none; \
             frozen: conv1, bn1, dense1"
        ),
        "{notices}"
    );
    assert!(!notices.contains("will look too good"), "another recording: {notices}");
    let (first, second) = (load(dir, FROM), load(dir, "second/last.safetensors"));
    let frozen = [
        "conv1.weight",
        "conv1.bias",
        "bn1.gamma",
        "bn1.beta",
        "bn1.running_mean",
        "bn1.running_variance",
        "dense1.weight",
        "dense1.bias",
    ];
    assert_eq!(equal_tensors(&first, &second), frozen);
    let transfer = second.record.transfer.as_ref().unwrap();
    assert_eq!((transfer.model.as_str(), transfer.frozen.len(), transfer.taken.len()), (FROM, 3, 7));
    assert!(first.training_rows.iter().all(|row| second.training_rows.contains(row)), "what it has seen, it has seen");
    assert!(second.training_rows.len() > first.training_rows.len());
    let info: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(dir.join("second/run.json")).unwrap()).unwrap();
    assert_eq!(info["transfer"]["frozen"], serde_json::json!(["conv1", "bn1", "dense1"]));
}

#[test]
fn layers_of_another_shape_begin_afresh() {
    let folder = folder_with_model();
    let dir = folder.path();
    let wider = RECIPE.replace("units = 8", "units = 9");
    fs::write(dir.join("wider.toml"), wider).unwrap();
    let args = [
        "train",
        "log",
        "--recipe",
        "wider.toml",
        "--seed",
        "2",
        "--set",
        "epochs=1",
        "--from",
        FROM,
        "--out",
        "second",
    ];
    let notices = String::from_utf8(run(dir, &args).stderr).unwrap();
    assert!(
        notices.contains(": conv1, bn1, conv2, bn2; fresh weights: dense1, prelu1, dense2; frozen: none"),
        "{notices}"
    );
    assert!(notices.contains("will look too good"), "the same recording, other blocks: {notices}");
}

#[test]
fn a_run_goes_on_from_its_own_copy_of_the_model_to_the_same_bits() {
    let folder = folder_with_model();
    let dir = folder.path();
    let args = [
        "train",
        "other",
        "--set",
        "split.validation_share=0",
        "--from",
        FROM,
        "--freeze",
        "bn1",
        "--out",
        "whole",
        "--json",
    ];
    let whole = json(dir, &args);
    // As if it had been killed before the end of its first epoch, and the first model were gone.
    for file in ["result.json", "model.safetensors", "last.safetensors", "checkpoint.safetensors", "history.csv"] {
        fs::remove_file(dir.join("whole").join(file)).unwrap();
    }
    fs::remove_dir_all(dir.join("first")).unwrap();
    let again = json(dir, &["train", "--resume", "whole", "--json"]);
    for key in ["weights_hash", "val_mse", "train_mse", "best_epoch"] {
        assert_eq!(again[key], whole[key], "{key}");
    }
}

#[test]
fn what_cannot_be_taken_over_or_frozen_is_an_error_that_names_it() {
    let folder = folder_with_model();
    let dir = folder.path();
    let refused = |extra: &[&str]| error(dir, &[&["train", "log", "--from", FROM, "--out", "second"], extra].concat());
    assert!(refused(&["--freeze", "convv1"]).contains("no layer `convv1` to freeze (did you mean `conv1`?)"));
    assert!(refused(&["--freeze", "relu1"]).contains("layer `relu1` has no weights"));
    assert!(refused(&["--freeze", "conv1,bn1,conv2,bn2,dense1,prelu1,dense2"]).contains("nothing is left to train"));
    let lenet = refused(&["--recipe", "lenet"]);
    assert!(lenet.contains("no layer of first/last.safetensors has the name and the shape"), "{lenet}");
    fs::write(dir.join("wider.toml"), RECIPE.replace("units = 8", "units = 9")).unwrap();
    let fresh = refused(&["--recipe", "wider.toml", "--freeze", "dense1"]);
    assert!(fresh.contains("layer `dense1` cannot be frozen") && fresh.contains("stay random"), "{fresh}");
    assert!(error(dir, &["train", "log", "--from", "small.toml"]).contains("small.toml: is no safetensors file"));
    let output = steersman(dir).args(["train", "log", "--freeze", "conv1"]).output().unwrap();
    assert_eq!(output.status.code(), Some(2), "--freeze needs --from");
    assert!(!dir.join("second").exists());
}
