//! What to do about what was found, in plain words.

use super::suspicious::Suspicion;
use super::{Pictures, Report, Steering, Treatment};
use crate::dataset::recording::View;
use crate::dataset::samples::{Flip, LabelKind};
use crate::dataset::unusable::Reason;

/// Share of labels that are exactly zero above which straight frames crowd out the bends.
pub(crate) const MANY_ZEROS: f64 = 0.35;
/// Share of zeros that the advised thinning leaves.
const ZEROS_LEFT: f64 = 1.0 / 3.0;
/// Turns to one side are rare below this share of all turns.
pub(crate) const RARE_SIDE: f64 = 0.25;
/// Share of labels at full lock above which driving was jerky.
pub(crate) const MUCH_FULL_LOCK: f64 = 0.05;
/// Labels of a keyboard take fewer different values than this share of the rows.
const FEW_LABELS: f64 = 0.02;
/// Below this number of rows, networks learn the road by heart.
pub(crate) const FEW_ROWS: usize = 5000;
/// Share of standing rows that is worth a word.
const MUCH_STANDING: f64 = 0.01;
/// A picture follows its label by this much, in milliseconds, where both belong together.
const USUAL_LAG_MS: std::ops::RangeInclusive<f64> = -60.0..=250.0;

/// What to do before training that does what `treatment` says, the weightiest first.
pub fn advice(report: &Report, treatment: &Treatment) -> Vec<String> {
    let mut advice = Vec::new();
    advice.extend(about_unusable(report));
    if let Some(steering) = &report.steering {
        about_labels(report.format_cameras > 1, steering, treatment, &mut advice);
    }
    about_rows(report, treatment, &mut advice);
    if let Some(pictures) = &report.pictures {
        about_pictures(pictures, &mut advice);
    }
    let contradictions: f64 =
        report.suspicious.iter().filter(|s| s.what == Suspicion::Contradiction).map(|s| s.length_s).sum();
    if contradictions > 0.0 {
        advice.push(format!(
            "{contradictions:.1} s in which the label points to the other side than the car turns: look at these lines, and take \
             them out of the log if the driver was correcting a slide"
        ));
    }
    advice
}

fn about_unusable(report: &Report) -> impl Iterator<Item = String> + '_ {
    report.unusable.0.iter().map(|(reason, tally)| {
        let remedy = match reason {
            Reason::ImageMissing => "copy the whole folder IMG beside the log, or record again",
            Reason::ImageTruncated | Reason::NotAnImage => "copy these images again; the disk may have been full",
            Reason::NotAFile => "only regular files are read: put pictures there",
            Reason::LabelOutOfRange => "steering must be in [-1, 1]; say --unit if it is in another unit",
            Reason::Ambiguous => "write the log with decimal points, or with a separator that is no comma",
            Reason::TooFewFields | Reason::TooManyFields => {
                "mend or delete these lines; say with --columns what stands where if the log has other columns"
            }
            Reason::NotANumber => "mend or delete these lines",
        };
        let rows = if tally.rows == 1 { "row" } else { "rows" };
        format!("{} {rows} left out, {}: {remedy}", tally.rows, reason.text())
    })
}

fn about_labels(simulated: bool, steering: &Steering, treatment: &Treatment, advice: &mut Vec<String>) {
    let zeros = steering.zero_share;
    let rows: usize = steering.histogram.iter().sum();
    if zeros > 0.99 {
        advice.push(
            "nearly all labels are exactly zero: there is nothing to learn from; check that steering was recorded"
                .into(),
        );
        return;
    }
    let Treatment { samples, balance, labels } = treatment;
    let by_path = labels.kind == LabelKind::Path;
    // What is left of them after the thinning of the recipe.
    let zeros_kept = zeros * balance.keep_zero.unwrap_or(1.0);
    let thinned = balance.histogram_max.is_some() || zeros_kept <= MANY_ZEROS * (1.0 - zeros + zeros_kept);
    if zeros > MANY_ZEROS && !thinned && !by_path {
        let keep = ZEROS_LEFT / (1.0 - ZEROS_LEFT) * (1.0 - zeros) / zeros;
        let keep = (20.0 * keep).round().max(1.0) / 20.0;
        advice.push(format!(
            "{:.0} % of the labels are exactly zero: keep {:.0} % of them, with --set balance.keep_zero={keep}",
            100.0 * zeros,
            100.0 * keep
        ));
    }
    let (left, right) = (steering.left_share, steering.right_share);
    let turns = left + right;
    if turns > 0.01 && left.min(right) < RARE_SIDE * turns && samples.flip == Flip::None {
        let side = if left > right { "left" } else { "right" };
        let share = 100.0 * left.max(right) / turns;
        let only = if share > 99.5 {
            format!("only {side} turns")
        } else {
            format!("{share:.0} % of the turns are to the {side}")
        };
        advice.push(format!("{only}: mirror, with --set samples.flip=random, or drive the other way round as well"));
    }
    if steering.full_lock_share > MUCH_FULL_LOCK && !by_path {
        advice.push(format!(
            "{:.0} % of the labels are at full lock: drive slower, or with mouse or gamepad, so that labels say how much to steer",
            100.0 * steering.full_lock_share
        ));
    }
    if simulated && !by_path && rows > 200 && (steering.distinct as f64) < FEW_LABELS * rows as f64 {
        advice.push(format!(
            "only {} different labels, as a keyboard gives them: mouse or gamepad give smoother ones",
            steering.distinct
        ));
    }
}

