//! Charts of steering that several pages share.

use crate::dataset::Recording;
use crate::report::charts::chart::{Axis, Chart, Mark};
use crate::report::charts::palette;

/// Number of bins of a histogram of labels in [-1, 1]; the middle bin is centred at 0.
const BINS: usize = 41;

/// Driving time at each row, s. Sessions follow each other with one second between them.
pub fn driven_times(recording: &Recording) -> Vec<f64> {
    let mut times = vec![0.0; recording.rows.len()];
    let mut begin = 0.0;
    for session in &recording.sessions {
        for row in session.clone() {
            times[row] = begin + recording.session_s(&(session.start..row + 1));
        }
        begin += recording.session_s(session) + 1.0;
    }
    times
}

/// A histogram of labels, those that are exactly zero in a colour of their own. Labels beyond ±1 widen the axis.
pub fn histogram(title: &str, size: [f64; 2], what: &str, labels: &[f32]) -> String {
    let beyond = labels.iter().fold(1.0f64, |most, label| most.max(f64::from(label.abs())));
    let width = 2.0 * beyond / BINS as f64;
    let (mut bins, mut zeros) = ([0usize; BINS], 0usize);
    for label in labels {
        let bin = ((f64::from(*label) + beyond) / width) as usize;
        bins[bin.min(BINS - 1)] += 1;
        zeros += usize::from(*label == 0.0);
    }
    let centre = |bin: usize| (bin as f64 + 0.5) * width - beyond;
    let all = (0..BINS).map(|bin| [centre(bin), bins[bin] as f64]).collect();
    let share = 100.0 * zeros as f64 / labels.len().max(1) as f64;
    let x = Axis::new("steering, −1 = full lock left, +1 = right").range(-beyond, beyond);
    let mut chart =
        Chart::new(title, size, x, Axis::new(what.to_string())).add("", palette::BLUE, Mark::Bars { width }, all);
    if zeros > 0 {
        let name = format!("exactly 0: {share:.0} %");
        chart = chart.add(&name, palette::ORANGE, Mark::Bars { width }, vec![[0.0, zeros as f64]]);
    }
    chart.draw()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::testing::recording_of;

    #[test]
    fn sessions_follow_each_other_a_second_apart() {
        let mut recording = recording_of(&[0.0; 6], 100);
        recording.rows[3..].iter_mut().for_each(|row| row.time_ms += 1_000_000);
        recording.sessions = vec![0..3, 3..6];
        let times = driven_times(&recording);
        assert!(times.iter().zip([0.0, 0.1, 0.2, 1.2, 1.3, 1.4]).all(|(a, b)| (a - b).abs() < 1e-9), "{times:?}");
    }

    #[test]
    fn a_histogram_names_the_share_of_zeros() {
        let text = histogram("t", [400.0, 300.0], "rows", &[0.0, 0.0, 0.5, -1.25]);
        assert!(text.contains("exactly 0: 50 %"), "{text}");
        assert!(roxmltree::Document::parse(&histogram("t", [400.0, 300.0], "rows", &[])).is_ok());
    }
}
