//! What the outputs of a network mean: the `outputs` entry of a recipe, and the labels beside the steering.

use serde::{Deserialize, Serialize};

use super::labels::later;
use crate::dataset::driven::recorded_speeds_mps;
use crate::dataset::recording::Recording;
use crate::geometry::MPS_PER_MPH;
use crate::{Error, Result};

/// What the output `steering` means.
const STEERING: &str =
    "steering in [-1, 1], positive to the right; times recipe.full_lock_deg it is degrees of the front wheels";
/// Largest share of the rows of a recording that may lack a label beside the steering; they are left out.
const MAX_UNRECORDED_SHARE: f64 = 0.2;

/// What an output of a network means.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OutputKind {
    /// The steering, [-1, 1], + = right.
    Steering,
    /// The throttle, [-1, 1]; what is below 0 brakes. Its label is the recorded throttle, less the brake where one was recorded.
    Throttle,
    /// The speed to drive at, as a share of a top speed. Its label is the recorded speed.
    Speed,
}

impl OutputKind {
    /// Name in recipes, exported files and messages.
    pub fn name(self) -> &'static str {
        match self {
            OutputKind::Steering => "steering",
            OutputKind::Throttle => "throttle",
            OutputKind::Speed => "speed",
        }
    }
}

/// One entry of a recipe's `outputs`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OutputSpec {
    /// What it means.
    pub name: OutputKind,
    /// How much its mean loss counts in the sum that training minimizes.
    #[serde(default = "one", skip_serializing_if = "is_one")]
    pub loss_weight: f64,
    /// Of `speed`: the speed at output 1, mph.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub top_speed_mph: Option<f64>,
    /// Of `speed`: the label is the speed of the driven path this time ahead, s, so that a car has the time to slow down. At the
    /// end of a session the last speed counts.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub ahead_s: f64,
}

fn one() -> f64 {
    1.0
}

fn is_one(weight: &f64) -> bool {
    *weight == 1.0
}

fn is_zero(time_s: &f64) -> bool {
    *time_s == 0.0
}

/// The outputs of a network, in the order of its last layer's units. The first is the steering.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Outputs(Vec<OutputSpec>);

impl Default for Outputs {
    fn default() -> Outputs {
        let steering = OutputSpec { name: OutputKind::Steering, loss_weight: 1.0, top_speed_mph: None, ahead_s: 0.0 };
        Outputs(vec![steering])
    }
}

impl Outputs {
    /// Steering, and `second` with a loss weight of 1; a speed is a share of `top_speed_mph`.
    pub fn with(second: OutputKind, top_speed_mph: Option<f64>) -> Outputs {
        let mut outputs = Outputs::default();
        outputs.0.push(OutputSpec { name: second, loss_weight: 1.0, top_speed_mph, ahead_s: 0.0 });
        outputs
    }

    /// Whether this is what stands for an entry that is absent.
    pub fn is_default(&self) -> bool {
        *self == Outputs::default()
    }

    /// The outputs, one for each unit of the last layer.
    pub fn specs(&self) -> &[OutputSpec] {
        &self.0
    }

    /// Their number.
    pub fn count(&self) -> usize {
        self.0.len()
    }

    /// The place of the output `kind` in the network's answer.
    pub fn index(&self, kind: OutputKind) -> Option<usize> {
        self.0.iter().position(|output| output.name == kind)
    }

    /// Speed at an output `speed` of 1, mph, if there is one.
    pub fn top_speed_mph(&self) -> Option<f64> {
        self.0.iter().find(|output| output.name == OutputKind::Speed)?.top_speed_mph
    }

    /// Names in their order, as in `steering, throttle`.
    pub fn names(&self) -> String {
        self.0.iter().map(|output| output.name.name()).collect::<Vec<_>>().join(", ")
    }

    /// Weights of the outputs in the loss; none where there is but the steering with a weight of 1.
    pub fn loss_weights(&self) -> Option<Vec<f32>> {
        (!self.is_default()).then(|| self.0.iter().map(|output| output.loss_weight as f32).collect())
    }

