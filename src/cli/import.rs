//! `steersman import`: a model that Keras saved becomes a model file.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clap::Args;
use serde::Serialize;
use steersman_kernels::Isa;

use super::arguments::RecordingArgs;
use super::process::pool;
use super::terminal::{or_dash, print, print_json};
use crate::dataset::colour::Colour;
use crate::dataset::preprocess::Preprocessing;
use crate::dataset::resize::Interpolation;
use crate::engine::network::Network;
use crate::engine::tensor::Shape;
use crate::error::{Error, Result};
use crate::exchange::fit::{self, Agreement, Candidate, Frames};
use crate::exchange::keras::{self, ImportOptions, LayerReport};
use crate::exchange::presets;
use crate::model_file::weights_hash;

/// Import a Keras model: HDF5 of Keras 1 and 2, or the .keras file of Keras 3
#[derive(Debug, Args)]
pub struct ImportArgs {
    /// HDF5 or .keras file
    file: PathBuf,
    /// The architecture, for files that hold weights only: the JSON of Keras' to_json
    #[arg(long, value_name = "JSON")]
    architecture: Option<PathBuf>,
    /// How an image becomes the input: a preset (naokishibuya, naokishibuya-2017-01-14, diz-vara, oargueta, udacity,
    /// udacity-bgr), that of a built-in recipe, or a TOML file
    #[arg(long, value_name = "NAME|FILE")]
    preprocessing: Option<String>,
    /// Try the plausible preprocessings on a recording, rank them by the error that the best gain and bias leave, and say which gain and
    /// bias; without --preprocessing, --out takes the best
    #[arg(long, value_name = "RECORDING")]
    fit: Option<PathBuf>,
    #[command(flatten)]
    reading: RecordingArgs,
    /// A Lambda layer computes x / A - B, where its byte code does not say so
    #[arg(long = "lambda", value_name = "LAYER=A,B", value_parser = parse_lambda, allow_hyphen_values = true)]
    lambdas: Vec<(String, (f64, f64))>,
    /// The weights come from Theano before Keras 2: its convolutions turned their kernels by 180 degrees
    #[arg(long)]
    theano_kernels: bool,
    /// What the steering output says straight on, and how much more at full lock to the right, where that is not 0 and 1: 90,45
    /// for degrees with 90 in the middle
    #[arg(long, value_name = "STRAIGHT,SPAN", value_parser = parse_output_scale, allow_hyphen_values = true)]
    output_scale: Option<[f64; 2]>,
    /// Model file to write; must not exist
    #[arg(long, value_name = "MODEL", required_unless_present = "fit")]
    out: Option<PathBuf>,
    /// Threads of --fit; 0 is one for each core
    #[arg(long, default_value_t = 0)]
    threads: usize,
    /// Print one JSON object as the last line
    #[arg(long)]
    json: bool,
}

/// A model under the right preprocessing goes with the labels better than this.
const WEAK_CORRELATION: f64 = 0.3;

/// Gains in this range need no `--output-scale`: another driver's hands explain them.
const USUAL_GAIN: std::ops::RangeInclusive<f64> = 0.4..=2.5;
/// Nor do biases up to this, shares of full lock.
const USUAL_BIAS: f64 = 0.2;

fn parse_lambda(text: &str) -> Result<(String, (f64, f64)), String> {
    let (layer, numbers) = text.split_once('=').ok_or("expected LAYER=A,B, as in lambda_1=127.5,1")?;
    let (a, b) = numbers.split_once(',').ok_or("expected two numbers: LAYER=A,B, as in lambda_1=127.5,1")?;
    let number = |text: &str| text.trim().parse().map_err(|_| format!("`{}` is no number", text.trim()));
    let (a, b): (f64, f64) = (number(a)?, number(b)?);
    if a == 0.0 || !a.is_finite() || !b.is_finite() {
        return Err("A must not be zero, and both must be finite".into());
    }
    Ok((layer.trim().into(), (a, b)))
}

