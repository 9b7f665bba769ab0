//! Exported models compute what the engine computes: as C, as Rust, in ONNX Runtime, and in donkeycar.

mod common;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use common::command::{error, json, run};
use common::formula::{hash, unit};
use steersman::engine::network::LayerSpec;
use steersman::model_file::{Model, TrainingRecord};
use steersman::pilot::Pilot;
use steersman::recipe::Recipe;
use steersman_kernels::Isa;

/// Largest difference of the steering, relative to it where it is beyond 1.
const BOUND: f32 = 1e-5;

/// Kinds of layers with odd sizes, which have to fit each other; [`layers`] adds all others.
const LAYERS: &str = r#"[
  { kind = "scale", factor = 0.01, offset = -1.0 },
  { kind = "batch_norm" },
  { kind = "conv2d", filters = 5, kernel = [3, 4], stride = [2, 1], padding = "same" },
  { kind = "prelu", slopes = "per_channel" },
  { kind = "batch_norm" },
  { kind = "average_pool", window = [2, 3], stride = [1, 2] },
  { kind = "crop", rows = [1, 0], columns = [0, 2] },
  { kind = "conv2d", filters = 7, kernel = [3, 3], padding = "same" },
  { kind = "batch_norm", epsilon = 0.01 },
  { kind = "elu", alpha = 0.5 },
  { kind = "zero_pad", rows = [1, 0], columns = [2, 1] },
  { kind = "tanh" },
  { kind = "conv2d", filters = 4, kernel = [2, 3], stride = [1, 2] },
  { kind = "prelu" },
  { kind = "max_pool", window = [3, 2], stride = [2, 2] },
  { kind = "dropout", drop_probability = 0.5 },
  { kind = "dense", units = 9 },
  { kind = "batch_norm" },
  { kind = "prelu" },
  { kind = "conv2d", filters = 6, kernel = [1, 1] },
  { kind = "leaky_relu", slope = 0.3 },
  { kind = "softsign" },
  { kind = "dense", units = 8 },
  { kind = "relu" },
  { kind = "flatten" },
  { kind = "dense", units = 1 },
]"#;

/// Every kind of layer: [`LAYERS`], and behind its first batch normalisation the examples of all kinds that it leaves out.
fn layers() -> String {
    let is_left_out = |kind: &str| !LAYERS.contains(&format!("kind = \"{kind}\""));
    let others = LayerSpec::EXAMPLES.iter().filter(|(kind, _)| is_left_out(kind));
    let others: String = others.map(|(_, example)| format!("\n  {example},")).collect();
    assert!(others.contains("swish"), "{others}");
    LAYERS.replacen("{ kind = \"batch_norm\" },", &format!("{{ kind = \"batch_norm\" }},{others}"), 1)
}

/// Every colour space, resized in every way: halved, linear down and up, area down and up, not at all; blurred before each of these.
const PREPROCESSINGS: [(&str, &str); 14] = [
    ("bgr", "colour = 'bgr', rows = [1, 39], resize = [21, 33]"),
    ("yuv-old", "colour = 'yuv-old', interpolation = 'linear', rows = [5, 38], resize = [19, 23]"),
    ("hsv", "colour = 'hsv', rows = [2, 38], resize = [18, 25]"),
    ("hls", "colour = 'hls', interpolation = 'area', rows = [0, 37], resize = [17, 31], colour_first = true"),
    ("lab", "colour = 'lab', interpolation = 'area', rows = [10, 30], resize = [27, 60]"),
    ("gray", "colour = 'gray', rows = [10, 30], resize = [20, 50], scale = 0.75, offset = 20.0"),
    ("rgb", "colour = 'rgb', rows = [10, 30], resize = [31, 77]"),
    ("yuv", "colour = 'yuv', interpolation = 'area', rows = [0, 40], resize = [16, 24]"),
    ("saturation", "colour = 'saturation', rows = [0, 40], resize = [20, 25], colour_first = true"),
    ("copy", "colour = 'lab', rows = [3, 30], resize = [27, 50], colour_first = true"),
    ("blur", "colour = 'yuv', rows = [5, 38], resize = [19, 23], blur = true"),
    ("blur-area", "colour = 'bgr', rows = [5, 40], resize = [19, 23], blur = true, interpolation = 'area'"),
    ("blur-planes", "colour = 'hsv', rows = [0, 40], resize = [20, 25], blur = true, colour_first = true"),
    ("blur-copy", "colour = 'rgb', rows = [3, 30], resize = [27, 50], blur = true"),
];

fn shipped(name: &str) -> Recipe {
    Recipe::find(name, &[]).unwrap()
}

