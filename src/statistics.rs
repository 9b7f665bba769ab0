//! Figures of distributions that several rooms report.

/// The value that the share `q` (0 to 1) of the sorted values do not exceed; 0 for none.
pub fn quantile(sorted: &[f64], q: f64) -> f64 {
    let at = ((sorted.len() as f64 - 1.0).max(0.0) * q).round() as usize;
    sorted.get(at).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles() {
        let values: Vec<f64> = (0..=100).map(f64::from).collect();
        assert_eq!((quantile(&values, 0.95), quantile(&values, 1.0), quantile(&[], 0.5)), (95.0, 100.0, 0.0));
    }
}
