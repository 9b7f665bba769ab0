//! Translates each Keras layer by its options alone; `assemble` adds shapes and weights.

mod activation;
mod options;
mod step;

use serde_json::Value;

pub(super) use step::{AxisOrder, KerasStep, KernelLayout, Operation};

use super::architecture::KerasLayer;
use super::lambda::{self, LambdaAffine};
use super::messages::shown;
use crate::engine::layers::{
    BatchNormSpec, Conv2dSpec, CropSpec, DropoutSpec, Padding, ResizeMethod, ResizeSpec, ScaleSpec, ZeroPadSpec,
};
use crate::engine::tensor::Initializer;
use activation::pointwise;
use options::Options;

/// Translates `layer`; `known` is the function that the user gave for it.
///
/// # Errors
///
/// The reason why the layer has no counterpart.
pub(super) fn translate(layer: &KerasLayer, known: Option<LambdaAffine>) -> Result<KerasStep, String> {
    let options = Options(&layer.config);
    let mut notice = None;
    let mut activation = None;
    let operation = match layer.class.as_str() {
        "InputLayer" => Operation::Input,
        "Lambda" => {
            let LambdaAffine { factor, offset } = match known {
                Some(known) => known,
                None => lambda::function(&layer.config).map_err(|reason| {
                    format!("{reason}; if it is x / A - B, say so with --lambda {}=A,B", layer.name)
                })?,
            };
            Operation::Plain(ScaleSpec { factor: factor as f32, offset: offset as f32 }.into())
        }
        "Rescaling" => {
            let (factor, offset) = (options.number(&["scale"], 1.0)?, options.number(&["offset"], 0.0)?);
            Operation::Plain(ScaleSpec { factor: factor as f32, offset: offset as f32 }.into())
        }
        "Conv2D" | "Convolution2D" => {
            activation = options.activation()?;
            conv(&options)?
        }
        "Dense" => {
            activation = options.activation()?;
            Operation::Dense {
                units: options.size(&["units", "output_dim"])?,
                bias: options.flag(&["use_bias", "bias"], true)?,
            }
        }
        "BatchNormalization" => {
            if options.number(&["mode"], 0.0)? != 0.0 {
                return Err("mode 1 and 2 of Keras 1's batch normalisation have no counterpart".into());
            }
            let old_weight = options.number(&["momentum"], 0.99)?;
            Operation::BatchNorm {
                spec: BatchNormSpec {
                    epsilon: options.number(&["epsilon"], 1e-3)? as f32,
                    running_old_weight: old_weight as f32,
                },
                axis: options.axis()?,
                center: options.flag(&["center"], true)?,
                scale: options.flag(&["scale"], true)?,
            }
        }
        "PReLU" => Operation::PRelu,
        "MaxPooling2D" | "MaxPool2D" => pool(&options, true)?,
        "AveragePooling2D" | "AvgPool2D" => pool(&options, false)?,
        "GlobalAveragePooling2D" | "GlobalMaxPooling2D" => {
            if options.flag(&["keepdims"], false)? {
                return Err("keepdims has no counterpart".into());
            }
            Operation::GlobalPool { max: layer.class == "GlobalMaxPooling2D" }
        }
        "ZeroPadding2D" => {
            let [rows, columns] = options.border(&["padding"])?;
            Operation::Plain(ZeroPadSpec { rows, columns }.into())
        }
        "Cropping2D" => {
            let [rows, columns] = options.border(&["cropping"])?;
            Operation::Plain(CropSpec { rows, columns }.into())
        }
        "Flatten" => Operation::Flatten,
        "Dropout" | "SpatialDropout2D" => {
            if layer.class != "Dropout" {
                notice = Some("drops whole channels in training; here it drops single numbers");
            }
            Operation::Plain(DropoutSpec { drop_probability: options.number(&["rate", "p"], 0.0)? as f32 }.into())
        }
        "GaussianNoise" | "GaussianDropout" | "AlphaDropout" | "ActivityRegularization" => {
            notice = Some("acts in training only, and is left out");
            Operation::Nothing
        }
        class if RANDOM.contains(&class) => {
            notice =
                Some("changes pictures in training only, and is left out; `augmentation` of a recipe does such things");
            Operation::Nothing
        }
        "Resizing" => {
            for name in ["crop_to_aspect_ratio", "pad_to_aspect_ratio", "antialias"] {
                if options.flag(&[name], false)? {
                    return Err(format!("`{name}` has no counterpart"));
                }
            }
            let method = match options.find(&["interpolation"]).map_or(Some("bilinear"), |(_, value)| value.as_str()) {
                Some("bilinear") => ResizeMethod::Bilinear,
                Some("nearest") => ResizeMethod::Nearest,
                // Keras 2 alone.
                Some("area") => ResizeMethod::Area,
                other => {
                    return Err(format!("interpolation `{}` has no counterpart", shown(other.unwrap_or("unknown"))));
                }
            };
            Operation::Resize(ResizeSpec { to: [options.size(&["height"])?, options.size(&["width"])?], method })
        }
        "Activation" => {
            activation = options.activation()?;
            Operation::Nothing
        }
        class => match pointwise(class, &options)? {
            Some(spec) => Operation::Plain(spec),
            None => return Err(without_counterpart(class).into()),
        },
    };
    Ok(KerasStep { operation, activation, order: options.order()?, input: options.input()?, notice })
}

