//! A model with a second output, throttle or speed, from the recipe to the road.

mod common;

use std::path::{Path, PathBuf};

use common::command::{error, json, run};
use serde_json::Value;
use steersman::dataset::OutputKind;
use steersman::model_file::{Model, TrainingRecord};
use steersman::pilot::Pilot;
use steersman::recipe::Recipe;
use steersman::simulator::{Speed, Track, TrialOptions, run_trial};
use steersman_kernels::Isa;

const THROTTLE: &str = "outputs=[{ name = 'steering' }, { name = 'throttle', loss_weight = 0.5 }]";
const SPEED: &str = "outputs=[{ name = 'steering' }, { name = 'speed', top_speed_mph = 25.0 }]";
const TWO_UNITS: &str = "layers.last.units=2";

fn sample() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("data/sample")
}

/// Trains `lenet` on `recording` for two epochs.
fn train(folder: &Path, recording: &Path, out: &str, settings: &[&str]) -> Value {
    let mut args = vec!["train", recording.to_str().unwrap(), "--recipe", "lenet", "--out", out, "--json"];
    for setting in ["epochs=2", "batch=8", "split.validation_share=0.3"].iter().chain(settings) {
        args.extend(["--set", setting]);
    }
    json(folder, &args)
}

/// A copy of the sample in `folder` whose log went through `change`, line by line.
fn changed_sample(folder: &Path, change: impl Fn(usize, &str) -> String) -> PathBuf {
    let copy = folder.join("changed");
    std::fs::create_dir_all(copy.join("IMG")).unwrap();
    for entry in std::fs::read_dir(sample().join("IMG")).unwrap() {
        let path = entry.unwrap().path();
        std::fs::copy(&path, copy.join("IMG").join(path.file_name().unwrap())).unwrap();
    }
    let log = std::fs::read_to_string(sample().join("driving_log.csv")).unwrap();
    let lines: Vec<String> = log.lines().enumerate().map(|(number, line)| change(number, line)).collect();
    std::fs::write(copy.join("driving_log.csv"), lines.join("\n") + "\n").unwrap();
    copy
}

/// A tub in `folder` of the sample's pictures whose records have an angle alone.
fn tub_without_throttle(folder: &Path) -> PathBuf {
    let tub = folder.join("tub");
    std::fs::create_dir_all(&tub).unwrap();
    std::fs::write(tub.join("meta.json"), "{\"inputs\": [\"cam/image_array\", \"user/angle\"]}").unwrap();
    for number in 0..24 {
        let name = format!("{number}_cam-image_array_.jpg");
        std::fs::copy(picture(), tub.join(&name)).unwrap();
        let angle = f64::from(number % 7 - 3) / 10.0;
        let record = serde_json::json!({"cam/image_array": name, "user/angle": angle, "user/mode": "user", "milliseconds": 900 * number});
        std::fs::write(tub.join(format!("record_{number}.json")), record.to_string()).unwrap();
    }
    tub
}

fn picture() -> PathBuf {
    let mut pictures: Vec<PathBuf> =
        std::fs::read_dir(sample().join("IMG")).unwrap().map(|entry| entry.unwrap().path()).collect();
    pictures.sort();
    pictures.remove(3)
}

/// A model of `lenet` with a second output, whose answer is `steering` and `second` whatever it sees.
fn constant_model(path: &Path, outputs: &str, steering: f32, second: f32) {
    let recipe = Recipe::find("lenet", &[TWO_UNITS, outputs].map(String::from)).unwrap();
    let network = recipe.network(Isa::PORTABLE).unwrap();
    let mut parameters = network.initialize(1);
    parameters.tensor_mut(network.tensor("dense3.weight").unwrap()).fill(0.0);
    parameters.tensor_mut(network.tensor("dense3.bias").unwrap()).copy_from_slice(&[steering, second]);
    let record = TrainingRecord::default();
    Model { recipe, parameters, record, training_rows: vec![] }.save(path).unwrap();
}

