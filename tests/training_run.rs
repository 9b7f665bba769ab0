//! The wiring of a training run, end to end: which images are validated, which rate belongs to which update, which epoch becomes
//! the model, when a run stops, and in which unit errors are told.
//!
//! The network is linear and the recording short, so that a run takes less than a second and each of these questions has an
//! answer that can be computed here.

mod common;

use std::path::{Path, PathBuf};

use common::command::json;
use common::painted_log;
use serde_json::Value;
use steersman::engine::network::Parameters;
use steersman::model_file::Model;
use steersman::observer::StopSignal;
use steersman::recipe::Recipe;
use steersman::training::{self, EpochRecord, TrainRequest, TrainResult, TrainingEvent, read_history};

const LINEAR: &str = "layers=[{kind='scale', factor=0.004, offset=-0.5}, {kind='flatten'}, {kind='dense', units=1}]";
const BATCH: u64 = 8;
/// A rate so small that no weight changes: the network stays as it was drawn.
const AT_REST: &str = "optimizer.learning_rate=1e-30";
/// A rate that grows in every update. The validation loss falls in the first two epochs and nearly doubles in the third, when
/// the steps have become too long.
const RISING: [&str; 2] = ["optimizer.learning_rate=10.0", "schedule.warmup_updates=100000"];

/// A finished run: what it printed, and its epochs.
fn train(folder: &Path, out: &str, settings: &[&str]) -> (Value, Vec<EpochRecord>) {
    let recording = Path::new(env!("CARGO_MANIFEST_DIR")).join("data/sample");
    let batch = format!("batch={BATCH}");
    let mut args =
        vec!["train", recording.to_str().unwrap(), "--recipe", "lenet", "--out", out, "--seed", "5", "--json"];
    for setting in [LINEAR, "preprocessing.resize=[16, 16]", &batch].iter().chain(settings) {
        args.extend(["--set", setting]);
    }
    (json(folder, &args), read_history(&folder.join(out).join("history.csv")).unwrap())
}

fn weights(folder: &Path, out: &str, file: &str) -> Parameters {
    Model::load(&folder.join(out).join(file)).unwrap().parameters
}

#[test]
fn validation_images_are_not_augmented() {
    let folder = tempfile::tempdir().unwrap();
    let (plain, _) = train(folder.path(), "plain", &["epochs=1", AT_REST]);
    let changes = ["augmentation.saturation=[0.1, 0.5]", "augmentation.contrast=[0.3, 0.6]"];
    let (augmented, _) = train(folder.path(), "augmented", &["epochs=1", AT_REST, changes[0], changes[1]]);
    assert_ne!(plain["train_mse"], augmented["train_mse"], "training images are augmented");
    for figure in ["val_mse", "val_center_mse", "val_mae_deg"] {
        assert!(plain[figure].is_number());
        assert_eq!(plain[figure], augmented[figure], "{figure}");
    }
}

/// `history.csv` has the rate of the last update of each epoch, which follows upon all updates but itself.
#[test]
fn the_schedule_counts_the_updates_that_are_done() {
    let folder = tempfile::tempdir().unwrap();
    let decay = "schedule.shape={kind='time_decay', decay_per_update=1.0}";
    let (result, history) = train(folder.path(), "decay", &["epochs=3", "optimizer.learning_rate=1e-3", decay]);
    let updates_per_epoch = result["train_images"].as_u64().unwrap().div_ceil(BATCH);
    assert_eq!(history.len(), 3);
    for record in history {
        let earlier = u64::from(record.epoch) * updates_per_epoch - 1;
        approx::assert_relative_eq!(record.learning_rate, 1e-3 / (1.0 + earlier as f64), max_relative = 1e-12);
    }
}

#[test]
fn the_model_has_the_weights_of_the_best_epoch_and_not_of_the_last() {
    let folder = tempfile::tempdir().unwrap();
    let (result, history) = train(folder.path(), "three", &["epochs=3", RISING[0], RISING[1]]);
    let loss = |epoch: usize| history[epoch - 1].val_mse.unwrap();
    assert!(loss(2) < 0.9 * loss(1) && loss(3) > 1.2 * loss(2), "the second epoch is the best: {history:?}");
    assert_eq!((&result["best_epoch"], &result["epochs"]), (&2.into(), &3.into()));
    assert_eq!(result["val_mse"].as_f64(), history[1].val_mse);

    train(folder.path(), "two", &["epochs=2", RISING[0], RISING[1]]);
    let best = weights(folder.path(), "three", "model.safetensors");
    assert!(best == weights(folder.path(), "two", "last.safetensors"), "the weights after two epochs");
    assert!(best != weights(folder.path(), "three", "last.safetensors"), "training went on in the third");
}

