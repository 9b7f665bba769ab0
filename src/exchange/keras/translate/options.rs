//! The options of a Keras layer, under all the names that they have had.

use serde_json::{Map, Value};

use super::step::AxisOrder;
use crate::exchange::keras::messages::shown;

/// The options of a layer; each may have several names, of which the newest comes first.
pub(super) struct Options<'a>(pub &'a Map<String, Value>);

impl<'a> Options<'a> {
    /// The first of `names` that is there and not null.
    pub fn find(&self, names: &[&'static str]) -> Option<(&'static str, &'a Value)> {
        names.iter().find_map(|name| self.0.get(*name).filter(|value| !value.is_null()).map(|value| (*name, value)))
    }

    pub fn number(&self, names: &[&'static str], default: f64) -> Result<f64, String> {
        let Some((name, value)) = self.find(names) else { return Ok(default) };
        // Keras 3 writes some numbers as arrays: {"class_name": "__numpy__", "config": {"value": 0.3}}.
        let value = value.pointer("/config/value").unwrap_or(value);
        let number = value.as_f64().filter(|number| number.is_finite());
        number.ok_or_else(|| format!("`{name}` must be a number, not {}", short(value)))
    }

    pub fn flag(&self, names: &[&'static str], default: bool) -> Result<bool, String> {
        let Some((name, value)) = self.find(names) else { return Ok(default) };
        value.as_bool().ok_or_else(|| format!("`{name}` must be true or false, not {}", short(value)))
    }

    pub fn size(&self, names: &[&'static str]) -> Result<usize, String> {
        let (name, value) = self.find(names).ok_or_else(|| format!("has no `{}`", names[0]))?;
        size(value).ok_or_else(|| format!("`{name}` must be a whole number, not {}", short(value)))
    }

    /// Height and width; one number stands for both.
    pub fn pair(&self, names: &[&'static str]) -> Result<Option<[usize; 2]>, String> {
        let Some((name, value)) = self.find(names) else { return Ok(None) };
        pair(value).map(Some).ok_or_else(|| format!("`{name}` must be two whole numbers, not {}", short(value)))
    }

    /// [top, bottom] and [left, right]: one number, [height, width], [top, bottom, left, right] or two pairs.
    pub fn border(&self, names: &[&'static str]) -> Result<[[usize; 2]; 2], String> {
        let (name, value) = self.find(names).ok_or_else(|| format!("has no `{}`", names[0]))?;
        let found = match value.as_array().map(Vec::as_slice) {
            Some([top, bottom, left, right]) => {
                let sizes = [top, bottom, left, right].map(size);
                sizes.iter().all(Option::is_some).then(|| {
                    let [top, bottom, left, right] = sizes.map(Option::unwrap_or_default);
                    [[top, bottom], [left, right]]
                })
            }
            Some([rows @ Value::Array(_), columns @ Value::Array(_)]) => {
                pair(rows).and_then(|rows| pair(columns).map(|columns| [rows, columns]))
            }
            _ => pair(value).map(|[h, w]| [[h, h], [w, w]]),
        };
        found
            .ok_or_else(|| format!("`{name}` must be whole numbers for top, bottom, left, right, not {}", short(value)))
    }

    pub fn same_padding(&self) -> Result<bool, String> {
        match self.find(&["padding", "border_mode"]).map(|(_, value)| value.as_str()) {
            None | Some(Some("valid")) => Ok(false),
            Some(Some("same")) => Ok(true),
            Some(other) => {
                Err(format!("padding `{}` has no counterpart", shown(other.unwrap_or("of an unknown kind"))))
            }
        }
    }

    /// The one axis that is normalised; -1 is the last.
    pub fn axis(&self) -> Result<i64, String> {
        let axis = match self.find(&["axis"]).map(|(_, value)| value) {
            None => Some(-1),
            Some(Value::Array(axes)) => axes.first().filter(|_| axes.len() == 1).and_then(Value::as_i64),
            Some(value) => value.as_i64(),
        };
        axis.ok_or_else(|| "normalising over several axes has no counterpart".to_string())
    }

    pub fn order(&self) -> Result<Option<AxisOrder>, String> {
        match self.find(&["data_format", "dim_ordering"]).map(|(_, value)| value.as_str()) {
            None | Some(Some("default")) => Ok(None),
            Some(Some("channels_last" | "tf")) => Ok(Some(AxisOrder::ChannelsLast)),
            Some(Some("channels_first" | "th")) => Ok(Some(AxisOrder::ChannelsFirst)),
            Some(other) => Err(format!("order of axes `{}` is unknown", shown(other.unwrap_or("of an unknown kind")))),
        }
    }

    pub fn input(&self) -> Result<Option<Vec<usize>>, String> {
        let Some((name, value)) = self.find(&["batch_shape", "batch_input_shape"]) else { return Ok(None) };
        let extents = value.as_array().and_then(|extents| extents.get(1..));
        let extents: Option<Vec<usize>> =
            extents.and_then(|all| all.iter().map(|n| if n.is_null() { Some(0) } else { size(n) }).collect());
        extents.map(Some).ok_or_else(|| format!("`{name}` must be a list of sizes, not {}", short(value)))
    }
}

/// A whole number, also written as 3.0; no larger than any size of a network.
fn size(value: &Value) -> Option<usize> {
    let number = value.as_f64().filter(|number| number.fract() == 0.0 && (0.0..=1e9).contains(number))?;
    Some(number as usize)
}

fn pair(value: &Value) -> Option<[usize; 2]> {
    match value.as_array().map(Vec::as_slice) {
        None => size(value).map(|both| [both, both]),
        Some([both]) => size(both).map(|both| [both, both]),
        Some([h, w]) => Some([size(h)?, size(w)?]),
        Some(_) => None,
    }
}

/// A value in a message; no longer than a line.
pub(super) fn short(value: &Value) -> String {
    let text = value.to_string();
    if text.chars().count() > 60 { text.chars().take(60).chain(['…']).collect() } else { text }
}