/// Layers that change pictures at random in training, and leave them alone else.
const RANDOM: [&str; 18] = [
    "RandomBrightness",
    "RandomColorDegeneration",
    "RandomColorJitter",
    "RandomContrast",
    "RandomElasticTransform",
    "RandomErasing",
    "RandomFlip",
    "RandomGaussianBlur",
    "RandomGrayscale",
    "RandomHue",
    "RandomInvert",
    "RandomPerspective",
    "RandomRotation",
    "RandomSaturation",
    "RandomSharpness",
    "RandomShear",
    "RandomTranslation",
    "RandomZoom",
];

/// Why a class cannot be imported.
fn without_counterpart(class: &str) -> &'static str {
    match class {
        "TimeDistributed" | "LSTM" | "GRU" | "SimpleRNN" | "ConvLSTM2D" | "Bidirectional" | "Embedding" | "Masking" => {
            "works on sequences of frames; a model here sees one frame at a time"
        }
        "Sequential" | "Model" | "Functional" => "is a model inside the model",
        "Merge" | "Add" | "Concatenate" | "Multiply" | "Average" | "Maximum" | "Subtract" | "Dot" => {
            "joins several branches; only a chain of layers can be imported"
        }
        "Reshape" | "Permute" | "RepeatVector" => "moves numbers about in a way that has no counterpart",
        "SeparableConv2D" | "SeparableConvolution2D" | "DepthwiseConv2D" => "separable convolution has no counterpart",
        "Deconvolution2D" | "Conv2DTranspose" | "UpSampling2D" => "enlarging a map has no counterpart",
        "AtrousConvolution2D" => "a kernel with holes has no counterpart",
        class if class.ends_with("1D") || class.ends_with("3D") => "works on one or three dimensions, not on images",
        _ => "has no counterpart",
    }
}

fn conv(options: &Options) -> Result<Operation, String> {
    if options.pair(&["dilation_rate", "atrous_rate"])?.unwrap_or([1, 1]) != [1, 1] {
        return Err("a kernel with holes (dilation) has no counterpart".into());
    }
    if options.number(&["groups"], 1.0)? != 1.0 {
        return Err("convolution in groups has no counterpart".into());
    }
    let kernel = match options.pair(&["kernel_size"])? {
        Some(kernel) => kernel,
        None => [options.size(&["nb_row"])?, options.size(&["nb_col"])?],
    };
    let padding = if options.same_padding()? { Padding::Same } else { Padding::Valid };
    let stride = options.pair(&["strides", "subsample"])?.unwrap_or([1, 1]);
    let filters = options.size(&["filters", "nb_filter"])?;
    let theano = options.0.get("dim_ordering").and_then(Value::as_str) == Some("th");
    Ok(Operation::Conv {
        spec: Conv2dSpec { filters, kernel, stride, padding, init: Initializer::default() },
        kernel: if theano { KernelLayout::OutInHeightWidth } else { KernelLayout::HeightWidthInOut },
        bias: options.flag(&["use_bias", "bias"], true)?,
    })
}