    /// What an output means, for people and for other programs.
    pub fn meaning(&self, kind: OutputKind) -> String {
        match kind {
            OutputKind::Steering => STEERING.into(),
            OutputKind::Throttle => "throttle in [-1, 1], negative to brake".into(),
            OutputKind::Speed => {
                format!("speed to drive at; times {} it is mph", self.top_speed_mph().unwrap_or_default())
            }
        }
    }

    /// What all outputs mean, in their order.
    pub fn label(&self) -> String {
        match &self.0[..] {
            [only] => self.meaning(only.name),
            all => {
                let named = all.iter().map(|output| format!("{}: {}", output.name.name(), self.meaning(output.name)));
                named.collect::<Vec<_>>().join("; ")
            }
        }
    }

    /// Checks names and numbers.
    ///
    /// # Errors
    /// [`Error::Usage`] naming the entry.
    pub fn validate(&self) -> Result<()> {
        let wrong = |message: String| Err(Error::Usage(format!("outputs: {message}")));
        if self.0.first().is_none_or(|first| first.name != OutputKind::Steering) {
            return wrong("the first must be `steering`".into());
        }
        for (index, output) in self.0.iter().enumerate() {
            let name = output.name.name();
            if self.0[..index].iter().any(|other| other.name == output.name) {
                return wrong(format!("`{name}` is there twice"));
            }
            if !(output.loss_weight.is_finite() && output.loss_weight > 0.0) {
                return wrong(format!("`{name}`: loss_weight must be a positive number, not {}", output.loss_weight));
            }
            match (output.name, output.top_speed_mph) {
                (OutputKind::Speed, Some(mph)) if mph.is_finite() && mph > 0.0 => {}
                (OutputKind::Speed, _) => {
                    return wrong("`speed` is a share of a top speed: give a positive top_speed_mph".into());
                }
                (_, Some(_)) => return wrong(format!("`{name}` takes no top_speed_mph")),
                (_, None) => {}
            }
            if output.name != OutputKind::Speed && output.ahead_s != 0.0 {
                return wrong(format!("`{name}` takes no ahead_s; labels.shift_s shifts all labels"));
            }
            if !(0.0..=5.0).contains(&output.ahead_s) {
                return wrong(format!("`{name}`: ahead_s must be 0 to 5 s, not {}", output.ahead_s));
            }
        }
        if self.index(OutputKind::Throttle).is_some() && self.index(OutputKind::Speed).is_some() {
            return wrong("a car is driven by `throttle` or by `speed`, not by both".into());
        }
        Ok(())
    }

    /// The labels of all outputs but the steering for each row of `recording`, `[rows][outputs − 1]`, `shift_s` later in its session;
    /// NaN for rows that have none. `notices` are told what the user should know.
    ///
    /// # Errors
    /// [`Error::Data`] with the place and a remedy if more than a fifth of the rows have none.
    pub(super) fn labels_beside_steering(
        &self,
        recording: &Recording,
        shift_s: f64,
        notices: &mut Vec<String>,
    ) -> Result<Vec<f32>> {
        let beside = self.0.len() - 1;
        let mut all = vec![f32::NAN; beside * recording.rows.len()];
        for (index, output) in self.0[1..].iter().enumerate() {
            let labels = output.labels(recording, notices)?;
            let labels = if shift_s > 0.0 { later(recording, &labels, shift_s) } else { labels };
            for (row, label) in labels.into_iter().enumerate() {
                all[row * beside + index] = label;
            }
        }
        Ok(all)
    }
}

impl OutputSpec {
    /// The labels of the rows of `recording`, NaN where one was not recorded.
    pub fn recorded(&self, recording: &Recording) -> Vec<f32> {
        let rows = &recording.rows;
        match self.name {
            OutputKind::Steering => rows.iter().map(|row| row.steering).collect(),
            OutputKind::Throttle => rows.iter().map(|row| throttle(row.throttle, row.brake)).collect(),
            OutputKind::Speed => match recorded_speeds_mps(recording) {
                None => vec![f32::NAN; rows.len()],
                Some(mps) => {
                    let top_mph = self.top_speed_mph.unwrap_or(f64::NAN);
                    let ahead = speeds_ahead(recording, &mps, self.ahead_s);
                    ahead.map(|mps| (mps / MPS_PER_MPH / top_mph) as f32).collect()
                }
            },
        }
    }

