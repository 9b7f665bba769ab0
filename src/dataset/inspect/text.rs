//! The findings in words.

use std::fmt::{self, Write};

use super::STRAIGHT;
use super::lag::Lag;
use super::report::{Pictures, Report, Session, Size, Spread, Steering};
use super::suspicious::Stretch;
use crate::text::escaped;

/// Characters of the longest bar of the histogram.
const BAR: usize = 50;
/// Sessions, and suspicious stretches, listed one by one.
const LISTED: usize = 10;

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}: {}", self.path, self.format)?;
        writeln!(f, "rows      {} of {} usable", self.usable, self.rows)?;
        for (reason, tally) in &self.unusable.0 {
            writeln!(f, "          {} left out: {}", tally.rows, reason.text())?;
            for example in &tally.examples {
                writeln!(f, "            {}", escaped(example))?;
            }
        }
        let rate = self.rate_hz.map_or(String::new(), |hz| format!(", {hz:.1} rows/s"));
        let count = self.sessions.len();
        writeln!(f, "sessions  {count}, {:.1} s driven within {:.1} s{rate}", self.driven_s, self.span_s)?;
        for session in self.sessions.iter().take(LISTED) {
            let Session { first_line, rows, length_s } = session;
            writeln!(f, "          from line {first_line}: {rows} rows, {length_s:.1} s")?;
        }
        if count > LISTED {
            writeln!(f, "          and {} more", count - LISTED)?;
        }
        if self.gaps.count > 0 {
            writeln!(f, "gaps      {} within sessions, the longest {:.2} s", self.gaps.count, self.gaps.longest_s)?;
        }
        if let Some(distance_m) = self.distance_m {
            writeln!(f, "distance  {distance_m:.0} m")?;
        }
        let cameras: Vec<&str> = self.cameras.iter().map(|camera| camera.name()).collect();
        let cameras = if cameras.is_empty() { "no images".to_owned() } else { cameras.join(", ") };
        let size = match &self.sizes[..] {
            [] | [_] => self.image_size.map_or(String::new(), |[h, w]| format!("; {w}x{h} pixels")),
            sizes => {
                let of = |Size { height, width, pictures }: &Size| format!("{pictures} of {width}x{height}");
                format!("; pictures of {} sizes: {}", sizes.len(), sizes.iter().map(of).collect::<Vec<_>>().join(", "))
            }
        };
        writeln!(f, "cameras   {cameras}{size}")?;
        for (name, spread, unit) in [("throttle", self.throttle, ""), ("speed", self.speed_mph, " mph")] {
            if let Some(Spread { min, mean, max }) = spread {
                let [min, mean, max] = [min, mean, max].map(|value| fixed(value, 2));
                writeln!(f, "{name:<9} {min} to {max}{unit}, mean {mean}")?;
            }
        }
        if let Some(steering) = &self.steering {
            let Steering { spread: Spread { min, mean, max }, deviation, zero_share, full_lock_share, .. } = steering;
            let (min, mean, max) = (fixed(*min, 3), fixed(*mean, 4), fixed(*max, 3));
            writeln!(f, "steering  {min} to {max}, mean {mean}, standard deviation {deviation:.4}")?;
            let (zero, lock) = (100.0 * zero_share, 100.0 * full_lock_share);
            writeln!(
                f,
                "          {zero:.1} % exactly 0, {lock:.1} % at full lock, {} different labels",
                steering.distinct
            )?;
            let (left, right) = (100.0 * steering.left_share, 100.0 * steering.right_share);
            let straight = (100.0 - left - right).max(0.0);
            writeln!(
                f,
                "          {left:.1} % to the left, {straight:.1} % straight (within {STRAIGHT}), {right:.1} % to the right"
            )?;
            f.write_str(&bars(&steering.histogram))?;
        }
        if let Some(Pictures { seen, undecodable, copies, frozen, lag }) = &self.pictures {
            let and = |count: &usize, what: &str| if *count > 0 { format!(", {count} {what}") } else { String::new() };
            let (bad, copies) = (and(undecodable, "cannot be decoded"), and(copies, "copies of earlier files"));
            let frozen = and(frozen, "frozen while the car moves");
            writeln!(f, "pictures  {seen} looked at{bad}{copies}{frozen}")?;
            match lag {
                Some(Lag { ms, correlation, .. }) => writeln!(
                    f,
                    "          they follow the labels by {} ms (correlation of steering and movement {})",
                    fixed(*ms, 0),
                    fixed(*correlation, 2)
                )?,
                None => writeln!(
                    f,
                    "          how well labels and pictures fit in time cannot be told from this recording"
                )?,
            }
        }
        if let Some(share) = self.standing_share.filter(|share| *share > 0.0) {
            writeln!(f, "standing  {:.1} % of the rows", 100.0 * share)?;
        }
        for Stretch { what, lines: [first, last], length_s, .. } in self.suspicious.iter().take(LISTED) {
            writeln!(f, "look at   lines {first} to {last}: {} ({length_s:.1} s)", what.text())?;
        }
        if self.suspicious.len() > LISTED {
            writeln!(f, "          and {} more stretches", self.suspicious.len() - LISTED)?;
        }
        self.notices.iter().try_for_each(|notice| writeln!(f, "note      {notice}"))?;
        self.advice.iter().try_for_each(|advice| writeln!(f, "advice    {advice}"))
    }
}

/// The histogram in characters; bins between the outermost filled ones that are empty are shown as well.
fn bars(histogram: &[usize]) -> String {
    let most = histogram.iter().copied().max().unwrap_or(0).max(1);
    let filled = |i: &usize| histogram[*i] > 0;
    let first = (0..histogram.len()).find(filled).unwrap_or(0);
    let last = (0..histogram.len()).rfind(filled).unwrap_or(0);
    let mut text = String::new();
    for (i, &count) in histogram.iter().enumerate().take(last + 1).skip(first) {
        let centre = (i as f64 - 10.0) / 10.0;
        let bar = "#".repeat((count * BAR).div_ceil(most));
        // Writing to a string cannot fail.
        let _ = writeln!(text, "{}", format!("          {centre:+.1} {count:>7} {bar}").trim_end());
    }
    text
}

/// `value` with `decimals`, and no sign before zero.
fn fixed(value: f64, decimals: usize) -> String {
    let text = format!("{value:.decimals$}");
    match text.strip_prefix('-') {
        Some(zero) if zero.bytes().all(|byte| matches!(byte, b'0' | b'.')) => zero.to_owned(),
        _ => text,
    }
}