fn every_layer() -> impl Iterator<Item = Recipe> {
    PREPROCESSINGS.into_iter().map(|(name, preprocessing)| {
        let text = format!(
            "name = '{name}'\nepochs = 1\nbatch = 1\nfull_lock_deg = 20.5\nlayers = {}\n\
             preprocessing = {{ source = [40, 50], {preprocessing} }}\noptimizer = {{ kind = 'adam', learning_rate = 1e-3 }}\n",
            layers()
        );
        Recipe::parse(name, &text, &[]).unwrap()
    })
}

/// A model with first weights, and slopes and statistics that are not those of a fresh network.
fn model(recipe: Recipe) -> Model {
    let network = recipe.network(Isa::PORTABLE).unwrap();
    let mut parameters = network.initialize(11);
    for tensor in network.tensors() {
        let number = hash(&tensor.name);
        let around = if tensor.name.ends_with("variance") { 0.6 } else { 0.3 };
        for (index, value) in parameters.tensor_mut(tensor).iter_mut().enumerate() {
            if tensor.spec.name != "weight" {
                *value += (around * unit(number(index))) as f32;
            }
        }
    }
    Model { recipe, parameters, record: TrainingRecord::default(), training_rows: vec![] }
}

/// Pictures of noise, of smooth colours, of nearly grey and of few levels.
fn pictures([h, w]: [usize; 2], count: usize) -> Vec<Vec<u8>> {
    let picture = |number: usize| {
        let noise = hash(&format!("picture {number}"));
        let level = |i: usize| {
            let (x, y, c) = (i / 3 % w, i / 3 / w, i % 3);
            let grain = (noise(i) >> 24) as usize;
            match number % 4 {
                0 => grain,
                1 => (x * (number + c) * 3 / 2 + y * (5 - c)) % 256,
                2 => (noise(i / 3) >> 24) as usize / 2 + 60 + grain % 4,
                _ => [0, 1, 127, 128, 254, 255][grain % 6],
            }
        };
        (0..h * w * 3).map(|i| level(i) as u8).collect()
    };
    (0..count).map(picture).collect()
}

fn run_tool(command: &mut Command) -> String {
    let output = command.output().unwrap();
    let messages = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && messages.is_empty(), "{command:?}: {messages}");
    String::from_utf8(output.stdout).unwrap()
}

/// Exports `model` as `language`, lets `compile` make a program of it in a folder, and compares what it prints for pictures.
fn compare(model: &Model, language: &str, file: &str, compile: &dyn Fn(&Path) -> PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    model.save(&dir.join("model.safetensors")).unwrap();
    run(dir, &["export", "model.safetensors", file, "--to", language]);
    let pictures = pictures(model.recipe.preprocessing.source, 40);
    fs::write(dir.join("pictures.rgb"), pictures.concat()).unwrap();
    let printed = run_tool(Command::new(compile(dir)).arg("pictures.rgb").current_dir(dir));

    let mut pilot = Pilot::new(model.clone(), Isa::best()).unwrap();
    let [h, w] = model.recipe.preprocessing.source;
    let name = &model.recipe.name;
    let mut lines = printed.lines();
    assert_eq!(lines.next().unwrap().parse(), Ok(model.recipe.full_lock_deg), "{name}");
    let answers: Vec<f32> = lines.map(|line| line.parse().unwrap()).collect();
    assert_eq!(answers.len(), pictures.len(), "{name}");
    let expected: Vec<f32> = pictures
        .iter()
        .map(|picture| pilot.steer(ndarray::ArrayView3::from_shape((h, w, 3), picture).unwrap()).unwrap())
        .collect();
    for (number, (answer, expected)) in answers.iter().zip(&expected).enumerate() {
        let error = (answer - expected).abs() / expected.abs().max(1.0);
        assert!(error <= BOUND, "{name} as {language}, picture {number}: {answer} instead of {expected}");
    }
    let spread = expected.iter().fold(0.0, |most: f32, x| most.max((x - expected[0]).abs()));
    assert!(spread > 1e-3, "{name}: pictures that all give the same prove nothing");
}

const C_DRIVER: &str = r#"
#include <stdint.h>
#include <stdio.h>
#include "model.c"
int main(int argc, char **argv) {
    static uint8_t image[STEER_HEIGHT * STEER_WIDTH * 3];
    FILE *file = argc > 1 ? fopen(argv[1], "rb") : NULL;
    printf("%g\n", STEER_FULL_LOCK_DEG);
    while (file && fread(image, sizeof image, 1, file) == 1) {
        printf("%.9g\n", steer(image));
    }
    return 0;
}
"#;

