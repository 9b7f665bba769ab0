//! Shows how recordings are split into training and validation.

use super::html::Page;
use crate::dataset::leak::LeakAudit;
use crate::dataset::split::{GUARD_MS, Split};
use crate::dataset::{Flip, Item, Recording, Targets};
use crate::recipe::Recipe;
use crate::report::charts::chart::NARROW;
use crate::report::charts::palette::{BLUE, INK, ORANGE, PALE, QUIET_INK, VERMILION};
use crate::report::charts::steering::driven_times;
use crate::report::charts::svg::{Anchor, Svg, text_width};
use crate::report::tone::Tone;

/// Most recordings that are drawn; the others are counted.
const MAX_STRIPS: usize = 24;
/// Width of the drawing, pixels.
const WIDTH: f64 = 1120.0;
/// Room for the name before a strip.
const LEFT: f64 = 190.0;

/// The use of a row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum RowFate {
    Training,
    Validation,
    /// Near a validation row, and used on neither side.
    Guard,
    /// Left out for its throttle or to balance the labels.
    LeftOut,
}

impl RowFate {
    const ALL: [(RowFate, &'static str, &'static str); 4] = [
        (RowFate::Training, BLUE, "training"),
        (RowFate::Validation, ORANGE, "validation"),
        (RowFate::Guard, VERMILION, "guard, on neither side"),
        (RowFate::LeftOut, PALE, "left out (balance, throttle)"),
    ];

    fn colour(self) -> &'static str {
        RowFate::ALL[self as usize].1
    }
}

/// A split, row by row.
#[derive(Clone, Debug)]
pub struct SplitView {
    strips: Vec<Strip>,
    more: usize,
    summary: String,
    audit: LeakAudit,
    /// The labels of an epoch's training images: with cameras and mirrors, without shifts.
    pub training_labels: Vec<f32>,
}

#[derive(Clone, Debug)]
struct Strip {
    name: String,
    length_s: f64,
    /// Stretches with the same fate, from and to in seconds driven.
    stretches: Vec<(f64, f64, RowFate)>,
}

impl SplitView {
    /// What `split` makes of `recordings`, whose labels are `targets`.
    pub fn of(recordings: &[Recording], targets: &Targets, split: &Split, recipe: &Recipe) -> SplitView {
        let strips = recordings.iter().enumerate().take(MAX_STRIPS);
        SplitView {
            strips: strips.map(|(i, recording)| Strip::of(i, recording, split)).collect(),
            more: recordings.len().saturating_sub(MAX_STRIPS),
            summary: split.summary(),
            audit: LeakAudit::of(split, recordings),
            training_labels: training_labels(targets, split, recipe),
        }
    }

    /// Adds the split in words and as strips over time to `page`.
    pub fn describe(&self, page: &mut Page) {
        for line in self.summary.lines() {
            page.paragraph(&format!("{line}."));
        }
        page.drawings(&[self.figure()]);
        if self.more > 0 {
            page.paragraph(&format!("And {} more recordings.", self.more));
        }
        let tone = if self.audit.share() < 0.01 { Tone::Good } else { Tone::Warning };
        page.advice(&format!("{}.", self.audit.summary()), tone);
    }

    /// The strips for a page: on wide ground and on a phone, where names stand above their strips.
    fn figure(&self) -> String {
        let (wide, narrow) = (self.draw(WIDTH, LEFT), self.draw(NARROW, 8.0));
        format!("<figure><div class=\"wide\">{wide}</div><div class=\"narrow\">{narrow}</div></figure>\n")
    }

    fn draw(&self, width: f64, left: f64) -> String {
        let beside = left >= LEFT;
        let step = if beside { 34.0 } else { 52.0 };
        let mut svg = Svg::new(width, 88.0 + step * self.strips.len() as f64);
        let (mut x, mut y) = (left, 10.0);
        for (fate, colour, name) in RowFate::ALL {
            let needed = 40.0 + text_width(name, 13.0);
            if x > left && x + needed > width {
                (x, y) = (left, y + 19.0);
            }
            let outline = if fate == RowFate::LeftOut { format!(" stroke=\"{QUIET_INK}\"") } else { String::new() };
            svg.rect([x, y], [14.0, 14.0], &format!("fill=\"{colour}\"{outline}"));
            svg.text([x + 20.0, y + 12.0], 13.0, Anchor::Start, "", name);
            x += needed;
        }
        let longest_s = self.strips.iter().map(|strip| strip.length_s).fold(1e-9, f64::max);
        let place = |s: f64| left + s / longest_s * (width - left - 20.0);
        let above = y + 26.0;
        for (i, strip) in self.strips.iter().enumerate() {
            let mut top = above + step * i as f64;
            if beside {
                svg.text([left - 10.0, top + 16.0], 13.0, Anchor::End, "", &shortened(&strip.name, 26));
            } else {
                svg.text([left, top + 13.0], 13.0, Anchor::Start, "", &shortened(&strip.name, 44));
                top += 19.0;
            }
            for (from, to, fate) in &strip.stretches {
                let width = (place(*to) - place(*from)).max(0.6);
                svg.rect([place(*from), top], [width, 24.0], &format!("fill=\"{}\"", fate.colour()));
            }
        }
        let bottom = above + step * self.strips.len() as f64;
        let most_ticks = (width - left) / 80.0;
        let seconds = [5.0, 10.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 3600.0, 36_000.0];
        let seconds = seconds.into_iter().find(|seconds| longest_s / seconds <= most_ticks).unwrap_or(longest_s);
        for k in 0..=(longest_s / seconds) as usize {
            let at = place(k as f64 * seconds);
            svg.line([at, bottom - 6.0], [at, bottom], &format!("stroke=\"{INK}\""));
            svg.text([at, bottom + 14.0], 12.0, Anchor::Middle, "", &format!("{:.0}", k as f64 * seconds));
        }
        let quiet = format!("fill=\"{QUIET_INK}\"");
        svg.text([(left + width) / 2.0, bottom + 32.0], 13.0, Anchor::Middle, &quiet, "time driven, s");
        svg.finish()
    }
}