    /// The labels of the rows of `recording` for training.
    fn labels(&self, recording: &Recording, notices: &mut Vec<String>) -> Result<Vec<f32>> {
        let place = || recording.path.display().to_string();
        let mut labels = self.recorded(recording);
        match self.name {
            OutputKind::Steering => Ok(labels),
            OutputKind::Throttle => {
                let missing = labels.iter().filter(|label| label.is_nan()).count();
                if missing as f64 > MAX_UNRECORDED_SHARE * labels.len() as f64 {
                    let first = labels.iter().position(|label| label.is_nan()).unwrap_or_default();
                    let message = format!(
                        "the recipe's output `throttle` learns from the recorded throttle, and {missing} of {} rows have none: \
                         record it, or take a recipe whose outputs are the steering alone",
                        labels.len()
                    );
                    return Err(Error::data_at(&recording.path, u64::from(recording.rows[first].line), message));
                }
                if missing > 0 {
                    notices.push(format!("{}: {missing} rows have no throttle and are left out", place()));
                }
                Ok(labels)
            }
            OutputKind::Speed => {
                let missing = labels.iter().filter(|label| label.is_nan()).count();
                if missing == labels.len() {
                    let message = "the recipe's output `speed` learns from the recorded speed, and no row has one other than 0: \
                                   record it, or take a recipe whose outputs are the steering alone or with `throttle`";
                    let line = recording.rows.first().map_or(1, |row| u64::from(row.line));
                    return Err(Error::data_at(&recording.path, line, message));
                }
                if missing > 0 {
                    notices.push(format!("{}: {missing} rows of sessions without a speed are left out", place()));
                }
                let faster = labels.iter().filter(|share| **share > 1.0).count();
                if faster > 0 {
                    let top_mph = self.top_speed_mph.unwrap_or_default();
                    notices.push(format!(
                        "{}: {faster} rows are faster than top_speed_mph = {top_mph} and count as that",
                        place()
                    ));
                }
                labels.iter_mut().for_each(|share| *share = share.min(1.0));
                Ok(labels)
            }
        }
    }
}

/// The pedals as one number: the throttle, less the brake where one was recorded.
fn throttle(throttle: f32, brake: f32) -> f32 {
    let pedals = if brake.is_finite() { throttle - brake } else { throttle };
    if pedals.is_finite() { pedals.clamp(-1.0, 1.0) } else { f32::NAN }
}

