//! Keras files of every generation give the outputs that Keras gave (see `tests/golden/README.md`), real ones steer, and what
//! cannot be imported is refused in full.

mod common;

use std::path::{Path, PathBuf};

use common::command::{error, json, run};
use common::formula::{hash, unit};
use common::painted_log;
use ndarray::{Array4, ArrayView4};
use serde_json::Value;
use steersman::dataset::colour::Colour;
use steersman::engine::network::Network;
use steersman::engine::tensor::Shape;
use steersman::exchange::fit::{self, Frames};
use steersman::exchange::keras::{ImportOptions, import};
use steersman_kernels::Isa;

fn golden(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/keras").join(name)
}

fn expected() -> Value {
    serde_json::from_str(&std::fs::read_to_string(golden("expected.json")).unwrap()).unwrap()
}

/// Grey levels from the formula.
fn images(n: usize, Shape { c, h, w }: Shape) -> Array4<f32> {
    let hash = hash("input");
    let grey = (0..n * c * h * w).map(|i| ((unit(hash(i)) + 1.0) * 127.5 + 0.5).floor() as f32);
    Array4::from_shape_vec((n, c, h, w), grey.collect()).unwrap()
}

/// Imports `file` and compares its outputs with those of `model` in Keras, on every vector unit.
fn agrees(file: &str, model: &str, options: &ImportOptions) {
    let expected = expected();
    let outputs: Vec<f64> = serde_json::from_value(expected[model]["outputs"].clone()).unwrap();
    let imported = import(&golden(file), options).unwrap_or_else(|e| panic!("{file}: {e}"));
    let input: Vec<usize> = serde_json::from_value(expected[model]["input"].clone()).unwrap();
    assert_eq!(imported.input, Shape::new(input[2], input[0], input[1]), "{file}");
    let images = images(expected["images"].as_u64().unwrap() as usize, imported.input);
    for isa in Isa::available() {
        let network = Network::new(imported.input, &imported.layers, isa).unwrap();
        let view: ArrayView4<f32> = images.view();
        let found = network.predict(&imported.parameters, view).unwrap();
        assert_eq!(found.len(), outputs.len(), "{file}");
        for (found, expected) in found.iter().zip(&outputs) {
            assert!((f64::from(*found) - expected).abs() <= 1e-5, "{file}, {}: {found} for {expected}", isa.name());
        }
    }
}

#[test]
fn files_of_todays_keras_agree_with_it() {
    for (file, model) in [
        ("keras3.keras", "keras3"),
        ("keras3.h5", "keras3"),
        ("functional.keras", "functional"),
        ("functional.h5", "functional"),
    ] {
        agrees(file, model, &ImportOptions::default());
    }
}

/// Image by image, the steering and the throttle.
#[test]
fn two_outputs_of_one_trunk_are_steering_and_throttle() {
    for file in ["donkey.keras", "donkey.h5"] {
        agrees(file, "donkey", &ImportOptions::default());
        let imported = import(&golden(file), &ImportOptions::default()).unwrap();
        let heads: Vec<_> = imported.report.iter().rev().take(2).map(|layer| (&*layer.layer, &layer.becomes)).collect();
        let last = vec!["dense2".to_string()];
        assert_eq!(heads, [("n_outputs1", &last), ("n_outputs0", &last)]);
        let notice = &imported.notices[0];
        assert!(notice.contains("(`n_outputs0` and `n_outputs1`): the first counts as steering"), "{notice}");
    }
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("p.toml"), "source = [22, 30]\nrows = [0, 22]\nresize = [22, 30]").unwrap();
    let file = golden("donkey.h5");
    run(folder.path(), &["import", file.to_str().unwrap(), "--preprocessing", "p.toml", "--out", "m.safetensors"]);
    let pixels = images(1, Shape::new(3, 22, 30)).map(|level| *level as u8).index_axis_move(ndarray::Axis(0), 0);
    let picture =
        image::RgbImage::from_fn(30, 22, |x, y| image::Rgb([0, 1, 2].map(|c| pixels[[c, y as usize, x as usize]])));
    picture.save(folder.path().join("picture.png")).unwrap();
    let answer = json(folder.path(), &["predict", "m.safetensors", "picture.png", "--json"]);
    let outputs: Vec<f64> = serde_json::from_value(expected()["donkey"]["outputs"].clone()).unwrap();
    for (name, expected) in ["steering", "throttle"].iter().zip(outputs) {
        assert!((answer[0][name].as_f64().unwrap() - expected).abs() < 1e-5, "{name}: {answer}, not {expected}");
    }
}