#[test]
fn a_run_stops_in_the_first_epoch_that_completes_the_patience() {
    let folder = tempfile::tempdir().unwrap();
    for patience in [1, 2] {
        let stopping = format!("early_stopping={{patience_epochs={patience}, min_delta=0.01}}");
        let out = format!("patience-{patience}");
        let (result, history) = train(folder.path(), &out, &["epochs=12", RISING[0], RISING[1], &stopping]);
        let (mut lowest, mut since, mut expected) = (f64::INFINITY, 0, None);
        for record in &history {
            let loss = record.val_mse.unwrap();
            (lowest, since) = if loss < lowest - 0.01 { (loss, 0) } else { (lowest, since + 1) };
            if since == patience && expected.is_none() {
                expected = Some(record.epoch);
            }
        }
        assert_eq!(result["epochs"].as_u64(), expected.map(u64::from), "{history:?}");
        assert!(history.len() < 12, "it stopped early");
    }
}

/// Networks that give one answer to every picture: their error is its distance from the label, times the full lock in degrees. Errors to
/// both sides count alike.
#[test]
fn the_mean_absolute_error_is_in_degrees_of_the_front_wheels() {
    let folder = tempfile::tempdir().unwrap();
    let run = |full_lock_deg: f64, answer: f64| {
        let out = format!("lock-{full_lock_deg}-{answer}");
        let weight = answer / (16.0 * 16.0);
        let ones = "{kind='scale', factor=0.0, offset=1.0}, {kind='flatten'}";
        let layers = format!("layers=[{ones}, {{kind='dense', units=1, init={{constant={weight:?}}}}}]");
        let setting = format!("full_lock_deg={full_lock_deg:?}");
        let (result, history) = train(folder.path(), &out, &["epochs=1", AT_REST, &layers, &setting]);
        let mut split = csv::Reader::from_path(folder.path().join(&out).join("split.csv")).unwrap();
        let rows = split.records().map(|row| row.unwrap()).filter(|row| &row[2] == "validation");
        let labels: Vec<f64> = rows.map(|row| row[4].parse::<f64>().unwrap()).collect();
        let expected =
            full_lock_deg * labels.iter().map(|label| (label - answer).abs()).sum::<f64>() / labels.len() as f64;
        approx::assert_relative_eq!(result["val_mae_deg"].as_f64().unwrap(), expected, max_relative = 1e-4);
        approx::assert_relative_eq!(history[0].val_mae_deg.unwrap(), expected, max_relative = 1e-4);
        (labels, expected, result)
    };
    for full_lock_deg in [25.0, 40.0] {
        let (mut labels, expected, result) = run(full_lock_deg, 0.0);
        assert!(expected > 1.0, "labels far enough from 0 to tell units apart");
        approx::assert_relative_eq!(result["relative_to_zero"].as_f64().unwrap(), 1.0, max_relative = 1e-5);
        labels.sort_by(f64::total_cmp);
        let middle = 0.5 * (labels[0] + labels[labels.len() - 1]);
        let (_, between, _) = run(full_lock_deg, middle);
        assert!(between > 0.1, "labels on both sides of {middle}, far enough from it");
    }
}

/// A run on `log` that keeps no decoded image, with what it told; `at_batch` is called before batch 2 is trained on.
fn watched(log: &Path, out: &Path, at_batch: &dyn Fn()) -> (steersman::Result<TrainResult>, Vec<TrainingEvent>) {
    let settings = [LINEAR, "preprocessing.resize=[16, 16]", "batch=8", "epochs=2"].map(String::from);
    let request =
        TrainRequest::new(vec![log.to_path_buf()], Recipe::find("lenet", &settings).unwrap(), out.to_path_buf());
    let request = TrainRequest { seed: 5, cache_mib: 1, ..request };
    let (mut events, mut batches) = (Vec::new(), 0);
    let mut observer = |event: TrainingEvent| {
        if let TrainingEvent::Batch { .. } = event {
            batches += 1;
            if batches == 1 {
                at_batch();
            }
        }
        events.push(event);
        Ok(())
    };
    let result = training::train(request, &mut observer, &StopSignal::default());
    (result, events)
}