#[test]
fn training_learns_both_and_tells_the_errors_of_both() {
    let scratch = tempfile::tempdir().unwrap();
    let folder = scratch.path();
    for (outputs, out, figure) in [(THROTTLE, "throttle", "val_throttle_mae"), (SPEED, "speed", "val_speed_mae_mph")] {
        let result = train(folder, &sample(), out, &[TWO_UNITS, outputs, "epochs=200", "balance.keep_zero=1.0"]);
        assert!(result[figure].is_number() && result["val_mae_deg"].is_number(), "{result}");
        let history = std::fs::read_to_string(folder.join(out).join("history.csv")).unwrap();
        assert!(history.lines().next().unwrap().contains(figure), "{history}");
        let model = Model::load(&folder.join(out).join("model.safetensors")).unwrap();
        assert_eq!(model.recipe.outputs.count(), 2);
        let evaluated = json(folder, &["evaluate", out, sample().to_str().unwrap(), "--json"]);
        let beside = &evaluated[if out == "throttle" { "throttle" } else { "speed_mph" }];
        assert_eq!(beside["rows"], 24, "{evaluated}");
        // Speeds of 19 to 21 mph, throttles of 0.16: after 200 epochs it is nearer to them than to nothing.
        let (mae, near) = (beside["mae"].as_f64().unwrap(), if out == "throttle" { 0.08 } else { 6.0 });
        assert!(mae < near, "{evaluated}");
        let predicted = json(folder, &["predict", out, picture().to_str().unwrap(), "--json"]);
        let answer = Pilot::load(&folder.join(out).join("model.safetensors")).unwrap().answer_file(&picture()).unwrap();
        let close = |value: &Value, expected: f32| (value.as_f64().unwrap() as f32 - expected).abs() < 1e-6;
        assert!(close(&predicted[0]["steering"], answer.steering), "{predicted}");
        match answer.throttle {
            Some(throttle) => assert!(close(&predicted[0]["throttle"], throttle), "{predicted}"),
            None => {
                assert!(close(&predicted[0]["speed"], answer.speed.unwrap()), "{predicted}");
                let mph = predicted[0]["speed_mph"].as_f64().unwrap();
                assert!((mph - 25.0 * f64::from(answer.speed.unwrap())).abs() < 1e-4, "{predicted}");
            }
        }
        let text = String::from_utf8(run(folder, &["predict", out, picture().to_str().unwrap()]).stdout).unwrap();
        assert!(text.contains(if out == "throttle" { "throttle" } else { " mph" }), "{text}");
    }
}

#[test]
fn naming_the_steering_alone_changes_no_bit() {
    let scratch = tempfile::tempdir().unwrap();
    let plain = train(scratch.path(), &sample(), "plain", &[]);
    let named = train(scratch.path(), &sample(), "named", &["outputs=[{ name = 'steering' }]"]);
    assert_eq!(plain["weights_hash"], named["weights_hash"]);
    assert_eq!(plain["val_mse"], named["val_mse"]);
    let recipe = |out: &str| std::fs::read_to_string(scratch.path().join(out).join("recipe.toml")).unwrap();
    assert_eq!(recipe("plain"), recipe("named"));
    assert!(!recipe("plain").contains("outputs"));
    // A weight does change it.
    let weighted =
        train(scratch.path(), &sample(), "weighted", &["outputs=[{ name = 'steering', loss_weight = 2.0 }]"]);
    assert_ne!(plain["weights_hash"], weighted["weights_hash"]);
}

#[test]
fn a_run_that_is_resumed_has_the_same_bits() {
    let scratch = tempfile::tempdir().unwrap();
    let whole = train(scratch.path(), &sample(), "whole", &[TWO_UNITS, THROTTLE]);
    let run_folder = scratch.path().join("whole");
    std::fs::remove_file(run_folder.join("result.json")).unwrap();
    std::fs::remove_file(run_folder.join("checkpoint.safetensors")).unwrap();
    let resumed = json(scratch.path(), &["train", "--resume", "whole", "--json"]);
    assert_eq!(resumed["weights_hash"], whole["weights_hash"]);
    // The same steering with another throttle are other rows.
    let path = changed_sample(scratch.path(), |number, line| {
        let mut fields: Vec<&str> = line.split(", ").collect();
        if number > 0 {
            fields[4] = "0.75";
        }
        fields.join(", ")
    });
    std::fs::remove_file(run_folder.join("result.json")).unwrap();
    let moved = ["train", "--resume", "whole", "--recordings", path.to_str().unwrap()];
    assert!(error(scratch.path(), &moved).contains("the recordings have changed"), "the throttle is a label");
}

#[test]
fn a_missing_label_is_an_error_with_its_place_and_a_remedy() {
    let scratch = tempfile::tempdir().unwrap();
    let folder = scratch.path();
    let path = tub_without_throttle(folder);
    let path = path.to_str().unwrap();
    for (outputs, words) in [(THROTTLE, "`throttle`"), (SPEED, "`speed`")] {
        let args = ["train", path, "--recipe", "lenet", "--out", "run", "--set", TWO_UNITS, "--set", outputs];
        let message = error(folder, &args);
        assert!(message.contains("tub") && message.contains(words), "{message}");
        assert!(message.contains("record it, or take a recipe"), "{message}");
        assert!(!folder.join("run").exists());
    }
    train(folder, Path::new(path), "steering", &["split.validation_share=0.0"]);
    constant_model(&folder.join("model"), THROTTLE, 0.0, 0.3);
    let output = run(folder, &["evaluate", "model", path, "--json"]);
    assert!(String::from_utf8_lossy(&output.stderr).contains("no row has a throttle"));
    assert!(!String::from_utf8_lossy(&output.stdout).contains("throttle"));
}