/// Random layers, resizing in the network and an input's size beside the layers; and an output that is no share of full lock.
#[test]
fn students_habits_agree_with_keras() {
    for file in ["degrees.keras"] {
        agrees(file, "degrees", &ImportOptions::default());
        let plain = import(&golden(file), &ImportOptions::default()).unwrap();
        assert!(plain.notices.iter().filter(|notice| notice.contains("in training only")).count() == 2, "{file}");
        let options = ImportOptions { output_scale: Some([90.0, -45.0]), ..ImportOptions::default() };
        let scaled = import(&golden(file), &options).unwrap();
        let images = images(2, plain.input);
        let network = Network::new(plain.input, &plain.layers, Isa::best()).unwrap();
        let answers = [&plain, &scaled].map(|model| network.predict(&model.parameters, images.view()).unwrap());
        for (degrees, steering) in answers[0].iter().zip(&answers[1]) {
            assert!((steering - (degrees - 90.0) / -45.0).abs() < 1e-5, "{steering} of {degrees}");
        }
    }
    let options = ImportOptions { output_scale: Some([90.0, 45.0]), ..ImportOptions::default() };
    let two = import(&golden("donkey.h5"), &options).unwrap();
    let one = import(&golden("donkey.h5"), &ImportOptions::default()).unwrap();
    let network = Network::new(two.input, &two.layers, Isa::best()).unwrap();
    let images = images(1, two.input);
    let answers = [one, two].map(|model| network.predict(&model.parameters, images.view()).unwrap());
    assert!((answers[1][[0, 0]] - (answers[0][[0, 0]] - 90.0) / 45.0).abs() < 1e-5);
    assert_eq!(answers[1][[0, 1]], answers[0][[0, 1]], "the throttle stays");
}

/// By any ratio, down and up; the layers are like any other: they train, explain and export.
#[test]
fn resizing_in_the_network_agrees_with_tensorflow() {
    for (file, model) in [("resized.keras", "resized"), ("resized.h5", "resized"), ("keras2-area.h5", "area")] {
        agrees(file, model, &ImportOptions::default());
    }
    let folder = tempfile::tempdir().unwrap();
    let file = golden("resized.h5");
    let answer = json(folder.path(), &["import", file.to_str().unwrap(), "--out", "m.safetensors", "--json"]);
    let row = |name: &str| {
        answer["layers"].as_array().unwrap().iter().find(|row| row["layer"] == name).unwrap()["becomes"][0].clone()
    };
    assert_eq!(row("resizing_4"), "resize3");
    image::RgbImage::from_fn(43, 31, |x, y| image::Rgb([(x * 5) as u8, (y * 7) as u8, 60]))
        .save(folder.path().join("a.png"))
        .unwrap();
    run(folder.path(), &["explain", "m.safetensors", "a.png", "--out", "seen"]);
    assert!(folder.path().join("seen/explain.html").is_file());
}

#[test]
fn answers_far_beyond_full_lock_are_warned_of() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    image::RgbImage::from_pixel(90, 48, image::Rgb([90, 120, 60])).save(dir.join("a.png")).unwrap();
    let file = golden("degrees.keras");
    let file = file.to_str().unwrap();
    let warnings = |scale: &[&str]| {
        std::fs::remove_file(dir.join("m.safetensors")).ok();
        run(dir, &[&["import", file, "--out", "m.safetensors"], scale].concat());
        String::from_utf8(run(dir, &["predict", "m.safetensors", "a.png"]).stderr).unwrap()
    };
    let warned = warnings(&["--output-scale", "0,0.0001"]);
    assert!(warned.contains("1 of 1 answers lie beyond 2") && warned.contains("--output-scale"), "{warned}");
    assert_eq!(warnings(&["--output-scale", "0,1000"]), "");
}

#[test]
fn files_in_the_style_of_keras_1_and_2_agree_with_it() {
    agrees("keras1.h5", "plain", &ImportOptions::default());
    agrees("keras2.h5", "plain", &ImportOptions::default());
    agrees("keras2-slashes.h5", "plain", &ImportOptions::default());
    // Theano's axes and kernels, weights alone, the architecture in a string and without the input's size.
    let options = ImportOptions {
        architecture: Some(golden("keras1-theano.json")),
        theano_kernels: true,
        input: Some(Shape::new(3, 20, 28)),
        ..ImportOptions::default()
    };
    agrees("keras1-theano-weights.h5", "plain", &options);
    let unturned = ImportOptions { theano_kernels: false, ..options };
    let notices = import(&golden("keras1-theano-weights.h5"), &unturned).unwrap().notices;
    assert!(notices[0].contains("--theano-kernels"), "{notices:?}");
}