#[test]
fn c_source_compiles_without_a_warning_and_agrees() {
    if Command::new("cc").arg("--version").output().is_err() {
        eprintln!("skipped: there is no C compiler `cc`");
        return;
    }
    let compile = |dir: &Path| {
        fs::write(dir.join("driver.c"), C_DRIVER).unwrap();
        let args = ["-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror", "-O2", "driver.c", "-o", "driver"];
        run_tool(Command::new("cc").args(args).current_dir(dir));
        // On its own, too.
        run_tool(Command::new("cc").args(&args[..5]).args(["-c", "model.c"]).current_dir(dir));
        dir.join("driver")
    };
    for recipe in ["hyper", "lenet", "pilotnet", "default"].map(shipped).into_iter().chain(every_layer()) {
        compare(&model(recipe), "c", "model.c", &compile);
    }
    for recipe in two_outputs() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("driver.c"), C_OUTPUTS_DRIVER).unwrap();
        compare_outputs(&model(recipe), "c", "model.c", folder.path(), &|dir| {
            let args = ["-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror", "-O2", "driver.c", "-o", "driver"];
            run_tool(Command::new("cc").args(args).current_dir(dir));
        });
    }
}

const C_OUTPUTS_DRIVER: &str = r#"
#include <stdint.h>
#include <stdio.h>
#include "model.c"
int main(int argc, char **argv) {
    static uint8_t image[STEER_HEIGHT * STEER_WIDTH * 3];
    FILE *file = argc > 1 ? fopen(argv[1], "rb") : NULL;
    while (file && fread(image, sizeof image, 1, file) == 1) {
        float outputs[STEER_OUTPUTS];
        steer_outputs(image, outputs);
        if (steer(image) != outputs[STEER_STEERING]) return 1;
        for (int i = 0; i < STEER_OUTPUTS; i++) printf("%.9g\n", outputs[i]);
    }
    return 0;
}
"#;

/// Recipes with a second output; the names of the places differ.
fn two_outputs() -> impl Iterator<Item = Recipe> {
    let throttle = "outputs=[{ name = 'steering' }, { name = 'throttle' }]";
    let speed = "outputs=[{ name = 'steering' }, { name = 'speed', top_speed_mph = 30 }]";
    [("lenet", throttle), ("default", speed)]
        .into_iter()
        .map(|(name, outputs)| Recipe::find(name, &["layers.last.units=2", outputs].map(String::from)).unwrap())
}

/// As [`compare`] for a program that prints each output in a line of its own, made by `compile` in `dir` from the export there.
fn compare_outputs(model: &Model, language: &str, file: &str, dir: &Path, compile: &dyn Fn(&Path)) {
    model.save(&dir.join("model.safetensors")).unwrap();
    run(dir, &["export", "model.safetensors", file, "--to", language]);
    let pictures = pictures(model.recipe.preprocessing.source, 10);
    fs::write(dir.join("pictures.rgb"), pictures.concat()).unwrap();
    compile(dir);
    let printed = run_tool(Command::new(dir.join("driver")).arg("pictures.rgb").current_dir(dir));
    let answers: Vec<f32> = printed.lines().map(|line| line.parse().unwrap()).collect();
    let [h, w] = model.recipe.preprocessing.source;
    let images = ndarray::Array4::from_shape_vec((10, h, w, 3), pictures.concat()).unwrap();
    let expected = Pilot::new(model.clone(), Isa::best()).unwrap().predict_outputs(images.view()).unwrap();
    assert_eq!(answers.len(), 20);
    for (answer, expected) in answers.iter().zip(&expected) {
        let error = (answer - expected).abs() / expected.abs().max(1.0);
        assert!(error <= BOUND, "{language}: {answer} instead of {expected}");
    }
    assert!((expected[[0, 0]] - expected[[0, 1]]).abs() > 1e-3, "outputs that are alike do not show their order");
}

const RUST_DRIVER: &str = r#"
#![deny(warnings)]
mod model;
use std::io::Read;
static MODEL: std::sync::Mutex<model::Model> = std::sync::Mutex::new(model::Model::new());
fn main() {
    let mut file = std::fs::File::open(std::env::args().nth(1).unwrap()).unwrap();
    let mut image = [0; model::HEIGHT * model::WIDTH * 3];
    println!("{}", model::FULL_LOCK_DEG);
    while file.read_exact(&mut image).is_ok() {
        println!("{:?}", MODEL.lock().unwrap().steer(&image));
    }
}
"#;