/// All pictures of a painted log, sorted.
fn pictures(folder: &Path) -> Vec<PathBuf> {
    let mut paths: Vec<PathBuf> =
        std::fs::read_dir(folder.join("IMG")).unwrap().map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    paths
}

#[test]
fn a_recording_that_decays_while_it_is_trained_on_ends_the_run_and_keeps_the_checkpoint() {
    let folder = tempfile::tempdir().unwrap();
    let (log, run) = (folder.path().join("log"), folder.path().join("run"));
    painted_log::write(&log, 300, "");
    let truncate = || pictures(&log).iter().step_by(2).for_each(|path| std::fs::write(path, b"\xff\xd8\xff").unwrap());
    let (result, _) = watched(&log, &run, &truncate);
    let message = result.unwrap_err().to_string();
    assert!(message.contains("more than a fifth is too much") && message.contains("--resume"), "{message}");
    assert!(message.contains("IMG/") && message.contains("the JPEG is truncated"), "{message}");
    assert!(run.join("checkpoint.safetensors").is_file() && !run.join("result.json").exists());
}

#[test]
fn figures_of_a_run_count_the_images_that_were_used() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("log");
    painted_log::write(&log, 300, "");
    let (whole, _) = watched(&log, &folder.path().join("whole"), &|| {});
    let whole = whole.unwrap();
    let vanish = || pictures(&log).iter().step_by(12).for_each(|path| std::fs::remove_file(path).unwrap());
    let (result, events) = watched(&log, &folder.path().join("run"), &vanish);
    let result = result.unwrap();
    assert!(result.train_images < whole.train_images, "{result:?}");
    // In the second epoch every image is known to be readable or not.
    let epochs: Vec<&EpochRecord> = events
        .iter()
        .filter_map(|event| if let TrainingEvent::Epoch { record, .. } = event { Some(record) } else { None })
        .collect();
    assert_eq!(epochs[1].images, result.train_images);
    let lost = whole.train_images - result.train_images;
    let told = format!("{lost} images cannot be decoded and are left out: ");
    let told = |event: &TrainingEvent| matches!(event, TrainingEvent::Notice(text) if text.starts_with(&told));
    assert!(events.iter().any(told), "{lost} lost: {events:?}");
    assert!(result.val_images < whole.val_images && result.val_images > 0, "{result:?}");
}

/// One update an epoch: the weights after each update are those of a shorter run.
const ONE_UPDATE: [&str; 4] =
    ["batch=1000", "keep=last", "optimizer.learning_rate=1e-3", "schedule.shape={kind='constant'}"];

#[test]
fn the_model_is_the_mean_of_the_weights_over_the_last_updates_and_is_what_is_validated() {
    let folder = tempfile::tempdir().unwrap();
    let after = |updates: usize| {
        let epochs = format!("epochs={updates}");
        train(folder.path(), &format!("plain-{updates}"), &[&ONE_UPDATE[..], &[&epochs]].concat());
        weights(folder.path(), &format!("plain-{updates}"), "model.safetensors").values
    };
    let plain: Vec<Vec<f32>> = (1..=4).map(after).collect();
    let ema = |k: i32| 0.5f64.powi(4 - k);
    let averages: [(&str, &str, [f64; 4]); 2] = [
        // Of four updates the first is left out: 0.25 · 4 = 1.
        ("swa", "averaging={kind='swa', from_share=0.25}", [0.0, 1.0, 1.0, 1.0]),
        ("ema", "averaging={kind='ema', decay=0.5}", [ema(1), ema(2), ema(3), ema(4)]),
    ];
    for (name, averaging, shares) in averages {
        let (result, _) = train(folder.path(), name, &[&ONE_UPDATE[..], &["epochs=4", averaging]].concat());
        let model = weights(folder.path(), name, "model.safetensors");
        assert!(model == weights(folder.path(), name, "last.safetensors"));
        for (k, value) in model.values.iter().enumerate() {
            let sum: f64 = plain.iter().zip(shares).map(|(weights, share)| share * f64::from(weights[k])).sum();
            let expected = sum / shares.iter().sum::<f64>();
            assert!((f64::from(*value) - expected).abs() < 1e-6, "{name}, weight {k}: {value} is not {expected}");
            assert!(name == "swa" || k > 0 || *value != plain[3][k], "the average is not the last weights");
        }
        // The same weights, validated by a run that does not change them.
        let file = format!("{name}/model.safetensors");
        let recording = Path::new(env!("CARGO_MANIFEST_DIR")).join("data/sample");
        let recording = recording.to_str().unwrap();
        let args = ["train", recording, "--from", &file, "--out", "again", "--seed", "5", "--json"];
        let again = json(folder.path(), &[&args[..], &["--set", "epochs=1", "--set", AT_REST]].concat());
        std::fs::remove_dir_all(folder.path().join("again")).unwrap();
        approx::assert_relative_eq!(
            again["val_mse"].as_f64().unwrap(),
            result["val_mse"].as_f64().unwrap(),
            max_relative = 1e-6
        );
    }
}

