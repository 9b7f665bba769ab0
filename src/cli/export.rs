//! `steersman export`: a model for other programs.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use serde::Serialize;

use super::{load_model, print, print_json};
use crate::error::{Error, Result};
use crate::exchange::onnx::{OPSET, OnnxOptions, onnx};
use crate::exchange::source::{Language, source};
use crate::exchange::tflite::tflite;
use crate::files::atomic_file;

/// Write a model as an ONNX file, as a TensorFlow Lite file, or as C or Rust source code that needs nothing else
#[derive(Debug, Args)]
pub struct ExportArgs {
    /// Model file
    model: PathBuf,
    /// What to write
    #[arg(long, value_enum, value_name = "FORMAT")]
    to: Format,
    /// File to write
    file: PathBuf,
    /// ONNX: take the camera image (uint8, RGB) instead of the preprocessed picture. The others always do
    #[arg(long)]
    with_preprocessing: bool,
    /// ONNX: merge batch normalisation into the layer before it. The others always do
    #[arg(long)]
    fold_batch_norm: bool,
    /// TensorFlow Lite: the constant throttle of a model that gives none, from -1 to 1
    #[arg(long, value_name = "VALUE", allow_hyphen_values = true)]
    throttle: Option<f32>,
    /// Overwrite FILE if it exists
    #[arg(long)]
    force: bool,
    /// Print one JSON object as the last line
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Format {
    /// For ONNX Runtime and others
    Onnx,
    /// C99, one file with a function `steer`
    C,
    /// Rust, one module with a type `Model`; no std needed
    Rust,
    /// TensorFlow Lite, a pilot for donkeycar (type `tflite_linear`)
    Tflite,
}

#[derive(Serialize)]
struct Exported {
    file: PathBuf,
    bytes: usize,
    /// The numbers one call takes, the batch left out: `[c, h, w]` of a preprocessed picture, or `[h, w, 3]` of an image.
    input: [usize; 3],
    with_preprocessing: bool,
}

pub fn run(args: ExportArgs) -> Result<()> {
    if args.file.exists() && !args.force {
        return Err(Error::Usage(format!(
            "{} exists and stays as it is; give another name, or --force to overwrite it",
            args.file.display()
        )));
    }
    if args.throttle.is_some() && !matches!(args.to, Format::Tflite) {
        return Err(Error::Usage("--throttle goes with --to tflite only".into()));
    }
    if matches!(args.to, Format::Tflite) && args.file.extension().is_none_or(|extension| extension != "tflite") {
        return Err(Error::Usage(format!(
            "{}: donkeycar loads files whose names end with .tflite: give such a name",
            args.file.display()
        )));
    }
    let model = load_model(&args.model)?;
    if same_file(&args.model, &args.file) {
        return Err(Error::Usage(format!(
            "{} is the model itself; give another name for the export",
            args.file.display()
        )));
    }
    let with_preprocessing = args.with_preprocessing || !matches!(args.to, Format::Onnx);
    let (bytes, kind) = match args.to {
        Format::Onnx => {
            let options = OnnxOptions { with_preprocessing, fold_batch_norm: args.fold_batch_norm };
            (onnx(&model, options)?, format!("ONNX, opset {OPSET}"))
        }
        Format::C => (source(&model, Language::C)?.into_bytes(), "C99".into()),
        Format::Rust => (source(&model, Language::Rust)?.into_bytes(), "Rust".into()),
        Format::Tflite => (tflite(&model, args.throttle)?, "TensorFlow Lite, float32".into()),
    };
    atomic_file::write(&args.file, &bytes)?;
    let [height, width] = model.recipe.preprocessing.source;
    let input = if with_preprocessing { [height, width, 3] } else { model.recipe.preprocessing.output() };
    let exported = Exported { file: args.file, bytes: bytes.len(), input, with_preprocessing };
    if args.json {
        return print_json(&exported);
    }
    let [a, b, c] = input;
    let takes = match with_preprocessing {
        true if matches!(args.to, Format::Tflite) => format!(
            "RGB images of {b}x{a} pixels divided by 255, [1][{a}][{b}][{c}]; for donkeycar set IMAGE_W = {b}, IMAGE_H = {a} \
             and drive with --type tflite_linear"
        ),
        true => format!("RGB images of {b}x{a} pixels, 8 bits, [{a}][{b}][{c}]"),
        false => format!("preprocessed pictures [{a}][{b}][{c}]; --with-preprocessing makes it take camera images"),
    };
    let file = exported.file.display();
    print(&format!("{file}: {kind}, {} KiB\ntakes {takes}\n", exported.bytes.div_ceil(1024)))
}

/// Whether both paths lead to the same file, which exists.
fn same_file(a: &Path, b: &Path) -> bool {
    matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b)
}
