//! Axes: which values they cover, where these lie, and the ticks.

/// Decades that a logarithmic axis shows at most; smaller values lie at its border.
const MAX_DECADES: i32 = 4;

/// How an axis maps values to places.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scale {
    /// Evenly.
    Linear,
    /// By the logarithm; values that are not positive are left out.
    Log,
}

/// One of the two axes.
#[derive(Clone, Debug)]
pub struct Axis {
    pub(super) label: String,
    pub(super) scale: Scale,
    pub(super) range: Option<[f64; 2]>,
}

impl Axis {
    /// An axis called `label`, unit included, that covers the data.
    pub fn new(label: impl Into<String>) -> Axis {
        Axis { label: label.into(), scale: Scale::Linear, range: None }
    }

    /// With a logarithmic scale.
    pub fn log(self) -> Axis {
        Axis { scale: Scale::Log, ..self }
    }

    /// From `low` to `high`, whatever the data; what lies beyond is drawn at the border.
    pub fn range(self, low: f64, high: f64) -> Axis {
        Axis { range: Some([low, high]), ..self }
    }
}

/// From values to pixels.
pub(super) struct PixelMap {
    pub scale: Scale,
    pub low: f64,
    pub high: f64,
    pub pixels: [f64; 2],
}

impl PixelMap {
    /// Covers `values`; with `round`, to the next ticks.
    pub fn new(axis: &Axis, values: impl Iterator<Item = f64>, pixels: [f64; 2], round: bool) -> PixelMap {
        let positive = axis.scale == Scale::Log;
        let [mut low, mut high] = axis.range.unwrap_or_else(|| {
            values
                .filter(|v| v.is_finite() && (!positive || *v > 0.0))
                .fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], v| [low.min(v), high.max(v)])
        });
        if low > high {
            (low, high) = if positive { (0.1, 1.0) } else { (0.0, 1.0) };
        }
        if positive {
            if axis.range.is_none() {
                low = low.max(high / 10f64.powi(MAX_DECADES));
            }
            // A logarithmic axis of less than a factor of 2 says nothing.
            if high / low < 2.0 {
                let middle = (low * high).sqrt();
                (low, high) = (middle / 1.5, middle * 1.5);
            }
            let spread = if axis.range.is_none() { (high / low).powf(0.05) } else { 1.0 };
            (low, high) = (low / spread, high * spread);
        } else {
            if high - low <= 1e-9 * low.abs() {
                let half = if low == 0.0 { 0.5 } else { 0.5 * low.abs() };
                (low, high) = (low - half, high + half);
            }
            if round && axis.range.is_none() {
                let step = step((high - low) / 5.0);
                (low, high) = ((low / step).floor() * step, (high / step).ceil() * step);
            }
        }
        PixelMap { scale: axis.scale, low, high, pixels }
    }

    /// Where `value` lies; values beyond the range at its border. Not a number where there is no place.
    pub fn place(&self, value: f64) -> f64 {
        let share = match self.scale {
            Scale::Linear => (value - self.low) / (self.high - self.low),
            Scale::Log if value <= 0.0 => f64::NAN,
            Scale::Log => (value / self.low).ln() / (self.high / self.low).ln(),
        };
        let share = if share.is_nan() { share } else { share.clamp(0.0, 1.0) };
        self.pixels[0] + share * (self.pixels[1] - self.pixels[0])
    }

    /// About `count` round values with their labels.
    pub fn ticks(&self, count: f64) -> Vec<(f64, String)> {
        match self.scale {
            Scale::Linear => {
                let step = step((self.high - self.low) / count.max(1.0));
                let decimals = (-(step.log10() + 1e-9).floor()).max(0.0) as usize;
                let first = (self.low / step - 1e-9).ceil() as i64;
                let last = (self.high / step + 1e-9).floor() as i64;
                let label = |value: f64| match value.abs() {
                    v if v >= 1e6 || (v > 0.0 && v < 1e-4) => format!("{value:e}"),
                    _ => format!("{value:.decimals$}"),
                };
                (first..=last).map(|i| i as f64 * step).map(|value| (value, label(value))).collect()
            }
            Scale::Log => {
                let (first, last) = (self.low.log10().floor() as i32, self.high.log10().ceil() as i32);
                let decades = f64::from(last - first);
                let steps: &[f64] = if decades <= 3.0 { &[1.0, 2.0, 5.0] } else { &[1.0] };
                let values = (first..=last).flat_map(|power| steps.iter().map(move |s| s * 10f64.powi(power)));
                let inside: Vec<f64> = values.filter(|v| (self.low * 0.999..=self.high * 1.001).contains(v)).collect();
                if inside.len() < 3 {
                    let even = PixelMap { scale: Scale::Linear, ..*self };
                    return even.ticks(count).into_iter().filter(|(value, _)| *value > 0.0).collect();
                }
                let label = |v: f64| match v {
                    v if !(1e-4..1e5).contains(&v) => format!("{v:.0e}"),
                    v if v >= 1.0 => format!("{v:.0}"),
                    v => format!("{v:.*}", (-v.log10() - 1e-9).ceil() as usize),
                };
                inside.into_iter().map(|v| (v, label(v))).collect()
            }
        }
    }
}

/// The next of 1, 2, 5, 10, … from `rough` on.
fn step(rough: f64) -> f64 {
    let power = 10f64.powf(rough.max(1e-300).log10().floor());
    let digit = rough / power;
    power * [1.0, 2.0, 5.0].into_iter().find(|d| digit <= d + 1e-9).unwrap_or(10.0)
}