#[test]
fn every_layer_is_reported_with_what_becomes_of_it() {
    let imported = import(&golden("functional.keras"), &ImportOptions::default()).unwrap();
    let row = |name: &str| {
        let found = imported.report.iter().find(|row| row.layer == name).unwrap();
        (found.class.clone(), found.becomes.join(" "))
    };
    assert_eq!(row("eyes"), ("Conv2D".into(), "conv1".into()));
    assert_eq!(row("dense_5"), ("Dense".into(), "conv2 relu1".into()));
    assert_eq!(row("gaussian_noise"), ("GaussianNoise".into(), String::new()));
    assert_eq!(row("steering"), ("Dense".into(), "dense2".into()));
    assert!(imported.notices[0].contains("acts in training only"));
}

#[test]
fn an_imported_model_is_like_any_other() {
    let folder = tempfile::tempdir().unwrap();
    let log = painted_log::write(&folder.path().join("log"), 30, "");
    let log = log.parent().unwrap().to_str().unwrap().to_string();
    let answer = json(
        folder.path(),
        &["import", golden("keras2.h5").to_str().unwrap(), "--out", "m.safetensors", "--fit", &log, "--json"],
    );
    assert_eq!(answer["keras_version"], "2.1.2");
    assert_eq!(answer["parameters"], 2450);
    let fits = answer["fit"].as_array().unwrap();
    let correlation = |fit: &Value| fit["correlation"].as_f64().unwrap();
    let error_left = |fit: &Value| fit["line"]["error"].as_f64().unwrap();
    assert!(fits.len() >= 12 && error_left(&fits[0]) <= error_left(&fits[1]));
    assert_eq!(answer["preprocessing"], fits[0]["preprocessing"]);

    let metrics = json(folder.path(), &["evaluate", "m.safetensors", &log, "--json"]);
    assert_eq!(metrics["rows"], 30);
    assert!((metrics["mse"].as_f64().unwrap().sqrt() - fits[0]["error"].as_f64().unwrap()).abs() < 1e-4);
    assert!((metrics["correlation"].as_f64().unwrap() - correlation(&fits[0])).abs() < 1e-4);
    let summary = String::from_utf8(run(folder.path(), &["summary", "m.safetensors"]).stdout).unwrap();
    assert!(summary.contains("leaky ReLU 0.2") && summary.contains("zero padding"), "{summary}");
    assert!(summary.contains("not trained here"), "{summary}");
    let frame = std::fs::read_dir(Path::new(&log).join("IMG")).unwrap().next().unwrap().unwrap().path();
    run(folder.path(), &["predict", "m.safetensors", frame.to_str().unwrap()]);

    for (format, file) in [("c", "model.c"), ("rust", "model.rs"), ("onnx", "model.onnx")] {
        run(folder.path(), &["export", "m.safetensors", file, "--to", format]);
        assert!(std::fs::metadata(folder.path().join(file)).unwrap().len() > 4 * 2450, "{file}");
    }
    let trained = json(
        folder.path(),
        &[
            &["train", &log, "--from", "m.safetensors", "--set", "epochs=1", "--set", "batch=8", "--out", "run"][..],
            &["--set", "split.validation_share=0", "--json"],
        ]
        .concat(),
    );
    let trained = trained["model"].as_str().unwrap_or_else(|| panic!("no model in {trained}")).to_string();
    assert_eq!(json(folder.path(), &["evaluate", &trained, &log, "--json"])["rows"], 30);
    run(folder.path(), &["explain", "m.safetensors", frame.to_str().unwrap(), "--out", "seen"]);
    assert!(folder.path().join("seen/explain.html").is_file());

    let again = error(folder.path(), &["import", golden("keras2.h5").to_str().unwrap(), "--out", "m.safetensors"]);
    assert!(again.contains("m.safetensors exists"), "{again}");
}