fn parse_output_scale(text: &str) -> Result<[f64; 2], String> {
    let numbers = text.split_once(',').and_then(|(a, b)| Some([a.trim().parse().ok()?, b.trim().parse().ok()?]));
    let [straight, span]: [f64; 2] = numbers.ok_or("expected two numbers, STRAIGHT,SPAN, as in 90,45")?;
    if span == 0.0 || !span.is_finite() || !straight.is_finite() {
        return Err("SPAN must not be zero, and both must be finite".into());
    }
    Ok([straight, span])
}

#[derive(Serialize)]
struct Answer {
    keras_version: Option<String>,
    input: Shape,
    parameters: usize,
    layers: Vec<LayerReport>,
    preprocessing: Preprocessing,
    weights: String,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    fit: Vec<Fit>,
    #[serde(skip_serializing_if = "Option::is_none")]
    model: Option<PathBuf>,
}

#[derive(Serialize)]
struct Fit {
    #[serde(flatten)]
    agreement: Agreement,
    preprocessing: Preprocessing,
}

pub fn run(args: ImportArgs) -> Result<()> {
    if let Some(out) = args.out.as_ref().filter(|out| out.exists()) {
        return Err(Error::Usage(format!("{} exists; choose another --out", out.display())));
    }
    let given = args.preprocessing.as_deref().map(presets::find).transpose()?;
    let shape_of = |p: &Preprocessing| {
        let [c, h, w] = p.output();
        Shape::new(c, h, w)
    };
    let options = ImportOptions {
        architecture: args.architecture.clone(),
        lambdas: args.lambdas.iter().cloned().collect::<BTreeMap<_, _>>(),
        theano_kernels: args.theano_kernels,
        input: given.as_ref().map(shape_of),
        output_scale: args.output_scale,
    };
    let imported = keras::import(&args.file, &options)?;
    for notice in &imported.notices {
        eprintln!("note: {notice}");
    }
    if let Some(given) = &given {
        imported.check_input(given)?;
    }
    let network = Network::new(imported.input, &imported.layers, Isa::best())?;

    let ranking = match &args.fit {
        Some(recording) => {
            let pool = pool(args.threads)?;
            let recording = pool.install(|| args.reading.load(recording))?;
            let frames = pool.install(|| Frames::of(&recording))?;
            let count = fit::combinations(&network, frames.source()).len();
            eprintln!("trying {count} combinations on up to {} frames of {}", frames.len(), recording.path.display());
            pool.install(|| fit::rank(&network, &imported.parameters, &frames, given.as_ref()))?
        }
        None => Vec::new(),
    };
    let preprocessing = match (given, ranking.first()) {
        (Some(given), _) => given,
        (None, Some(best)) => best.preprocessing.clone(),
        (None, None) => {
            let guess = whole_image(imported.input)?;
            eprintln!(
                "warning: the file does not say how an image becomes the network's input. The whole image in {} is a guess: \
                 colour order, crop and scaling may be others. Name them with --preprocessing, or let --fit RECORDING find \
                 what fits",
                if imported.input.c == 3 { "RGB" } else { "grey" }
            );
            guess
        }
    };

    if let Some(taken) = ranking.iter().find(|candidate| candidate.preprocessing == preprocessing) {
        for warning in fit_warnings(&taken.agreement, args.output_scale) {
            eprintln!("warning: {warning}");
        }
    }

    let mut text = layer_table(&imported.report);
    text += &ranking_table(&ranking);
    if !ranking.is_empty() {
        text += &format!("\n[preprocessing]\n{}\n", fit::to_toml(&args.file, &ranking[0].preprocessing)?);
    }
    let answer = Answer {
        keras_version: imported.keras_version.clone(),
        input: imported.input,
        parameters: network.count(true) + network.count(false),
        layers: imported.report.clone(),
        preprocessing: preprocessing.clone(),
        weights: weights_hash(&network, &imported.parameters),
        fit: ranking
            .into_iter()
            .map(|Candidate { preprocessing, agreement }| Fit { agreement, preprocessing })
            .collect(),
        model: args.out.clone(),
    };
    let model = imported.into_model(&name_of(&args.file), preprocessing)?;
    if let Some(out) = &args.out {
        model.save(out)?;
        text += &format!("model {}\n", out.display());
    }
    if args.json { print_json(&answer) } else { print(&text) }
}

