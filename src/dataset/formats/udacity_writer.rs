//! Writing what the module `udacity` reads: lines of a `driving_log.csv`, and names of pictures that carry their time.

use std::fmt::Display;
use std::io::{self, Write};

/// The first line of a log with a header.
pub const HEADER: &str = "center,left,right,steering,throttle,brake,speed\n";

/// The first line of a log that says in a last column who steered: `user` or `pilot`.
pub const HEADER_WITH_MODE: &str = "center,left,right,steering,throttle,brake,speed,mode\n";

/// Milliseconds from 1970-01-01 to 10000-01-01, where names end.
const YEAR_10000_MS: u64 = 253_402_300_800_000;

/// Writes a line: the pictures of the centre, left and right camera as the log names them (empty: none), then steering in
/// [-1, 1], throttle, brake (0 to 1) and speed in miles per hour, with `separator` between all of them.
///
/// # Errors
/// What `out` says.
pub fn write_row(
    out: &mut impl Write,
    separator: &str,
    pictures: [&dyn Display; 3],
    numbers: [f32; 4],
) -> io::Result<()> {
    let [center, left, right] = pictures;
    let [steering, throttle, brake, speed_mph] = numbers;
    write!(out, "{center}{separator}{left}{separator}{right}{separator}")?;
    writeln!(out, "{steering}{separator}{throttle}{separator}{brake}{separator}{speed_mph}")
}

/// Year, month, day, hour, minute and second, UTC, of `time_ms` milliseconds after 1970.
pub(crate) fn civil(time_ms: u64) -> [u64; 6] {
    // The civil calendar from days, counting years from March so that the leap day comes last (H. Hinnant).
    let days = time_ms / 86_400_000 + 719_468;
    let (era, day_of_era) = (days / 146_097, days % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let from_march = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * from_march + 2) / 5 + 1;
    let month = if from_march < 10 { from_march + 3 } else { from_march - 9 };
    let year = 400 * era + year_of_era + u64::from(month <= 2);
    [year, month, day, time_ms / 3_600_000 % 24, time_ms / 60_000 % 60, time_ms / 1000 % 60]
}

/// Name of a picture of `camera` (`center`, `left` or `right`) that was taken `time_ms` milliseconds after 1970, UTC.
pub fn picture_name(camera: &str, time_ms: u64) -> String {
    let time_ms = if time_ms < YEAR_10000_MS { time_ms } else { time_ms % 1000 };
    let [year, month, day, hour, minute, second] = civil(time_ms);
    let ms = time_ms % 1000;
    format!("{camera}_{year:04}_{month:02}_{day:02}_{hour:02}_{minute:02}_{second:02}_{ms:03}.jpg")
}

#[cfg(test)]
mod tests {
    use super::super::udacity::time_of;
    use super::*;

    #[test]
    fn names_carry_the_time_in_utc() {
        assert_eq!(picture_name("center", 0), "center_1970_01_01_00_00_00_000.jpg");
        // `date -u -d @1709210096` is 2024-02-29 12:34:56.
        assert_eq!(picture_name("left", 1_709_210_096_789), "left_2024_02_29_12_34_56_789.jpg");
        assert_eq!(picture_name("center", u64::MAX), "center_1970_01_01_00_00_00_615.jpg");
        for day in (0..2_932_896).step_by(17) {
            let time_ms = day * 86_400_000 + day % 86_400_000;
            assert_eq!(time_of(&picture_name("center", time_ms)), Some(time_ms as i64));
        }
    }

    #[test]
    fn rows_are_written_in_the_order_of_the_columns() {
        let mut text = Vec::new();
        write_row(&mut text, ", ", [&"IMG/a.jpg", &"", &""], [-0.25, 1.0, 0.0, 7.5e-5]).unwrap();
        assert_eq!(String::from_utf8(text).unwrap(), "IMG/a.jpg, , , -0.25, 1, 0, 0.000075\n");
        assert_eq!(HEADER.trim_end().split(',').count(), 7);
    }
}