/// Driven and served, an imported model goes the same way.
#[cfg(unix)]
#[test]
fn an_imported_model_drives_and_is_served() {
    let folder = tempfile::tempdir().unwrap();
    run(folder.path(), &["import", golden("keras2.h5").to_str().unwrap(), "--out", "m.safetensors"]);
    let served = common::served::Served::start(folder.path(), "m.safetensors", &["--speed", "20"]);
    let url = format!("ws://127.0.0.1:{}", served.port);
    let way = ["--track", "lake", "--seed", "5", "--json"];
    let driven = json(folder.path(), &[&["drive", "m.safetensors", "--runs", "1"][..], &way].concat());
    let simulated = json(folder.path(), &[&["sim", "--connect", &url, "--lockstep"][..], &way].concat());
    assert!(driven["distance_m"].as_f64().unwrap() > 1.0, "{driven}");
    assert_eq!(driven["distance_m"], simulated["distance_m"]);
    served.stop();
}

#[test]
fn a_preprocessing_that_fits_badly_is_taken_with_a_warning() {
    let folder = tempfile::tempdir().unwrap();
    let log = painted_log::write(&folder.path().join("log"), 200, "");
    // The labels of other pictures: nothing goes with them.
    let shuffled: Vec<String> = std::fs::read_to_string(&log)
        .unwrap()
        .lines()
        .enumerate()
        .map(|(row, line)| {
            let mut fields: Vec<&str> = line.split(", ").collect();
            let label = format!("{}", 0.4 * unit(hash("labels")(row)));
            if row > 0 {
                fields[3] = &label;
            }
            fields.join(", ")
        })
        .collect();
    std::fs::write(&log, shuffled.join("\n")).unwrap();
    let file = golden("keras2.h5");
    let args = ["import", file.to_str().unwrap(), "--out", "m.safetensors", "--fit", "log"];
    let output = run(folder.path(), &args);
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("warning: no preprocessing fits"), "{said}\n{}", String::from_utf8_lossy(&output.stdout));
}

/// The architecture of `keras1-theano.json`, which is JSON in a string, with its list of layers changed.
fn changed_architecture(path: &Path, change: impl Fn(&mut Vec<Value>)) {
    let text: String = serde_json::from_str(&std::fs::read_to_string(golden("keras1-theano.json")).unwrap()).unwrap();
    let mut model: Value = serde_json::from_str(&text).unwrap();
    change(model["config"].as_array_mut().unwrap());
    std::fs::write(path, model.to_string()).unwrap();
}

#[test]
fn several_outputs_or_another_preprocessing_are_refused_before_anything_is_fitted() {
    let folder = tempfile::tempdir().unwrap();
    painted_log::write(&folder.path().join("log"), 30, "");
    let refused = |args: &[&str]| error(folder.path(), &[&["import", "--fit", "log"], args].concat());
    let keras1 = golden("keras1.h5");
    let message = refused(&[keras1.to_str().unwrap(), "--preprocessing", "oargueta"]);
    assert!(message.contains("takes images of 20x28 with 3 colour planes"), "{message}");

    std::fs::write(folder.path().join("p.toml"), "resize = [20, 28]").unwrap();
    changed_architecture(&folder.path().join("several.json"), |layers| drop(layers.pop()));
    let weights = golden("keras1-theano-weights.h5");
    let weights = [weights.to_str().unwrap(), "--preprocessing", "p.toml", "--architecture", "several.json"];
    let message = refused(&weights);
    assert!(message.contains("gives 6 numbers for an image"), "{message}");
}

#[test]
fn names_of_the_file_reach_the_terminal_short_and_tame() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("names.json");
    changed_architecture(&path, |layers| {
        for number in 0..30 {
            let name = format!("\u{1b}[31m{number}{}", "long".repeat(1000));
            layers.push(serde_json::json!({"class_name": name, "config": {"name": name}}));
        }
    });
    let options = ImportOptions { architecture: Some(path), ..ImportOptions::default() };
    let message = import(&golden("keras1-theano-weights.h5"), &options).unwrap_err().to_string();
    assert!(message.contains("30 layers cannot be imported") && message.ends_with("and 10 more"), "{message}");
    assert!(!message.contains('\u{1b}') && message.len() < 10_000, "{message}");
}

