#![allow(missing_docs)]
use serde::{Deserialize, Serialize};
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SampleSpec { pub side_cameras: Option<f64>, pub flip: Option<String>, pub min_throttle: Option<f64>, pub group: Option<String>, pub validation_side_cameras: bool, pub validation_flips: bool }
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Balance { pub keep_zero: Option<f64> }
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Augmentation { pub shift_px: Option<f64> }
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SplitSpec { pub mode: Option<String>, pub validation_share: f64 }
macro_rules! v { ($($t:ty)*) => { $(impl $t { pub fn validate(&self) -> crate::Result<()> { Ok(()) } })* } }
v!(SampleSpec Balance Augmentation SplitSpec);
