//! Activations: as a layer of their own, and as an option of another layer.

use serde_json::Value;

use super::options::{Options, short};
use crate::engine::layers::{EluSpec, LeakyReluSpec, ReluSpec, SoftsignSpec, SwishSpec, TanhSpec};
use crate::engine::network::LayerSpec;
use crate::exchange::keras::messages::shown;

/// An activation that is a layer of its own, or is named by one.
pub(super) fn pointwise(class: &str, options: &Options) -> Result<Option<LayerSpec>, String> {
    Ok(Some(match class {
        "ELU" => EluSpec { alpha: options.number(&["alpha"], 1.0)? as f32 }.into(),
        "LeakyReLU" => LeakyReluSpec { slope: options.number(&["negative_slope", "alpha"], 0.3)? as f32 }.into(),
        "ReLU" => {
            if options.0.get("max_value").is_some_and(|value| !value.is_null()) {
                return Err("a rectifier with a ceiling has no counterpart".into());
            }
            if options.number(&["threshold"], 0.0)? != 0.0 {
                return Err("a rectifier with a threshold has no counterpart".into());
            }
            match options.number(&["negative_slope"], 0.0)? {
                0.0 => ReluSpec {}.into(),
                slope => LeakyReluSpec { slope: slope as f32 }.into(),
            }
        }
        _ => return Ok(None),
    }))
}

impl Options<'_> {
    /// The layer that the option `activation` stands for.
    pub fn activation(&self) -> Result<Option<LayerSpec>, String> {
        self.find(&["activation"]).map_or(Ok(None), |(_, value)| activation(value))
    }
}

fn activation(value: &Value) -> Result<Option<LayerSpec>, String> {
    let name = match value {
        Value::String(name) => name.as_str(),
        Value::Object(object) => {
            let class = object.get("class_name").and_then(Value::as_str).unwrap_or_default();
            match object.get("config") {
                // A function, by name.
                Some(Value::String(name)) => name.as_str(),
                Some(Value::Object(config)) => {
                    let found = pointwise(class, &Options(config))?;
                    return found.map(Some).ok_or_else(|| format!("activation `{}` has no counterpart", shown(class)));
                }
                _ => class,
            }
        }
        _ => return Err(format!("activation {} has no counterpart", short(value))),
    };
    Ok(Some(match name {
        "linear" => return Ok(None),
        "relu" => ReluSpec {}.into(),
        "elu" => EluSpec { alpha: 1.0 }.into(),
        "tanh" => TanhSpec {}.into(),
        "softsign" => SoftsignSpec {}.into(),
        "swish" | "silu" => SwishSpec {}.into(),
        "leaky_relu" => LeakyReluSpec { slope: 0.2 }.into(),
        _ => return Err(format!("activation `{}` has no counterpart", shown(name))),
    }))
}
