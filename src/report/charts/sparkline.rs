//! A curve in one line of characters, for terminals.

const LEVELS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];

/// The values as blocks of eight heights, at most `width` of them; more values are averaged in groups. The scale is
/// logarithmic if all values are positive. Values that are not finite leave a blank.
pub fn sparkline(values: &[f64], width: usize) -> String {
    let group = values.len().div_ceil(width.max(1)).max(1);
    let mean = |chunk: &[f64]| chunk.iter().sum::<f64>() / chunk.len() as f64;
    let mut heights: Vec<f64> = values.chunks(group).map(mean).collect();
    if heights.iter().all(|value| !value.is_finite() || *value > 0.0) {
        heights.iter_mut().for_each(|value| *value = value.ln());
    }
    let finite = || heights.iter().copied().filter(|value| value.is_finite());
    let (low, high) = (finite().fold(f64::INFINITY, f64::min), finite().fold(f64::NEG_INFINITY, f64::max));
    let level = |value: &f64| match value {
        value if !value.is_finite() => ' ',
        _ if high - low < 1e-9 => LEVELS[3],
        value => LEVELS[((value - low) / (high - low) * 7.0).round() as usize],
    };
    heights.iter().map(level).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heights_follow_the_logarithm_of_the_values() {
        assert_eq!(sparkline(&[8.0, 4.0, 1.0], 10), "█▆▁");
        assert_eq!(sparkline(&[-1.0, 0.0, 1.0], 10), "▁▅█");
        assert_eq!(sparkline(&[2.0, f64::NAN, 2.0], 10), "▄ ▄");
        assert_eq!(sparkline(&[], 10), "");
    }

    #[test]
    fn long_curves_are_averaged_to_the_width() {
        let values: Vec<f64> = (0..1000).map(f64::from).collect();
        let line: Vec<char> = sparkline(&values, 20).chars().collect();
        assert!(line.len() == 20 && line.is_sorted());
    }
}
