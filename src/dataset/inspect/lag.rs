//! How long the picture takes to follow the label.
//!
//! A turned wheel turns the car, and the far scene moves sideways. The lag is the shift in time at which labels and that
//! movement ([`Frame::turn`]) correlate best. The picture follows the wheel by 0 to 0.2 s. Labels that come later than what
//! the picture shows, or much earlier, were put beside the wrong frames.

use serde::Serialize;

use super::super::recording::Recording;
use super::frames::{Frame, peak_offset};

/// Largest lag that is looked for, in seconds.
const REACH_S: f64 = 1.0;
/// Pairs of label and movement that a lag needs.
const MIN_PAIRS: usize = 100;
/// Correlation that a lag needs.
const MIN_CORRELATION: f64 = 0.3;

/// How labels and pictures fit together in time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Lag {
    /// Time from a label to the movement of the picture that fits it best, in milliseconds; negative if the picture comes
    /// first.
    pub ms: f64,
    /// Correlation of the two at that lag.
    pub correlation: f64,
    /// Widths of the picture per second that the far scene moves at steering 1, by least squares.
    pub turn_at_full_lock: f64,
}

impl Lag {
    /// The lag of a recording; `None` if labels and pictures have too little in common to tell.
    pub fn of(recording: &Recording, frames: &[Option<Frame>]) -> Option<Lag> {
        let step_s = 1.0 / recording.rate_hz()?;
        let reach = (REACH_S / step_s).round() as isize;
        let at: Vec<Option<(f64, f64)>> =
            (-reach - 1..=reach).map(|rows| correlate(recording, frames, rows).filter(|c| c.0.is_finite())).collect();
        let value = |i: usize| at.get(i).copied().flatten().map(|(correlation, _)| correlation);
        let best = (0..at.len())
            .filter(|&i| value(i).is_some())
            .max_by(|&a, &b| value(a).partial_cmp(&value(b)).unwrap_or(std::cmp::Ordering::Equal))?;
        let (correlation, turn_at_full_lock) = at[best]?;
        let around = best.checked_sub(1).and_then(value).zip(value(best + 1));
        let offset = around.map_or(0.0, |(left, right)| peak_offset([left, correlation, right]));
        // A movement lies between its frame and the next: half a row later than the frame.
        let rows = best as f64 + offset - (reach + 1) as f64 + 0.5;
        (correlation >= MIN_CORRELATION).then(|| Lag { ms: 1000.0 * rows * step_s, correlation, turn_at_full_lock })
    }
}

/// Correlation of the labels with the movement `rows` later, and the slope of the movement over the label.
fn correlate(recording: &Recording, frames: &[Option<Frame>], rows: isize) -> Option<(f64, f64)> {
    let (mut n, mut sums, mut squares, mut product) = (0usize, [0.0; 2], [0.0; 2], 0.0);
    for session in &recording.sessions {
        for row in session.clone() {
            let Some(later) = row.checked_add_signed(rows).filter(|later| session.contains(later)) else { continue };
            let Some(turn) = frames.get(later).copied().flatten().and_then(|frame| frame.turn) else { continue };
            let (label, turn) = (f64::from(recording.rows[row].steering), f64::from(turn));
            n += 1;
            sums = [sums[0] + label, sums[1] + turn];
            squares = [squares[0] + label * label, squares[1] + turn * turn];
            product += label * turn;
        }
    }
    let count = n as f64;
    let variance = |i: usize| squares[i] / count - (sums[i] / count).powi(2);
    let covariance = product / count - sums[0] / count * (sums[1] / count);
    let known = n >= MIN_PAIRS && variance(0) > 1e-9 && variance(1) > 1e-12;
    known.then(|| (covariance / (variance(0) * variance(1)).sqrt(), covariance / variance(0)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::testing::recording_of;

    #[test]
    fn a_known_delay_is_found() {
        let label = |i: isize| (i as f32 * 0.21).sin() * 0.4 + (i as f32 * 0.047).cos() * 0.3;
        let labels: Vec<f32> = (0..400).map(label).collect();
        let recording = recording_of(&labels, 100);
        for delay in [-3, 0, 2] {
            let frame =
                |i: isize| Frame { brightness: 90.0, turn: Some(0.8 * label(i - delay)), frozen: false, copy_of: None };
            let frames: Vec<_> = (0..400).map(|i| Some(frame(i))).collect();
            let lag = Lag::of(&recording, &frames).unwrap();
            assert!((lag.ms - (100.0 * delay as f64 + 50.0)).abs() < 12.0, "{delay}: {lag:?}");
            assert!(lag.correlation > 0.99 && (lag.turn_at_full_lock - 0.8).abs() < 0.02, "{lag:?}");
        }
    }

    #[test]
    fn unrelated_or_absent_movement_has_no_lag() {
        let labels: Vec<f32> = (0..400).map(|i| (i as f32 * 0.21).sin() * 0.4).collect();
        let recording = recording_of(&labels, 100);
        let noise = |i: u32| (i.wrapping_mul(2_654_435_761) >> 16) as f32 / 65_536.0 - 0.5;
        let frame = |turn| Some(Frame { brightness: 90.0, turn, frozen: false, copy_of: None });
        let frames: Vec<_> = (0..400).map(|i| frame(Some(noise(i)))).collect();
        assert_eq!(Lag::of(&recording, &frames), None);
        assert_eq!(Lag::of(&recording, &[frame(None); 400]), None);
    }
}