fn about_rows(report: &Report, treatment: &Treatment, advice: &mut Vec<String>) {
    if report.usable > 0 && report.usable < FEW_ROWS {
        advice.push(format!(
            "{} rows are few: record more laps, in both directions, and ways back from the edge of the road",
            report.usable
        ));
    }
    let standing = report.standing_share.filter(|share| *share > MUCH_STANDING);
    if let Some(share) =
        standing.filter(|_| treatment.samples.min_throttle.is_none() && treatment.labels.kind == LabelKind::Wheel)
    {
        advice.push(format!(
            "{:.0} % of the rows stand still: leave them out, with --set samples.min_throttle=0 or by hand",
            100.0 * share
        ));
    }
    if report.format_cameras > 1 && report.usable > 0 && !report.cameras.contains(&View::Left) {
        advice.push("no side cameras: a car off its line is never seen, so record ways back to it".into());
    }
    if report.gaps.count as f64 > 0.01 * report.usable as f64 && report.gaps.count > 2 {
        advice.push(format!(
            "{} gaps in time: the computer was too slow while recording; lower its picture quality",
            report.gaps.count
        ));
    }
}

fn about_pictures(pictures: &Pictures, advice: &mut Vec<String>) {
    let Pictures { seen, undecodable, copies, frozen, lag } = *pictures;
    if undecodable > 0 {
        advice.push(format!("{undecodable} pictures cannot be decoded: copy them again, or delete their rows"));
    }
    if copies as f64 > 0.01 * seen as f64 {
        advice.push(format!("{copies} pictures are copies of earlier ones: the log, or a part of it, is there twice"));
    }
    if frozen as f64 > 0.01 * seen as f64 {
        advice.push(format!(
            "{frozen} pictures are frozen while the car moves: their labels belong to pictures that were lost"
        ));
    }
    if let Some(lag) = lag.filter(|lag| !USUAL_LAG_MS.contains(&lag.ms)) {
        advice.push(format!(
            "pictures and labels are {:.0} ms apart, usual are 0 to 200: labels stand beside the wrong pictures, or were smoothed",
            lag.ms
        ));
    }
}

#[cfg(test)]
mod tests {
    use super::super::describe::describe;
    use super::*;
    use crate::dataset::samples::Balance;
    use crate::dataset::testing::recording_of;
    use std::path::Path;

    fn advice(labels: &[f32]) -> Vec<String> {
        advice_for(labels, &Treatment::default())
    }

    fn advice_for(labels: &[f32], treatment: &Treatment) -> Vec<String> {
        describe(Path::new("x"), &recording_of(labels, 100), &[], treatment).advice
    }

    #[test]
    fn nothing_is_advised_that_the_recipe_does_already() {
        // Two thirds are zeros, the rest turns left.
        let labels: Vec<f32> = (0..6000).map(|i| if i % 3 == 0 { -0.1 - i as f32 * 1e-4 } else { 0.0 }).collect();
        let found = advice(&labels);
        assert!(found[0].contains("balance.keep_zero") && found[1].contains("samples.flip"), "{found:?}");
        let mut treatment = Treatment::default();
        treatment.samples.flip = Flip::Both;
        let found = advice_for(&labels, &treatment);
        assert!(found.len() == 1 && found[0].contains("balance.keep_zero"), "{found:?}");
        // 4000 zeros thinned to 1000 stand beside 2000 others, thinned to 3600 they are still too many.
        treatment.balance.keep_zero = Some(0.25);
        assert_eq!(advice_for(&labels, &treatment), Vec::<String>::new());
        treatment.balance.keep_zero = Some(0.9);
        assert_eq!(advice_for(&labels, &treatment).len(), 1);
        treatment.balance = Balance { histogram_bins: Some(21), histogram_max: Some(100), ..Balance::default() };
        assert_eq!(advice_for(&labels, &treatment), Vec::<String>::new());
        // The path has neither the zeros nor the few labels of a keyboard.
        let mut treatment = Treatment::default();
        treatment.samples.flip = Flip::Both;
        treatment.labels.kind = LabelKind::Path;
        assert_eq!(advice_for(&labels, &treatment), Vec::<String>::new());
    }

    #[test]
    fn advice_names_the_figure_and_the_remedy() {
        let mut labels: Vec<f32> = (0..440).map(|i| -0.05 - i as f32 * 0.001).collect();
        labels.extend([0.0; 560]);
        let found = advice(&labels);
        assert_eq!(
            found[0],
            "56 % of the labels are exactly zero: keep 40 % of them, with --set balance.keep_zero=0.4"
        );
        assert!(found[1].starts_with("only left turns: mirror, with --set samples.flip=random"), "{found:?}");
        assert!(found[2].starts_with("1000 rows are few"), "{found:?}");
        // 560 of 1000 zeros, 40 % kept: 224 of 664, a third.
        assert!((224.0f64 / 664.0 - 1.0 / 3.0).abs() < 0.01);
    }

    #[test]
    fn a_good_recording_needs_no_advice() {
        let labels: Vec<f32> =
            (0..6000).map(|i| (i as f32 * 0.05).sin() * 0.3 + (i as f32 * 0.0011).sin() * 0.1).collect();
        assert_eq!(advice(&labels), Vec::<String>::new());
    }

    #[test]
    fn keyboards_and_full_lock_are_recognised() {
        let labels: Vec<f32> = (0..6000).map(|i| [0.2, -0.2, 1.0, -1.0][i % 4]).collect();
        let found = advice(&labels);
        assert!(
            found[0].starts_with("50 % of the labels are at full lock") && found[1].starts_with("only 4 different"),
            "{found:?}"
        );
        assert!(advice(&[0.0; 6000])[0].contains("nothing to learn"));
    }
}