#[test]
fn rust_source_compiles_without_a_warning_or_std_and_agrees() {
    let rustc = std::env::var_os("RUSTC").unwrap_or("rustc".into());
    let compile = |dir: &Path| {
        fs::write(dir.join("driver.rs"), RUST_DRIVER).unwrap();
        fs::write(dir.join("library.rs"), "#![no_std]\n#![forbid(unsafe_code)]\n#![deny(warnings)]\npub mod model;\n")
            .unwrap();
        let common = ["--edition", "2021", "-C", "opt-level=2"];
        run_tool(Command::new(&rustc).args(common).args(["driver.rs", "-o", "driver"]).current_dir(dir));
        let library = ["--crate-type", "lib", "--emit", "metadata", "library.rs"];
        run_tool(Command::new(&rustc).args(common).args(library).current_dir(dir));
        dir.join("driver")
    };
    for recipe in ["hyper", "lenet", "pilotnet", "default"].map(shipped).into_iter().chain(every_layer()) {
        compare(&model(recipe), "rust", "model.rs", &compile);
    }
    for recipe in two_outputs() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("driver.rs"), RUST_OUTPUTS_DRIVER).unwrap();
        compare_outputs(&model(recipe), "rust", "model.rs", folder.path(), &|dir| {
            let args = ["--edition", "2021", "-C", "opt-level=2", "driver.rs", "-o", "driver"];
            run_tool(Command::new(&rustc).args(args).current_dir(dir));
        });
    }
}

const RUST_OUTPUTS_DRIVER: &str = r#"
#![deny(warnings)]
#![allow(dead_code)] // An exported file offers more than this program calls.
mod model;
use std::io::Read;
static MODEL: std::sync::Mutex<model::Model> = std::sync::Mutex::new(model::Model::new());
fn main() {
    let mut file = std::fs::File::open(std::env::args().nth(1).unwrap()).unwrap();
    let mut image = [0; model::HEIGHT * model::WIDTH * 3];
    while file.read_exact(&mut image).is_ok() {
        let mut model = MODEL.lock().unwrap();
        let outputs: [f32; model::OUTPUTS] = model.outputs(&image);
        assert_eq!(model.steer(&image), outputs[model::STEERING]);
        outputs.iter().for_each(|output| println!("{output:?}"));
    }
}
"#;

/// The Python that `variable` names, or `python3`, if it has the modules of `imports`; or a printed reason.
fn python(variable: &str, imports: &str, requirements: &str) -> Option<PathBuf> {
    let given = std::env::var_os(variable).map(PathBuf::from);
    let python = given.clone().unwrap_or("python3".into());
    let output = Command::new(&python).args(["-c", imports]).output();
    let reason = match output {
        Ok(output) if output.status.success() => return Some(python),
        Ok(output) => String::from_utf8_lossy(&output.stderr).lines().last().unwrap_or_default().to_string(),
        Err(error) => error.to_string(),
    };
    assert!(given.is_none(), "{variable}: {}: {reason}", python.display());
    eprintln!("skipped: {}: {reason} (see tests/exchange/{requirements})", python.display());
    None
}

