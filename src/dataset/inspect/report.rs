//! The findings about a recording.

use serde::Serialize;

use super::lag::Lag;
use super::suspicious::Stretch;
use crate::dataset::recording::View;
use crate::dataset::unusable::Unusable;

/// The findings; serialises to JSON, and [`Display`](std::fmt::Display) prints them for people.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// What was inspected.
    pub path: String,
    /// Name of its format in JSON, such as `udacity` or `tub`.
    pub kind: &'static str,
    /// Name of its format for people.
    #[serde(skip)]
    pub format: &'static str,
    /// Cameras that recordings of its format have.
    #[serde(skip)]
    pub format_cameras: usize,
    /// Rows of the log.
    pub rows: usize,
    /// Rows that can be used for training.
    pub usable: usize,
    /// The others, by reason.
    pub unusable: Unusable,
    /// Number of rows and length of each session.
    pub sessions: Vec<Session>,
    /// Seconds driven, the sum of the sessions.
    pub driven_s: f64,
    /// Seconds from the earliest to the latest row.
    pub span_s: f64,
    /// Rows per second within sessions.
    pub rate_hz: Option<f64>,
    /// Whether the times come from the recording; otherwise rows count as 20 Hz.
    pub times_plausible: bool,
    /// Cameras that have images.
    pub cameras: Vec<View>,
    /// Height and width of the first image.
    pub image_size: Option<[usize; 2]>,
    /// The sizes of the centre camera's pictures, the most frequent first.
    pub sizes: Vec<Size>,
    /// Whether the labels look like shares of full lock, or the user has said what they are.
    pub labels_believed: bool,
    /// The labels; `None` without rows.
    pub steering: Option<Steering>,
    /// Smallest, mean and largest throttle, where it was recorded.
    pub throttle: Option<Spread>,
    /// Smallest, mean and largest speed in miles per hour, where it was recorded.
    pub speed_mph: Option<Spread>,
    /// Distance driven in metres, from speed and time, where the speed was recorded.
    pub distance_m: Option<f64>,
    /// Share of the rows in which the car stands, where the speed was recorded.
    pub standing_share: Option<f64>,
    /// Missing rows within sessions.
    pub gaps: Gaps,
    /// What the pictures of the centre camera show; `None` without pictures.
    pub pictures: Option<Pictures>,
    /// Stretches to be looked at.
    pub suspicious: Vec<Stretch>,
    /// What the reader should know.
    pub notices: Vec<String>,
    /// What the reader should do.
    pub advice: Vec<String>,
}

/// Steps between rows of a session that are at least three times the usual one.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Gaps {
    /// Their number.
    pub count: usize,
    /// The longest, in seconds; 0 without one.
    pub longest_s: f64,
}

/// What the pictures of the centre camera show.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Pictures {
    /// Pictures that could be read.
    pub seen: usize,
    /// Rows whose picture cannot be decoded.
    pub undecodable: usize,
    /// Files that are the same as an earlier one, byte for byte.
    pub copies: usize,
    /// Pictures that show the same as the one before although the car moves, but for noise.
    pub frozen: usize,
    /// How labels and pictures fit together in time, where that can be told.
    pub lag: Option<Lag>,
}

/// A stretch driven without a break.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Session {
    /// Line of the log it begins at.
    pub first_line: u32,
    /// Its rows.
    pub rows: usize,
    /// Its length in seconds.
    pub length_s: f64,
}

/// Pictures of one size.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Size {
    /// Height in pixels.
    pub height: usize,
    /// Width in pixels.
    pub width: usize,
    /// Their number.
    pub pictures: usize,
}

/// What the labels look like.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Steering {
    /// Smallest, mean and largest label.
    #[serde(flatten)]
    pub spread: Spread,
    /// Standard deviation.
    pub deviation: f64,
    /// Share of labels that are exactly 0.
    pub zero_share: f64,
    /// Share of labels at full lock, to either side.
    pub full_lock_share: f64,
    /// Share of labels beyond 0.04 to the left.
    pub left_share: f64,
    /// Share of labels beyond 0.04 to the right.
    pub right_share: f64,
    /// How many different labels there are.
    pub distinct: usize,
    /// Labels in each bin of width 0.1, centred at -1.0, -0.9, … 1.0.
    pub histogram: Vec<usize>,
}

/// Smallest, mean and largest of some values.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Spread {
    /// Smallest.
    pub min: f64,
    /// Mean.
    pub mean: f64,
    /// Largest.
    pub max: f64,
}

impl Spread {
    pub(super) fn of(values: impl Iterator<Item = f32>) -> Option<Self> {
        let (mut min, mut max, mut sum, mut count) = (f64::INFINITY, f64::NEG_INFINITY, 0.0, 0_usize);
        for value in values.map(f64::from).filter(|value| value.is_finite()) {
            (min, max, sum, count) = (min.min(value), max.max(value), sum + value, count + 1);
        }
        (count > 0).then(|| Self { min, mean: sum / count as f64, max })
    }
}
