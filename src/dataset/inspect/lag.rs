//! How long the picture takes to follow the label.
//!
//! A turned wheel turns the car, and the far scene moves sideways. The lag is the shift in time at which labels and that
//! movement ([`Frame::turn`]) correlate best, after the moving mean over two seconds is taken off both: of a long smooth bend,
//! any shift fits, and only quick changes tell the time. The picture follows the wheel by 0 to 0.2 s. Labels that come later
//! than what the picture shows, or much earlier, were put beside the wrong frames.

use serde::Serialize;

use super::frames::{Frame, peak_offset};
use crate::dataset::recording::Recording;

/// Largest lag that is looked for, in seconds.
const REACH_S: f64 = 1.0;
/// Pairs of label and movement that a lag needs.
const MIN_PAIRS: usize = 100;
/// Correlation that a lag needs, of the quick changes as of the whole.
const MIN_CORRELATION: f64 = 0.5;
/// Half of the window of the moving mean, in seconds.
const MEAN_S: f64 = 1.0;

/// How labels and pictures fit together in time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Lag {
    /// Time from a label to the movement of the picture that fits it best, in milliseconds; negative if the picture comes
    /// first.
    pub ms: f64,
    /// Correlation of their quick changes at that lag.
    pub correlation: f64,
    /// Widths of the picture per second that the far scene moves at steering 1, by least squares.
    pub turn_at_full_lock: f64,
}

impl Lag {
    /// The lag of a recording; `None` if labels and pictures have too little in common to tell, as where the wheel never
    /// moves quickly.
    pub fn of(recording: &Recording, frames: &[Option<Frame>]) -> Option<Lag> {
        let step_s = 1.0 / recording.rate_hz()?;
        let label = |row: usize| f64::from(recording.rows[row].steering);
        let turn = |row: usize| frames.get(row).copied().flatten().and_then(|f| f.turn).map_or(f64::NAN, f64::from);
        let rows = 0..recording.rows.len();
        let whole: [Vec<f64>; 2] = [rows.clone().map(label).collect(), rows.map(turn).collect()];
        let half = (MEAN_S / step_s).round() as usize;
        let quick = [quick_changes(recording, &whole[0], half), quick_changes(recording, &whole[1], half)];

        let reach = (REACH_S / step_s).round() as isize;
        let shifts: Vec<isize> = (-reach - 1..=reach).collect();
        let at: Vec<Option<f64>> = shifts
            .iter()
            .map(|&shift| correlate(recording, &quick, shift).map(|(correlation, _)| correlation))
            .collect();
        let value = |i: usize| at.get(i).copied().flatten();
        let known = (0..at.len()).filter_map(|i| Some((i, value(i)?)));
        let (best, correlation) = known.max_by(|a, b| a.1.total_cmp(&b.1))?;
        let (whole_correlation, turn_at_full_lock) = correlate(recording, &whole, shifts[best])?;
        let around = best.checked_sub(1).and_then(value).zip(value(best + 1));
        let offset = around.map_or(0.0, |(left, right)| peak_offset([left, correlation, right]));
        // A movement lies between its frame and the next: half a row later than the frame.
        let rows = shifts[best] as f64 + offset + 0.5;
        let believed = correlation.min(whole_correlation) >= MIN_CORRELATION;
        believed.then_some(Lag { ms: 1000.0 * rows * step_s, correlation, turn_at_full_lock })
    }
}

/// `values` less their mean over `half` rows to both sides within the session; not a number where there is none.
fn quick_changes(recording: &Recording, values: &[f64], half: usize) -> Vec<f64> {
    let mut changes = Vec::with_capacity(values.len());
    for session in &recording.sessions {
        for row in session.clone() {
            let window = &values[row.saturating_sub(half).max(session.start)..(row + half + 1).min(session.end)];
            let (sum, count) = window
                .iter()
                .filter(|value| value.is_finite())
                .fold((0.0, 0usize), |(sum, count), value| (sum + value, count + 1));
            changes.push(if count > half { values[row] - sum / count as f64 } else { f64::NAN });
        }
    }
    changes
}

/// Correlation of the first series with the second `shift` rows later, and the slope of the second over the first.
fn correlate(recording: &Recording, [first, second]: &[Vec<f64>; 2], shift: isize) -> Option<(f64, f64)> {
    let (mut n, mut sums, mut squares, mut product) = (0usize, [0.0; 2], [0.0; 2], 0.0);
    for session in &recording.sessions {
        for row in session.clone() {
            let Some(later) = row.checked_add_signed(shift).filter(|later| session.contains(later)) else { continue };
            let (a, b) = (first[row], second[later]);
            if a.is_finite() && b.is_finite() {
                n += 1;
                sums = [sums[0] + a, sums[1] + b];
                squares = [squares[0] + a * a, squares[1] + b * b];
                product += a * b;
            }
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
            let frame = |i: isize| Frame {
                size: [160, 320],
                brightness: 90.0,
                turn: Some(0.8 * label(i - delay)),
                frozen: false,
                copy_of: None,
            };
            let frames: Vec<_> = (0..400).map(|i| Some(frame(i))).collect();
            let lag = Lag::of(&recording, &frames).unwrap();
            assert!((lag.ms - (100.0 * delay as f64 + 50.0)).abs() < 12.0, "{delay}: {lag:?}");
            assert!(lag.correlation > 0.99 && (lag.turn_at_full_lock - 0.8).abs() < 0.02, "{lag:?}");
        }
    }

    #[test]
    fn smooth_driving_does_not_tell() {
        // A bend of a minute, followed with a delay of half a second and a tremble of its own: any lag fits.
        let label = |i: f32| (i * 0.0105).sin() * 0.4;
        let labels: Vec<f32> = (0..600).map(|i| label(i as f32)).collect();
        let recording = recording_of(&labels, 100);
        let turn =
            |i: u32| label(i as f32 - 5.0) + 0.02 * ((i.wrapping_mul(2_654_435_761) >> 16) as f32 / 65_536.0 - 0.5);
        let frame =
            |i| Some(Frame { size: [160, 320], brightness: 90.0, turn: Some(turn(i)), frozen: false, copy_of: None });
        let frames: Vec<_> = (0..600).map(frame).collect();
        assert_eq!(Lag::of(&recording, &frames), None);
    }

    #[test]
    fn unrelated_or_absent_movement_has_no_lag() {
        let labels: Vec<f32> = (0..400).map(|i| (i as f32 * 0.21).sin() * 0.4).collect();
        let recording = recording_of(&labels, 100);
        let noise = |i: u32| (i.wrapping_mul(2_654_435_761) >> 16) as f32 / 65_536.0 - 0.5;
        let frame = |turn| Some(Frame { size: [160, 320], brightness: 90.0, turn, frozen: false, copy_of: None });
        let frames: Vec<_> = (0..400).map(|i| frame(Some(noise(i)))).collect();
        assert_eq!(Lag::of(&recording, &frames), None);
        assert_eq!(Lag::of(&recording, &[frame(None); 400]), None);
    }
}
