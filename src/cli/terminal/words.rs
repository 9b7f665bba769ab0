//! Numbers, counts and durations as text.

/// `1 run`, `3 runs`; `noun` forms its plural with an s.
pub(crate) fn counted(count: usize, noun: &str) -> String {
    if count == 1 { format!("1 {noun}") } else { format!("{count} {noun}s") }
}

/// A duration in the two largest units that it has: `45 s`, `3 min 20 s`, `2 h 5 min`.
pub(crate) fn duration(seconds: f64) -> String {
    let seconds = seconds.max(0.0).round() as u64;
    match seconds {
        0..60 => format!("{seconds} s"),
        60..3600 => format!("{} min {} s", seconds / 60, seconds % 60),
        _ => format!("{} h {} min", seconds / 3600, seconds % 3600 / 60),
    }
}

/// A number with `decimals`, or a dash where there is none.
pub(crate) fn or_dash(value: Option<f64>, decimals: usize) -> String {
    value.map_or("-".into(), |value| format!("{value:.decimals$}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_is_no_plural_and_durations_have_two_units() {
        assert_eq!([counted(0, "run"), counted(1, "run"), counted(12, "run")], ["0 runs", "1 run", "12 runs"]);
        let said = [0.4, 59.6, 200.0, 7500.0].map(duration);
        assert_eq!(said, ["0 s", "1 min 0 s", "3 min 20 s", "2 h 5 min"]);
    }
}
