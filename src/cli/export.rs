//! `steersman export`: a model for other programs.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use serde::Serialize;

use super::arguments::{load_model, model_file};
use super::terminal::{print, print_json};
use crate::error::{Error, Result};
use crate::exchange::onnx::{OPSET, OnnxOptions, onnx};
use crate::exchange::source::{Language, source};
use crate::exchange::tflite::tflite;
use crate::files::atomic_file;
use crate::model_file::Model;

/// Write a model as an ONNX file, as a TensorFlow Lite file, or as C or Rust source code that needs nothing else
#[derive(Debug, Args)]
pub struct ExportArgs {
    /// Model file
    model: PathBuf,
    #[command(flatten)]
    request: ExportRequest,
    /// Print one JSON object as the last line
    #[arg(long)]
    json: bool,
}

/// What is written, and where
#[derive(Debug, Args)]
pub(crate) struct ExportRequest {
    /// What to write
    #[arg(long, value_enum, value_name = "FORMAT")]
    pub to: Format,
    /// File to write
    pub file: PathBuf,
    /// ONNX: take the camera image (uint8, RGB) instead of the preprocessed picture. The others always do
    #[arg(long)]
    pub with_preprocessing: bool,
    /// ONNX: merge batch normalisation into the layer before it. The others always do
    #[arg(long)]
    pub fold_batch_norm: bool,
    /// TensorFlow Lite: the constant throttle of a model that gives none, from -1 to 1
    #[arg(long, value_name = "VALUE", allow_hyphen_values = true)]
    pub throttle: Option<f32>,
    /// Overwrite FILE if it exists
    #[arg(long)]
    pub force: bool,
}

/// What a model can be exported as.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub(crate) enum Format {
    /// For ONNX Runtime and others
    Onnx,
    /// C99, one file with a function `steer`
    C,
    /// Rust, one module with a type `Model`; no std needed
    Rust,
    /// TensorFlow Lite, a pilot for donkeycar (type `tflite_linear`)
    Tflite,
}

/// What was written; `export --json` prints it.
#[derive(Serialize)]
pub(crate) struct Exported {
    file: PathBuf,
    bytes: usize,
    /// The numbers one call takes, the batch left out: `[c, h, w]` of a preprocessed picture, or `[h, w, 3]` of an image.
    input: [usize; 3],
    with_preprocessing: bool,
    #[serde(skip)]
    kind: String,
}

impl ExportRequest {
    /// Checks what does not depend on the model.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] for a file that exists, and for options that do not go together.
    fn check(&self) -> Result<()> {
        if self.file.exists() && !self.force {
            return Err(Error::Usage(format!(
                "{} exists and stays as it is; give another name, or --force to overwrite it",
                self.file.display()
            )));
        }
        if self.throttle.is_some() && !matches!(self.to, Format::Tflite) {
            return Err(Error::Usage("--throttle goes with --to tflite only".into()));
        }
        if matches!(self.to, Format::Tflite) && self.file.extension().is_none_or(|extension| extension != "tflite") {
            return Err(Error::Usage(format!(
                "{}: donkeycar loads files whose names end with .tflite: give such a name",
                self.file.display()
            )));
        }
        Ok(())
    }

    /// Writes `model`, which was read from the file `path`.
    ///
    /// # Errors
    ///
    /// As [`check`](Self::check); [`Error::Usage`] for the model's own file; those of the formats; [`Error::Io`].
    pub fn write(&self, path: &Path, model: &Model) -> Result<Exported> {
        self.check()?;
        if same_file(path, &self.file) {
            return Err(Error::Usage(format!(
                "{} is the model itself; give another name for the export",
                self.file.display()
            )));
        }
        let with_preprocessing = self.with_preprocessing || !matches!(self.to, Format::Onnx);
        let (bytes, kind) = match self.to {
            Format::Onnx => {
                let options = OnnxOptions { with_preprocessing, fold_batch_norm: self.fold_batch_norm };
                (onnx(model, options)?, format!("ONNX, opset {OPSET}"))
            }
            Format::C => (source(model, Language::C)?.into_bytes(), "C99".into()),
            Format::Rust => (source(model, Language::Rust)?.into_bytes(), "Rust".into()),
            Format::Tflite => (tflite(model, self.throttle)?, "TensorFlow Lite, float32".into()),
        };
        atomic_file::write(&self.file, &bytes)?;
        let [height, width] = model.recipe.preprocessing.source;
        let input = if with_preprocessing { [height, width, 3] } else { model.recipe.preprocessing.output() };
        Ok(Exported { file: self.file.clone(), bytes: bytes.len(), input, with_preprocessing, kind })
    }
}

pub fn run(args: ExportArgs) -> Result<()> {
    args.request.check()?;
    // The folder of a run stands for its model.
    let path = model_file(&args.model)?;
    let exported = args.request.write(&path, &load_model(&args.model)?)?;
    if args.json {
        return print_json(&exported);
    }
    let Exported { input, with_preprocessing, kind, .. } = &exported;
    let [a, b, c] = input;
    let takes = match with_preprocessing {
        true if matches!(args.request.to, Format::Tflite) => format!(
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
