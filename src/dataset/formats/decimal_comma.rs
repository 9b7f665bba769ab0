//! Rows written where the decimal mark is a comma.
//!
//! The simulator writes numbers in the language of the system, so that with `,` as separator `-0.0858, 0.1286, 0, 12.18`
//! becomes `-0,0858,0,1286,0,12,18`. Which commas separate and which are decimal marks is found from what the four
//! values can be. Where more than one reading remains, the row is reported, not guessed.

/// Fastest plausible speed in miles per hour: the car's limit is 30, and it overshoots a little downhill.
const MAX_SPEED_MPH: f64 = 32.0;

/// All readings of `tokens` (the row from the steering on, split at every comma) as steering, throttle, brake, speed.
///
/// A reading must keep the ranges of the four values, the simulator's way of writing numbers (no leading zeros, no
/// trailing zeros of a fraction), and must not brake and accelerate at once: one axis feeds both.
pub(super) fn readings(tokens: &[&str]) -> Vec<[f64; 4]> {
    if !(4..=8).contains(&tokens.len()) {
        return Vec::new();
    }
    // Bit i of `split` says that value i was written with a decimal comma and so takes two tokens.
    (0..16_u32)
        .filter(|split| 4 + split.count_ones() as usize == tokens.len())
        .filter_map(|split| {
            let mut rest = tokens;
            let mut values = [0.0; 4];
            for (i, value) in values.iter_mut().enumerate() {
                let (used, left) = rest.split_at(if split >> i & 1 == 1 { 2 } else { 1 });
                *value = number(used)?;
                rest = left;
            }
            plausible(values).then_some(values)
        })
        .collect()
}

fn plausible([steering, throttle, brake, speed_mph]: [f64; 4]) -> bool {
    (-1.0..=1.0).contains(&steering)
        && (0.0..=1.0).contains(&throttle)
        && (0.0..=1.0).contains(&brake)
        && (0.0..=MAX_SPEED_MPH).contains(&speed_mph)
        && (throttle == 0.0 || brake == 0.0)
}

/// The number written as `[whole]` or `[whole, fraction]`, if it is written as the simulator would.
fn number(tokens: &[&str]) -> Option<f64> {
    let digits = |text: &str| !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
    let without_exponent = |text: &str| text.split(['E', 'e']).next().unwrap_or("").to_owned();
    let whole = tokens.first()?.trim();
    let unsigned = whole.strip_prefix('-').unwrap_or(whole);
    match tokens.get(1) {
        None => {
            let mantissa = without_exponent(unsigned);
            (digits(&mantissa) && (mantissa == "0" || !mantissa.starts_with('0'))).then_some(())?;
            whole.parse().ok()
        }
        Some(fraction) => {
            let mantissa = without_exponent(fraction);
            let written = digits(unsigned) && (unsigned == "0" || !unsigned.starts_with('0'));
            (written && digits(&mantissa) && !mantissa.ends_with('0')).then_some(())?;
            format!("{whole}.{fraction}").parse().ok()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(row: &str) -> Vec<[f64; 4]> {
        readings(&row.split(',').collect::<Vec<_>>())
    }

    #[test]
    fn rows_with_one_reading() {
        assert_eq!(read("-0,08581576,0,1286689,0,12,1822"), [[-0.08581576, 0.1286689, 0.0, 12.1822]]);
        assert_eq!(read("0,1,0,30,19"), [[0.0, 1.0, 0.0, 30.19]]);
        assert_eq!(read("-0,5,0,25,0,29,5"), [[-0.5, 0.25, 0.0, 29.5]]);
        assert_eq!(read("0,05,1,0,7"), [[0.05, 1.0, 0.0, 7.0]]);
        assert_eq!(read("0,25,0,125,0,7,5E-05"), [[0.25, 0.125, 0.0, 7.5e-5]]);
        assert_eq!(read("1,0,0,22"), [[1.0, 0.0, 0.0, 22.0]]);
    }

    #[test]
    fn rows_with_several_readings() {
        // Rolling: braking with 0.12 at 18 mph, or not braking at 12.18 mph.
        let both = read("-0,0858,0,0,12,18");
        assert!(both.contains(&[-0.0858, 0.0, 0.0, 12.18]) && both.contains(&[-0.0858, 0.0, 0.12, 18.0]));
        assert_eq!(read("0,5,0,0,5,5").len(), 2);
    }

    #[test]
    fn rows_with_no_reading() {
        for row in ["0,0,0", "5,5,5,5,5", "0,1,0,30,19,7,7,7,7", "a,b,c,d,e", "-1,-1,0,22,5,1", ",,,,,"] {
            assert!(read(row).is_empty(), "{row}");
        }
    }
}