/// The whole image, resized to the network's input.
fn whole_image(input: Shape) -> Result<Preprocessing> {
    let colour = match input.c {
        3 => Colour::Rgb,
        1 => Colour::Gray,
        c => {
            let message =
                format!("the network takes {c} colour planes: say with --preprocessing how an image gives them");
            return Err(Error::Usage(message));
        }
    };
    Ok(Preprocessing { resize: [input.h, input.w], colour, ..Preprocessing::default() })
}

/// A recipe's name from a file's name.
fn name_of(file: &Path) -> String {
    let stem = file.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
    let name: String = stem.chars().map(|c| if c.is_alphanumeric() || "-_.".contains(c) { c } else { '-' }).collect();
    let name = name.trim_start_matches('.');
    if name.is_empty() { "imported".into() } else { name.into() }
}

fn layer_table(report: &[LayerReport]) -> String {
    let mut text = format!("{:<28} {:<24} {}\n", "layer", "class", "becomes");
    for LayerReport { layer, class, becomes } in report {
        let becomes = if becomes.is_empty() { "-".to_string() } else { becomes.join(", ") };
        text += &format!("{layer:<28} {class:<24} {becomes}\n");
    }
    text
}

/// What the user should know of the outputs under the preprocessing that is taken. `output_scale` is what they were read with.
fn fit_warnings(agreement: &Agreement, output_scale: Option<[f64; 2]>) -> Vec<String> {
    let mut warnings: Vec<String> = agreement.absurdity().into_iter().collect();
    let (line, r) = match (agreement.line, agreement.correlation) {
        (Some(line), Some(r)) if r.abs() >= WEAK_CORRELATION => (line, r),
        (_, r) => {
            warnings.push(format!(
                "no preprocessing fits: the correlation with the labels is {} under the one that is taken. The right one may not be \
                 among those that were tried, or the model was trained for another kind of picture; name it with --preprocessing",
                or_dash(r, 3)
            ));
            return warnings;
        }
    };
    if r < 0.0 {
        warnings.push(format!(
            "the outputs are mirrored: where the labels say right they say left (gain {:.3})",
            line.gain
        ));
    }
    if !USUAL_GAIN.contains(&line.gain) || line.bias.abs() > USUAL_BIAS {
        let [straight, span] = line.output_scale(output_scale.unwrap_or([0.0, 1.0]));
        // Four digits of the span.
        let decimals = (3.0 - span.abs().log10().floor()).clamp(0.0, 12.0) as usize;
        // No minus in front of zeros.
        let straight = if straight.abs() < 0.5 * 10f64.powi(-(decimals as i32)) { 0.0 } else { straight };
        warnings.push(format!(
            "the outputs come nearest to the labels times {:.3} {:+.3}: either this is not the right preprocessing, or the model gives \
             another unit than shares of full lock; then import with --output-scale {straight:.decimals$},{span:.decimals$}, or \
             the round numbers near it that its makers chose",
            line.gain, line.bias
        ));
    }
    warnings
}