#[test]
fn the_recipe_says_what_is_wrong_with_outputs() {
    let scratch = tempfile::tempdir().unwrap();
    let failing = |settings: &[&str]| {
        let mut args = vec!["summary", "--recipe", "lenet"];
        settings.iter().for_each(|setting| args.extend(["--set", setting]));
        error(scratch.path(), &args)
    };
    let message = failing(&[THROTTLE]);
    assert!(message.contains("one for each of the outputs steering, throttle"), "{message}");
    assert!(message.contains("--set layers.last.units=2"), "{message}");
    assert!(failing(&[TWO_UNITS]).contains("must give one number, the steering"));
    assert!(failing(&["layers.99.units=2"]).contains("layers are counted from 1 to 13"));
    assert!(failing(&["outputs=[{ name = 'brake' }]"]).contains("unknown variant `brake`"));
    assert!(failing(&[TWO_UNITS, "outputs=[{ name = 'steering' }, { name = 'speed' }]"]).contains("top_speed_mph"));
}

#[test]
fn the_model_gives_the_throttle_only_if_that_is_asked_for() {
    let scratch = tempfile::tempdir().unwrap();
    let folder = scratch.path();
    // Without steering the car leaves the road after some seconds; until then it has the speed.
    let drive = |model: &str, speed| {
        let options = TrialOptions { laps: 1, speed, latency_ms: 0.0, noise: 0.0, assisted: false };
        let mut pilot = Pilot::load(&folder.join(model)).unwrap();
        run_trial(&Track::load("lake").unwrap(), &mut pilot, &options, 1).unwrap().mean_speed_mph()
    };
    constant_model(&folder.join("speed"), SPEED, 0.0, 0.5);
    constant_model(&folder.join("throttle"), THROTTLE, 0.0, 0.9);
    let held = drive("speed", Speed::Fixed(20.0));
    let (own, limited) = (drive("speed", Speed::Driver(30.0)), drive("speed", Speed::Driver(10.0)));
    assert!(held > 15.0 && (10.0..13.5).contains(&own) && (8.0..11.5).contains(&limited), "{held} {own} {limited}");
    let (full, gentle) = (drive("throttle", Speed::Driver(30.0)), drive("throttle", Speed::Driver(13.0)));
    assert!(full > gentle + 1.0 && gentle < 13.0, "{full} {gentle}");

    let plain = Recipe::find("lenet", &[]).unwrap();
    let parameters = plain.network(Isa::PORTABLE).unwrap().initialize(1);
    let record = TrainingRecord::default();
    Model { recipe: plain, parameters, record, training_rows: vec![] }.save(&folder.join("plain")).unwrap();
    for command in [
        &["drive", "plain", "--track", "lake", "--throttle", "model"][..],
        &["serve", "plain", "--port", "0", "--throttle", "model"],
        &["drive", "speed", "--track", "lake", "--throttle", "model", "--against", "plain"],
    ] {
        let message = error(folder, command);
        assert!(message.contains("plain gives the steering alone") && message.contains("`outputs`"), "{message}");
    }
    let auto = ["drive", "speed", "--track", "lake", "--throttle", "model", "--speed", "auto"];
    assert!(error(folder, &auto).contains("does not go with --speed auto"));
}

#[test]
fn a_batch_has_the_bits_of_single_pictures_and_the_order_of_the_recipe() {
    let scratch = tempfile::tempdir().unwrap();
    let path = scratch.path().join("model");
    constant_model(&path, SPEED, 0.25, 0.5);
    let mut pilot = Pilot::load(&path).unwrap();
    let images = ndarray::Array4::from_shape_fn((3, 120, 160, 3), |(n, y, x, c)| ((n * 91 + y + x * c) % 251) as u8);
    let all = pilot.predict_outputs(images.view()).unwrap();
    assert_eq!(all.dim(), (3, 2));
    for (image, row) in images.outer_iter().zip(all.outer_iter()) {
        let answer = pilot.answer(image).unwrap();
        assert_eq!((row[0], Some(row[1])), (answer.steering, answer.speed));
        assert_eq!((answer.steering, answer.speed, answer.throttle), (0.25, Some(0.5), None));
    }
    assert_eq!(pilot.recipe().outputs.index(OutputKind::Speed), Some(1));
    assert_eq!(pilot.recipe().outputs.top_speed_mph(), Some(25.0));
}