impl Strip {
    fn of(index: usize, recording: &Recording, split: &Split) -> Strip {
        let times = driven_times(recording);
        let mut fates = vec![RowFate::LeftOut; recording.rows.len()];
        let here = |side: &[Item]| -> Vec<usize> {
            side.iter().filter(|item| usize::from(item.recording) == index).map(|item| item.row as usize).collect()
        };
        let validation = here(&split.validation);
        // A row may be on both sides where single images are split: validation is drawn last.
        here(&split.training).into_iter().for_each(|row| fates[row] = RowFate::Training);
        for &row in &validation {
            let session = recording.sessions[recording.session_of(row)].clone();
            let near = |other: &usize| (recording.rows[*other].time_ms - recording.rows[row].time_ms).abs() <= GUARD_MS;
            let before = (session.start..row).rev().take_while(near);
            let after = (row + 1..session.end).take_while(near);
            before.chain(after).filter(|_| !split.spec.mode.leaks() && !split.whole).for_each(|other| {
                if fates[other] == RowFate::LeftOut {
                    fates[other] = RowFate::Guard;
                }
            });
        }
        validation.into_iter().for_each(|row| fates[row] = RowFate::Validation);
        let mut stretches: Vec<(f64, f64, RowFate)> = Vec::new();
        for session in &recording.sessions {
            for row in session.clone() {
                let end = times.get(row + 1).filter(|_| row + 1 < session.end).copied().unwrap_or(times[row] + 0.1);
                match stretches.last_mut() {
                    Some((_, to, fate)) if *fate == fates[row] && row > session.start => *to = end,
                    _ => stretches.push((times[row], end, fates[row])),
                }
            }
        }
        let name = recording.path.file_name().unwrap_or(recording.path.as_os_str()).to_string_lossy().into_owned();
        Strip { name, length_s: times.last().copied().unwrap_or(0.0), stretches }
    }
}

fn training_labels(targets: &Targets, split: &Split, recipe: &Recipe) -> Vec<f32> {
    let of_item = |item: &Item| -> Vec<f32> {
        item.cameras().map(|camera| recipe.samples.label(targets, *item, camera)).collect()
    };
    let times = |row: usize| split.times.get(row).map_or(1, |times| *times as usize);
    let own = split.training.iter().enumerate();
    let own: Vec<f32> =
        own.flat_map(|(row, item)| std::iter::repeat_n(of_item(item), times(row))).flatten().collect::<Vec<f32>>();
    // An epoch draws some of the simulator's at random; here they are spread evenly.
    let simulator: Vec<f32> = split.simulator.iter().flat_map(of_item).collect();
    let share = recipe.samples.simulator_share;
    let drawn = ((share / (1.0 - share) * own.len() as f64).round() as usize).min(simulator.len());
    let drawn = (0..drawn).map(|k| simulator[k * simulator.len() / drawn]);
    let labels = own.into_iter().chain(drawn);
    match recipe.samples.flip {
        Flip::None => labels.collect(),
        Flip::Both => labels.flat_map(|label| [label, -label]).collect(),
        // One in two is mirrored; for the histogram it does not matter which.
        Flip::Random => labels.enumerate().map(|(i, label)| if i % 2 == 0 { label } else { -label }).collect(),
    }
}

/// The end of a name that is too long.
fn shortened(name: &str, most: usize) -> String {
    let count = name.chars().count();
    if count <= most { name.into() } else { format!("…{}", name.chars().skip(count - most + 1).collect::<String>()) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::testing::recording_of;

    #[test]
    fn every_row_has_its_fate() {
        let labels: Vec<f32> = (0..1200).map(|i| if i % 3 == 0 { 0.0 } else { 0.3 }).collect();
        let recordings = [recording_of(&labels, 100)];
        let recipe = Recipe::find("lenet", &[]).unwrap();
        let targets = recipe.targets(&recordings, &[], &[]).unwrap();
        let (spec, samples, balance) = (&recipe.split, &recipe.samples, &recipe.balance);
        let split = crate::dataset::split::split(&recordings, &targets, spec, samples, balance, 1).unwrap();
        let view = SplitView::of(&recordings, &targets, &split, &recipe);
        let seconds = |wanted: RowFate| -> f64 {
            view.strips[0].stretches.iter().filter(|s| s.2 == wanted).map(|(from, to, _)| to - from).sum()
        };
        assert!((seconds(RowFate::Validation) - 0.1 * split.validation.len() as f64).abs() < 1e-6);
        assert!((seconds(RowFate::Training) - 0.1 * split.training.len() as f64).abs() < 1e-6);
        assert!((seconds(RowFate::LeftOut) - 0.1 * split.balanced_rows as f64).abs() < 3.0);
        assert!(split.guard_rows >= 10);
        assert!((seconds(RowFate::Guard) - 0.1 * split.guard_rows as f64).abs() < 0.3, "{}", seconds(RowFate::Guard));
        // Three cameras, no mirror; the left camera's labels are 0.25 higher.
        assert_eq!(view.training_labels.len(), 3 * split.training.len());
        assert_eq!(view.training_labels[1] - view.training_labels[0], 0.25);
    }
}