fn ranking_table(ranking: &[Candidate]) -> String {
    if ranking.is_empty() {
        return String::new();
    }
    let mut text = format!(
        "\nerror: root of the mean squared difference from the labels, where 1 is full lock, after the best gain and bias; as is: without \
         them\n{:>7} {:>8} {:>8} {:>8} {:>11}  {:<8} {:<12} {:<14} {:<14} {}\n",
        "error", "as is", "gain", "bias", "correlation", "colour", "rows", "resize", "method", "input"
    );
    for Candidate { preprocessing: p, agreement } in ranking {
        let colour = p.colour.name();
        let method = match p.interpolation {
            Interpolation::Linear => "linear",
            Interpolation::Area => "area",
        };
        let method = if p.blur { format!("blur, {method}") } else { method.into() };
        let rows = format!("{} to {}", p.rows[0], p.rows[1]);
        let size = format!("{}x{}{}", p.resize[0], p.resize[1], if p.colour_first { " after" } else { "" });
        let scaling = match (p.scale, p.offset) {
            (1.0, 0.0) => "grey levels".to_string(),
            (scale, offset) => format!("x / {} {offset:+}", 1.0 / scale),
        };
        let line = agreement.line;
        text += &format!(
            "{:>7} {:>8} {:>8} {:>8} {:>11}  {colour:<8} {rows:<12} {size:<14} {method:<14} {scaling}\n",
            or_dash(line.map(|line| line.error), 3),
            or_dash(agreement.error, 3),
            or_dash(line.map(|line| line.gain), 3),
            or_dash(line.map(|line| line.bias), 3),
            or_dash(agreement.correlation, 3),
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lambda_is_named_with_two_numbers() {
        assert_eq!(parse_lambda("lambda_1=127.5, 1").unwrap(), ("lambda_1".into(), (127.5, 1.0)));
        for wrong in ["lambda_1", "a=1", "a=x,1", "a=0,1", "a=1,inf"] {
            assert!(parse_lambda(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn an_output_scale_is_two_numbers() {
        assert_eq!(parse_output_scale("90, -45").unwrap(), [90.0, -45.0]);
        for wrong in ["90", "90,0", "x,1", "nan,1", "1,inf"] {
            assert!(parse_output_scale(wrong).is_err(), "{wrong}");
        }
    }

    /// Outputs 90 + 45 · label, and their opposite, as they are and with a unit that was named.
    #[test]
    fn a_fit_tells_mirrored_outputs_and_other_units() {
        let labels = || (-4..5).map(|i| f64::from(i) / 10.0);
        let warnings = |of: fn(f64) -> f64, scale| {
            let pairs: Vec<(f64, f64)> = labels().map(|label| (of(label), label)).collect();
            fit_warnings(&Agreement::of(&pairs), scale)
        };
        assert!(warnings(|label| 0.8 * label + 0.05, None).is_empty());
        let mirrored = warnings(|label| -label, None);
        assert!(mirrored[0].contains("mirrored") && mirrored[0].contains("gain -1.000"), "{mirrored:?}");
        assert!(mirrored[1].contains("--output-scale 0.000,-1.000"), "{mirrored:?}");
        let degrees = warnings(|label| 90.0 + 45.0 * label, None);
        assert!(degrees[0].contains("9 of 9 outputs lie beyond 2"), "{degrees:?}");
        assert!(degrees[1].contains("--output-scale 90.00,45.00"), "{degrees:?}");
        let misread = warnings(|label| (90.0 + 45.0 * label - 80.0) / 10.0, Some([80.0, 10.0]));
        assert!(misread.iter().any(|warning| warning.contains("--output-scale 90.00,45.00")), "{misread:?}");
        let unrelated = warnings(|label| (label * 100.0).sin(), None);
        assert!(unrelated.len() == 1 && unrelated[0].contains("no preprocessing fits"), "{unrelated:?}");
        let constant = warnings(|_| 0.25, None);
        assert!(
            constant[0].contains("whatever") && constant[1].contains("correlation with the labels is -"),
            "{constant:?}"
        );
    }

    #[test]
    fn recipes_are_called_after_the_file() {
        assert_eq!(name_of(Path::new("runs/my model (1).h5")), "my-model--1-");
        assert_eq!(name_of(Path::new(".h5")), "h5");
        assert_eq!(name_of(Path::new("...")), "imported");
    }
}