#[test]
fn a_run_with_the_simulators_set_goes_on_with_it_and_tells_of_it() {
    let folder = tempfile::tempdir().unwrap();
    let [log, set] = ["log", "set/lake"].map(|name| folder.path().join(name));
    painted_log::write(&log, 300, "");
    painted_log::write(&set, 500, "");
    // Row 0 of both is straight on; nothing is thinned out.
    let settings = [
        LINEAR,
        "preprocessing.resize=[16, 16]",
        "batch=16",
        "epochs=3",
        "samples.simulator_share=0.4",
        "balance.keep_zero=1.0",
    ];
    let recipe = Recipe::find("lenet", &settings.map(String::from)).unwrap();
    let request = |out: &str, simulator: &[&Path]| TrainRequest {
        simulator: simulator.iter().map(|path| path.to_path_buf()).collect(),
        seed: 5,
        ..TrainRequest::new(vec![log.clone()], recipe.clone(), folder.path().join(out))
    };
    let stop = StopSignal::default();
    let train = |out: &str, simulator: &[&Path]| {
        training::train(request(out, simulator), &mut |_: TrainingEvent| Ok(()), &stop).unwrap()
    };
    let (alone, whole) = (train("alone", &[]), train("whole", &[&set]));
    let own = alone.train_images;
    assert_eq!((alone.simulator_images, alone.val_images), (0, whole.val_images));
    assert_eq!(whole.train_images, own + whole.simulator_images);
    assert_eq!(whole.simulator_images, (own as f64 * 0.4 / 0.6).round() as usize);
    assert_ne!(alone.weights_hash, whole.weights_hash);
    // Another set is another run, also where the seed is the same.
    let hash = |out: &str| {
        let info = std::fs::read_to_string(folder.path().join(out).join("run.json")).unwrap();
        let info: serde_json::Value = serde_json::from_str(&info).unwrap();
        (info["rows_hash"].as_str().unwrap().to_string(), info["simulator"].as_array().map(Vec::len))
    };
    assert_eq!([hash("alone").1, hash("whole").1], [None, Some(1)]);
    assert_ne!(hash("alone").0, hash("whole").0);

    let mut batches = 0;
    let mut stopping = |event: TrainingEvent| {
        batches += usize::from(matches!(event, TrainingEvent::Batch { .. }));
        if batches > whole.train_images / 16 + 3 { Err(steersman::Error::Interrupted) } else { Ok(()) }
    };
    assert!(training::train(request("stopped", &[&set]), &mut stopping, &stop).is_err());
    let stopped = folder.path().join("stopped");
    let moved = folder.path().join("elsewhere");
    std::fs::rename(&set, &moved).unwrap();
    let resume = || training::resume(&stopped, false, &mut |_: TrainingEvent| Ok(()), &stop);
    let gone = resume().unwrap_err().to_string();
    assert!(gone.contains("simulator's set") && gone.contains("--with-simulator"), "{gone}");
    std::fs::rename(&moved, &set).unwrap();
    assert_eq!(resume().unwrap().weights_hash, whole.weights_hash);
    let split = std::fs::read_to_string(stopped.join("split.csv")).unwrap();
    assert_eq!(split.lines().filter(|line| line.contains(",simulator,")).count(), 500);
    let page = steersman::report::pages::run::write(&stopped).unwrap();
    let page = std::fs::read_to_string(page).unwrap();
    assert!(
        page.contains("the simulator's set of 1 recordings")
            || page.contains("the simulator&#39;s set of 1 recordings")
    );
}
