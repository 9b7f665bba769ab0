//! What is painted: moments, names and scales.

use std::time::Duration;

use crate::picture::RgbImage;
use crate::report::charts::map;
use crate::simulator::car::dynamics::MAX_STEER_DEG;

/// Ranges that the curve of steering may have, degrees to either side.
const STEERING_RANGES_DEG: [f64; 3] = [5.0, 10.0, MAX_STEER_DEG];
/// A moment, as far as it is known.
#[derive(Clone, Debug, Default)]
pub struct FilmFrame {
    /// What the camera shows.
    pub picture: RgbImage,
    /// Time since the beginning, s.
    pub time_s: f64,
    /// Angle of the front wheels that the model wants, degrees, + = right.
    pub model_deg: Option<f64>,
    /// The same of the person or the expert.
    pub reference_deg: Option<f64>,
    /// Speed, mph.
    pub speed_mph: Option<f64>,
    /// Distance from the line, m, + = right as driven.
    pub cte_m: Option<f64>,
    /// How long the model took to answer.
    pub answered_in: Option<Duration>,
    /// Lap, from 1, and laps in all if that is known.
    pub lap: Option<(usize, Option<usize>)>,
    /// Where the car is (x, y), m.
    pub place: Option<[f64; 2]>,
    /// Whether the car was just put somewhere else, so that its way has a gap.
    pub put_back: bool,
}

/// The names that stand in a video.
#[derive(Clone, Debug)]
pub struct Captions {
    /// What is driven on, or what was recorded.
    pub title: String,
    /// What else to know, in one line.
    pub subtitle: String,
    /// Name of who steers, or would steer, drawn in the colour of models; at most 6 letters.
    pub model: Option<&'static str>,
    /// Name of whose steering it is compared with; at most 6 letters.
    pub reference: &'static str,
}

/// Scales that a film keeps from its first frame to its last.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FilmScales {
    /// Range of the curve of steering, degrees to either side.
    pub steering_deg: f64,
    /// Distance from the line that has the darkest colour on the map, m.
    pub darkest_m: f64,
}

impl FilmScales {
    /// Scales for a film in which the wheels turn by `angles_deg` and the car is `cte_m` from its line. What turns further is
    /// drawn at the border.
    pub fn covering(angles_deg: impl Iterator<Item = f64>, cte_m: impl Iterator<Item = f64>) -> FilmScales {
        let widest = angles_deg.map(f64::abs).fold(0.0, f64::max);
        let range = STEERING_RANGES_DEG.into_iter().find(|range| widest <= *range);
        FilmScales { steering_deg: range.unwrap_or(MAX_STEER_DEG), darkest_m: map::darkest_m(cte_m) }
    }
}