fn pool(options: &Options, max: bool) -> Result<Operation, String> {
    let window = options.pair(&["pool_size"])?.unwrap_or([2, 2]);
    let stride = options.pair(&["strides"])?.unwrap_or(window);
    Ok(Operation::Pool { max, window, stride, same: options.same_padding()? })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::layers::SwishSpec;
    use serde_json::json;

    fn layer(class: &str, config: Value) -> KerasLayer {
        KerasLayer { name: "l".into(), class: class.into(), config: config.as_object().unwrap().clone() }
    }

    fn step(class: &str, config: Value) -> KerasStep {
        translate(&layer(class, config), None).unwrap()
    }

    fn reason(class: &str, config: Value) -> String {
        translate(&layer(class, config), None).unwrap_err()
    }

    #[test]
    fn old_and_new_names_mean_the_same() {
        let old = json!({"nb_filter": 3, "nb_row": 5, "nb_col": 2, "subsample": [2, 1], "border_mode": "same",
            "dim_ordering": "tf", "bias": false, "activation": "tanh"});
        let new = json!({"filters": 3, "kernel_size": [5, 2], "strides": [2, 1], "padding": "same",
            "data_format": "channels_last", "use_bias": false, "activation": {"class_name": "f", "config": "tanh"}});
        assert_eq!(step("Convolution2D", old), step("Conv2D", new));
        assert_eq!(step("Dense", json!({"output_dim": 4})), step("Dense", json!({"units": 4, "activation": "linear"})));
        assert_eq!(step("Dropout", json!({"p": 0.5})), step("Dropout", json!({"rate": 0.5})));
    }

    #[test]
    fn swish_is_read_by_both_its_names_as_a_layer_and_as_an_option() {
        for name in ["swish", "silu"] {
            for (class, option) in [("Activation", json!(name)), ("Dense", json!({"class_name": "f", "config": name}))]
            {
                let step = step(class, json!({"units": 3, "activation": option}));
                assert_eq!(step.activation, Some(SwishSpec {}.into()), "{class} {name}");
            }
        }
    }

    #[test]
    fn borders_are_read_in_every_spelling() {
        let expected = Operation::Plain(ZeroPadSpec { rows: [1, 1], columns: [2, 2] }.into());
        for padding in [json!([1, 2]), json!([1, 1, 2, 2]), json!([[1, 1], [2, 2]])] {
            assert_eq!(step("ZeroPadding2D", json!({"padding": padding})).operation, expected);
        }
        let expected = Operation::Plain(CropSpec { rows: [50, 20], columns: [0, 1] }.into());
        assert_eq!(step("Cropping2D", json!({"cropping": [[50, 20], [0, 1]]})).operation, expected);
        assert!(reason("Cropping2D", json!({"cropping": [[50, -20], [0, 1]]})).contains("whole numbers"));
        assert!(reason("Cropping2D", json!({"cropping": [50, 20, 7]})).contains("whole numbers"));
    }

    #[test]
    fn what_has_no_counterpart_says_why() {
        for (class, config, expected) in [
            ("TimeDistributed", json!({}), "sequences"),
            ("LSTM", json!({"units": 3}), "sequences"),
            ("Concatenate", json!({}), "branches"),
            ("Sequential", json!({}), "model inside"),
            ("Conv3D", json!({}), "one or three dimensions"),
            ("MyLayer", json!({}), "has no counterpart"),
            ("Dense", json!({"units": 3, "activation": "sigmoid"}), "activation `sigmoid`"),
            ("Dense", json!({}), "has no `units`"),
            ("Dense", json!({"units": -1}), "whole number"),
            ("Dense", json!({"units": 1e300}), "whole number"),
            ("Conv2D", json!({"filters": 3, "kernel_size": [3, 3], "dilation_rate": [2, 2]}), "holes"),
            ("Conv2D", json!({"filters": 3, "kernel_size": [3, 3], "padding": "causal"}), "padding `causal`"),
            ("Conv2D", json!({"filters": 3, "kernel_size": [3, 3, 3]}), "two whole numbers"),
            ("BatchNormalization", json!({"mode": 2}), "mode 1 and 2"),
            ("BatchNormalization", json!({"axis": [1, 2]}), "several axes"),
            ("ReLU", json!({"max_value": 6.0}), "ceiling"),
            ("Lambda", json!({"function": "resize"}), "say so with --lambda l=A,B"),
            ("MaxPooling2D", json!({"data_format": "diagonal"}), "order of axes `diagonal`"),
        ] {
            assert!(reason(class, config).contains(expected), "{class}: {expected}");
        }
    }

    #[test]
    fn the_user_can_say_what_a_lambda_computes() {
        let known = Some(LambdaAffine { factor: 0.5, offset: -1.0 });
        let step = translate(&layer("Lambda", json!({"function": "normalise"})), known).unwrap();
        assert_eq!(step.operation, Operation::Plain(ScaleSpec { factor: 0.5, offset: -1.0 }.into()));
    }
}