/// Runs a script of `tests/exchange` on every recipe, every layer and every preprocessing, `others` included; each of its lines
/// that end with `ok` is one form of a model, of which there are `forms`.
fn check_with(python: &Path, script: &str, recording: &str, others: &[Recipe], forms: usize) {
    let folder = tempfile::tempdir().unwrap();
    let mut models = Vec::new();
    let named = two_outputs().map(|recipe| Recipe { name: format!("{}-two-outputs", recipe.name), ..recipe });
    let one = ["hyper", "hyper-prelu", "lenet", "pilotnet", "default"].map(shipped).into_iter().chain(every_layer());
    for recipe in one.chain(named).chain(others.iter().cloned()) {
        let path = folder.path().join(format!("{}.safetensors", recipe.name));
        model(recipe).save(&path).unwrap();
        models.push(path);
    }
    let checkout = Path::new(env!("CARGO_MANIFEST_DIR"));
    let sample = checkout.join("data/sample");
    let recording = std::env::var_os("STEERSMAN_RECORDINGS").map_or(sample, |path| Path::new(&path).join(recording));
    let mut command = Command::new(python);
    command.arg(checkout.join("tests/exchange").join(script));
    command.args(["--rows", "100", "--steersman", env!("CARGO_BIN_EXE_steersman")]);
    let output = command.arg(recording).args(&models).output().unwrap();
    let table = String::from_utf8_lossy(&output.stdout);
    println!("{table}");
    assert!(output.status.success(), "{table}{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(table.lines().filter(|line| line.ends_with("ok")).count(), forms * models.len(), "{table}");
}

#[test]
fn onnx_files_pass_the_checker_and_agree_in_onnx_runtime() {
    let imports = "import numpy, onnx, onnxruntime, PIL";
    let Some(python) = python("STEERSMAN_PYTHON", imports, "requirements.txt") else { return };
    check_with(&python, "check_onnx.py", "lake-sample", &[shipped("donkey")], 4);
}

#[test]
fn donkeycar_drives_with_tflite_files_as_the_engine_does() {
    let imports = "import ai_edge_litert, donkeycar, PIL";
    let Some(python) = python("STEERSMAN_DONKEYCAR_PYTHON", imports, "requirements-donkeycar.txt") else { return };
    check_with(&python, "check_tflite.py", "donkey-tub", &[shipped("donkey")], 1);
}

#[test]
fn a_pilot_for_donkeycar_has_exactly_one_throttle() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    model(shipped("lenet")).save(&dir.join("steers")).unwrap();
    for recipe in two_outputs() {
        model(recipe.clone()).save(&dir.join(recipe.outputs.specs()[1].name.name())).unwrap();
    }
    let export = |model: &'static str, rest: &[&'static str]| {
        [&["export", model, "pilot.tflite", "--to", "tflite", "--force"], rest].concat()
    };
    let constant = ["--throttle", "-0.25"];
    for (model, rest, message) in [
        ("steers", &[][..], "--throttle VALUE drives at a constant one"),
        ("speed", &[], "--throttle VALUE leaves the speed out"),
        ("throttle", &constant, "gives its own throttle"),
        ("steers", &["--throttle", "1.5"], "from -1 to 1"),
        ("steers", &["--throttle", "nan"], "from -1 to 1"),
    ] {
        let error = error(dir, &export(model, rest));
        assert!(error.contains(message), "{model}: {error}");
    }
    assert!(error(dir, &["export", "steers", "pilot", "--to", "tflite"]).contains("end with .tflite"));
    assert!(error(dir, &["export", "steers", "a.c", "--to", "c", "--throttle", "0.1"]).contains("--to tflite only"));
    assert!(!dir.join("pilot.tflite").exists());
    for (model, rest) in [("steers", &constant[..]), ("speed", &constant), ("throttle", &[])] {
        run(dir, &export(model, rest));
        let bytes = fs::read(dir.join("pilot.tflite")).unwrap();
        assert_eq!(&bytes[4..8], b"TFL3");
        assert!(bytes.len().is_multiple_of(16), "constants lie at multiples of 16 bytes");
        // Steering and throttle are the names in their order that donkeycar sorts them by.
        for name in ["serving_default", "serving_default_img_in:0", "img_in", "n_outputs0", "n_outputs1"] {
            assert!(bytes.windows(name.len()).any(|window| window == name.as_bytes()), "{model}: {name}");
        }
    }
}

#[test]
fn a_file_that_exists_is_kept_and_bad_input_says_what_to_do() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    model(shipped("lenet")).save(&dir.join("model.safetensors")).unwrap();
    fs::write(dir.join("mine.onnx"), "mine").unwrap();
    let message = error(dir, &["export", "model.safetensors", "mine.onnx", "--to", "onnx"]);
    assert!(message.contains("mine.onnx exists and stays as it is") && message.contains("--force"), "{message}");
    assert_eq!(fs::read(dir.join("mine.onnx")).unwrap(), b"mine");

    let exported = json(dir, &["export", "model.safetensors", "mine.onnx", "--to", "onnx", "--force", "--json"]);
    assert_eq!(exported["input"], serde_json::json!([1, 64, 64]));
    assert_eq!(exported["bytes"], fs::metadata(dir.join("mine.onnx")).unwrap().len());
    let exported = json(dir, &["export", "model.safetensors", "model.c", "--to", "c", "--json"]);
    assert_eq!(exported["input"], serde_json::json!([160, 320, 3]));

    let message = error(dir, &["export", "mine.onnx", "b.onnx", "--to", "onnx"]);
    assert!(message.contains("mine.onnx: was exported") && message.contains("name the model file"), "{message}");
    let onto_itself = ["export", "model.safetensors", "./model.safetensors", "--to", "c", "--force"];
    assert!(error(dir, &onto_itself).contains("is the model itself"));
    assert!(error(dir, &["export", "gone", "b.onnx", "--to", "onnx"]).contains("gone"));
    assert!(error(dir, &["export", "model.safetensors", "no/b.c", "--to", "c"]).contains("no"));
    assert!(!dir.join("b.onnx").exists());

    let output =
        common::command::steersman(dir).args(["export", "model.safetensors", "x", "--to", "java"]).output().unwrap();
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2));
    assert!(message.contains("[possible values: onnx, c, rust, tflite]"), "{message}");
}