#[test]
fn what_cannot_be_imported_is_said_in_full() {
    let folder = tempfile::tempdir().unwrap();
    let keras1 = golden("keras1.h5");
    let import = |args: &[&str]| error(folder.path(), &[&["import", "--out", "m.safetensors"], args].concat());
    let weights = golden("keras1-theano-weights.h5");
    let weights = weights.to_str().unwrap();

    assert!(import(&["none.h5"]).contains("none.h5"));
    assert!(import(&[weights]).contains("--architecture FILE.json"));
    assert!(import(&[golden("expected.json").to_str().unwrap()]).contains("neither an HDF5 file nor the zip archive"));
    let architecture = golden("keras1-theano.json");
    let unsized_input = import(&[weights, "--architecture", architecture.to_str().unwrap()]);
    assert!(unsized_input.contains("give the preprocessing"), "{unsized_input}");
    let unfitting = import(&[keras1.to_str().unwrap(), "--preprocessing", "oargueta"]);
    assert!(unfitting.contains("takes images of 20x28 with 3 colour planes"), "{unfitting}");
    let unknown = import(&[keras1.to_str().unwrap(), "--lambda", "lambda_7=2,1"]);
    assert!(unknown.contains("has no layer `lambda_7`"), "{unknown}");

    let json = r#"{"class_name": "Sequential", "config": [
        {"class_name": "TimeDistributed", "config": {"name": "frames", "batch_input_shape": [null, 5, 20, 28, 3]}},
        {"class_name": "Conv2D", "config": {"name": "eyes", "filters": 3, "kernel_size": [3, 3], "dilation_rate": [2, 2]}},
        {"class_name": "Flatten", "config": {"name": "flat"}},
        {"class_name": "LSTM", "config": {"name": "memory", "units": 3}},
        {"class_name": "Dense", "config": {"name": "out", "units": 1, "activation": "sigmoid"}}]}"#;
    std::fs::write(folder.path().join("lstm.json"), json).unwrap();
    let all = import(&[weights, "--architecture", "lstm.json"]);
    assert!(all.contains("4 layers cannot be imported"), "{all}");
    for layer in ["frames (TimeDistributed)", "eyes (Conv2D)", "memory (LSTM)", "out (Dense): activation `sigmoid`"] {
        assert!(all.contains(layer), "{layer} in {all}");
    }

    let other = std::fs::read_to_string(architecture).unwrap().replace("nb_filter\\\": 5", "nb_filter\\\": 6");
    std::fs::write(folder.path().join("other.json"), other).unwrap();
    std::fs::write(folder.path().join("p.toml"), "resize = [20, 28]").unwrap();
    let wrong = import(&[weights, "--architecture", "other.json", "--preprocessing", "p.toml"]);
    assert!(wrong.contains("conv_b (Convolution2D): tensor `conv_b_W:0` has shape"), "{wrong}");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 3, "nothing is left behind");
}

/// The folder in `variable`, or a printed reason.
fn folder_of(variable: &str) -> Option<PathBuf> {
    let folder = std::env::var_os(variable).map(PathBuf::from);
    match folder.as_ref().map(|folder| folder.is_dir()) {
        Some(true) => folder,
        Some(false) => panic!("{variable} is no folder: {folder:?}"),
        None => {
            eprintln!("skipped: {variable} is not set");
            None
        }
    }
}

/// A model that was trained here on pictures in BGR, of which crop and colours are to be found again.
#[test]
fn the_preprocessing_of_our_own_model_is_found_again() {
    let folder = tempfile::tempdir().unwrap();
    let log = painted_log::write(&folder.path().join("log"), 160, "");
    let (log, dir) = (log.parent().unwrap(), folder.path());
    let settings =
        ["epochs=4", "batch=16", "split.validation_share=0", "preprocessing.colour=\"bgr\"", "samples.flip=\"none\""];
    let settings: Vec<&str> = settings.iter().flat_map(|setting| ["--set", setting]).collect();
    let args = ["train", log.to_str().unwrap(), "--recipe", "default", "--out", "run"];
    run(dir, &[&args[..], &settings].concat());
    let model = steersman::model_file::Model::load(&dir.join("run/model.safetensors")).unwrap();
    let network = model.recipe.network(Isa::best()).unwrap();
    let frames = Frames::of(&steersman::dataset::load(log).unwrap()).unwrap();
    let own = &model.recipe.preprocessing;
    let ranking = fit::rank(&network, &model.parameters, &frames, Some(own)).unwrap();
    let place = ranking.iter().position(|candidate| candidate.preprocessing == *own).unwrap();
    let (best, own) = (&ranking[0], &ranking[place].agreement);
    let line = own.line.unwrap();
    println!("place {place} of {}: {own:?}, best {best:?}", ranking.len());
    assert_eq!(best.preprocessing.colour, Colour::Bgr);
    assert!(line.error < 1.3 * best.agreement.line.unwrap().error, "{line:?}");
    assert!((0.7..1.4).contains(&line.gain) && line.bias.abs() < 0.1 && own.correlation.unwrap() > 0.9, "{line:?}");
    assert_eq!(own.absurdity(), None);
}