/// The speed `ahead_s` after each row, between rows by linear interpolation, at the end of a session its last.
fn speeds_ahead<'a>(recording: &'a Recording, mps: &'a [f64], ahead_s: f64) -> impl Iterator<Item = f64> + 'a {
    recording.sessions.iter().flat_map(move |session| {
        let time_ms = |row: usize| recording.rows[row].time_ms as f64;
        let mut after = session.start;
        session.clone().map(move |row| {
            let wanted_ms = time_ms(row) + 1000.0 * ahead_s;
            after = after.max(row);
            while after < session.end && time_ms(after) < wanted_ms {
                after += 1;
            }
            if after >= session.end {
                return mps[session.end - 1];
            }
            if after == row || time_ms(after) <= wanted_ms {
                return mps[after];
            }
            let (from_ms, to_ms) = (time_ms(after - 1), time_ms(after));
            let share = (wanted_ms - from_ms) / (to_ms - from_ms);
            mps[after - 1] + share * (mps[after] - mps[after - 1])
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::testing::recording_of;

    fn read(text: &str) -> std::result::Result<Outputs, String> {
        #[derive(Deserialize)]
        struct Entry {
            outputs: Outputs,
        }
        let entry: Entry = toml::from_str(text).map_err(|e| e.message().to_string())?;
        entry.outputs.validate().map_err(|e| e.to_string())?;
        Ok(entry.outputs)
    }

    #[test]
    fn entries_read_from_toml_and_wrong_ones_are_named() {
        let outputs = read("outputs = [{ name = 'steering' }, { name = 'throttle', loss_weight = 0.3 }]").unwrap();
        assert_eq!((outputs.names().as_str(), outputs.loss_weights()), ("steering, throttle", Some(vec![1.0, 0.3])));
        assert_eq!((outputs.index(OutputKind::Throttle), outputs.index(OutputKind::Speed)), (Some(1), None));
        let steering = read("outputs = [{ name = 'steering' }]").unwrap();
        assert!(steering.is_default() && steering.loss_weights().is_none());
        for (text, named) in [
            ("[]", "the first must be `steering`"),
            ("[{ name = 'throttle' }]", "the first must be `steering`"),
            ("[{ name = 'steering' }, { name = 'steering' }]", "`steering` is there twice"),
            ("[{ name = 'steering', loss_weight = 0 }]", "`steering`: loss_weight"),
            ("[{ name = 'steering' }, { name = 'speed' }]", "give a positive top_speed_mph"),
            ("[{ name = 'steering' }, { name = 'throttle', top_speed_mph = 3 }]", "`throttle` takes no top_speed_mph"),
            ("[{ name = 'steering' }, { name = 'throttle', ahead_s = 1 }]", "`throttle` takes no ahead_s"),
            ("[{ name = 'steering' }, { name = 'brake' }]", "unknown variant `brake`"),
            (
                "[{ name = 'steering' }, { name = 'throttle' }, { name = 'speed', top_speed_mph = 30 }]",
                "by `throttle` or by `speed`",
            ),
        ] {
            let error = read(&format!("outputs = {text}")).unwrap_err();
            assert!(error.contains(named), "{text}: {error}");
        }
    }

    #[test]
    fn the_throttle_is_the_recorded_one_less_the_brake() {
        let mut recording = recording_of(&[0.1; 10], 100);
        for (row, (throttle, brake)) in [(0.5, f32::NAN), (0.0, 0.25), (0.25, 0.0)].into_iter().enumerate() {
            (recording.rows[row].throttle, recording.rows[row].brake) = (throttle, brake);
        }
        recording.rows[3].throttle = f32::NAN;
        let outputs = Outputs::with(OutputKind::Throttle, None);
        let mut notices = Vec::new();
        let labels = outputs.labels_beside_steering(&recording, 0.0, &mut notices).unwrap();
        assert_eq!(labels[..3], [0.5, -0.25, 0.25]);
        assert!(labels[3].is_nan() && notices.len() == 1 && notices[0].contains("1 rows have no throttle"));
        recording.rows.iter_mut().skip(2).for_each(|row| row.throttle = f32::NAN);
        let error = outputs.labels_beside_steering(&recording, 0.0, &mut notices).unwrap_err().to_string();
        assert!(error.contains("8 of 10 rows have none") && error.contains(":3:"), "{error}");
    }

    #[test]
    fn the_speed_is_a_share_of_the_top_speed_and_may_be_that_of_later() {
        // 10 rows a second in two sessions, faster by 1 mph a row.
        let mut recording = recording_of(&[0.0; 12], 100);
        recording.sessions = vec![0..6, 6..12];
        recording.rows.iter_mut().zip(10u8..).for_each(|(row, mph)| row.speed_mph = f32::from(mph));
        let mut outputs = Outputs::with(OutputKind::Speed, Some(20.0));
        let mut notices = Vec::new();
        let labels = outputs.labels_beside_steering(&recording, 0.0, &mut notices).unwrap();
        assert!((labels[0] - 0.5).abs() < 1e-6 && (labels[10] - 1.0).abs() < 1e-6);
        assert_eq!(labels[11], 1.0);
        assert!(notices[0].contains("1 rows are faster than top_speed_mph = 20"), "{notices:?}");
        outputs.0[1].ahead_s = 0.25;
        let ahead = outputs.labels_beside_steering(&recording, 0.0, &mut notices).unwrap();
        assert!((ahead[0] - 12.5 / 20.0).abs() < 1e-6, "{ahead:?}");
        assert!((ahead[5] - 15.0 / 20.0).abs() < 1e-6, "the last speed of a session counts to its end: {ahead:?}");
        recording.rows.iter_mut().for_each(|row| row.speed_mph = 0.0);
        let error = outputs.labels_beside_steering(&recording, 0.0, &mut notices).unwrap_err().to_string();
        assert!(error.contains("no row has one other than 0"), "{error}");
    }
}