/// The colours, which only OpenCV up to 3.1 gave, and the crops of two models of 2017, off the lake. On the lake's labels their gains are
/// about 1, and nothing is to be warned of.
#[test]
fn the_preprocessing_of_real_models_is_found() {
    let (Some(models), Some(recordings)) = (folder_of("STEERSMAN_MODELS"), folder_of("STEERSMAN_RECORDINGS")) else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let lake = recordings.join("lake-sample");
    let (first, second) = (models.join("naokishibuya/model.h5"), models.join("naokishibuya-2017-01-14/model.h5"));
    let architecture = second.with_file_name("model.json");
    let second = [second.to_str().unwrap(), "--architecture", architecture.to_str().unwrap()];
    for (files, rows, most_error, gains) in
        [(&[first.to_str().unwrap()][..], [60, 135], 0.11, 1.0..1.35), (&second, [30, 135], 0.13, 0.7..1.0)]
    {
        let args = [&["import"], files, &["--fit", lake.to_str().unwrap(), "--json"]].concat();
        let output = run(folder.path(), &args);
        let warnings = String::from_utf8_lossy(&output.stderr);
        assert!(!warnings.contains("warning"), "{warnings}");
        let text = String::from_utf8_lossy(&output.stdout);
        let answer: Value = serde_json::from_str(text.lines().last().unwrap()).unwrap();
        let fits = answer["fit"].as_array().unwrap();
        let numbers = |fit: &Value| ["gain", "error"].map(|name| fit["line"][name].as_f64().unwrap());
        for fit in &fits[..5] {
            let [gain, error] = numbers(fit);
            assert_eq!(fit["preprocessing"]["colour"], "yuv-old", "{fit}");
            assert!(error < most_error && gains.contains(&gain), "{fit}");
        }
        assert!(fits[..5].iter().any(|fit| fit["preprocessing"]["rows"] == serde_json::json!(rows)), "{fits:?}");
    }
}

/// Two models of 2017 (naokishibuya/car-behavioral-cloning) whose correlations with the labels are known.
#[test]
fn real_models_of_2017_steer() {
    let (Some(models), Some(recordings)) = (folder_of("STEERSMAN_MODELS"), folder_of("STEERSMAN_RECORDINGS")) else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let correlation = |model: &str, recording: &str| {
        let recording = recordings.join(recording);
        let metrics = json(folder.path(), &["evaluate", model, recording.to_str().unwrap(), "--json"]);
        metrics["correlation"].as_f64().unwrap()
    };
    let first = models.join("naokishibuya/model.h5");
    let args = ["--preprocessing", "naokishibuya", "--out", "first.safetensors", "--json"];
    let answer = json(folder.path(), &[&["import", first.to_str().unwrap()][..], &args].concat());
    assert_eq!((answer["parameters"].as_u64(), answer["keras_version"].as_str()), (Some(252_219), Some("1.2.1")));
    let (lake, mountain) =
        (correlation("first.safetensors", "lake-sample"), correlation("first.safetensors", "mountain-keyboard"));
    println!("correlation with the labels: {lake:.3} on the lake, {mountain:.3} on the mountain");

    let second = models.join("naokishibuya-2017-01-14");
    let (file, architecture) = (second.join("model.h5"), second.join("model.json"));
    let args = ["--preprocessing", "naokishibuya-2017-01-14", "--out", "second.safetensors"];
    let files = ["import", file.to_str().unwrap(), "--architecture", architecture.to_str().unwrap()];
    run(folder.path(), &[&files[..], &args].concat());
    let (earlier_lake, earlier_mountain) =
        (correlation("second.safetensors", "lake-sample"), correlation("second.safetensors", "mountain-keyboard"));
    println!(
        "correlation with the labels, earlier model: {earlier_lake:.3} on the lake, {earlier_mountain:.3} on the mountain"
    );
    // Keras itself, on every third row and with another resizing: 0.66, 0.32; 0.48, 0.62.
    for (found, expected) in [(lake, 0.66), (mountain, 0.34), (earlier_lake, 0.48), (earlier_mountain, 0.63)] {
        assert!((found - expected).abs() < 0.02, "{found} for {expected}");
    }
}
